"""The commands that read results: ``ctid status``, ``table``, ``show``, ``export``, ``figure`` and ``report``."""

import json
import re
from collections.abc import Sequence
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
    experiment: Annotated[str, typer.Argument(metavar="EXPERIMENT", help="Name of the experiment.")],
    style: Annotated[Literal["csv", "json"], typer.Option("--format", help="Form of the output.")] = "csv",
    out: Out = Path("results"),
    file: Annotated[Path | None, typer.Option("--file", metavar="FILE", help="Write here, not to stdout.")] = None,
) -> None:
    """Write every estimate of an experiment, one row each."""
    from ctid_cli.reporting.exporting import csv_lines, json_lines
    from ctid_cli.reporting.results import read_results

    results = read_results(out, experiment)
    lines = csv_lines(results.stored) if style == "csv" else json_lines(results.rows)
    if file is None:
        for text in lines:
            typer.echo(text, nl=False)
        return
    write_files({file: (text.encode() for text in lines)})
    typer.echo(f"{len(results.rows)} estimates written to {file}", err=True)


@guarded
def figure(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME]...", help="Experiment (quickstart), figure (2, additive/3) or study (additive)."
        ),
    ] = None,
    kind: Annotated[
        str | None, typer.Option("--kind", metavar="KIND", help="measure, box, errors, delays or convergence.")
    ] = None,
    measure: Annotated[
        str | None, typer.Option("--measure", metavar="NAME", help="What is measured, such as rmse or rmse:delay.")
    ] = None,
    parameters: Annotated[
        str | None, typer.Option("--parameters", metavar="NAMES", help="With --kind errors and box: a1,delay.")
    ] = None,
    style: Annotated[
        Literal["svg", "png", "pdf"] | None, typer.Option("--format", help="Form of the files; svg by default.")
    ] = None,
    out: Out = Path("results"),
    file: Annotated[Path | None, typer.Option("--file", metavar="FILE", help="Where a single figure goes.")] = None,
) -> None:
    """Draw figures of experiments and of studies.

    Of an experiment: measure, a percentage or another measure over all that was swept; box, the errors of each
    parameter; errors, two of them against each other with what theory expects; delays, where the estimated delays lie;
    convergence, the measure from the first data sets only. All with their 95 % intervals. Without --kind: the one that
    tells most. It goes to OUT/<experiment>/figures, and its path is printed.

    Of a study, as SVG: most are computed from the study's specifications and need no results: all of useful-redundancy,
    additive/2 and additive/6. The others of additive are drawn from results in OUT; where these are missing, the answer
    says what to run first. Each goes to OUT/<study>_figures/figure_<number>.svg.

    Without a name: all figures of the useful-redundancy study.
    """
    from ctid_cli.reporting.figures.experiment_plot import chosen_kind, experiment_drawing
    from ctid_cli.reporting.results import read_results
    from ctid_cli.studies.catalogue import find_figures, require_results, sorted_names

    experiments, others = sorted_names(names or [], out)
    figures = find_figures(others, out) if others or not experiments else []
    count = len(figures) + len(experiments)
    if file is not None and count != 1:
        raise UsageError(f"--file takes one figure, not {count}; --out names the folder of several")
    if figures and (kind, measure, parameters, style or "svg") != (None, None, None, "svg"):
        raise UsageError(
            "figures of studies are SVG files as published; --kind, --measure, --parameters and --format "
            "are for those of experiments"
        )
    require_results(figures, out)
    style = style or _format_of(file)
    for item in figures:
        path = out / item.place if file is None else file
        write_files({path: item.svg(out)}, out if file is None else None)
        typer.echo(path)
    for name in experiments:
        results = read_results(out, name)
        chosen = chosen_kind(results, kind, measure)
        drawing = experiment_drawing(results, chosen, measure, parameters.split(",") if parameters else ())
        words = [chosen, measure, *(parameters or "").split(",")]
        stem = "_".join(re.sub(r"[^\w.]+", "-", word) for word in words if word)
        path = results.folder / "figures" / f"{stem}.{style}" if file is None else file
        write_files({path: drawing.saved(style)}, out if file is None else None)
        typer.echo(path)


