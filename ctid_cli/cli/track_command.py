"""``ctid track``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import typer

from ctid_cli.cli._common import From, Json, TimeColumn, To, answer, given_command, guarded, write_files
from ctid_cli.cli._progress import RecordProgress
from ctid_cli.errors import UsageError

if TYPE_CHECKING:
    from ctid_cli.signals.sampled_signal import SampledSignal
    from ctid_cli.storage.track_file import Reading
    from ctid_cli.tones.track import Track


@guarded
def track(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(metavar="SIGNAL", help="Recorded signal (.csv, .mat, .wav, .flac).")],
    tones: Annotated[str, typer.Option("--tones", metavar="N", help="Number of sinusoids, or auto.")] = "auto",
    time: TimeColumn = None,
    signal: Annotated[str | None, typer.Option("--signal", metavar="NAME", help="Column or channel to use.")] = None,
    interval: Annotated[float | None, typer.Option("--interval", metavar="SECONDS", help="Sampling interval.")] = None,
    rate: Annotated[float | None, typer.Option("--rate", metavar="HERTZ", help="In place of the interval.")] = None,
    start: From = None,
    stop: To = None,
    every: Annotated[
        float | None,
        typer.Option("--every", metavar="SECONDS", help="One row every so often; about 1000 if not given."),
    ] = None,
    window: Annotated[float | None, typer.Option("--window", metavar="SECONDS", help="Length of the windows.")] = None,
    accuracy: Annotated[
        float | None,
        typer.Option(
            "--accuracy",
            metavar="HZ",
            help="Rows with a larger standard error are not valid; .001 of the tone's frequency if not given.",
        ),
    ] = None,
    as_json: Json = False,
    style: Annotated[Literal["csv", "h5"], typer.Option("--format", help="Form of the track.")] = "csv",
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the track and its figure.")] = Path("."),
) -> None:
    """Follow the frequencies of a recorded sum of sinusoids.

    Prints the frequency of each tone, how well it is known, how far it moves, and for how much of the time it can be
    trusted; writes everything over time to track.csv (or track.h5), track.svg and track.json, which ctid report makes
    a page of. All the rest is chosen from the record, and said.
    """
    from ctid_cli.storage.track_file import Reading

    reading = Reading(time, signal, _interval(interval, rate), start, stop)
    for name, value in (("--from", start), ("--to", stop)):
        if value is not None and not math.isfinite(value):
            raise UsageError(f"{name} must be an instant, not {value:g}")
    from concurrent.futures import ThreadPoolExecutor

    from ctid_cli.reporting.figures.style import load_matplotlib
    from ctid_cli.reporting.track_columns import track_bytes, track_table
    from ctid_cli.reporting.track_plot import track_drawing
    from ctid_cli.reporting.track_report import track_object, track_text
    from ctid_cli.storage.track_file import track_file_text
    from ctid_cli.tones.residual import with_lines_left

    data, figure, result = out / f"track.{style}", out / "track.svg", out / "track.json"
    if any(file.exists() and written.exists() and file.samefile(written) for written in (data, figure, result)):
        raise UsageError(f"{file} would be overwritten by the track; write it elsewhere (--out DIR)")
    for name, value in (("--every", every), ("--window", window)):
        if value is not None and not 0 < value < math.inf:
            raise UsageError(f"{name} must be a positive number of seconds, not {value:g}")
    if accuracy is not None and not 0 < accuracy < math.inf:
        raise UsageError(f"--accuracy must be a positive number of hertz, not {accuracy:g}")
    record = reading.read(file)
    _require_part(record, reading)
    load_matplotlib()
    found = _follow(record, Asked(_tones(tones), accuracy, every, window))
    with ThreadPoolExecutor(1) as thread:
        drawing = track_drawing(found, record.start, record.unit, file.name)
        drawn = thread.submit(drawing.saved)
        found = with_lines_left(found, record.samples, record.interval)
    files = [data, figure, result]
    content = track_object(record, found, accuracy)
    text = track_file_text(found, content, file, reading, out, given_command(context))
    table = track_bytes(track_table(found, record.start), style, record.unit)
    write_files({data: table, figure: drawn.result(), result: text.encode() + b"\n"})
    answer(
        as_json,
        lambda: content | {"written": [str(each) for each in files]},
        lambda: f"{track_text(record, found, accuracy)}\n\nWritten: {', '.join(map(str, files))}",
    )


class Asked(NamedTuple):
    """What a track is asked for; None where it is to be chosen."""

    tones: int | None
    accuracy: float | None
    every: float | None
    window: float | None


def _follow(record: SampledSignal, asked: Asked) -> Track:
    """Return the track of a record."""
    from ctid_cli.tones.track import track as follow

    try:
        with RecordProgress(Path(record.file).name) as tell:
            return follow(record, *asked, on_progress=tell)
    except ValueError as error:
        raise UsageError(str(error)) from None


def _require_part(record: SampledSignal, reading: Reading) -> None:
    """Refuse a part that is too short, which is often one in another unit of time."""
    from ctid_cli.tones.constants import FEWEST

    if record.samples.size < FEWEST and not (reading.start is None and reading.stop is None):
        end = record.start + (record.samples.size - 1) * record.interval
        part = f"--from and --to leave {record.samples.size} samples, from {record.start:.6g} to {end:.6g} s"
        raise UsageError(f"{part}; there must be {FEWEST}. Both are in the unit of the file's times")


def _tones(text: str) -> int | None:
    """The number of tones; None to have it chosen."""
    from ctid_cli.tones.constants import MOST_ASKED

    if text == "auto":
        return None
    if not text.isdecimal() or int(text) > MOST_ASKED:
        raise UsageError(f"--tones must be a number from 0 to {MOST_ASKED}, or auto, not {text!r}")
    return int(text)


def _interval(interval: float | None, rate: float | None) -> float | None:
    if interval is not None and rate is not None:
        raise UsageError("--interval and --rate say the same; give one of them")
    for name, value in (("--interval", interval), ("--rate", rate)):
        if value is not None and not (0 < value < math.inf and 1.0 / value < math.inf):
            raise UsageError(f"{name} must be a positive number, not {value:g}")
    return interval if rate is None else 1.0 / rate
