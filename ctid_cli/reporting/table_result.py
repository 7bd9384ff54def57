"""Tables of experiments: rows for programs, and formatted tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from ctid_cli.inference.intervals import UncertainValue
from ctid_cli.inference.monte_carlo import Measure
from ctid_cli.progress import reported
from ctid_cli.reporting.document import Result, Section, Table
from ctid_cli.reporting.estimate import parameters
from ctid_cli.reporting.layout import (
    delay_label,
    number,
    percent,
    seconds,
    setting_text,
    setting_title,
    with_error,
)
from ctid_cli.reporting.measures import (
    OF_FREQUENCIES,
    Row,
    counted_in,
    default_measures,
    measure_frame,
    measure_of,
    percentage_frame,
    records_of,
    settings_of,
)
from ctid_cli.reporting.results import Results, out_option
from ctid_cli.storage.manifest import is_of_signal

NOT_RUN = "not run"
RULE = "Estimates that failed count as not converged. 95 %: Wilson interval of the percentage."
TIME = "Time: median processor time of one estimate, or elapsed time where only that is stored"
SETTLING = (
    "settling: time until the slowest tone is in the band to stay [s], from the start and after the last step; - is "
    "never, or unknown. rms: root-mean-square error of each tone over the window [rad/s]; medians over the data sets."
)
#: Titles of measured frequencies that differ from their keys.
TITLES = {"median_settling_time": "settling", "median_settling_after_step": "after step", "false_alarms": "alarms"}
#: Meaning of a rule of success, by its key.
SUCCESS: Mapping[str, Callable[[float, str], str]] = {
    "delay_relative_error": lambda value, _: f"delay estimate lies within {100 * value:g} % of the true delay",
    "parameter_relative_error": lambda value, _: f"parameters all lie within {100 * value:g} % of the true ones",
    "band": lambda value, soon: (
        f"frequencies all come to lie within {value:g} rad/s of the true ones{soon}, to stay there"
    ),
    "fit_percent": lambda value, _: f"model fits to at least {value:g} %",
}
#: Additional keys in rows of a measured record.
OF_RECORDS = (
    *("id", "status", "delay", "numerator", "denominator", "standard_errors"),
    *("fit_percent", "validation_fit_percent"),
)
#: Measures that single large errors can determine. A note is added if their Monte Carlo error exceeds a share of them
#: with at least a few data sets: for normal errors the share is 1/sqrt(2 n), 0.22 for ten.
OF_SQUARES, WIDE, FEW = ("rmse", "deviation"), 0.5, 10
#: Most estimators, and estimates of a measured record, side by side; a wider table continues below.
ESTIMATORS_PER_BLOCK = 2
ESTIMATES_PER_BLOCK = 3


@dataclass(frozen=True, eq=False)
class TableResult(Result):
    """Rows of one or several tables, with their presentation and notes."""

    rows: Sequence[Row]
    shown: Sequence[Section]
    remarks: Sequence[str] = ()

    def sections(self) -> list[Section]:
        """Return the formatted tables."""
        remarks = [f"Note: {remark}" for remark in self.remarks]
        return [*self.shown, *([Section(notes=remarks)] if remarks else [])]

    def content(self) -> list[Row]:
        """Return the rows for JSON."""
        return list(self.rows)

    def main_table(self) -> Table:
        """Return the rows, a column for each key that any of them has."""
        titles = list(dict.fromkeys(key for row in self.rows for key in row))
        return Table(titles, [[row.get(title) for row in self.rows] for title in titles])

    def to_frame(self) -> pd.DataFrame:
        """Return the rows, a column for each key that any of them has."""
        return pd.DataFrame(self.rows, dtype=object)


def joined(tables: Sequence[TableResult]) -> TableResult:
    """Return several tables as one result."""
    rows = [row for table in tables for row in table.rows]
    remarks = dict.fromkeys(remark for table in tables for remark in table.remarks)
    return TableResult(rows, [section for table in tables for section in table.shown], [*remarks])


# --- parts of all tables --------------------------------------------------------------------------------------------


def labels_of(frame: pd.DataFrame, *others: str, options: Sequence[str] = ()) -> pd.DataFrame:
    """Return the identifying columns as text: swept fields but ``options``, starts, and other keys that any row has."""
    known = frame.loc[:, frame.notna().any()].astype(object)
    known = known.where(known.notna(), None)
    keys = [key for key in settings_of(known) if key not in options]
    texts = {setting_title(key): [setting_text(key, value) for value in known[key]] for key in keys}
    if "initial_delay" in known:
        texts["initial delay"] = [delay_label(delay) for delay in known["initial_delay"]]
    texts |= {key: [number(value) for value in known[key]] for key in others if key in known}
    return pd.DataFrame(texts, index=frame.index)


def pivot(texts: pd.DataFrame, down: Sequence[str], across: str, shown: Sequence[str], empty: str = "") -> pd.DataFrame:
    """Return the columns ``shown`` for each value of ``across``, which is the title of the first of them."""
    parts = [
        own.set_index([*down])[[*shown]].rename(columns={shown[0]: title})
        for title, own in texts.groupby(across, sort=False)
    ]
    order = texts.set_index([*down]).index.unique()
    return pd.concat([part.reindex(order) for part in parts], axis=1).fillna(empty).reset_index()


def cells_of(frame: pd.DataFrame, *, rule: bool = True) -> pd.DataFrame:
    """Return percentages, their intervals, counts and times of rows as text; without a rule only the last two."""
    rows = records_of(frame)
    texts = {"%": [percent_text(row) for row in rows], "95 %": [interval_text(row) for row in rows]} if rule else {}
    texts["n"] = [str(row["n"]) if rule or row["n"] else NOT_RUN for row in rows]
    texts["time"] = [seconds(time_of(row)) if row["n"] else "" for row in rows]
    return pd.DataFrame(texts, index=frame.index)


def percent_text(row: Row) -> str:
    """Return the percentage of a cell."""
    return percent(row["percent"], row["n"]) if row["n"] else NOT_RUN


def interval_text(row: Row) -> str:
    """Return the interval of the percentage of a cell."""
    if not row["n"]:
        return ""
    return "-" if row["low"] is None else f"[{percent(row['low'], row['n'])}, {percent(row['high'], row['n'])}]"


def time_of(row: Row) -> float | None:
    """Return the time of one estimate: processor time, or wall time if only that is stored."""
    time: float | None = row["median_cpu_seconds"]
    return row["median_seconds"] if time is None else time


def notes_of(results: Results, out: Any) -> list[str]:
    """Return notes on the results."""
    notes = []
    if results.failed:
        command = f"ctid status {results.experiment}{out_option(out)}"
        notes.append(f"{results.failed} estimates failed; to see why: {command}")
    if results.stored.mixed:
        notes.append(f"{results.experiment} mixes results of different code versions or processors (--allow-mixed)")
    return notes


# --- an experiment --------------------------------------------------------------------------------------------------


@reported("computing the table")
def experiment_table(results: Results, remarks: Sequence[str] = ()) -> TableResult:
    """Return the table of one experiment: percentages, measures, or the estimates of a measured record."""
    if results.settings.get("data") is None and (names := default_measures(results)):
        return measure_table(results, names, remarks)
    frame = percentage_frame(results)
    if results.settings.get("data") is not None:
        return TableResult(_with_estimates(results, frame), _record_sections(results), remarks)
    head = Section(results.experiment, [f"Counted: {success_sentence(results.settings)}."])
    cells = cells_of(frame, rule=bool(results.settings.get("success")))
    meaning = f"{RULE} " if results.settings.get("success") else ""
    if is_of_signal(results.manifest):
        measured = [key for key in map(str, frame) if key.startswith(OF_FREQUENCIES)]
        texts = {title_of(key): [number(value, 3) for value in frame[key]] for key in measured}
        table = labels_of(frame, "method").join(cells.drop(columns="time")).assign(**texts, time=cells["time"])
        alarms = " alarms: false ones, in all data sets together." if "false_alarms" in frame else ""
        shown = [Section(table=Table.of_frame(table)), Section(notes=[f"{meaning}{SETTLING}{alarms} {TIME}."])]
    else:
        tables = [Section(table=Table.of_frame(table)) for table in _by_estimator(results, frame, cells)]
        shown = [*tables, Section(notes=[f"{meaning}{TIME}."])]
    return TableResult(records_of(frame), [head, *shown], remarks)


def title_of(key: str) -> str:
    """Return the title of measured frequencies."""
    return TITLES.get(key, key.removeprefix("median_").replace("_", " "))


def success_sentence(settings: Mapping[str, Any]) -> str:
    """Return the meaning of the percentages of an experiment."""
    rule = settings.get("success") or {}
    soon = f" within {rule['by']:g} s" if rule.get("by") is not None else ""
    parts = [sentence(rule[key], soon) for key, sentence in SUCCESS.items() if rule.get(key) is not None]
    if not parts:
        return "nothing, the specification has no success rule"
    return "percent of the data sets whose " + " and whose ".join(parts)


def _by_estimator(results: Results, frame: pd.DataFrame, cells: pd.DataFrame) -> list[pd.DataFrame]:
    """Return percentages: settings of the data and starts down, estimators with their options across."""
    options = results.swept("estimators")
    labels = labels_of(frame, options=options)
    labels = labels if len(labels.columns) else labels.assign(experiment=results.experiment)
    names = [named(row["method"], row, options) for row in records_of(frame)]
    texts = labels.join(cells).assign(title=[f"{name}: {cells.columns[0]}" for name in names])
    return [
        pivot(texts[texts["title"].isin(some)], [*labels], "title", [*cells])
        for some in _blocks(texts["title"].unique().tolist(), ESTIMATORS_PER_BLOCK)
    ]


def named(name: str, row: Mapping[str, Any], options: Sequence[str]) -> str:
    """Return the name of an estimator with the values of its swept options."""
    return ", ".join([name, *(f"{key} {number(row[key])}" for key in options if row[key] is not None)])


def _blocks(items: Sequence[Any], size: int) -> list[Sequence[Any]]:
    return [items[k : k + size] for k in range(0, len(items), size)]


# --- measures -------------------------------------------------------------------------------------------------------


@reported("computing the table")
def measure_table(results: Results, names: Sequence[str], remarks: Sequence[str] = ()) -> TableResult:
    """Return measures by name, those of parameters in one table, those of estimates in another, failures in a third."""
    frame = measure_frame(results, names).reset_index(drop=True)
    measures = {name: measure_of(name, results) for name in dict.fromkeys(names)}
    tables: dict[str, list[str]] = {}
    for name, measure in measures.items():
        kind = measure.source if measure.source in ("errors", "status") else "estimates"
        tables.setdefault("poles" if name.endswith(":poles") else kind, []).append(name)
    present = frame[(frame["measure"] != "failures") | (frame["value"] != 0)]
    parts = [part for own in tables.values() if len(part := present[present["measure"].isin(own)])]
    shown = [Section(table=Table.of_frame(_measured(part, measures))) for part in parts]
    meant = {name.partition(":")[0]: measure.meaning for name, measure in measures.items()}
    meanings = "; ".join(f"{name}: {meaning}" for name, meaning in meant.items())
    foot = f"{meanings}. ± is one Monte Carlo standard error, [ ] a 95 % interval; --format csv and json have both."
    if frame["without_value"].any():
        foot += " n: estimates that count; no value: those without what is measured, failed ones among them."
    if len(present) < len(frame):
        foot += " Statuses that no estimate ended with are left out."
    squared = frame["measure"].str.partition(":")[0].isin(OF_SQUARES)
    wide = squared & (frame["error"] > WIDE * frame["value"]) & (frame["n"] >= FEW)
    if wide.any() and "robust_deviation" not in meant:
        foot += (
            " Where ± exceeds half of the value, few large errors determine it; --measure median_bias,robust_deviation"
        )
        foot += " describe the other estimates."
    return TableResult(records_of(frame), [Section(results.experiment), *shown, Section(notes=[foot])], remarks)


def _measured(frame: pd.DataFrame, measures: Mapping[str, Measure]) -> pd.DataFrame:
    """Return swept fields, starts, estimators and parameters down, measures across."""
    labels = labels_of(frame, "method", "parameter")
    place, counted = labels.agg("\n".join, axis=1), counted_in(frame)
    # The count of most measures; a measure of fewer estimates shows its own.
    most = counted.groupby(place).transform("max")
    first = frame[["failed", "without_value"]].assign(fewer=counted < most, place=place)
    first = first.sort_values("fewer", kind="stable").groupby("place").first()
    counts = {"n": most.astype(str)}
    if not frame["measure"].isin(["failures"]).any():
        counts["failed"] = place.map(first["failed"]).astype(str)
    if frame["without_value"].any():
        counts["no value"] = place.map(first["without_value"]).astype(str)
    titles = {name: _title(name, measure) for name, measure in measures.items()}
    cells = [_cell(row, n, total) for row, n, total in zip(records_of(frame), counted, most, strict=True)]
    texts = labels.assign(**counts, title=frame["measure"].map(titles), cell=cells)
    table = pivot(texts, [*labels, *counts], "title", ["cell"])
    table = table[[*labels, *texts["title"].unique(), *counts]]
    return table.rename(columns={"parameter": "status"}) if "failures" in frame["measure"].values else table


def _title(name: str, measure: Measure) -> str:
    """Return a measure with its unit, unless that is the unit of its parameter."""
    of_parameter = measure.source == "errors" and measure.unit != "%"
    return name if of_parameter or measure.unit == "-" else f"{name} [{measure.unit}]"


def _cell(row: Row, n: int, most: int) -> str:
    """Return a value with its Monte Carlo error or interval, and its number of estimates if others have more."""
    if row["value"] is None:
        return "-"
    own = "" if n == most else f" (n {n})"
    if row["unit"] == "%" and row["low"] is not None and row["high"] is not None:
        return f"{row['value']:.1f} [{row['low']:.1f}, {row['high']:.1f}]{own}"
    return (number(row["value"], 4) if row["error"] is None else with_error(row["value"], row["error"])) + own


# --- a measured record ----------------------------------------------------------------------------------------------


def _with_estimates(results: Results, frame: pd.DataFrame) -> list[Row]:
    """Return the rows of a measured record with its estimates."""
    estimates = dict(zip(results.numbers.tolist(), results.stored, strict=True))
    found = [{key: estimates.get(group, {}).get(key) for key in OF_RECORDS} for group in frame.index]
    return [row | own for row, own in zip(records_of(frame), found, strict=True)]


def _record_sections(results: Results) -> list[Section]:
    """Return the estimates of a measured record across, parameters with standard errors and measures of fit down."""
    bounds = {item["name"]: item["content"].get("delay_bounds") for item in results.manifest["estimators"]}
    rows, options = list(results.stored), results.swept("estimators")
    fits = {("fit, estimation part", "%"): "fit_percent"}
    if any(item.get("validation_fit_percent") is not None for item in rows):
        fits["fit, validation part", "%"] = "validation_fit_percent"
    columns, names = {}, dict[tuple[str, str], None]()
    several = len({row["start"] for row in rows}) > 1
    for row in rows:
        found = {(one.name, one.unit): _with_error(one) for one in parameters(row, bounds.get(row["estimator"]))}
        names |= dict.fromkeys(found)
        found |= {("id", ""): row["id"], ("status", ""): row["status"]}
        found |= {line: number(row.get(key), 4) for line, key in fits.items()}
        found["time", ""] = seconds(row.get("cpu_seconds") or row.get("seconds"))
        title = named(row["estimator"], row, options)
        columns[title + (f", start {start_text(row['start'])}" if several else "")] = found
    lines = [("id", ""), ("status", ""), *names, *fits, ("time", "")]
    table = pd.DataFrame(columns).reindex(pd.MultiIndex.from_tuples(lines, names=["", "unit"])).fillna("-")
    blocks = [table[some] for some in _blocks([*table], ESTIMATES_PER_BLOCK)]
    sections = [Section(table=Table.of_frame(block[(block != "-").any(axis=1)].reset_index())) for block in blocks]
    marks = [f"{title}: {row['marks']}" for title, row in zip(columns, rows, strict=True) if row.get("marks")]
    foot = "± is one standard error. Fit: 100 (1 - ||y - x|| / ||y - mean y||) of the simulated output x."
    return [Section(results.experiment), *sections, Section(notes=[*marks, foot])]


def _with_error(item: UncertainValue) -> str:
    known = math.isfinite(item.standard_error)
    return with_error(item.estimate, item.standard_error) if known else f"{number(item.estimate)} ({item.status})"


def start_text(label: str) -> str:
    """Return the label of a start, with its unit if it is a delay."""
    try:
        return f"{float(label):g} s"
    except ValueError:
        return label
