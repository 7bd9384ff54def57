"""``ctid track``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ctid_cli.cli._common import emit, given_command, guarded, refuse_overwriting, write_files
from ctid_cli.cli._options import FormatOptions, From, TimeColumn, To
from ctid_cli.cli._progress import RecordProgress
from ctid_cli.errors import UsageError

if TYPE_CHECKING:
    from ctid_cli.signals.sampled_signal import SampledSignal
    from ctid_cli.storage.track_file import Reading
    from ctid_cli.tones.track import Track


@dataclass(frozen=True)
class SignalOptions:
    """Which column and which part of a recorded signal is used, and its clock."""

    time: TimeColumn = None
    signal: Annotated[str | None, typer.Option("--signal", metavar="NAME", help="Column or channel to use.")] = None
    interval: Annotated[float | None, typer.Option("--interval", metavar="SECONDS", help="Sampling interval.")] = None
    rate: Annotated[float | None, typer.Option("--rate", metavar="HERTZ", help="In place of the interval.")] = None
    start: From = None
    stop: To = None

    def reading(self) -> Reading:
        """Return how the signal is read from its file."""
        from ctid_cli.storage.track_file import Reading

        if self.interval is not None and self.rate is not None:
            raise UsageError("--interval and --rate say the same; give one of them")
        for name, value in (("--interval", self.interval), ("--rate", self.rate)):
            if value is not None and not (0 < value < math.inf and 1.0 / value < math.inf):
                raise UsageError(f"{name} must be a positive number, not {value:g}")
        for name, value in (("--from", self.start), ("--to", self.stop)):
            if value is not None and not math.isfinite(value):
                raise UsageError(f"{name} must be an instant, not {value:g}")
        interval = self.interval if self.rate is None else 1.0 / self.rate
        return Reading(self.time, self.signal, interval, self.start, self.stop)


@dataclass(frozen=True)
class ToneOptions:
    """How tones are followed; None where it is chosen from the record."""

    tones: Annotated[str, typer.Option("--tones", metavar="N", help="Number of sinusoids, or auto.")] = "auto"
    every: Annotated[
        float | None, typer.Option("--every", metavar="SECONDS", help="Time between rows; about 1000 rows by default.")
    ] = None
    window: Annotated[float | None, typer.Option("--window", metavar="SECONDS", help="Length of the windows.")] = None
    accuracy: Annotated[
        float | None,
        typer.Option(
            "--accuracy",
            metavar="HZ",
            help="Rows with a larger standard error are not valid; .001 of the tone's frequency if not given.",
        ),
    ] = None

    def require_sensible(self) -> None:
        """Refuse what no tones can be followed with."""
        from ctid_cli.tones.constants import MOST_ASKED

        for name, value in (("--every", self.every), ("--window", self.window)):
            if value is not None and not 0 < value < math.inf:
                raise UsageError(f"{name} must be a positive number of seconds, not {value:g}")
        if self.accuracy is not None and not 0 < self.accuracy < math.inf:
            raise UsageError(f"--accuracy must be a positive number of hertz, not {self.accuracy:g}")
        if self.tones != "auto" and not (self.tones.isdecimal() and int(self.tones) <= MOST_ASKED):
            raise UsageError(f"--tones must be a number from 0 to {MOST_ASKED}, or auto, not {self.tones!r}")

    def follow(self, record: SampledSignal) -> Track:
        """Return the track of a record."""
        from ctid_cli.tones.track import track as follow

        tones = None if self.tones == "auto" else int(self.tones)
        try:
            with RecordProgress(Path(record.file).name) as tell:
                return follow(record, tones, self.accuracy, self.every, self.window, on_progress=tell)
        except ValueError as error:
            raise UsageError(str(error)) from None


@guarded
def track(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(metavar="SIGNAL", help="Recorded signal (.csv, .mat, .wav, .flac).")],
    part: SignalOptions,
    options: ToneOptions,
    form: FormatOptions,
    hdf5: Annotated[bool, typer.Option("--hdf5", help="Write track.h5 in place of track.csv.")] = False,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the track and its figure.")] = Path("."),
) -> None:
    """Follow the frequencies of a recorded sum of sinusoids.

    Prints the frequency of each tone, how well it is known, how far it moves, and for how much of the time it can be
    trusted; writes everything over time to track.csv (or track.h5), track.svg and track.json, which ctid report makes
    a page of. All the rest is chosen from the record, and printed.
    """
    reading = part.reading()
    options.require_sensible()
    written = [out / f"track.{'h5' if hdf5 else 'csv'}", out / "track.svg", out / "track.json"]
    refuse_overwriting([file], written)
    record = reading.read(file)
    _require_part(record, reading)
    from ctid_cli.reporting.figures.style import load_matplotlib

    load_matplotlib()
    found = options.follow(record)
    from ctid_cli.canonical import plain
    from ctid_cli.reporting.column_file import frame_bytes, hdf5_bytes
    from ctid_cli.reporting.track_result import TrackResult
    from ctid_cli.storage.track_file import track_file_text

    result = TrackResult(found, record, options.accuracy)
    text = track_file_text(found, plain(result.content()), file, reading, out, given_command(context))
    table = (hdf5_bytes if hdf5 else frame_bytes)(result.to_frame())
    write_files(dict(zip(written, (table, result.drawing().saved(), text.encode() + b"\n"), strict=True)))
    emit(result, form.form, written)


def _require_part(record: SampledSignal, reading: Reading) -> None:
    """Refuse a part that is too short, which is often one in another unit of time."""
    from ctid_cli.tones.constants import FEWEST

    if record.samples.size < FEWEST and not (reading.start is None and reading.stop is None):
        end = record.start + (record.samples.size - 1) * record.interval
        part = f"--from and --to leave {record.samples.size} samples, from {record.start:.6g} to {end:.6g} s"
        raise UsageError(f"{part}; there must be {FEWEST}. Both are in the unit of the file's times")
