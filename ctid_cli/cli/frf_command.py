"""``ctid frf``."""

from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import (
    From,
    InputColumn,
    InputHold,
    Json,
    OutputColumn,
    TimeColumn,
    To,
    answer,
    guarded,
    refuse_overwriting,
    write_files,
)
from ctid_cli.errors import UsageError
from ctid_cli.signals.treatment import ResponseMethod


@guarded
def frf(
    files: Annotated[
        list[Path],
        typer.Argument(metavar="FILE...", help="Record (.csv, .mat, .h5); several: realisations of one input."),
    ],
    method: Annotated[ResponseMethod, typer.Option("--method", help="How the response is estimated.")] = "auto",
    period: Annotated[
        int | None, typer.Option("--period", metavar="SAMPLES", help="Period of the input, if it is not found.")
    ] = None,
    width: Annotated[
        int | None, typer.Option("--width", metavar="LINES", help="Half-width of the local polynomials, 4 or more.")
    ] = None,
    segment: Annotated[
        int | None, typer.Option("--segment", metavar="SAMPLES", help="Length of the segments of Welch's method.")
    ] = None,
    hold: InputHold = "zoh",
    time: TimeColumn = None,
    input: InputColumn = None,
    output: OutputColumn = None,
    start: From = None,
    stop: To = None,
    as_json: Json = False,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for frf.csv and frf.svg.")] = Path("."),
) -> None:
    """Estimate the frequency response of measured records, without a model.

    An input that repeats itself is averaged over its periods, which gives the variance by the noise and, from lines
    without input or from several records, the level of nonlinear distortions. Any other record is taken by local
    polynomials. Writes frf.csv and frf.svg.
    """
    from ctid_cli.inference.frequency_response import estimate_frequency_response
    from ctid_cli.reporting.column_file import columns_bytes
    from ctid_cli.reporting.frf_plot import frf_drawing
    from ctid_cli.reporting.frf_report import frf_columns, frf_object, frf_text
    from ctid_cli.reporting.identification_report import common_units
    from ctid_cli.signals.measurement import read_measurement

    data, figure = out / "frf.csv", out / "frf.svg"
    refuse_overwriting(files, [data, figure])
    for name, value, wanted in (("--period", period, "periodic"), ("--segment", segment, "welch")):
        if value is not None and method not in ("auto", wanted):
            raise UsageError(f"{name} belongs to --method {wanted}, not to {method}")
    for name, value, least in (("--period", period, 2), ("--width", width, 4)):
        if value is not None and value < least:
            raise UsageError(f"{name} must be {least} or more, not {value}")
    if width is not None and method not in ("auto", "local-polynomial"):
        raise UsageError(f"--width belongs to --method local-polynomial, not to {method}")
    measurements = [
        read_measurement(file, time=time, input=input, output=output, hold=hold, start=start, stop=stop)
        for file in files
    ]
    units = common_units(measurements)
    found = estimate_frequency_response(
        [item.record for item in measurements],
        method=_method(method, period, width, segment),
        period=period,
        half_width=width,
        segment=segment,
        time_unit=units.time,
    )
    title = ", ".join(file.name for file in files)
    content = columns_bytes(frf_columns(found, units), "csv", {})
    write_files({data: content, figure: frf_drawing(found, units, title).saved()})
    answer(
        as_json,
        lambda: frf_object(found, measurements, units),
        lambda: frf_text(found, measurements, units),
        [data, figure],
    )


def _method(method: ResponseMethod, period: int | None, width: int | None, segment: int | None) -> ResponseMethod:
    """An option of one method asks for that method."""
    asked: dict[ResponseMethod, int | None] = {"periodic": period, "local-polynomial": width, "welch": segment}
    wanted = [name for name, value in asked.items() if value is not None]
    if len(wanted) > 1:
        raise UsageError(f"--period, --width and --segment belong to different methods: {' and '.join(wanted)}")
    return wanted[0] if wanted else method
