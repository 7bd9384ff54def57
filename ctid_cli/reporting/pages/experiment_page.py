"""Page of one experiment: question, results, uncertainty, and how to reproduce it."""

import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import ctid_cli
from ctid_cli.errors import UsageError
from ctid_cli.progress import reported
from ctid_cli.reporting.document import Section, Table
from ctid_cli.reporting.figures.experiment_plot import experiment_drawing, kinds_of, main_measure
from ctid_cli.reporting.measures import SUCCESSES, default_measures
from ctid_cli.reporting.pages.page import Chapter, write_page
from ctid_cli.reporting.pages.question import formula_of, references
from ctid_cli.reporting.paired_result import compare_estimators
from ctid_cli.reporting.results import Results, out_option
from ctid_cli.reporting.status_result import outcomes_of
from ctid_cli.reporting.surprises import surprises
from ctid_cli.reporting.table_result import experiment_table, measure_table, notes_of, success_sentence
from ctid_cli.storage.sqlite_file import SPEC
from ctid_cli.storage.status import public_sessions
from ctid_cli.text import count

#: Measures of every simulated system, besides those of the specification.
MEASURES = ("bias", "rmse", "coverage")
#: Up to this number of estimators are compared pairwise; more only with the first one.
ALL_PAIRS = 3
#: Most kinds of failure that are listed.
FAILURES_LISTED = 20


@reported("writing the page")
def experiment_page(results: Results, out: Path) -> str:
    """Return the page as HTML."""
    sessions = public_sessions(results.folder)
    made = max((str(session.get("stopped") or session.get("started") or "") for session in sessions), default="")
    lead = f"{_counts(results)}.{f' Computed until {made}.' if made else ''}"
    numbers = f"All numbers: `ctid table {results.experiment}{out_option(out)} --format csv`; every estimate: "
    numbers += f"`ctid export {results.experiment}{out_option(out)}`."
    chapters = [
        Chapter("Warnings", [Section(sentences=[f"- {note}"]) for note in surprises(results)]),
        Chapter("Question", [*_question(results)]),
        Chapter("Tables", [*_tables(results), Section(notes=[numbers])]),
        Chapter("Figures", list(_figures(results, out))),
        Chapter("Differences on the same data sets", list(_comparisons(results, out))),
        Chapter("What went wrong", _outcomes(results, out)),
        Chapter("Provenance", list(_provenance(results, sessions))),
        Chapter("How to cite", [_cited(results)]),
    ]
    return write_page(results.experiment, lead, chapters)


def _counts(results: Results) -> str:
    """Return the size of the experiment in words."""
    manifest = results.manifest
    methods = len({part["name"] for part in manifest["estimators"]})
    sets = sum(cell["replicates"] for cell in manifest["data_cells"])
    cells = f" in {count(len(manifest['data_cells']), 'setting')}" if len(manifest["data_cells"]) > 1 else ""
    estimates = count(len(results.stored), "estimate")
    failed = f", {results.failed} of them failed" if results.failed else ", none of them failed"
    return f"{count(methods, 'estimator')} on {count(sets, 'data set')}{cells}: {estimates}{failed}"


def _question(results: Results) -> Iterator[Section]:
    """Return the equation of the system, the data sets, the rule of success, and the specification as written."""
    settings, seed = results.settings, results.manifest["seed"]
    yield Section(sentences=[formula_of(settings)] if formula_of(settings) else [])
    sizes = [cell["replicates"] for cell in results.manifest["data_cells"]]
    runs = " to ".join(map(str, dict.fromkeys((min(sizes), max(sizes)))))
    sets = "One measured record, the same for all estimators."
    if seed is not None:
        sets = f"{runs} data sets of each setting, seed {seed}. The same data sets for all estimators."
    rule = f"Counted: {success_sentence(settings)}. Estimates that failed count as not converged."
    yield Section(sentences=[sets, *([rule] if settings.get("success") else [])])
    try:
        text = (results.folder / SPEC).read_text(encoding="utf-8")
    except OSError:
        return
    where, same = (" next to its record", "") if seed is None else ("", ": the same seed gives the same data sets")
    yield Section("The specification", [f"Save it as a file{where} and run `ctid run FILE`{same}.", text + "\n"])


def _tables(results: Results) -> list[Section]:
    """Return the tables of ``ctid table``, and the usual measures if they are not among them."""
    tables = [experiment_table(results)]
    if results.is_simulated:
        others = [name for name in MEASURES if name not in default_measures(results)]
        tables += [measure_table(results, others)] if others else []
    return [section for table in tables for section in table.shown]


def _figures(results: Results, out: Path) -> Iterator[Section]:
    try:
        kinds = kinds_of(results)
    except UsageError:
        return
    name = main_measure(results)
    for kind in kinds:
        drawing = experiment_drawing(results, kind, name if kind == "measure" else None)
        caption = f"{name.capitalize()} over all settings" if kind == "measure" else "Errors of each parameter"
        command = f"`ctid figure {results.experiment} --kind {kind}{out_option(out)}`"
        yield Section(drawing=drawing, caption=f"{caption}. {command}")


def _comparisons(results: Results, out: Path) -> Iterator[Section]:
    """Yield differences of estimators on the same data sets, if enough of them are common."""
    names = list(dict.fromkeys(part["name"] for part in results.manifest["estimators"]))
    pairs = itertools.combinations(names, 2)
    for pair in pairs if len(names) <= ALL_PAIRS else ((names[0], name) for name in names[1:]):
        try:
            yield from compare_estimators(results, ",".join(pair), out).shown
        except UsageError:
            continue


def _outcomes(results: Results, out: Path) -> list[Section]:
    """Return the outcomes of unsuccessful estimates, with the command that shows one of them."""
    notes = [f"Note: {note}" for note in notes_of(results, out)]
    listed = [each for each in outcomes_of(results.stored) if each["status"] not in SUCCESSES][:FAILURES_LISTED]
    if not listed:
        return [Section(sentences=["Nothing: every estimate ended as it should."], notes=notes)]
    for each in listed:
        each["the first of them"] = f"`ctid export {results.experiment} --id {each.pop('first')}{out_option(out)}`"
    return [Section(table=Table.of_rows(listed), notes=notes)]


def _provenance(results: Results, sessions: list[dict[str, Any]]) -> Iterator[Section]:
    """Yield the origin of the results."""
    seed = results.manifest["seed"]
    of_seed = "" if seed is None else f", seed {seed}"
    made = f"Specification {results.manifest['spec_hash'][:16]}{of_seed}; page by ctid {ctid_cli.__version__}."
    origins = [(each.code_version, each.platform, _versions(dict(each.packages))) for each in results.stored.origins]
    yield Section("", [made], Table.of_lines(["code version", "platform", "libraries"], origins))
    if sessions:
        titles = {
            "started": "session",
            "stopped": "until",
            "computed": "computed",
            "failed": "failed",
            "jobs": "workers",
        }
        rows = [
            {title: each.get(key) for key, title in titles.items()}
            | {"Python and libraries": _versions(each.get("packages") or {})}
            for each in sessions
        ]
        yield Section(table=Table.of_rows(rows))


def _versions(packages: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in packages.items())


def _cited(results: Results) -> Section:
    """Return the articles to cite."""
    seed = results.manifest["seed"]
    own = f"ctid {ctid_cli.__version__}, experiment {results.experiment}, "
    own += f"specification {results.manifest['spec_hash'][:16]}{'' if seed is None else f', seed {seed}'}."
    others = references(results.settings)
    return Section(sentences=[own + (" And the articles whose methods these are:" if others else ""), *others])
