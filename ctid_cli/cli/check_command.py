"""``ctid check``."""

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ctid_cli.cli._common import emit, guarded
from ctid_cli.cli._options import FormatOptions, RecordOptions, flag
from ctid_cli.errors import MismatchError
from ctid_cli.signals.treatment import AskedHold

if TYPE_CHECKING:
    from ctid_cli.signals.measurement import Measurement


@guarded
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Measured record (.csv, .mat, .h5).")],
    columns: RecordOptions,
    form: FormatOptions,
    hold: Annotated[AskedHold, flag("--hold", "The input between its samples.")] = "auto",
    strict: Annotated[bool, flag("--strict", "Exit code 7 if there is a PROBLEM.")] = False,
) -> None:
    """State facts on a measured record, and the fit to begin with.

    Clock, gaps, input, saturation, outliers; signal-to-noise ratio, response time, delay; offset, drift, start from
    rest and feedback, tested beside the response to the input in noise of any colour. Columns are found by their usual
    names (t, u, y) unless named.
    """
    from ctid_cli.identification.choice import Given
    from ctid_cli.identification.choose import choose
    from ctid_cli.inference.record_facts import record_facts
    from ctid_cli.reporting.record_result import RecordCheckResult

    measured = columns.read(file, "zoh" if hold == "auto" else hold)
    facts = record_facts(measured.record)
    result = RecordCheckResult(measured, facts)
    if result.worst != "problem":
        choice = choose(measured.record, Given(hold=hold), measured.time_unit or "s")
        result = replace(result, command=command_of(measured, choice.words()) if choice.seen else None)
    emit(result, form.form)
    if strict and result.worst == "problem":
        raise MismatchError(f"{file}: no model can be identified from this record as it is")


def command_of(measured: "Measurement", chosen: Sequence[str]) -> str:
    """Return the fit of a record by what was chosen, with the columns and the part that were asked for."""
    from ctid_cli.signals.table import ROLES, USUAL_NAMES, split_header

    words = ["ctid", "fit", measured.record.name]
    for role in ROLES:
        name = split_header(getattr(measured, role))[0]
        if name.lower() not in USUAL_NAMES[role][:2] and Path(measured.record.name).suffix.lower() != ".mat":
            words += [f"--{role}", name]
    words += chosen
    for option, value in (("--from", measured.start), ("--to", measured.stop)):
        words += [] if value is None else [option, f"{value:.12g}"]
    return shlex.join(words)
