"""``ctid track``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ctid_cli.cli._common import From, Json, TimeColumn, To, answer, guarded, write_files
from ctid_cli.cli._progress import RecordProgress
from ctid_cli.errors import UsageError
from ctid_cli.kinds import KINDS

if TYPE_CHECKING:
    from ctid_cli.signals.sampled_signal import SampledSignal

    Method = str
else:
    Method = Literal[("automatic", *KINDS["frequency_estimator"])]


@guarded
def track(
    file: Annotated[Path, typer.Argument(metavar="SIGNAL", help="Recorded signal (.csv, .mat, .wav).")],
    tones: Annotated[int, typer.Option("--tones", help="Number of sinusoids, 1 to 8: the strongest ones.")],
    method: Annotated[Method, typer.Option("--method", help="How the frequencies are estimated.")] = "automatic",
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
    as_json: Json = False,
    style: Annotated[Literal["csv", "h5"], typer.Option("--format", help="Form of the track.")] = "csv",
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the track and its figure.")] = Path("."),
) -> None:
    """Follow the frequencies of a recorded sum of sinusoids.

    Prints the frequency of each tone, how far it moves, and for how much of the time it can be trusted; writes the
    frequencies and amplitudes over time to track.csv (or track.h5) and track.svg. All the rest is chosen from the
    record, and said.
    """
    from ctid_cli.frequency.automatic import choose_settings
    from ctid_cli.frequency.record_track import track_record
    from ctid_cli.reporting.track_plot import track_drawing
    from ctid_cli.reporting.track_report import track_bytes, track_object, track_table, track_text
    from ctid_cli.signals.sampled_signal import read_sampled_signal

    data, figure = out / f"track.{style}", out / "track.svg"
    if any(file.exists() and written.exists() and file.samefile(written) for written in (data, figure)):
        raise UsageError(f"{file} would be overwritten by the track; write it elsewhere (--out DIR)")
    given = _interval(interval, rate)
    for name, value in (("--from", start), ("--to", stop)):
        if value is not None and not math.isfinite(value):
            raise UsageError(f"{name} must be an instant, not {value:g}")
    for name, value in (("--every", every), ("--window", window)):
        if value is not None and not 0 < value < math.inf:
            raise UsageError(f"{name} must be a positive number of seconds, not {value:g}")
    record = _in_seconds(read_sampled_signal(file, time=time, signal=signal, interval=given, start=start, stop=stop))
    kind = None if method == "automatic" else method
    try:
        settings = choose_settings(record.samples, record.interval, tones, method=kind, window=window)
        with RecordProgress(file.name) as tell:
            found = track_record(record.samples, record.interval, settings, every=every, on_progress=tell)
    except ValueError as error:
        raise UsageError(str(error)) from None
    drawn = track_drawing(found, record.start, record.unit, f"{file.name}: {settings.estimator.kind}").saved()
    write_files({data: track_bytes(track_table(found, record.start), style, record.unit), figure: drawn})
    answer(
        as_json,
        lambda: track_object(record, settings, found, [data, figure]),
        lambda: f"{track_text(record, settings, found)}\n\nWritten: {data}, {figure}",
    )


def _interval(interval: float | None, rate: float | None) -> float | None:
    if interval is not None and rate is not None:
        raise UsageError("--interval and --rate say the same; give one of them")
    for name, value in (("--interval", interval), ("--rate", rate)):
        if value is not None and not (0 < value < math.inf and 1.0 / value < math.inf):
            raise UsageError(f"{name} must be a positive number, not {value:g}")
    return interval if rate is None else 1.0 / rate


def _in_seconds(record: SampledSignal) -> SampledSignal:
    from ctid_cli.reporting.estimate import SECONDS

    unit = record.time_unit or "s"
    if unit not in SECONDS:
        unknown = f"{record.file}: the unit of time, {unit!r}, is not known, so there is no frequency in Hz"
        raise UsageError(f"{unknown}; give the clock with --interval SECONDS or --rate HERTZ")
    return record.rescaled(SECONDS[unit], "s")
