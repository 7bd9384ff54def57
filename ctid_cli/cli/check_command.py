"""``ctid check``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import Json, guarded
from ctid_cli.cli.fit_command import HoldOption


@guarded
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Measured record (.csv, .mat).")],
    time: Annotated[str | None, typer.Option("--time", metavar="COLUMN", help="Column of the times.")] = None,
    input: Annotated[str | None, typer.Option("--input", metavar="COLUMN", help="Column of the input.")] = None,
    output: Annotated[str | None, typer.Option("--output", metavar="COLUMN", help="Column of the output.")] = None,
    hold: Annotated[
        HoldOption, typer.Option("--hold", help="Input between its samples: held (zoh) or straight lines (foh).")
    ] = HoldOption.zoh,
    start: Annotated[float | None, typer.Option("--from", metavar="TIME", help="First instant to use.")] = None,
    stop: Annotated[float | None, typer.Option("--to", metavar="TIME", help="Last instant to use.")] = None,
    as_json: Json = False,
) -> None:
    """Say what a measured record is worth, before any model.

    Sampling, gaps, excitation, offsets, trends, bandwidth against the clock, and a hint of the delay: what is wrong
    with these data, in words, the worst first. Columns are found by their usual names (t, u, y) unless named.
    """
    import json

    from ctid_cli.inference.record_check import check_record_quality
    from ctid_cli.reporting.record_report import record_object, record_text
    from ctid_cli.signals.measurement import read_measurement

    measurement = read_measurement(file, time=time, input=input, output=output, hold=hold.value, start=start, stop=stop)
    report = check_record_quality(
        measurement.record,
        time_unit=measurement.time_unit or "s",
        input_unit=measurement.input_unit or "",
        output_unit=measurement.output_unit or "",
    )
    if as_json:
        typer.echo(json.dumps(record_object(measurement, report), allow_nan=False))
    else:
        typer.echo(record_text(measurement, report))
