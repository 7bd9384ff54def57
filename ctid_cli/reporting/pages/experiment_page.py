"""The page of one experiment: what was asked, what came out, how sure that is, and how to get it again."""

import itertools
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import ctid_cli
from ctid_cli.errors import UsageError
from ctid_cli.reporting.figures.experiment_plot import Kind, experiment_drawing, kinds_of, main_measure
from ctid_cli.reporting.layout import Report, Table, count
from ctid_cli.reporting.measure_tables import measure_report
from ctid_cli.reporting.measures import SUCCESSES, default_measures
from ctid_cli.reporting.overview import sentence_of
from ctid_cli.reporting.pages.page import inline, written
from ctid_cli.reporting.pages.question import equation, estimators, parts, references
from ctid_cli.reporting.paired_table import compare_estimators
from ctid_cli.reporting.results import Results, out_option
from ctid_cli.reporting.surprises import surprises
from ctid_cli.reporting.table_blocks import success_sentence
from ctid_cli.reporting.tables import experiment_report, notes_of
from ctid_cli.storage.estimates import Estimates
from ctid_cli.storage.folder import SPEC
from ctid_cli.storage.manifest import true_values
from ctid_cli.storage.status import public_sessions

#: What is measured of every simulated system, beside what the specification asks for.
MEASURES = ("bias", "rmse", "coverage")
#: So many estimators are compared two by two; more of them with the first one.
ALL_PAIRS = 3
#: Kinds of failure that are listed.
FAILURES_LISTED = 20
#: What the figures show.
CAPTIONS: dict[Kind, str] = {
    "measure": "over all settings",
    "box": "How the errors of each parameter are spread",
}


def experiment_page(results: Results, out: Path) -> str:
    """The page as HTML."""
    settings = results.settings
    sessions = public_sessions(results.folder)
    sizes = [cell["replicates"] for cell in results.manifest["data_cells"]]
    return written(
        "experiment.html",
        title=results.experiment,
        version=ctid_cli.__version__,
        made=max((str(session.get("stopped") or session.get("started") or "") for session in sessions), default=""),
        counts=_counts(results),
        equation=equation(settings),
        parts=list(parts(settings)),
        estimators=list(estimators(settings)),
        runs=" to ".join(map(str, dict.fromkeys((min(sizes), max(sizes))))),
        seed=results.manifest["seed"],
        success=success_sentence(settings) if settings.get("success") else "",
        reports=_tables(results),
        figures=list(_figures(results, out)),
        comparisons=list(_comparisons(results, out)),
        outcomes=_outcomes(results.stored, out),
        notes=notes_of(results, out),
        surprises=surprises(results),
        spec_hash=results.manifest["spec_hash"],
        origins=results.stored.origins,
        sessions=sessions,
        specification=_specification(results),
        out=out_option(out),
        references=references(settings),
    )


def _counts(results: Results) -> str:
    """How much there is."""
    manifest = results.manifest
    methods = len({part["name"] for part in manifest["estimators"]})
    sets = sum(cell["replicates"] for cell in manifest["data_cells"])
    cells = f" in {count(len(manifest['data_cells']), 'setting')}" if len(manifest["data_cells"]) > 1 else ""
    estimates = count(len(results.rows), "estimate")
    failed = f", {results.failed} of them failed" if results.failed else ", none of them failed"
    return f"{count(methods, 'estimator')} on {count(sets, 'data set')}{cells}: {estimates}{failed}"


def _tables(results: Results) -> list[Report]:
    """The tables of ``ctid table``, and the usual measures where they are not among them."""
    reports = [experiment_report(results)]
    if any(map(true_values, results.manifest["data_cells"])):
        others = [name for name in MEASURES if name not in default_measures(results)]
        reports += [measure_report(results, others)] if others else []
    return [Report([_untitled(block) for block in report.blocks], notes=report.notes) for report in reports]


def _untitled(block: Any) -> list[str | Table]:
    """The name of the experiment is that of the page."""
    return [item for item in block if not (isinstance(item, str) and item.startswith("### "))]


def _figures(results: Results, out: Path) -> Iterator[dict[str, Any]]:
    try:
        kinds = kinds_of(results)
    except UsageError:
        return
    name = main_measure(results)
    for kind in kinds:
        drawing = experiment_drawing(results, kind, name if kind == "measure" else None)
        caption = f"{name.capitalize()} {CAPTIONS[kind]}" if kind == "measure" else CAPTIONS[kind]
        command = f"ctid figure {results.experiment} --kind {kind}{out_option(out)}"
        yield {"svg": inline(drawing.laid_out_once(), kind), "caption": caption, "command": command}


def _comparisons(results: Results, out: Path) -> Iterator[Report]:
    """Differences of estimators on the same data sets, where they have enough of them in common."""
    names = list(dict.fromkeys(part["name"] for part in results.manifest["estimators"]))
    pairs = itertools.combinations(names, 2)
    for pair in pairs if len(names) <= ALL_PAIRS else ((names[0], name) for name in names[1:]):
        try:
            yield compare_estimators(results, ",".join(pair), out)
        except UsageError:
            continue


def _outcomes(rows: Estimates, out: Path) -> list[dict[str, Any]]:
    """How the estimates ended that did not end well, with the command that shows one of them."""
    first: dict[tuple[str, str, str], str] = {}
    found: Counter[tuple[str, str, str]] = Counter()
    well = np.isin(rows.column("status"), [status.encode() for status in SUCCESSES])
    for row in rows.chosen(~well).rows("estimator", "status", "message", "id"):
        how = (row["estimator"], row["status"], sentence_of(row))
        found[how] += 1
        first.setdefault(how, row["id"])
    return [
        {
            "estimator": how[0],
            "status": how[1],
            "reason": how[2],
            "n": n,
            "command": f"ctid show {first[how]}{out_option(out)}",
        }
        for how, n in found.most_common(FAILURES_LISTED)
    ]


def _specification(results: Results) -> str:
    """The specification as it was written."""
    try:
        return (results.folder / SPEC).read_text(encoding="utf-8")
    except OSError:
        return ""
