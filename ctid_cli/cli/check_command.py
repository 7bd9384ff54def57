"""``ctid check``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import From, InputColumn, InputHold, Json, OutputColumn, TimeColumn, To, echo_json, guarded


@guarded
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Measured record (.csv, .mat).")],
    time: TimeColumn = None,
    input: InputColumn = None,
    output: OutputColumn = None,
    hold: InputHold = "zoh",
    start: From = None,
    stop: To = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit code 7 if there is a PROBLEM.")] = False,
    as_json: Json = False,
) -> None:
    """Say what a measured record is worth, before any model.

    Sampling, gaps, excitation, offsets, trends, bandwidth against the clock, and a hint of the delay: what is wrong
    with these data, in words, the worst first. Columns are found by their usual names (t, u, y) unless named.
    """
    from ctid_cli.errors import MismatchError
    from ctid_cli.reporting.record_findings import check_record_quality
    from ctid_cli.reporting.record_report import record_object, record_text
    from ctid_cli.signals.measurement import read_measurement

    measurement = read_measurement(file, time=time, input=input, output=output, hold=hold, start=start, stop=stop)
    report = check_record_quality(
        measurement.record,
        time_unit=measurement.time_unit or "s",
        input_unit=measurement.input_unit or "",
        output_unit=measurement.output_unit or "",
    )
    if as_json:
        echo_json(record_object(measurement, report))
    else:
        typer.echo(record_text(measurement, report))
    if strict and report.worst == "problem":
        raise MismatchError(f"{file}: no model can be identified from this record as it is")
