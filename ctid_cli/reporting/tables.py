"""Tables for people: published studies, experiments, and measured records."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ctid_cli.reporting.estimate import parameters
from ctid_cli.reporting.layout import (
    delay_label,
    interval,
    markdown_table,
    number,
    percent,
    seconds,
    text_table,
    with_error,
)
from ctid_cli.reporting.rows import Row, pooled_rows
from ctid_cli.reporting.study import Study, StudyTable

NOT_RUN = "not run"
RULE = "Estimates that failed count as not converged. 95 %: Wilson interval of the percentage."
TIME = "Time: median of one estimate."

#: Estimators side by side, and estimates of a measured record, before a table continues below.
GROUPS_PER_BLOCK = 2
ESTIMATES_PER_BLOCK = 3

#: Titles of the columns of measured frequencies.
MEASURE_TITLES = {
    "median_settling_time": "settling",
    "median_settling_after_step": "after step",
    "false_alarms": "alarms",
}

_SHORT = {"snr_db": ("SNR", " dB")}


def csv_text(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None) -> str:
    """Rows as CSV; an empty field where a row lacks a column."""
    names = list(columns if columns is not None else dict.fromkeys(key for row in rows for key in row))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, names, restval="", lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()


def setting_title(key: str) -> str:
    """A swept field as a column title."""
    return _SHORT.get(key, (key, ""))[0]


def setting_text(key: str, value: Any) -> str:
    """The value of a swept field, with its unit where the title does not say it."""
    return number(value) + (_SHORT.get(key, ("", ""))[1] if value is not None else "")


def study_table(study: Study, table: StudyTable, rows: Sequence[Row], style: str = "text") -> str:
    """A published table with our percentages in it."""
    delays = _delays(rows)
    heading = [f"Table {table.number}. {table.title}", f"Counted: {study.success}."]
    groups = _group(
        rows, lambda row: (row.sampling, tuple(row.settings.items()), row.method, row.initial_delay is None)
    )
    labels = list(dict.fromkeys(name for row in rows for name in row.settings))
    if len(delays) == 1 or style == "md":
        body = _study_flat(groups, delays, labels, style)
    else:
        body = _study_stacked(groups, delays, labels)
    pooled = _pooled(study, table, rows, style)
    foot = f"{RULE} {TIME[:-1]}; of several cells, the least to the greatest."
    foot += f" Published: {study.published_data_sets} data sets, {study.source}."
    startless = list(dict.fromkeys(row.method for row in rows if row.initial_delay is None))
    if startless:
        verb = "was" if len(startless) == 1 else "were"
        foot += f" {_listed(startless)} {verb} given no initial delay: one estimate per data set, "
        foot += "shown under every initial delay."
    shown = dict.fromkeys(row.method for row in rows)
    legend = "; ".join(f"{name}: {study.methods[name]}" for name in shown if name in study.methods) + "."
    if style == "md":
        return "\n\n".join(
            [f"### {heading[0]}", heading[1], body, "All cells of the table together:", pooled, foot, legend]
        )
    parts = [[*heading], [body], ["All cells of the table together:", pooled], [*_wrap(foot), *_wrap(legend)]]
    return "\n\n".join("\n".join(part) for part in parts)


def experiment_table(name: str, rows: Sequence[Row], success: str, style: str = "text") -> str:
    """Percentages of one experiment: swept data and starts down, estimators across."""
    keys = dict.fromkeys(key for row in rows for key, value in row.settings.items() if value is not None)
    down = [key for key in keys if not any(key in row.estimator_settings for row in rows)]

    def place(row: Row) -> tuple[Any, ...]:
        return (*(row.settings.get(key) for key in down), row.initial_delay)

    def column(row: Row) -> str:
        own = [
            f"{key} {number(row.settings[key])}" for key in row.estimator_settings if row.settings.get(key) is not None
        ]
        return ", ".join([row.method, *own])

    lines = list(dict.fromkeys(place(row) for row in rows))
    columns = list(dict.fromkeys(column(row) for row in rows))
    cells = {(place(row), column(row)): row for row in rows}
    draw = text_table if style == "text" else markdown_table
    blocks = []
    for first in range(0, len(columns), GROUPS_PER_BLOCK):
        block = columns[first : first + GROUPS_PER_BLOCK]
        header = [setting_title(key) for key in down] + ["initial delay"]
        for title in block:
            header += [f"{title}: %", "95 %", "n", "time"]
        body = []
        for line in lines:
            if not any((line, title) in cells for title in block):
                continue
            texts = [setting_text(key, value) for key, value in zip(down, line[:-1], strict=True)] + [
                delay_label(line[-1])
            ]
            for title in block:
                texts += _four(cells.get((line, title)))
            body.append(texts)
        blocks.append(draw(header, body, "l" * (len(down) + 1) + "rrrr" * len(block)))
    heading = [name, f"Counted: {success}."]
    foot = f"{RULE} {TIME}"
    if style == "md":
        return "\n\n".join([f"### {heading[0]}", heading[1], *blocks, foot])
    return "\n".join([*heading, "", "\n\n".join(blocks), "", *_wrap(foot)])


def frequency_table(name: str, rows: Sequence[Row], success: str, style: str = "text") -> str:
    """Frequencies of a signal: swept fields and estimators down, percentages and measures across."""
    keys = list(dict.fromkeys(key for row in rows for key in row.settings))
    measures = list(dict.fromkeys(key for row in rows for key in row.measures or {}))
    header = [*(setting_title(key) for key in keys), "estimator", "%", "95 %", "n"]
    header += [MEASURE_TITLES.get(key, key.removeprefix("median_").replace("_", " ")) for key in measures]
    body = []
    for row in rows:
        found = row.measures or {}
        texts = [setting_text(key, row.settings.get(key)) for key in keys] + [row.method]
        texts += [_percent(row), _interval(row) if row.n else "", str(row.n)]
        body.append([*texts, *(number(found.get(key), 3) for key in measures), _time(row)])
    header.append("time")
    align = "l" * (len(keys) + 1) + "r" * (len(measures) + 4)
    foot = f"{RULE} settling: median over the data sets of the time until the slowest tone is in the band to stay [s], "
    foot += "from the start and after the last step of a frequency; - is never, or unknown. rms: median over the data "
    foot += "sets of the root-mean-square error of each tone over the window [rad/s]. "
    if "false_alarms" in measures:
        foot += "alarms: false ones, in all data sets together. "
    foot += TIME
    if style == "md":
        table = markdown_table(header, body, align)
        return "\n\n".join([f"### {name}", f"Counted: {success}.", table, foot])
    counted = _wrap(f"Counted: {success}.")
    return "\n".join([name, *counted, "", text_table(header, body, align), "", *_wrap(foot)])


def record_table(
    name: str,
    estimates: Sequence[Mapping[str, Any]],
    bounds: Mapping[str, Sequence[float] | None],
    style: str = "text",
) -> str:
    """Estimates on a measured record: parameters with standard errors, and how well the models fit."""
    draw = text_table if style == "text" else markdown_table
    blocks = []
    for first in range(0, len(estimates), ESTIMATES_PER_BLOCK):
        block = estimates[first : first + ESTIMATES_PER_BLOCK]
        header = ["", "unit"] + [f"{item['estimator']}, start {_start(item['start'])}" for item in block]
        found = [{p.name: p for p in parameters(item, bounds.get(item["estimator"]))} for item in block]
        names = dict.fromkeys(parameter for one in found for parameter in one)
        body = [["id", ""] + [str(item["id"]) for item in block]]
        body.append(["status", ""] + [str(item["status"]) for item in block])
        for parameter in names:
            unit = next(one[parameter].unit for one in found if parameter in one)
            texts = []
            for one in found:
                item = one.get(parameter)
                if item is None:
                    texts.append("-")
                elif not math.isfinite(item.standard_error):
                    texts.append(f"{number(item.estimate)} ({item.status})")
                else:
                    texts.append(with_error(item.estimate, item.standard_error))
            body.append([parameter, unit, *texts])
        body.append(["fit, estimation part", "%"] + [number(item.get("fit_percent"), 4) for item in block])
        if any(item.get("validation_fit_percent") is not None for item in estimates):
            body.append(
                ["fit, validation part", "%"] + [number(item.get("validation_fit_percent"), 4) for item in block]
            )
        body.append(["time", ""] + [seconds(item.get("seconds")) for item in block])
        blocks.append(draw(header, body, "ll" + "r" * len(block)))
    foot = "± is one standard error. Fit: 100 (1 - ||y - x|| / ||y - mean y||) of the simulated output x."
    if style == "md":
        return "\n\n".join([f"### {name}", *blocks, foot])
    return "\n".join([name, "", "\n\n".join(blocks), "", *_wrap(foot)])


def _study_stacked(groups: list[list[Row]], delays: list[Any], labels: list[str]) -> str:
    """Four lines per method, so that six initial delays fit 100 columns."""
    header = ["sampling", *(setting_title(key) for key in labels), "method", "initial delay"]
    header += [delay_label(delay) for delay in delays]
    body: list[list[str]] = []
    last: list[str] = []
    for group in groups:
        names = _names(group[0], labels)
        # A label that the line above has already said is left out, as in a printed table.
        shown = [name if last[: k + 1] != names[: k + 1] else "" for k, name in enumerate(names)]
        if last and last[:-1] != names[:-1]:
            body.append([""] * len(header))
        last = names
        blank = [""] * len(names)
        ours = _across(group, delays)
        run = any(row.n for row in group)
        percents = [_percent(row) if row is None or row.n else "-" for row in ours]
        body.append([*shown, _n(group) if run else NOT_RUN, *percents])
        if run:
            body.append([*blank, "95 %", *(_whole_interval(row) for row in ours)])
        if any(row.published_percent is not None for row in group):
            body.append([*blank, "published", *(_published(row) for row in ours)])
        if run:
            body.append([*blank, "time", *(_time(row) for row in ours)])
    align = "l" * (len(labels) + 3) + "r" * len(delays)
    return text_table(header, body, align)


def _study_flat(groups: list[list[Row]], delays: list[Any], labels: list[str], style: str) -> str:
    header = ["sampling", *(setting_title(key) for key in labels), "method", "n"]
    body = []
    single = len(delays) == 1
    for group in groups:
        texts = [*_names(group[0], labels), _n(group).removeprefix("n = ")]
        for row in _across(group, delays):
            if single:
                texts += [_percent(row), _interval(row), _published(row)]
            else:
                texts.append(_together(row))
        times = [row.median_seconds for row in group if row.n and row.median_seconds is not None]
        body.append([*texts, _span(min(times, default=None), max(times, default=None))])
    header += ["percent", "95 %", "published"] if single else [delay_label(delay) for delay in delays]
    header.append("time")
    align = "l" * (len(labels) + 2) + "r" * (len(header) - len(labels) - 2)
    return (text_table if style == "text" else markdown_table)(header, body, align)


def _pooled(study: Study, table: StudyTable, rows: Sequence[Row], style: str) -> str:
    header = ["method", "cells", "n", "percent", "published", "time"]
    body = []
    for row in pooled_rows(study, table, rows):
        name = ", ".join([row.method, *(f"{key} {number(value)}" for key, value in row.settings.items())])
        cells = str(row.cells) if row.cells_run == row.cells else f"{row.cells_run} of {row.cells}"
        ours = NOT_RUN if row.percent is None else f"{row.percent:.1f}"
        published = "" if row.published_percent is None else f"{row.published_percent:.1f}"
        body.append([name, cells, str(row.n), ours, published, _span(row.least_seconds, row.greatest_seconds)])
    return (text_table if style == "text" else markdown_table)(header, body, "lrrrrr")


def _across(group: Sequence[Row], delays: Sequence[Any]) -> list[Row | None]:
    """A group's cell at every initial delay: the same one where there was none to start from."""
    cells = {row.initial_delay: row for row in group}
    return [cells.get(delay, cells.get(None)) for delay in delays]


