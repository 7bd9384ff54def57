"""Sound files: their channels as columns of a table, and their clock."""

import os
import warnings
import wave
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.signals.files import require_file
from ctid_cli.signals.table import Table

#: A sampling rate [Hz] and its samples, one row for each instant.
Sound = tuple[int, NDArray[Any]]


def is_sound(path: str | os.PathLike[str]) -> bool:
    """Whether the name of a file is that of a sound."""
    return Path(path).suffix.lower() in READERS


def read_sound(path: str | os.PathLike[str]) -> tuple[Table, float, str]:
    """Channels of a sound file, its sampling rate [Hz], and a note."""
    file = require_file(path)
    suffix = Path(path).suffix.lower()
    read, form = READERS[suffix]
    try:
        rate, data = read(path)
    except DataError:
        raise
    except OSError as error:
        raise DataError(f"{file}: cannot be read: {error.strerror or error}") from None
    except Exception:  # the reader meets damaged files with whatever its parser stumbles over
        raise DataError(f"{file}: this is not a {form}, or a damaged one") from None
    channels = np.asarray(data).reshape(len(data), -1)
    if channels.size == 0 or rate <= 0:
        raise DataError(f"{file}: the file holds no samples")
    names = tuple(f"channel {k + 1}" for k in range(channels.shape[1]))

    def convert(name: str) -> Array:
        # Whole numbers become fractions of full scale; those of eight bits are not signed.
        kind, scaled = channels.dtype, channels[:, names.index(name)].astype(np.float64)
        if kind == np.uint8:
            scaled -= 128.0
            scaled /= 128.0
        elif kind.kind == "i":
            scaled /= float(np.iinfo(kind).max) + 1.0
        return scaled

    note = f"Sound of {rate} Hz; amplitudes are fractions of full scale."
    if len(names) > 1:
        note += f" The first of {len(names)} channels is used unless --signal names another."
    return Table(file, names, convert, None, "channel"), float(rate), note


def _read_wav(path: str | os.PathLike[str]) -> Sound:
    usual = _read_usual_wav(path)
    if usual is not None:
        return usual
    from scipy.io import wavfile  # slow to import: it brings sparse matrices

    with warnings.catch_warnings():
        # Chunks with titles and the like are no concern of the samples.
        warnings.simplefilter("ignore", wavfile.WavFileWarning)
        rate, data = wavfile.read(path)
    return int(rate), data


def _read_usual_wav(path: str | os.PathLike[str]) -> Sound | None:
    """A sound of 16 bits that is whole; None if it is another."""
    try:
        with wave.open(os.fspath(path), "rb") as file:
            if file.getsampwidth() != 2:
                return None
            rate, count, channels = file.getframerate(), file.getnframes(), file.getnchannels()
            content = file.readframes(count)
    except (wave.Error, EOFError):
        return None
    whole = len(content) == 2 * channels * count
    return (rate, np.frombuffer(content, "<i2").reshape(count, channels)) if whole else None


def _read_flac(path: str | os.PathLike[str]) -> Sound:
    try:
        import soundfile
    except (ImportError, OSError):  # an OSError where the library that it needs is not there
        how = "pip install 'ctid[sound]' adds what reads it, or save the sound as .wav"
        raise DataError(f"{os.fspath(path)}: a FLAC file needs the package soundfile: {how}") from None
    data, rate = soundfile.read(os.fspath(path), dtype="int32", always_2d=True)
    return int(rate), data


#: What reads a file, by the end of its name, and what it should be.
READERS: dict[str, tuple[Callable[[str | os.PathLike[str]], Sound], str]] = {
    **dict.fromkeys((".wav", ".wave"), (_read_wav, "WAV file of plain samples")),
    ".flac": (_read_flac, "FLAC file"),
}
