"""``ctid figure`` and ``ctid report``: figures and pages of results."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

import typer

from ctid_cli.cli._common import Out, guarded, write_files
from ctid_cli.cli._options import flag
from ctid_cli.errors import UsageError

Form = Literal["svg", "png", "pdf"]


@guarded
def figure(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME", help="Experiment (quickstart), figure (2, additive/3) or study (additive)."),
    ] = None,
    kind: Annotated[str | None, flag("--kind", "measure or box.", "KIND")] = None,
    measure: Annotated[str | None, flag("--measure", "Measure, such as rmse or rmse:delay.", "NAME")] = None,
    parameters: Annotated[str | None, flag("--parameters", "With --kind box: a1,delay.", "NAMES")] = None,
    style: Annotated[Form | None, flag("--format", "Format of the files; svg by default.")] = None,
    out: Out = Path("results"),
    file: Annotated[Path | None, flag("--file", "File of a single figure.", "FILE")] = None,
) -> None:
    """Draw figures of experiments and of studies.

    Of an experiment: measure, a percentage or another measure over all that was swept; box, the errors of each
    parameter. Both with 95 % intervals; without --kind the most informative one. It goes to OUT/<experiment>/figures,
    and its path is printed.

    Of a study, as SVG: most are computed from the study's specifications and need no results: all of useful-redundancy,
    additive/2 and additive/6. The others of additive are drawn from results in OUT; where these are missing, a message
    says what to run first. Each goes to OUT/<study>_figures/figure_<number>.svg.

    Without a name: all figures of the useful-redundancy study.
    """
    from ctid_cli.studies.catalogue import find_figures, require_results, sorted_names

    experiments, others = sorted_names(names or [], out)
    figures = find_figures(others, out) if others or not experiments else []
    count = len(figures) + len(experiments)
    if file is not None and count != 1:
        raise UsageError(f"--file takes one figure, not {count}; --out names the folder of several")
    if figures and (kind, measure, parameters, style or "svg") != (None, None, None, "svg"):
        options = "--kind, --measure, --parameters and --format are for those of experiments"
        raise UsageError(f"figures of studies are SVG files as published; {options}")
    require_results(figures, out)
    for item in figures:
        _write(item.svg(out), out / item.place, out, file)
    for name in experiments:
        _draw_experiment(name, out, file, style, (kind, measure, parameters))


def _draw_experiment(
    name: str, out: Path, file: Path | None, style: Form | None, chosen: tuple[str | None, str | None, str | None]
) -> None:
    """Draw a figure of an experiment, to a file named after its kind."""
    from ctid_cli.reporting.figures.experiment_plot import chosen_kind, experiment_drawing
    from ctid_cli.reporting.results import read_results

    results = read_results(out, name)
    given_kind, measure, names = chosen
    parameters = names.split(",") if names else []
    kind = chosen_kind(results, given_kind, measure)
    drawing = experiment_drawing(results, kind, measure, parameters)
    stem = "_".join(re.sub(r"[^\w.]+", "-", word) for word in (kind, measure, *parameters) if word)
    form = style or _form_of(file)
    _write(drawing.saved(form), results.folder / "figures" / f"{stem}.{form}", out, file)


def _form_of(file: Path | None) -> Form:
    suffix = "" if file is None else file.suffix.lower()
    return "png" if suffix == ".png" else "pdf" if suffix == ".pdf" else "svg"


def _write(content: bytes, usual: Path, out: Path, file: Path | None) -> None:
    """Write a file to its default place in the results folder, or to the user's path, and print its path."""
    path = usual if file is None else file
    write_files({path: content}, out if file is None else None)
    typer.echo(path)


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
        flag("--file", "File of the page; OUT/<experiment>/report.html, fit.html or track.html by default.", "FILE"),
    ] = None,
    record: Annotated[
        list[Path] | None, flag("--record", "Record of the fit or track, if it was moved.", "FILE")
    ] = None,
    validate: Annotated[
        Path | None, flag("--validate", "Validation record of the fit, if it was moved.", "FILE")
    ] = None,
) -> None:
    """Write a page about a fit, a track, an experiment or a study.

    One self-contained HTML file, to read, print or send. For a fit: data, model, responses, residuals, and warnings.
    For a track: the signal, its spectrogram, its tones, and the spectrum of the residual. For an experiment or study:
    the question, tables, figures, differences of the estimators on the same data sets, failures with the commands that
    show them, and provenance. Also how to cite it.
    """
    path = Path(name)
    if path.suffix.lower() == ".json" or path.is_file():
        page = _page_of_file(path, record or [], validate)
        place = path.with_suffix(".html") if file is None else file
        write_files({place: page.encode()})
        typer.echo(place)
        return
    if record or validate:
        raise UsageError("--record and --validate go with a file, such as: ctid report fit.json --record FILE")
    from ctid_cli.studies.study_page import page_of

    page, usual = page_of(name, out)
    _write(page.encode(), usual, out, file)


def _page_of_file(path: Path, records: list[Path], validate: Path | None) -> str:
    """Return the page of a fit or a track, whose file contains its kind."""
    from ctid_cli.reporting.fit_result import FitResult
    from ctid_cli.reporting.records import Records
    from ctid_cli.reporting.track_result import TrackResult
    from ctid_cli.storage.fit_file import FIT, read_fit
    from ctid_cli.storage.track_file import TRACK, read_track

    if path.suffix.lower() != ".json":
        pages = "pages are made of fit.json (ctid fit) and track.json (ctid track)"
        raise UsageError(f"{path} is neither a fit nor a track: {pages}")
    if FIT.kind_in(str(path)) != TRACK.kind:
        fit = read_fit(path, records or None, validate)
        if not fit.sources:
            return str(fit.result._result().page(fit.content))
        return FitResult(fit.result, Records(fit.measurements, fit.validation)).page(fit.content)
    if validate:
        raise UsageError(f"{path} is a track, which has no validation record; leave --validate out")
    if len(records) > 1:
        raise UsageError(f"{path} is of one record; --record names {len(records)}")
    track = read_track(path, records[0] if records else None)
    return TrackResult(track.track, track.source.read(), track.content["accuracy_hz"]).page(track.content)
