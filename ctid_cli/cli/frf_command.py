"""``ctid frf``."""

from pathlib import Path
from typing import Annotated, cast

import typer

from ctid_cli.cli._common import InputHold, emit, guarded, refuse_overwriting, write_files
from ctid_cli.cli._options import FormatOptions, RecordOptions
from ctid_cli.errors import UsageError
from ctid_cli.signals.treatment import ResponseMethod


@guarded
def frf(
    files: Annotated[
        list[Path],
        typer.Argument(metavar="FILE", help="Record (.csv, .mat, .h5); several: realisations of one input."),
    ],
    columns: RecordOptions,
    form: FormatOptions,
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
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for frf.csv and frf.svg.")] = Path("."),
) -> None:
    """Estimate the frequency response of measured records.

    No model is fitted. An input that repeats itself is averaged over its periods, which gives the variance by the
    noise and, from lines without input or from several records, the level of nonlinear distortions. Any other
    record is taken by local polynomials. Writes frf.csv and frf.svg.
    """
    from ctid_cli.inference.frequency_response import estimate_frequency_response
    from ctid_cli.reporting.column_file import frame_bytes
    from ctid_cli.reporting.frf_result import FrequencyResponseResult
    from ctid_cli.reporting.records import Records

    written = [out / "frf.csv", out / "frf.svg"]
    refuse_overwriting(files, written)
    method = _method(method, period, width, segment)
    records = Records([columns.read(file, hold) for file in files])
    found = estimate_frequency_response(
        records.data,
        method=method,
        period=period,
        half_width=width,
        segment=segment,
        time_unit=records.units.time,
    )
    result = FrequencyResponseResult(found, records)
    write_files({written[0]: frame_bytes(result.to_frame()), written[1]: result.drawing().saved()})
    emit(result, form.form, written)


def _method(method: ResponseMethod, period: int | None, width: int | None, segment: int | None) -> ResponseMethod:
    """Return the method that the options belong to, and refuse those of two methods and values that are too small."""
    given = [
        (name, owner, value, least)
        for name, owner, value, least in (
            ("--period", "periodic", period, 2),
            ("--width", "local-polynomial", width, 4),
            ("--segment", "welch", segment, 1),
        )
        if value is not None
    ]
    for name, owner, value, least in given:
        if method not in ("auto", owner):
            raise UsageError(f"{name} belongs to --method {owner}, not to {method}")
        if value < least:
            raise UsageError(f"{name} must be {least} or more, not {value}")
    if len(given) > 1:
        names = " and ".join(owner for _, owner, _, _ in given)
        raise UsageError(f"--period, --width and --segment belong to different methods: {names}")
    return cast(ResponseMethod, given[0][1]) if given else method
