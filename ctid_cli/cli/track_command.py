"""``ctid track``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ctid_cli.cli._common import emit, given_command, guarded, refuse_overwriting, write_files
from ctid_cli.cli._options import FormatOptions, From, TimeColumn, To, flag, positive
from ctid_cli.errors import UsageError

if TYPE_CHECKING:
    from ctid_cli.signals.sampled_signal import SampledSignal
    from ctid_cli.storage.track_file import Reading
    from ctid_cli.tones.track import Track


@dataclass(frozen=True)
class SignalOptions:
    """Column and part of a recorded signal to use, and its clock."""

    time: TimeColumn = None
    signal: Annotated[str | None, flag("--signal", "Column or channel to use.", "NAME")] = None
    interval: Annotated[float | None, flag("--interval", "Sampling interval.", "SECONDS", parser=positive)] = None
    rate: Annotated[float | None, flag("--rate", "In place of the interval.", "HERTZ", parser=positive)] = None
    start: From = None
    stop: To = None

    def reading(self) -> Reading:
        """Return the options for reading the signal from its file."""
        from ctid_cli.storage.track_file import Reading

        if self.interval is not None and self.rate is not None:
            raise UsageError("--interval and --rate say the same; give one of them")
        interval = self.interval if self.rate is None else 1.0 / self.rate
        return Reading(self.time, self.signal, interval, self.start, self.stop)


@dataclass(frozen=True)
class ToneOptions:
    """Options for following tones; what is None is chosen from the record."""

    tones: Annotated[str, flag("--tones", "Number of sinusoids, or auto.", "N")] = "auto"
    every: Annotated[
        float | None, flag("--every", "Time between rows; about 1000 rows by default.", "SECONDS", parser=positive)
    ] = None
    window: Annotated[float | None, flag("--window", "Length of the windows.", "SECONDS", parser=positive)] = None
    accuracy: Annotated[
        float | None,
        flag(
            "--accuracy", "Largest standard error of a valid row; .001 of its tone if not given.", "HZ", parser=positive
        ),
    ] = None

    def follow(self, record: SampledSignal) -> Track:
        """Return the track of a record."""
        from ctid_cli.tones.constants import MOST_TONES
        from ctid_cli.tones.track import track as follow

        if self.tones != "auto" and not (self.tones.isdecimal() and int(self.tones) <= MOST_TONES):
            raise UsageError(f"--tones must be a number from 0 to {MOST_TONES}, or auto, not {self.tones!r}")
        tones = None if self.tones == "auto" else int(self.tones)
        try:
            return follow(record, tones, self.accuracy, self.every, self.window)
        except ValueError as error:
            raise UsageError(str(error)) from None


@guarded
def track(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(metavar="SIGNAL", help="Recorded signal (.csv, .mat, .wav, .flac).")],
    part: SignalOptions,
    options: ToneOptions,
    form: FormatOptions,
    hdf5: Annotated[bool, flag("--hdf5", "Write track.h5 in place of track.csv.")] = False,
    out: Annotated[Path, flag("--out", "Folder for the track and its figure.", "DIR")] = Path("."),
) -> None:
    """Follow the frequencies of a recorded sum of sinusoids.

    Prints the frequency of each tone, its standard error, its variation, and the share of time in which it is valid;
    writes all values over time to track.csv (or track.h5), track.svg and track.json, from which ctid report makes a
    page. Other settings are chosen from the record, and printed.
    """
    reading = part.reading()
    written = [out / f"track.{'h5' if hdf5 else 'csv'}", out / "track.svg", out / "track.json"]
    refuse_overwriting([file], written)
    record = reading.read(file)
    _require_part(record, reading)
    found = options.follow(record)
    from ctid_cli.canonical import plain
    from ctid_cli.reporting.column_file import csv_bytes, hdf5_bytes
    from ctid_cli.reporting.track_result import TrackResult
    from ctid_cli.storage.track_file import track_file_text

    result = TrackResult(found, record, options.accuracy)
    text = track_file_text(found, plain(result.content()), file, reading, out, given_command(context))
    table = (hdf5_bytes if hdf5 else csv_bytes)(result.main_table())
    write_files({written[0]: table, written[2]: text.encode() + b"\n"})
    emit(result, form.form, written, draw=lambda: write_files({written[1]: result.drawing().saved()}))


def _require_part(record: SampledSignal, reading: Reading) -> None:
    """Refuse a part that is too short, often because of another unit of time."""
    from ctid_cli.tones.constants import FEWEST

    if record.samples.size < FEWEST and not (reading.start is None and reading.stop is None):
        end = record.start + (record.samples.size - 1) * record.interval
        part = f"--from and --to leave {record.samples.size} samples, from {record.start:.6g} to {end:.6g} s"
        raise UsageError(f"{part}; there must be {FEWEST}. Both are in the unit of the file's times")
