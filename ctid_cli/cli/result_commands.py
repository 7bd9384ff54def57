"""Commands on stored results: ``ctid status``, ``table``, ``export``, ``merge`` and ``verify``."""

from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import AllowMixed, Out, emit, guarded, write_files
from ctid_cli.cli._options import FormatOptions, flag
from ctid_cli.errors import MismatchError, UsageError
from ctid_cli.reporting.document import Format, Tool


@guarded
def status(
    form: FormatOptions,
    experiment: Annotated[str | None, typer.Argument(metavar="EXPERIMENT", help="Only this one, in full.")] = None,
    out: Out = Path("results"),
) -> None:
    """Show stored, missing and failed estimates.

    Of all experiments, one line each. Of one: by estimator and data, and how the estimates ended.
    """
    from ctid_cli.reporting.results import experiments_in, read_results
    from ctid_cli.reporting.status_result import Overview, StatusResult
    from ctid_cli.running.states import cell_precisions
    from ctid_cli.storage.status import experiment_status

    if experiment is None:
        found = [StatusResult(experiment_status(out / name), out) for name in experiments_in(out)]
        for result in found if form.form == "json" else [Overview(found, out)]:
            emit(result, form.form)
        return
    if not (out / experiment).is_dir():
        read_results(out, experiment)
    one = experiment_status(out / experiment)
    if not one.done:
        # An unfinished first run has nothing to read yet.
        emit(StatusResult(one, out), form.form)
        return
    results = read_results(out, experiment)
    until = (results.settings.get("monte_carlo") or {}).get("until")
    cells = cell_precisions(results.manifest, results.stored.results) if until else ()
    emit(StatusResult(one, out, results.stored, cells), form.form)


@guarded
def table(
    form: FormatOptions,
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME", help="Table (1, useful-redundancy/3) or experiment (quickstart)."),
    ] = None,
    measure: Annotated[
        str | None,
        flag("--measure", "Measures of an experiment, such as bias,rmse,coverage.", "NAMES"),
    ] = None,
    compare: Annotated[
        str | None,
        flag("--compare", "Differences of two estimators on the same data sets.", "A,B"),
    ] = None,
    out: Out = Path("results"),
) -> None:
    """Print tables of convergence percentages, or of other measures.

    With their 95 % intervals and numbers of data sets, and the published values where there are any.

    Measures: percent, bias, deviation, mse, rmse, median_bias, robust_deviation, standard_error, error_ratio, coverage,
    efficiency, failures, cpu, cpu_90, h2, hinf, fresh_fit; rmse:delay of one parameter, rmse:poles, response:1.5 at a
    frequency [rad/s]. An experiment without a success rule shows bias and rmse, or what `measures` of its specification
    names.

    Without a name: all tables of the useful-redundancy study. Cells that were not run say so; if the folder results
    contains nothing of a table, as in a fresh clone, the committed results are printed.
    """
    from ctid_cli.reporting.paired_result import compare_estimators
    from ctid_cli.reporting.study_table import build_tables, experiments
    from ctid_cli.reporting.table_result import joined

    if measure is not None and compare is not None:
        raise UsageError("--measure and --compare exclude each other; give one of them")
    if not out.is_dir():
        typer.echo(f"ctid: there is no folder {out}, so nothing was run yet (--out names the results folder)", err=True)
    if compare is not None:
        found = experiments(names or [], out, "--compare")
        result = joined([compare_estimators(results, compare, out) for results in found])
    else:
        measures = measure.split(",") if measure is not None else ()
        result = build_tables(names or [], out, committed=out == Path("results"), measures=measures)
    emit(result, form.form)
    # Text, Markdown and LaTeX contain the remarks themselves.
    for remark in result.remarks if form.form in ("csv", "json") else ():
        typer.echo(f"ctid: {remark}", err=True)


