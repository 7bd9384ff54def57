"""``ctid check``: a command of its own for a FILE, and a group of further checks beside it."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from ctid_cli.cli._common import (
    AllowCode,
    AllowOutside,
    ComputingCommand,
    Config,
    From,
    InputColumn,
    Json,
    Out,
    OutputColumn,
    Overrides,
    TimeColumn,
    To,
    answer,
    guarded,
)
from ctid_cli.cli.experiment_commands import load_plans
from ctid_cli.errors import MismatchError, UsageError
from ctid_cli.signals.treatment import AskedHold

further = typer.Typer(rich_markup_mode=None, context_settings={"help_option_names": ["-h", "--help"]})


@guarded
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Measured record (.csv, .mat, .h5).")],
    time: TimeColumn = None,
    input: InputColumn = None,
    output: OutputColumn = None,
    hold: Annotated[AskedHold, typer.Option("--hold", help="The input between its samples.")] = "auto",
    start: From = None,
    stop: To = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit code 7 if there is a PROBLEM.")] = False,
    as_json: Json = False,
) -> None:
    """Say what a measured record is worth, and which model to begin with.

    Sampling, gaps, excitation, offsets, trends, bandwidth against the clock, and a hint of the delay: what is wrong
    with these data, in words, the worst first; then a structure to begin with, by a short search of at most four poles.
    Columns are found by their usual names (t, u, y) unless named.
    """
    from ctid_cli.reporting.order_proposal import proposed_by_check
    from ctid_cli.reporting.record_findings import check_record_quality
    from ctid_cli.reporting.record_report import record_object, record_text
    from ctid_cli.signals.measurement import read_measurement

    read = partial(read_measurement, file, time=time, input=input, output=output, start=start, stop=stop)
    found = read(hold="zoh" if hold == "auto" else hold)
    units = found.time_unit or "s", found.input_unit or "", found.output_unit or ""
    report = check_record_quality(found.record, *units)
    searched, why = found, ""
    if hold == "auto" and report.worst != "problem":
        from ctid_cli.reporting.hold_choice import hold_for_check

        chosen, why = hold_for_check(found.record, report)
        searched = found if chosen == "zoh" else read(hold=chosen)
    proposal = proposed_by_check(searched.record, report)
    if proposal is not None and searched is not found:
        proposal = proposal._replace(sentence=f"{why} {proposal.sentence}")
    answer(as_json, lambda: record_object(found, report, proposal), lambda: record_text(searched, report, proposal))
    if strict and report.worst == "problem":
        raise MismatchError(f"{file}: no model can be identified from this record as it is")


@further.command("filters", cls=ComputingCommand)
@guarded
def check_filters(
    bandwidth: Annotated[float, typer.Option("--bandwidth", metavar="RAD/S", help="The system's last -3 dB crossing.")],
    largest_error: Annotated[float, typer.Option("--largest-error", metavar="SECONDS", help="Of an initial delay.")],
    filters: Annotated[int, typer.Option("--filters", metavar="N", help="Number of filters, at least 2.")] = 10,
    beta: Annotated[float, typer.Option("--beta", metavar="RATIO", help="Ratio of the periods, 1.717 to 10.")] = 10.0,
    as_json: Json = False,
) -> None:
    """Say whether a set of low-pass filters leads a delay estimate past local minima.

    A search that switches between the filters must find, from every wrong delay, one filter whose cost falls to a
    minimum closer to the true delay. The first line says PASS or NOT PASSED; then come the filters, which of them
    serves which delay error, and how many are sure to suffice. The exit code is 0 either way.
    """
    from ctid_cli.filtering import filter_set
    from ctid_cli.reporting.filter_report import filter_object, filter_text
    from ctid_cli.signals.checks import require_integer, require_positive

    try:
        require_positive("--bandwidth", bandwidth, "rad/s")
        require_positive("--largest-error", largest_error, "s")
        require_integer("--filters", filters, 2)
        chosen = filter_set.FilterSet(bandwidth, filters, beta)
        found = filter_set.check_filters(chosen.cutoffs, largest_error)
    except ValueError as error:
        raise UsageError(str(error)) from None
    answer(as_json, lambda: filter_object(chosen, found), lambda: filter_text(chosen, found))


@further.command("accuracy", cls=ComputingCommand)
@guarded
def check_accuracy(
    config: Config,
    overrides: Overrides = None,
    out: Out = Path("results"),
    allow_code: AllowCode = False,
    allow_outside: AllowOutside = False,
    as_json: Json = False,
) -> None:
    """Say how accurate the estimates of an experiment can be, before any data are taken.

    For every estimator and the swept numbers of samples: the standard error of each parameter by theory, with the
    formula that it comes from. White Gaussian excitation on a regular clock has a limit for long records; otherwise
    the sensitivities of the experiment's first data set count. Where the experiment has results in OUT, the answer ends
    with what is unexpected about them.
    """
    from ctid_cli.reporting.accuracy_report import accuracy_object, accuracy_text
    from ctid_cli.reporting.results import find_results

    ((_, plan),) = load_plans([config], overrides or [], allow_code=allow_code, allow_outside=allow_outside)
    content = accuracy_object(plan, find_results(out, plan.experiment))
    answer(as_json, lambda: content, lambda: accuracy_text(content))


class CheckCommand(ComputingCommand):
    """``ctid check FILE``, which hands over if the first word names a further check: such a file is ``./filters``."""

    further = typer.main.get_group(further).commands

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        """Parse the command line."""
        if args and args[0] in self.further:
            return self.further[args[0]].make_context(f"{info_name} {args[0]}", args[1:], parent, **extra)
        return super().make_context(info_name, args, parent, **extra)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the end of the help: the further checks."""
        with formatter.section("Further checks"):
            formatter.write_dl([(name, command.get_short_help_str(80)) for name, command in self.further.items()])