def _names(row: Row, labels: Sequence[str]) -> list[str]:
    return [row.sampling or "-", *(setting_text(key, row.settings.get(key)) for key in labels), row.method]


def _together(row: Row | None) -> str:
    if row is None:
        return "-"
    ours = f"{_percent(row)} {_interval(row)}" if row.n else NOT_RUN
    return ours if row.published_percent is None else f"{ours} (pub {_published(row)})"


def _four(row: Row | None) -> list[str]:
    if row is None:
        return ["", "", "", ""]
    return [_percent(row), _interval(row) if row.n else "", str(row.n), seconds(row.median_seconds) if row.n else ""]


def _percent(row: Row | None) -> str:
    if row is None:
        return ""
    return percent(row.percent, row.n) if row.n else NOT_RUN


def _interval(row: Row | None) -> str:
    return interval(row.low, row.high, row.n) if row is not None and row.n else ""


def _whole_interval(row: Row | None) -> str:
    """Ends to whole percents, so that the columns stay narrow with more than 100 data sets as well."""
    if row is None or not row.n or row.low is None or row.high is None:
        return ""
    return f"{row.low:.0f}-{row.high:.0f}"


def _time(row: Row | None) -> str:
    return seconds(row.median_seconds) if row is not None and row.n else ""


def _span(least: float | None, greatest: float | None) -> str:
    """Range of the cells' median times."""
    ends = list(dict.fromkeys(seconds(end) for end in (least, greatest) if end is not None))
    return " to ".join(ends)


def _published(row: Row | None) -> str:
    return "" if row is None or row.published_percent is None else number(row.published_percent)


def _n(group: Sequence[Row]) -> str:
    counts = sorted({row.n for row in group if row.n})
    if not counts:
        return "n = 0"
    return f"n = {counts[0]}" if len(counts) == 1 else f"n = {counts[0]}-{counts[-1]}"


def _delays(rows: Sequence[Row]) -> list[Any]:
    delays = {row.initial_delay for row in rows}
    numbers = sorted(delay for delay in delays if isinstance(delay, int | float))
    return [*numbers, *(["random"] if "random" in delays else [])]


def _group(rows: Sequence[Row], key: Callable[[Row], Any]) -> list[list[Row]]:
    groups: dict[Any, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return list(groups.values())


def _start(label: str) -> str:
    try:
        return f"{float(label):g} s"
    except ValueError:
        return label


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _wrap(text: str, width: int = 98) -> list[str]:
    import textwrap

    return textwrap.wrap(text, width)
