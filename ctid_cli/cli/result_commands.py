"""The commands that read results: ``ctid status``, ``table``, ``show``, ``export`` and ``figure``."""

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from ctid_cli.cli._common import AllowCode, Json, Out, answer, guarded, write_files
from ctid_cli.errors import MismatchError, UsageError


@guarded
def status(
    experiment: Annotated[str | None, typer.Argument(metavar="[EXPERIMENT]", help="Only this one, in full.")] = None,
    out: Out = Path("results"),
    as_json: Json = False,
) -> None:
    """Say what is stored and what is missing.

    Counts estimates: done, planned, failed, and those that the latest settings set aside.
    """
    from ctid_cli.reporting.overview import overview_text, status_object, status_text
    from ctid_cli.reporting.results import experiments_in, read_results
    from ctid_cli.running.cell_precision import cell_precisions
    from ctid_cli.storage.store import experiment_status

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
    rows = [] if results is None else results.rows
    cells = () if results is None else cell_precisions(results.manifest, results.stored.results)
    answer(as_json, lambda: status_object(one, rows, cells), lambda: status_text(one, rows, out, cells))


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
    from ctid_cli.reporting.comparison import check_tables, mismatch_sentence, write_comparison
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
        comparison = check_tables(names or [], out, reference)
        typer.echo(write_comparison(comparison, style))
        if comparison.mismatches:
            raise MismatchError(mismatch_sentence(comparison))
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
    from ctid_cli.storage.store import find_estimate

    found = find_estimate(out, id)
    again = repeat(found, allow_code=allow_code) if history else None
    answer(as_json, lambda: detail_object(found, again, out), lambda: detail_text(found, again, out))


@guarded
def export(
    experiment: Annotated[str, typer.Argument(metavar="EXPERIMENT", help="Name of the experiment.")],
    style: Annotated[Literal["csv", "json"], typer.Option("--format", help="Form of the output.")] = "csv",
    out: Out = Path("results"),
    file: Annotated[Path | None, typer.Option("--file", metavar="FILE", help="Write here, not to stdout.")] = None,
) -> None:
    """Write every estimate of an experiment, one row each."""
    from ctid_cli.reporting.estimate import as_object
    from ctid_cli.reporting.results import read_results
    from ctid_cli.storage.store import load_estimates
    from ctid_cli.storage.summary import export_rows

    results = read_results(out, experiment)
    if style == "csv":
        text = str(export_rows(load_estimates(results.folder)).to_csv(index=False, lineterminator="\n"))
    else:
        text = json.dumps([as_object(row) for row in results.rows], indent=1, allow_nan=False) + "\n"
    if file is None:
        typer.echo(text, nl=False)
        return
    write_files({file: text.encode()})
    typer.echo(f"{len(results.rows)} estimates written to {file}", err=True)


@guarded
def figure(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", help="Figure (2, additive/3) or study (additive)."),
    ] = None,
    out: Out = Path("results"),
    file: Annotated[Path | None, typer.Option("--file", metavar="FILE", help="Where a single figure goes.")] = None,
) -> None:
    """Draw figures of a study as SVG files.

    Most are computed from the study's specifications and need no results: all of useful-redundancy, additive/2 and
    additive/6. The others of additive are drawn from results in OUT; where these are missing, the answer says what to
    run first. Each goes to OUT/<study>_figures/figure_<number>.svg, and its path is printed.

    Without a name: all figures of the useful-redundancy study.
    """
    from ctid_cli.studies.catalogue import find_figures, require_results

    figures = find_figures(names or [])
    if file is not None and len(figures) != 1:
        raise UsageError(f"--file takes one figure, not {len(figures)}; --out names the folder of several")
    require_results(figures, out)
    for item in figures:
        path = out / item.place if file is None else file
        write_files({path: item.svg(out)})
        typer.echo(path)