def _format_of(file: Path | None) -> Literal["svg", "png", "pdf"]:
    suffix = "" if file is None else file.suffix.lower()
    return "png" if suffix == ".png" else "pdf" if suffix == ".pdf" else "svg"


@guarded
def report(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME", help="Fit (fit.json), track (track.json), experiment (quickstart) or study (additive)."
        ),
    ],
    out: Out = Path("results"),
    file: Annotated[
        Path | None,
        typer.Option(
            "--file",
            metavar="FILE",
            help="Where the page goes; OUT/<experiment>/report.html, fit.html or track.html by default.",
        ),
    ] = None,
    record: Annotated[
        list[Path] | None, typer.Option("--record", metavar="FILE", help="Of a fit or track: where its record is now.")
    ] = None,
    validate: Annotated[
        Path | None, typer.Option("--validate", metavar="FILE", help="Of a fit: where its validation record is now.")
    ] = None,
) -> None:
    """Write a page about a fit, a track, an experiment or a study, to read, print or send.

    One HTML file that opens anywhere and loads nothing. Of a fit: data, model, what it does, its residuals, and what to
    know before using it. Of a track: the signal, its spectrogram, its tones, and the spectrum of what these leave. Of
    an experiment or study: the question, tables, figures, differences of the estimators on the same data sets, what
    went wrong and the commands that show it, how all of it was computed. And how to cite it.
    """
    if Path(name).suffix.lower() == ".json" or Path(name).is_file():
        _report_file(Path(name), record, validate, file)
        return
    if record or validate:
        raise UsageError("--record and --validate go with a file, such as: ctid report fit.json --record FILE")
    from ctid_cli.reporting.pages.experiment_page import experiment_page
    from ctid_cli.reporting.results import experiments_in, read_results
    from ctid_cli.studies.catalogue import all_studies
    from ctid_cli.studies.study_page import study_page
    from ctid_cli.text import did_you_mean

    known, studies = experiments_in(out), all_studies()
    if name in known:
        results = read_results(out, name)
        page, path = experiment_page(results, out), results.folder / "report.html"
    elif name in studies:
        page, path = study_page(studies[name], out), out / f"{studies[name].folder.name}_report.html"
    else:
        hint = did_you_mean(name, [*known, *studies]) or "."
        wrong = f"{name!r} is neither an experiment with results in {out} nor a study{hint}"
        raise UsageError(f"{wrong} Known: {', '.join([*known, *studies])}")
    path, within = (path, out) if file is None else (file, None)
    write_files({path: page.encode()}, within)
    typer.echo(path)


def _report_file(path: Path, record: list[Path] | None, validate: Path | None, file: Path | None) -> None:
    from ctid_cli.storage.fit_file import FIT
    from ctid_cli.storage.result_file import kind_in
    from ctid_cli.storage.track_file import TRACK

    if path.suffix.lower() != ".json":
        pages = "pages are made of fit.json (ctid fit) and track.json (ctid track)"
        raise UsageError(f"{path} is neither a fit nor a track: {pages}")
    is_track = kind_in(str(path), FIT) == TRACK.kind
    page = _page_of_track(path, record, validate) if is_track else _page_of_fit(path, record, validate)
    place = path.with_suffix(".html") if file is None else file
    write_files({place: page.encode()})
    typer.echo(place)


def _page_of_fit(path: Path, record: list[Path] | None, validate: Path | None) -> str:
    from ctid_cli.reporting.pages.fit_page import fit_page
    from ctid_cli.storage.fit_file import read_fit

    stored = read_fit(path, record, validate)
    return fit_page(stored.result, stored.measurements, stored.validation, stored.content)


def _page_of_track(path: Path, record: list[Path] | None, validate: Path | None) -> str:
    from ctid_cli.reporting.pages.track_page import track_page
    from ctid_cli.storage.track_file import read_track

    if validate:
        raise UsageError(f"{path} is a track, which has no validation record; leave --validate out")
    if record and len(record) > 1:
        raise UsageError(f"{path} is of one record; --record names {len(record)}")
    stored = read_track(path, record[0] if record else None)
    return track_page(stored.track, stored.source.read(), stored.content)
