"""What ``ctid table`` answers: published tables and experiments by name."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ctid_cli.errors import UsageError
from ctid_cli.reporting.committed import committed_tables, made_by, read_tables
from ctid_cli.reporting.layout import Report
from ctid_cli.reporting.measure_tables import measure_report
from ctid_cli.reporting.measures import default_measures
from ctid_cli.reporting.percentages import Row, experiment_rows, settings_of, study_rows
from ctid_cli.reporting.results import (
    Results,
    differences,
    experiments_in,
    find_results,
    out_option,
    read_results,
    shown_path,
)
from ctid_cli.reporting.study import Study, data_folder, load_study
from ctid_cli.reporting.surprises import surprises
from ctid_cli.reporting.table_blocks import frequency_blocks, percentage_blocks, record_blocks, study_blocks
from ctid_cli.specification.load import load_spec
from ctid_cli.storage.folder import InUseError
from ctid_cli.storage.manifest import is_of_signal
from ctid_cli.text import did_you_mean

#: What a measured record's rows carry besides the keys of every table.
RECORD_KEYS = (
    *("id", "status", "delay", "numerator", "denominator", "standard_errors"),
    *("fit_percent", "validation_fit_percent"),
)


def build_tables(
    names: Sequence[str], out: Path, style: str = "text", *, committed: bool = False, measures: Sequence[str] = ()
) -> list[Report]:
    """The tables that were asked for; committed ones stand in for those of which nothing was run, if they may."""
    if measures:
        found = experiments(names, out, "--measure")
        return [measure_report(results, measures, [*notes_of(results, out), *surprises(results)]) for results in found]
    study = load_study()
    reports = []
    for name in names or [study.name]:
        study_name, _, number = name.rpartition("/")
        if name == study.name:
            reports += [_study_report(study, k, out, style, committed) for k in study.tables]
        elif number.isdigit() and study_name in ("", study.name):
            if int(number) not in study.tables:
                raise UsageError(f"{study.name} has no table {number}; it has {', '.join(map(str, study.tables))}")
            reports.append(_study_report(study, int(number), out, style, committed))
        else:
            results = find_results(out, name)
            if results is None:
                known = [*map(str, study.tables), study.name, *experiments_in(out)]
                hint = did_you_mean(name, known) or "."
                wrong = f"{name!r} is neither a table nor an experiment with results in {out}{hint}"
                raise UsageError(f"{wrong} Known: {', '.join(known)}")
            reports.append(experiment_report(results, [*notes_of(results, out), *surprises(results)]))
    return reports


def experiments(names: Sequence[str], out: Path, option: str) -> list[Results]:
    """Results of the experiments that an option is about."""
    if not names:
        raise UsageError(f"{option} needs the name of an experiment: ctid table NAME {option} …")
    return [read_results(out, name) for name in names]


def _study_report(study: Study, number: int, out: Path, style: str, committed: bool) -> Report:
    table = study.tables[number]
    notes: list[str] = []
    known: set[str] = set()
    found: dict[str, Results] = {}
    for name in table.experiments:
        results, estimators, remarks = _results_of(study, name, out)
        if results is not None:
            found[name] = results
        known |= estimators
        notes += remarks
    rows = study_rows(study, table, found)
    file = committed_tables(study.name) if committed and not found else None
    if file is not None:
        rows = [row | {"table": number} for row in read_tables(file) if row["table"] == str(number)]
        remark = made_by(file.parent, study.name)
        notes.insert(0, f"these are the committed results of {shown_path(file)}" + (f", {remark}" if remark else ""))
    published = {place.method for place in table.published}
    missing = [method for method in study.methods if known and method in published - known]
    if missing:
        which = ", ".join(missing)
        notes.append(f"no experiment has the estimator {which} yet; its rows show the published values only")
    options = dict.fromkeys(name for results in found.values() for name in results.swept("estimators"))
    return Report(study_blocks(study, table, rows, style, list(options)), rows, notes)


def _results_of(study: Study, name: str, out: Path) -> tuple[Results | None, set[str], list[str]]:
    """Results of one experiment, the estimators that it has or should have, and remarks."""
    config = data_folder("configs") / study.experiments[name]["config"]
    # An installed package carries the tables, but not the specifications.
    specification = load_spec(config).canonical() if config.is_file() else None
    command = f"ctid run {shown_path(config)}{out_option(out)}"
    try:
        results = find_results(out, name)
    except InUseError as error:
        return None, set(), [f"{name} has no stored results yet: {error}"]
    if results is None:
        return None, set(), [f"{name} was not run." + (f" To fill its rows: {command}" if specification else "")]
    estimators, remarks = set(results.settings["estimators"]), notes_of(results, out)
    if specification is not None:
        estimators |= specification["estimators"].keys()
        remarks = [*_departures(results, specification, set(study.fields.values()), command), *remarks]
    return results, estimators, remarks


def _departures(results: Results, specification: Mapping[str, Any], shown: set[str], command: str) -> Iterator[str]:
    """In what results are not those of the published specification."""
    absent = [method for method in specification["estimators"] if method not in results.settings["estimators"]]
    if absent:
        which = f"the estimator {', '.join(absent)} of its specification"
        yield f"{results.experiment} was run without {which}; to add it: {command}"
    changed = differences(results.settings, specification, shown)
    if changed:
        yield f"{results.experiment} was run with other settings than the published ones: {'; '.join(changed)}"


def experiment_report(results: Results, notes: Sequence[str] = ()) -> Report:
    """What is said of one experiment."""
    rows = experiment_rows(results)
    if results.settings.get("data") is not None:
        return Report(record_blocks(results), _record_rows(results, rows), notes)
    if names := default_measures(results):
        return measure_report(results, names, notes)
    blocks = frequency_blocks if is_of_signal(results.manifest) else percentage_blocks
    return Report(blocks(results, rows), rows, notes)


def _record_rows(results: Results, rows: Sequence[Row]) -> list[Row]:
    """Rows of a measured record with its estimates."""
    keys = ["estimator", "initial_delay", *settings_of(rows)]
    estimates = {tuple(item.get(key) for key in keys): item for item in reversed(list(results.rows))}
    found = []
    for row in rows:
        estimate = estimates.get(tuple({**row, "estimator": row["method"]}[key] for key in keys), {})
        found.append(row | {key: estimate.get(key) for key in RECORD_KEYS})
    return found


def notes_of(results: Results, out: Path) -> list[str]:
    """What to know of the results themselves."""
    notes = []
    if results.failed:
        command = f"ctid status {results.experiment}{out_option(out)}"
        notes.append(f"{results.failed} estimates failed; to see why: {command}")
    if results.stored.mixed:
        notes.append(f"{results.experiment} mixes results of different code versions or processors (--allow-mixed)")
    return notes
