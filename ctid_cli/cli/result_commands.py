"""The commands that read results: ``ctid status``, ``table``, ``show``, ``export``, ``figure`` and ``report``."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from ctid_cli.cli._common import AllowCode, Json, Out, answer, guarded, write_files
from ctid_cli.errors import MismatchError, UsageError
from ctid_cli.reporting.document import Tool


@guarded
def status(
    experiment: Annotated[str | None, typer.Argument(metavar="[EXPERIMENT]", help="Only this one, in full.")] = None,
    out: Out = Path("results"),
    as_json: Json = False,
) -> None:
    """Say what is stored and what is missing.

    Counts estimates: done, planned, failed, and those that the latest settings set aside.
    """
    from ctid_cli.inference.monte_carlo import CellPrecision
    from ctid_cli.reporting.exporting import with_list
    from ctid_cli.reporting.overview import OF_STATUS, overview_text, status_object, status_text
    from ctid_cli.reporting.results import experiments_in, read_results
    from ctid_cli.running.precision import cell_precisions
    from ctid_cli.storage.status import experiment_status

    if experiment is None:
        found = [experiment_status(out / name) for name in experiments_in(out)]
        nothing = f"There are no results in {out}. To make some: ctid run configs/quickstart.yaml"
        text = overview_text(found) if found else nothing
        lines = [json.dumps(status_object(item)) for item in found] if as_json else [text]
        for line in lines:
            typer.echo(line)
        return
    if not (out / experiment).is_dir():
        read_results(out, experiment)
    one = experiment_status(out / experiment)
    # A first run that is still going on has nothing to read yet.
    results = read_results(out, experiment) if one.done else None
    rows = () if results is None else results.rows
    cells: Sequence[CellPrecision] = ()
    if results is not None and (results.settings.get("monte_carlo") or {}).get("until"):
        cells = cell_precisions(results.manifest, results.stored.results)
    if as_json:
        for text in with_list(status_object(one, cells), "estimates", rows):
            typer.echo(text, nl=False)
    else:
        some = () if results is None else results.stored.rows(*OF_STATUS)
        typer.echo(status_text(one, some, out, cells))


@guarded
def table(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", help="Table (1, useful-redundancy/3) or experiment (quickstart)."),
    ] = None,
    style: Annotated[
        Literal["text", "md", "latex", "csv", "json"], typer.Option("--format", help="Form of output.")
    ] = "text",
    measure: Annotated[
        str | None,
        typer.Option("--measure", metavar="NAMES", help="Measures of an experiment, such as bias,rmse,coverage."),
    ] = None,
    compare: Annotated[
        str | None,
        typer.Option("--compare", metavar="A,B", help="Differences of two estimators on the same data sets."),
    ] = None,
    check: Annotated[
        bool,
        typer.Option("--check", help="Compare with the committed tables and the paper; exit code 7 if they differ."),
    ] = False,
    reference: Annotated[
        Path | None,
        typer.Option("--reference", metavar="FILE", help="With --check: these tables (CSV) for the committed ones."),
    ] = None,
    out: Out = Path("results"),
) -> None:
    """Print tables of convergence percentages, or of other measures.

    With their 95 % intervals and numbers of data sets, and the published values where there are any.

    Measures: percent, bias, deviation, mse, rmse, median_bias, robust_deviation, standard_error, error_ratio, coverage,
    efficiency, failures, cpu, cpu_90, h2, hinf, fresh_fit; rmse:delay of one parameter, rmse:poles, response:1.5 at a
    frequency [rad/s]. An experiment without a success rule shows bias and rmse, or what `measures` of its specification
    names.

    Without a name: all tables of the useful-redundancy study. Cells that were not run say so; where the folder results
    holds nothing of a table, as in a fresh clone, the committed results are printed.
    """
    from ctid_cli.reporting.layout import write_reports
    from ctid_cli.reporting.paired_table import compare_estimators
    from ctid_cli.reporting.tables import build_tables, experiments

    if reference is not None and not check:
        raise UsageError("--reference goes with --check")
    if sum((check, measure is not None, compare is not None)) > 1:
        raise UsageError("--check, --measure and --compare are three questions; ask one at a time")
    if not out.is_dir():
        typer.echo(f"ctid: there is no folder {out}, so nothing was run yet (--out names the results folder)", err=True)
    if check:
        _check(names or [], out, reference, style)
        return
    if compare is not None:
        tables = [compare_estimators(results, compare, out) for results in experiments(names or [], out, "--compare")]
    else:
        measures = measure.split(",") if measure is not None else ()
        tables = build_tables(names or [], out, style, committed=out == Path("results"), measures=measures)
    typer.echo(write_reports(tables, style))
    # Text and Markdown hold their notes themselves.
    for note in (note for report in tables for note in report.notes if style in ("csv", "json")):
        typer.echo(f"ctid: {note}", err=True)


def _check(names: list[str], out: Path, reference: Path | None, style: str) -> None:
    from ctid_cli.reporting.comparison import check_tables, mismatch_sentence, write_comparison

    comparison = check_tables(names, out, reference)
    typer.echo(write_comparison(comparison, style))
    if comparison.mismatches:
        raise MismatchError(mismatch_sentence(comparison))


@guarded
def show(
    id: Annotated[str, typer.Argument(metavar="ID", help="Identifier of the estimate, or its first letters.")],
    out: Out = Path("results"),
    as_json: Json = False,
    history: Annotated[bool, typer.Option("--history", help="Estimate again, and print every iteration.")] = False,
    allow_code: AllowCode = False,
) -> None:
    """Print one estimate in full.

    Its parameters with their uncertainty, its status, the data it comes from, and how to redo it.
    `ctid export EXPERIMENT` lists the identifiers, `ctid status EXPERIMENT` those of failed estimates.
    """
    from ctid_cli.reporting.detail import detail_object, detail_text, repeat
    from ctid_cli.storage.status import find_estimate

    found = find_estimate(out, id)
    again = repeat(found, allow_code=allow_code) if history else None
    answer(as_json, lambda: detail_object(found, again, out), lambda: detail_text(found, again, out))


@guarded
def export(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Experiment (quickstart), or a fit (fit.json).")],
    style: Annotated[Literal["csv", "json"], typer.Option("--format", help="Form of the estimates.")] = "csv",
    tool: Annotated[Tool | None, typer.Option("--as", help="Of a fit: the tool that the model is for.")] = None,
    pade: Annotated[
        int | None, typer.Option("--pade", metavar="ORDER", help="With --as control: approximate the delay.")
    ] = None,
    out: Out = Path("results"),
    file: Annotated[Path | None, typer.Option("--file", metavar="FILE", help="Write here, not to stdout.")] = None,
) -> None:
    """Write every estimate of an experiment, one row each, or the model of a fit as code for another tool."""
    if name.endswith(".json"):
        from ctid_cli.reporting.fit_tables import stored_model_code

        if tool is None:
            raise UsageError(f"{name} is a fit; say which tool it is for: --as control, matlab or scipy")
        code = stored_model_code(Path(name), tool, pade)
        typer.echo(code, nl=False) if file is None else write_files({file: code.encode()})
        return
    if tool is not None or pade is not None:
        raise UsageError("--as and --pade are for a fit (fit.json), not for an experiment")
    from ctid_cli.reporting.exporting import csv_lines, json_lines
    from ctid_cli.reporting.results import read_results

    results = read_results(out, name)
    lines = csv_lines(results.stored) if style == "csv" else json_lines(results.rows)
    if file is None:
        for text in lines:
            typer.echo(text, nl=False)
        return
    write_files({file: (text.encode() for text in lines)})
    typer.echo(f"{len(results.rows)} estimates written to {file}", err=True)
