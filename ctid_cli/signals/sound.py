"""Sound files: channels as columns of a table, and sampling rate."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.signals.data_checks import Rows
from ctid_cli.signals.files import require_file, require_values
from ctid_cli.signals.table import Found, Table

#: Suffixes of sound files.
SOUNDS = (".wav", ".wave", ".flac", ".aif", ".aiff", ".ogg", ".mp3")


def is_sound(path: str | os.PathLike[str]) -> bool:
    """Return whether a file name has the suffix of a sound file."""
    return Path(path).suffix.lower() in SOUNDS


def read_sound(path: str | os.PathLike[str]) -> tuple[Table, float]:
    """Return the channels of a sound file as fractions of full scale, and its sampling rate [Hz]."""
    file, kind = require_file(path), Path(path).suffix[1:].upper()
    try:
        import soundfile
    except (ImportError, OSError):  # an OSError if its C library is missing
        how = "install it with pip install 'ctid[sound]', or save the samples as text (.csv)"
        raise DataError(f"{file}: {kind} files are read with the package soundfile; {how}") from None
    try:
        with soundfile.SoundFile(os.fspath(path)) as sound:
            rate, channels = sound.samplerate, sound.channels
            require_values(f"{file}: 'samples'", sound.frames * channels)
            samples = sound.read(dtype="float64", always_2d=True)
    except (soundfile.SoundFileError, ValueError, RuntimeError):
        raise DataError(f"{file}: this is not a valid {kind} file; export the sound anew") from None
    if samples.size == 0 or rate <= 0:
        raise DataError(f"{file}: the file holds no samples")
    names = tuple(f"channel {k + 1}" for k in range(channels))

    def read(wanted: Sequence[str]) -> Found:
        return Found({name: np.ascontiguousarray(samples[:, names.index(name)]) for name in wanted}, Rows(file))

    note = f"Sound of {rate} Hz; amplitudes are fractions of full scale."
    if channels > 1:
        note += f" The first of {channels} channels is used unless --signal names another."
    return Table(file, names, read, head=file, noun="channel", notes=(note,)), float(rate)
