"""Tables of an experiment: percentages of estimates with a delay, measured frequencies, and estimates of a record."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ctid_cli.inference.uncertain_value import UncertainValue
from ctid_cli.reporting.estimate import parameters
from ctid_cli.reporting.layout import Report, Table, delay_label, number, seconds, with_error
from ctid_cli.reporting.percentages import Row, experiment_rows, measures_of, settings_of
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.study_table import (
    RULE,
    TIME,
    interval_text,
    percent_text,
    setting_text,
    setting_title,
    time_text,
)
from ctid_cli.storage.manifest import is_of_signal

#: Estimators side by side, and estimates of a measured record, before a table continues below.
GROUPS_PER_BLOCK = 2
ESTIMATES_PER_BLOCK = 3

#: Titles of the columns of measured frequencies.
MEASURE_TITLES = {
    "median_settling_time": "settling",
    "median_settling_after_step": "after step",
    "false_alarms": "alarms",
}

#: What a measured record's rows carry besides the keys of every table.
RECORD_KEYS = (
    *("id", "status", "delay", "numerator", "denominator", "standard_errors"),
    *("fit_percent", "validation_fit_percent"),
)


def experiment_report(results: Results, notes: Sequence[str] = ()) -> Report:
    """What ``ctid table`` says of one experiment."""
    rows = experiment_rows(results)
    if results.measured:
        return Report(_record_blocks(results), _record_rows(results, rows), notes)
    if is_of_signal(results.manifest):
        return Report(_frequency_blocks(results, rows), rows, notes)
    return Report(_percentage_blocks(results, rows), rows, notes)


def success_sentence(settings: Mapping[str, Any]) -> str:
    """What the percentages of an experiment count."""
    rule = settings.get("success") or {}
    soon = f" within {rule['by']:g} s" if rule.get("by") is not None else ""
    sentences = {
        "delay_relative_error": "delay estimate lies within {percent:g} % of the true delay",
        "parameter_relative_error": "parameters all lie within {percent:g} % of the true ones",
        "band": f"frequencies all come to lie within {{value:g}} rad/s of the true ones{soon}, to stay there",
        "fit_percent": "model fits to at least {value:g} %",
    }
    parts = [
        sentence.format(value=rule[key], percent=100 * rule[key])
        for key, sentence in sentences.items()
        if rule.get(key) is not None
    ]
    if not parts:
        return "nothing, the specification has no success rule"
    return "percent of the data sets whose " + " and whose ".join(parts)


def _percentage_blocks(results: Results, rows: Sequence[Row]) -> list[list[str | Table]]:
    """Swept data and starts down, estimators across."""
    options = results.swept("estimators")
    down = [key for key in settings_of(rows) if key not in options and any(row[key] is not None for row in rows)]
    cells: dict[tuple[Any, ...], dict[str, Row]] = {}
    for row in rows:
        own = (f"{key} {number(row[key])}" for key in options if row[key] is not None)
        place = (*(row[key] for key in down), row["initial_delay"])
        cells.setdefault(place, {})[", ".join([row["method"], *own])] = row
    titles = list(dict.fromkeys(title for line in cells.values() for title in line))
    tables: list[list[str | Table]] = []
    for first in range(0, len(titles), GROUPS_PER_BLOCK):
        block = titles[first : first + GROUPS_PER_BLOCK]
        header = [*map(setting_title, down), "initial delay"]
        header += [text for title in block for text in (f"{title}: %", "95 %", "n", "time")]
        body = [
            [*map(setting_text, down, place), delay_label(place[-1])]
            + [text for title in block for text in _four(line.get(title))]
            for place, line in cells.items()
            if not line.keys().isdisjoint(block)
        ]
        tables.append([Table(header, body, "l" * (len(down) + 1) + "rrrr" * len(block))])
    return [_heading(results), *tables, [f"{RULE} {TIME}."]]


def _four(row: Row | None) -> list[str]:
    return ["", "", "", ""] if row is None else [percent_text(row), interval_text(row), str(row["n"]), time_text(row)]


def _heading(results: Results) -> list[str | Table]:
    return [f"### {results.experiment}", f"Counted: {success_sentence(results.settings)}."]


def _frequency_blocks(results: Results, rows: Sequence[Row]) -> list[list[str | Table]]:
    """Swept fields and estimators down, percentages and measures across."""
    keys, measures = settings_of(rows), measures_of(rows)
    titles = (MEASURE_TITLES.get(key, key.removeprefix("median_").replace("_", " ")) for key in measures)
    header = [*map(setting_title, keys), "estimator", "%", "95 %", "n", *titles, "time"]
    body = [
        [
            *(setting_text(key, row[key]) for key in keys),
            *(row["method"], percent_text(row), interval_text(row), str(row["n"])),
            *(number(row[key], 3) for key in measures),
            time_text(row),
        ]
        for row in rows
    ]
    foot = f"{RULE} settling: median over the data sets of the time until the slowest tone is in the band to stay [s], "
    foot += "from the start and after the last step of a frequency; - is never, or unknown. rms: median over the data "
    foot += "sets of the root-mean-square error of each tone over the window [rad/s]. "
    foot += "alarms: false ones, in all data sets together. " if "false_alarms" in measures else ""
    table = Table(header, body, "l" * (len(keys) + 1) + "r" * (len(measures) + 4))
    return [_heading(results), [table], [f"{foot}{TIME}."]]


def _record_rows(results: Results, rows: Sequence[Row]) -> list[Row]:
    """Rows of a measured record with its estimates."""
    keys = settings_of(rows)
    found = []
    for row in rows:
        same = {"estimator": row["method"], "initial_delay": row["initial_delay"]} | {key: row[key] for key in keys}
        matching = (item for item in results.rows if all(item.get(key) == value for key, value in same.items()))
        estimate = next(matching, {})
        found.append(row | {key: estimate.get(key) for key in RECORD_KEYS})
    return found


def _record_blocks(results: Results) -> list[list[str | Table]]:
    """Estimates of a measured record across, parameters with standard errors and measures of fit down."""
    bounds = {item["name"]: item["content"].get("delay_bounds") for item in results.manifest["estimators"]}
    fits = {"fit, estimation part": "fit_percent"}
    if any(item.get("validation_fit_percent") is not None for item in results.rows):
        fits["fit, validation part"] = "validation_fit_percent"
    tables: list[list[str | Table]] = []
    for first in range(0, len(results.rows), ESTIMATES_PER_BLOCK):
        block = results.rows[first : first + ESTIMATES_PER_BLOCK]
        found = [{item.name: item for item in parameters(row, bounds.get(row["estimator"]))} for row in block]
        units = {name: item.unit for one in reversed(found) for name, item in one.items()}
        names = dict.fromkeys(name for one in found for name in one)
        body = [[key, "", *(str(row[key]) for row in block)] for key in ("id", "status")]
        body += [[name, units[name], *(_with_error(one.get(name)) for one in found)] for name in names]
        body += [[title, "%", *(number(row.get(key), 4) for row in block)] for title, key in fits.items()]
        body.append(["time", "", *(seconds(row.get("seconds")) for row in block)])
        header = ["", "unit", *(f"{row['estimator']}, start {_start(row['start'])}" for row in block)]
        tables.append([Table(header, body, "ll" + "r" * len(block))])
    foot = "± is one standard error. Fit: 100 (1 - ||y - x|| / ||y - mean y||) of the simulated output x."
    return [[f"### {results.experiment}"], *tables, [foot]]


def _with_error(item: UncertainValue | None) -> str:
    if item is None:
        return "-"
    if not math.isfinite(item.standard_error):
        return f"{number(item.estimate)} ({item.status})"
    return with_error(item.estimate, item.standard_error)


def _start(label: str) -> str:
    try:
        return f"{float(label):g} s"
    except ValueError:
        return label
