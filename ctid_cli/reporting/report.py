"""What ``ctid table`` answers: published tables and experiments by name, in the form asked for."""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ctid_cli.errors import UsageError
from ctid_cli.reporting.results import Results, differences, experiments_in, find_results, out_option, shown_path
from ctid_cli.reporting.rows import Row, experiment_rows, study_rows
from ctid_cli.reporting.study import DEFAULT_STUDY, Study, data_folder, load_study
from ctid_cli.reporting.tables import csv_text, experiment_table, frequency_table, record_table, study_table
from ctid_cli.specification.spec import load_spec
from ctid_cli.storage.folder import InUseError
from ctid_cli.storage.manifest import is_of_signal

#: What a measured record's rows carry besides the keys of every table.
_RECORD_KEYS = (
    *("id", "status", "delay", "numerator", "denominator", "standard_errors"),
    *("fit_percent", "validation_fit_percent"),
)


@dataclass(frozen=True)
class Table:
    """One table, ready to be written in any form."""

    rows: list[dict[str, Any]]
    text: str
    markdown: str
    notes: list[str] = field(default_factory=list)


def build_tables(names: Sequence[str], out: Path) -> list[Table]:
    """The tables that were asked for."""
    tables: list[Table] = []
    for name in names or [DEFAULT_STUDY]:
        study_name, _, number = name.rpartition("/")
        study_name = study_name or DEFAULT_STUDY
        if name == DEFAULT_STUDY:
            study = load_study(name)
            tables += [_study(study, k, out) for k in study.tables]
        elif number.isdigit() and study_name == DEFAULT_STUDY:
            study = load_study(study_name)
            if int(number) not in study.tables:
                raise UsageError(f"{study.name} has no table {number}; it has {_listed(study.tables)}")
            tables.append(_study(study, int(number), out))
        else:
            results = find_results(out, name)
            if results is None:
                raise UsageError(_unknown(name, out))
            tables.append(_record(results, out) if results.measured else _experiment(results, out))
    return tables


def write_tables(tables: Sequence[Table], style: str) -> str:
    """Tables in one of the forms."""
    rows = [row for table in tables for row in table.rows]
    if style == "json":
        return json.dumps(rows, indent=1, allow_nan=False)
    if style == "csv":
        return csv_text([{key: _csv_value(value) for key, value in row.items()} for row in rows]).rstrip("\n")
    texts = []
    for table in tables:
        body = table.text if style == "text" else table.markdown
        notes = [f"Note: {note}" for note in table.notes]
        texts.append("\n".join([body, *notes]) if style == "text" else "\n\n".join([body, *notes]))
    return "\n\n\n".join(texts)


def success_sentence(settings: Mapping[str, Any]) -> str:
    """What the percentages of an experiment count."""
    rule = settings.get("success") or {}
    parts = []
    if rule.get("delay_relative_error") is not None:
        parts.append(f"delay estimate lies within {100 * rule['delay_relative_error']:g} % of the true delay")
    if rule.get("parameter_relative_error") is not None:
        parts.append(f"parameters all lie within {100 * rule['parameter_relative_error']:g} % of the true ones")
    if rule.get("band") is not None:
        soon = "" if rule.get("by") is None else f" within {rule['by']:g} s"
        parts.append(f"frequencies all come to lie within {rule['band']:g} rad/s of the true ones{soon}, to stay there")
    if rule.get("fit_percent") is not None:
        parts.append(f"model fits to at least {rule['fit_percent']:g} %")
    if not parts:
        return "nothing, the specification has no success rule"
    return "percent of the data sets whose " + " and whose ".join(parts)


def _study(study: Study, number: int, out: Path) -> Table:
    table = study.tables[number]
    notes = []
    known: set[str] = set()
    found: dict[str, Results | None] = {}
    for name in dict.fromkeys(row.experiment for row in table.rows):
        config = data_folder("configs") / study.experiments[name].config
        try:
            results = found[name] = find_results(out, name)
        except InUseError as error:
            notes.append(f"{name} has no stored results yet: {error}")
            continue
        if results is None:
            # An installed package carries the tables, but not the specifications.
            hint = f" To fill its rows: ctid run {shown_path(config)}{out_option(out)}" if config.is_file() else ""
            notes.append(f"{name} was not run.{hint}")
            continue
        if config.is_file():
            specification = load_spec(config).canonical()
            known |= specification["estimators"].keys()
            absent = [method for method in specification["estimators"] if method not in results.settings["estimators"]]
            if absent:
                add = f"to add it: ctid run {shown_path(config)}{out_option(out)}"
                notes.append(f"{name} was run without the estimator {_listed(absent)} of its specification; {add}")
            changed = differences(results.settings, specification, set(study.fields.values()))
            if changed:
                notes.append(f"{name} was run with other settings than the published ones: {'; '.join(changed)}")
        notes += _notes(results, out)
    rows = study_rows(study, table, found)
    known |= {name for results in found.values() if results for name in results.settings["estimators"]}
    published = {method for row in table.rows for method in row.published}
    missing = [method for method in study.methods if known and method in published - known]
    if missing:
        notes.append(f"no experiment has the estimator {_listed(missing)} yet; its rows show the published values only")
    text, markdown = (study_table(study, table, rows, style) for style in ("text", "md"))
    return Table([row.as_dict() for row in rows], text, markdown, notes)


def _experiment(results: Results, out: Path) -> Table:
    rows: list[Row] = experiment_rows(results, results.experiment)
    success = success_sentence(results.settings)
    draw = frequency_table if is_of_signal(results.manifest) else experiment_table
    text, markdown = (draw(results.experiment, rows, success, style) for style in ("text", "md"))
    return Table([row.as_dict() for row in rows], text, markdown, _notes(results, out))


def _record(results: Results, out: Path) -> Table:
    bounds = {item["name"]: item["content"].get("delay_bounds") for item in results.manifest["estimators"]}
    rows = []
    for row in experiment_rows(results, results.experiment):
        estimate = _matching(row, results.rows)
        rows.append(row.as_dict() | {key: estimate.get(key) for key in _RECORD_KEYS})
    text, markdown = (record_table(results.experiment, results.rows, bounds, style) for style in ("text", "md"))
    return Table(rows, text, markdown, _notes(results, out))


def _matching(row: Row, estimates: Sequence[dict[str, Any]]) -> dict[str, Any]:
    for estimate in estimates:
        same = estimate["estimator"] == row.method and estimate["initial_delay"] == row.initial_delay
        if same and all(estimate.get(name) == value for name, value in row.settings.items()):
            return estimate
    return {}


def _notes(results: Results, out: Path) -> list[str]:
    notes = []
    if results.failed:
        notes.append(
            f"{results.failed} estimates failed; to see why: ctid status {results.experiment}{out_option(out)}"
        )
    if results.mixed:
        notes.append(f"{results.experiment} mixes results of different code versions or processors (--allow-mixed)")
    return notes


def _unknown(name: str, out: Path) -> str:
    study = load_study()
    known = [*(str(k) for k in study.tables), study.name, *experiments_in(out)]
    close = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else "."
    return f"{name!r} is neither a table nor an experiment with results in {out}{hint} Known: {', '.join(known)}"


def _listed(items: Any) -> str:
    return ", ".join(str(item) for item in items)


def _csv_value(value: Any) -> Any:
    return json.dumps(value) if isinstance(value, dict | list) else value
