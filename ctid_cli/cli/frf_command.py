"""``ctid frf``."""

from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import emit, guarded, refuse_overwriting, write_files
from ctid_cli.cli._options import FormatOptions, RecordOptions, flag
from ctid_cli.errors import UsageError
from ctid_cli.signals.treatment import Hold, ResponseMethod


@guarded
def frf(
    files: Annotated[
        list[Path],
        typer.Argument(metavar="FILE", help="Record (.csv, .mat, .h5); several: realisations of one input."),
    ],
    columns: RecordOptions,
    form: FormatOptions,
    method: Annotated[ResponseMethod, flag("--method", "How the response is estimated.")] = "auto",
    period: Annotated[int | None, flag("--period", "Period of the input, if it is not found.", "SAMPLES")] = None,
    width: Annotated[int | None, flag("--width", "Half-width of the local polynomials, 4 or more.", "LINES")] = None,
    segment: Annotated[int | None, flag("--segment", "Length of the segments of Welch's method.", "SAMPLES")] = None,
    hold: Annotated[Hold, flag("--hold", "The input between its samples.")] = "zoh",
    out: Annotated[Path, flag("--out", "Folder for frf.csv and frf.svg.", "DIR")] = Path("."),
) -> None:
    """Estimate the frequency response of measured records.

    No model is fitted. An input that repeats itself is averaged over its periods, which gives the variance by the
    noise and, from lines without input or from several records, the level of nonlinear distortions. Any other
    record is taken by local polynomials. Writes frf.csv and frf.svg.
    """
    from ctid_cli.inference.frequency_response import estimate_frequency_response
    from ctid_cli.reporting.column_file import frame_bytes
    from ctid_cli.reporting.frf_result import FrequencyResponseResult

    written = [out / "frf.csv", out / "frf.svg"]
    refuse_overwriting(files, written)
    method = _method(method, period, width, segment)
    records = columns.read_all(files, None, hold)
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
    options: tuple[tuple[str, ResponseMethod, int | None, int], ...] = (
        ("--period", "periodic", period, 2),
        ("--width", "local-polynomial", width, 4),
        ("--segment", "welch", segment, 1),
    )
    owners: list[ResponseMethod] = []
    for name, owner, value, least in options:
        if value is None:
            continue
        if method not in ("auto", owner):
            raise UsageError(f"{name} belongs to --method {owner}, not to {method}")
        if value < least:
            raise UsageError(f"{name} must be {least} or more, not {value}")
        owners.append(owner)
    if len(owners) > 1:
        raise UsageError(f"--period, --width and --segment belong to different methods: {' and '.join(owners)}")
    return owners[0] if owners else method