@guarded
def export(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="Experiment (quickstart), or a fit (fit.json).")
    ] = None,
    id: Annotated[str | None, flag("--id", "One estimate in full, by the first letters of its id.", "ID")] = None,
    format: Annotated[Format | None, flag("--format", "Output format: csv or json; of one estimate any.")] = None,
    json: Annotated[bool, flag("--json", "Short for --format json.")] = False,
    tool: Annotated[Tool | None, flag("--as", "Tool for which the model of a fit is written.")] = None,
    pade: Annotated[int | None, flag("--pade", "With --as control: approximate the delay.", "ORDER")] = None,
    out: Out = Path("results"),
    file: Annotated[Path | None, flag("--file", "Write to this file, not to stdout.", "FILE")] = None,
) -> None:
    """Write the estimates of an experiment, or a fit as code.

    Every estimate in one row, one of them in full (--id), or the model of a fit as code for another tool (--as).
    `ctid status EXPERIMENT` has the identifier of an estimate of each outcome.
    """
    form = "json" if json else format
    if name is not None and name.endswith(".json"):
        _export_fit(Path(name), tool, pade, file)
    elif tool is not None or pade is not None:
        raise UsageError("--as and --pade are for a fit (fit.json), not for an experiment")
    elif id is not None:
        _export_one(name, id, form or "text", out, file)
    elif name is None:
        raise UsageError("name an experiment, or one estimate with --id")
    elif form not in (None, "csv", "json"):
        raise UsageError(f"all estimates are written as csv or json, not as {form}; --id gives one of them in any form")
    else:
        _export_all(name, form or "csv", out, file)


def _export_fit(path: Path, tool: Tool | None, pade: int | None, file: Path | None) -> None:
    """Write the model of a stored fit as code."""
    from ctid_cli.reporting.fit_tables import stored_model_code

    if tool is None:
        raise UsageError(f"{path} is a fit; say which tool it is for: --as control, matlab or scipy")
    code = stored_model_code(path, tool, pade)
    if file is None:
        typer.echo(code, nl=False)
    else:
        write_files({file: code.encode()})


def _export_all(experiment: str, form: Format, out: Path, file: Path | None) -> None:
    """Write every estimate, in parts of limited size."""
    from ctid_cli.reporting.results import read_results
    from ctid_cli.storage.estimates import csv_lines, json_lines

    results = read_results(out, experiment)
    lines = csv_lines(results.stored) if form == "csv" else json_lines(results.stored)
    if file is None:
        for text in lines:
            typer.echo(text, nl=False)
        return
    write_files({file: (text.encode() for text in lines)})
    typer.echo(f"{len(results.stored)} estimates written to {file}", err=True)


def _export_one(experiment: str | None, id: str, form: Format, out: Path, file: Path | None) -> None:
    """Write one estimate of an experiment, or of any."""
    from ctid_cli.reporting.estimate_result import EstimateResult
    from ctid_cli.reporting.results import stored_folder
    from ctid_cli.storage.status import find_estimate

    result = EstimateResult(find_estimate(out if experiment is None else stored_folder(out, experiment), id))
    if file is None:
        emit(result, form)
    else:
        write_files({file: f"{result.write(form)}\n".encode()})


@guarded
def merge(
    form: FormatOptions,
    folders: Annotated[
        list[Path], typer.Argument(metavar="FOLDER", help="Folders of shards, or folders that hold some.")
    ],
    out: Out = Path("results"),
    allow_mixed: AllowMixed = False,
    partial: Annotated[bool, flag("--partial", "Merge although some estimates are missing.")] = False,
) -> None:
    """Merge the shards of experiments into one folder of results.

    `ctid run --shard K/N` computes one of N shards. Merged in any order, they give the runs.h5 of a single run,
    byte for byte. The folders of the shards are not changed.
    """
    from ctid_cli.reporting.status_result import MergeResult
    from ctid_cli.storage.merge import find_sources, merge_all

    for merged in merge_all(find_sources(folders), out, allow_mixed=allow_mixed, partial=partial):
        emit(MergeResult(merged, out), form.form)


@guarded
def verify(
    form: FormatOptions,
    names: Annotated[
        list[str] | None, typer.Argument(metavar="NAME", help="Experiments (quickstart); all by default.")
    ] = None,
    out: Out = Path("results"),
) -> None:
    """Check what is stored of experiments.

    The journal with every estimate in it, and runs.h5. Exit code 7 if anything is damaged or missing. Nothing is
    changed: `ctid run --fresh --keep-readable` moves damaged results aside, keeps what can be read and computes the
    rest.
    """
    from ctid_cli.reporting.results import experiments_in, stored_folder
    from ctid_cli.reporting.status_result import VerificationResult
    from ctid_cli.storage.status import verify as check

    found = [check(stored_folder(out, name)) for name in dict.fromkeys(names or experiments_in(out))]
    if not found:
        raise UsageError(f"there are no results in {out}")
    for number, item in enumerate(found):
        typer.echo("", nl=number > 0 and form.form != "json")
        emit(VerificationResult(item, out), form.form)
    wrong = [item.folder for item in found if not item.is_intact]
    if wrong:
        raise MismatchError(f"not as it was written: {', '.join(map(str, wrong))}")
