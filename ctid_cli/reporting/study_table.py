"""A published table with our percentages in it, as blocks of a report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ctid_cli.reporting.layout import Table, delay_label, interval, number, percent, seconds
from ctid_cli.reporting.percentages import Row, pooled_rows, settings_of
from ctid_cli.reporting.study import Study, StudyTable
from ctid_cli.text import listed

NOT_RUN = "not run"
RULE = "Estimates that failed count as not converged. 95 %: Wilson interval of the percentage."
TIME = "Time: median of one estimate"

_SHORT = {"snr_db": ("SNR", " dB")}


def setting_title(key: str) -> str:
    """A swept field as a column title."""
    return _SHORT.get(key, (key, ""))[0]


def setting_text(key: str, value: Any) -> str:
    """The value of a swept field, with its unit where the title does not say it."""
    return number(value) + (_SHORT.get(key, ("", ""))[1] if value is not None else "")


def percent_text(row: Row) -> str:
    """The percentage of a cell."""
    return percent(row["percent"], row["n"]) if row["n"] else NOT_RUN


def interval_text(row: Row) -> str:
    """The interval of a cell's percentage."""
    return interval(row["low"], row["high"], row["n"]) if row["n"] else ""


def time_text(row: Row) -> str:
    """The time of a cell."""
    return seconds(row["median_seconds"]) if row["n"] else ""


def study_blocks(
    study: Study, table: StudyTable, rows: Sequence[Row], style: str = "text", options: Sequence[str] = ()
) -> list[list[str | Table]]:
    """A published table, all its cells together, and what its columns mean."""
    labels = settings_of(rows)
    given = {row["initial_delay"] for row in rows} - {None}
    delays = sorted(given - {"random"}) + ["random"] * ("random" in given)

    def group_of(row: Row) -> tuple[Any, ...]:
        return (row["sampling"], *(row[key] for key in labels), row["method"], row["initial_delay"] is None)

    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(group_of(row), []).append(row)
    header = ["sampling", *map(setting_title, labels), "method"]
    stacked = style != "md" and len(delays) > 1
    body = (_stacked if stacked else _flat)(header, list(groups.values()), delays, labels)
    foot = f"{RULE} {TIME}; of several cells, the least to the greatest."
    foot += f" Published: {study.published_data_sets} data sets, {study.source}."
    methods = list(dict.fromkeys(row["method"] for row in rows))
    startless = [
        name for name in methods if any(row["method"] == name and row["initial_delay"] is None for row in rows)
    ]
    if startless:
        foot += f" {listed(startless)} {'was' if len(startless) == 1 else 'were'} given no initial delay: one estimate "
        foot += "per data set, shown under every initial delay."
    legend = "; ".join(f"{name}: {study.methods[name]}" for name in methods if name in study.methods) + "."
    return [
        [f"### Table {table.number}. {table.title}", f"Counted: {study.success}."],
        [body],
        ["All cells of the table together:", _pooled(pooled_rows(study, table, rows, options))],
        [foot, legend],
    ]


def _stacked(header: list[str], groups: list[list[Row]], delays: list[Any], labels: list[str]) -> Table:
    """Four lines per method, so that six initial delays fit the width of a page."""
    header = [*header, "initial delay", *map(delay_label, delays)]
    body: list[list[str]] = []
    last: list[str] = []
    for group in groups:
        names = _names(group[0], labels)
        # A label that the line above has already said is left out, as in a printed table.
        shown = [name if last[: k + 1] != names[: k + 1] else "" for k, name in enumerate(names)]
        if last and last[:-1] != names[:-1]:
            body.append([""] * len(header))
        last, blank = names, [""] * len(names)
        ours, run = _across(group, delays), any(row["n"] for row in group)
        percents = ["" if row is None else percent_text(row) if row["n"] else "-" for row in ours]
        body.append([*shown, f"n = {_sizes(group)}" if run else NOT_RUN, *percents])
        if run:
            body.append([*blank, "95 %", *("" if row is None else _whole_interval(row) for row in ours)])
        if any(row["published_percent"] is not None for row in group):
            body.append([*blank, "published", *map(_published, ours)])
        if run:
            body.append([*blank, "time", *("" if row is None else time_text(row) for row in ours)])
    return Table(header, body, "l" * (len(labels) + 3) + "r" * len(delays))


def _flat(header: list[str], groups: list[list[Row]], delays: list[Any], labels: list[str]) -> Table:
    """One line per method."""
    body = []
    single = len(delays) == 1
    for group in groups:
        texts = [*_names(group[0], labels), _sizes(group)]
        for row in _across(group, delays):
            if row is None:
                texts += ["", "", ""] if single else ["-"]
            elif single:
                texts += [percent_text(row), interval_text(row), _published(row)]
            else:
                published = "" if row["published_percent"] is None else f" (pub {_published(row)})"
                texts.append(f"{percent_text(row)} {interval_text(row)}".rstrip() + published)
        body.append([*texts, _span([row["median_seconds"] for row in group if row["n"]])])
    columns = ["percent", "95 %", "published"] if single else list(map(delay_label, delays))
    return Table([*header, "n", *columns, "time"], body, "l" * len(header) + "r" * (len(columns) + 2))


def _pooled(rows: Sequence[Row]) -> Table:
    own = ("method", "cells", "cells_run", "n", "converged", "percent", "published_percent", "seconds")
    body = [
        [
            ", ".join([row["method"], *(f"{key} {number(row[key])}" for key in row if key not in own)]),
            str(row["cells"]) if row["cells_run"] == row["cells"] else f"{row['cells_run']} of {row['cells']}",
            str(row["n"]),
            NOT_RUN if row["percent"] is None else f"{row['percent']:.1f}",
            "" if row["published_percent"] is None else f"{row['published_percent']:.1f}",
            _span(row["seconds"]),
        ]
        for row in rows
    ]
    return Table(["method", "cells", "n", "percent", "published", "time"], body, "lrrrrr")


def _across(group: Sequence[Row], delays: Sequence[Any]) -> list[Row | None]:
    """A group's cell at every initial delay: the same one where there was none to start from."""
    cells = {row["initial_delay"]: row for row in group}
    return [cells.get(delay, cells.get(None)) for delay in delays]


def _names(row: Row, labels: Sequence[str]) -> list[str]:
    return [row["sampling"] or "-", *(setting_text(key, row[key]) for key in labels), row["method"]]


def _sizes(group: Sequence[Row]) -> str:
    counts = sorted({row["n"] for row in group if row["n"]}) or [0]
    return "-".join(map(str, dict.fromkeys([counts[0], counts[-1]])))


def _whole_interval(row: Row) -> str:
    """Ends to whole percents, so that the columns stay narrow with more than 100 data sets as well."""
    return f"{row['low']:.0f}-{row['high']:.0f}" if row["n"] and row["low"] is not None else ""


def _published(row: Row | None) -> str:
    return "" if row is None or row["published_percent"] is None else number(row["published_percent"])


def _span(times: Sequence[float | None]) -> str:
    """Range of the cells' median times."""
    known = [time for time in times if time is not None]
    return " to ".join(dict.fromkeys(map(seconds, (min(known), max(known))))) if known else ""
