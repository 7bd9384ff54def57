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
    from ctid_cli.reporting.order_proposal import proposed_by_check
    from ctid_cli.reporting.record_findings import check_record_quality
    from ctid_cli.reporting.record_result import RecordCheckResult

    measured, why = columns.read(file, "zoh" if hold == "auto" else hold), ""
    units = measured.time_unit or "s", measured.input_unit or "", measured.output_unit or ""
    report = check_record_quality(measured.record, *units)
    if hold == "auto" and report.worst != "problem":
        from ctid_cli.reporting.hold_choice import hold_for_check

        chosen, reason = hold_for_check(measured.record, report)
        if chosen != "zoh":
            measured, why = columns.read(file, chosen), f"{reason} "
    proposal = proposed_by_check(measured.record, report)
    proposal = proposal and proposal._replace(sentence=why + proposal.sentence)
    emit(RecordCheckResult(measured, report, proposal), form.form)
    if strict and report.worst == "problem":
        raise MismatchError(f"{file}: no model can be identified from this record as it is")
