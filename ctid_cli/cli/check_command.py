"""``ctid check``."""

from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import emit, guarded
from ctid_cli.cli._options import FormatOptions, RecordOptions
from ctid_cli.errors import MismatchError
from ctid_cli.signals.treatment import AskedHold


@guarded
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Measured record (.csv, .mat, .h5).")],
    columns: RecordOptions,
    form: FormatOptions,
    hold: Annotated[AskedHold, typer.Option("--hold", help="The input between its samples.")] = "auto",
    strict: Annotated[bool, typer.Option("--strict", help="Exit code 7 if there is a PROBLEM.")] = False,
) -> None:
    """Check a measured record, and propose a model to begin with.

    Sampling, gaps, excitation, offsets, trends, bandwidth against the sampling frequency, and a hint of the delay: what
    is wrong with these data, the worst first; then a structure to begin with, by a short search of at most four poles.
    Columns are found by their usual names (t, u, y) unless named.
    """
    from ctid_cli.identification.choice import Given
    from ctid_cli.identification.choose import choose
    from ctid_cli.reporting.record_findings import check_record_quality
    from ctid_cli.reporting.record_result import RecordCheckResult

    measured = columns.read(file, "zoh" if hold == "auto" else hold)
    units = measured.time_unit or "s", measured.input_unit or "", measured.output_unit or ""
    report = check_record_quality(measured.record, *units)
    choice = None if report.worst == "problem" else choose(measured.record, Given(hold=hold))
    emit(RecordCheckResult(measured, report, choice if choice and choice.seen else None), form.form)
    if strict and report.worst == "problem":
        raise MismatchError(f"{file}: no model can be identified from this record as it is")
