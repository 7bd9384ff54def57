"""Tables as blocks of a report: published ones with our percentages in them, and those of an experiment."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ctid_cli.inference.intervals import UncertainValue
from ctid_cli.reporting.estimate import parameters
from ctid_cli.reporting.layout import Table, delay_label, number, percent, seconds, with_error
from ctid_cli.reporting.percentages import Row, measures_of, pooled_rows, settings_of, time_of
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.study import Study, StudyTable
from ctid_cli.text import listed

Blocks = list[list[str | Table]]

NOT_RUN = "not run"
RULE = "Estimates that failed count as not converged. 95 %: Wilson interval of the percentage."
TIME = "Time: median of one estimate, of the processor where that is stored"

#: Estimators side by side, and estimates of a measured record, before a table continues below.
GROUPS_PER_BLOCK = 2
ESTIMATES_PER_BLOCK = 3

#: Titles of the columns of measured frequencies.
MEASURE_TITLES = {"median_settling_time": "settling", "median_settling_after_step": "after step"}

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
    if not row["n"]:
        return ""
    return "-" if row["low"] is None else f"[{percent(row['low'], row['n'])}, {percent(row['high'], row['n'])}]"


def time_text(row: Row) -> str:
    """The time of a cell."""
    return seconds(time_of(row)) if row["n"] else ""


def study_blocks(
    study: Study, table: StudyTable, rows: Sequence[Row], style: str = "text", options: Sequence[str] = ()
) -> Blocks:
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
    published = f"Published: {study.published_data_sets} data sets, {study.source}."
    foot = f"{RULE} {TIME}; of several cells, the least to the greatest. {published}"
    methods = list(dict.fromkeys(row["method"] for row in rows))
    startless = list(dict.fromkeys(row["method"] for row in rows if row["initial_delay"] is None))
    if startless:
        shown = "one estimate per data set, shown under every initial delay"
        foot += f" {listed(startless)} {'was' if len(startless) == 1 else 'were'} given no initial delay: {shown}."
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
        last, ours = names, _across(group, delays)
        for title, text in _lines(group).items():
            body.append([*shown, title, *("" if row is None else text(row) for row in ours)])
            shown = [""] * len(names)
    return Table(header, body, "l" * (len(labels) + 3) + "r" * len(delays))


def _lines(group: list[Row]) -> dict[str, Callable[[Row], str]]:
    """What is said of a method, line by line."""
    run = any(row["n"] for row in group)
    first = f"n = {_sizes(group)}" if run else NOT_RUN
    lines: dict[str, Callable[[Row], str]] = {first: lambda row: percent_text(row) if row["n"] else "-"}
    lines |= {"95 %": _whole_interval} if run else {}
    lines |= {"published": _published} if any(row["published_percent"] is not None for row in group) else {}
    return lines | ({"time": time_text} if run else {})


def _flat(header: list[str], groups: list[list[Row]], delays: list[Any], labels: list[str]) -> Table:
    """One line per method."""
    body = []
    single = len(delays) == 1
    for group in groups:
        texts = [*_names(group[0], labels), _sizes(group)]
        for row in _across(group, delays):
            cells = ["", "", ""] if row is None else [percent_text(row), interval_text(row), _published(row)]
            one = " ".join(cells[:2]).rstrip() + (f" (pub {cells[2]})" if cells[2] else "")
            texts += cells if single else [one or "-"]
        body.append([*texts, _span([time_of(row) for row in group if row["n"]])])
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


def _published(row: Row) -> str:
    return "" if row["published_percent"] is None else number(row["published_percent"])


def _span(times: Sequence[float | None]) -> str:
    """Range of the cells' median times."""
    known = [time for time in times if time is not None]
    return " to ".join(dict.fromkeys(map(seconds, (min(known), max(known))))) if known else ""


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


def percentage_blocks(results: Results, rows: Sequence[Row]) -> Blocks:
    """Swept data and starts down, estimators across."""
    options = results.swept("estimators")
    down = [key for key in settings_of(rows) if key not in options and any(row[key] is not None for row in rows)]
    cells: dict[tuple[Any, ...], dict[str, Row]] = {}
    for row in rows:
        own = (f"{key} {number(row[key])}" for key in options if row[key] is not None)
        place = (*(row[key] for key in down), row["initial_delay"])
        cells.setdefault(place, {})[", ".join([row["method"], *own])] = row
    titles = list(dict.fromkeys(title for line in cells.values() for title in line))
    blocks = [titles[k : k + GROUPS_PER_BLOCK] for k in range(0, len(titles), GROUPS_PER_BLOCK)]
    judged = _judged(results)
    tables: Blocks = [[_percentage_table(down, block, cells, judged)] for block in blocks]
    return [_heading(results), *tables, [f"{RULE} {TIME}." if judged else f"{TIME}."]]


def _percentage_table(
    down: Sequence[str], titles: Sequence[str], cells: Mapping[tuple[Any, ...], Mapping[str, Row]], judged: bool
) -> Table:
    columns = [*_counts(judged), "time"]
    header = [*map(setting_title, down), "initial delay"]
    header += [text for title in titles for text in (f"{title}: {columns[0]}", *columns[1:])]
    empty = [""] * len(columns)
    body = [
        [*map(setting_text, down, place), delay_label(place[-1])]
        + [text for title in titles for text in (_told(line[title], judged) if title in line else empty)]
        for place, line in cells.items()
        if not line.keys().isdisjoint(titles)
    ]
    return Table(header, body, "l" * (len(down) + 1) + "r" * len(columns) * len(titles))


def _judged(results: Results) -> bool:
    """Whether there is a rule by which an estimate counts as converged."""
    return bool(results.settings.get("success"))


def _counts(judged: bool) -> list[str]:
    """Columns that count estimates; without a rule there is no percentage."""
    return ["%", "95 %", "n"] if judged else ["n"]


def _told(row: Row, judged: bool) -> list[str]:
    """Counts and time of a cell."""
    counts = [percent_text(row), interval_text(row), str(row["n"])] if judged else [str(row["n"] or NOT_RUN)]
    return [*counts, time_text(row)]


def _heading(results: Results) -> list[str | Table]:
    return [f"### {results.experiment}", f"Counted: {success_sentence(results.settings)}."]


def frequency_blocks(results: Results, rows: Sequence[Row]) -> Blocks:
    """Swept fields and estimators down, percentages and measures across."""
    keys, measures, judged = settings_of(rows), measures_of(rows), _judged(results)
    plain = (key.removeprefix("median_").removeprefix("false_").replace("_", " ") for key in measures)
    titles = (MEASURE_TITLES.get(key, title) for key, title in zip(measures, plain, strict=True))
    header = [*map(setting_title, keys), "estimator", *_counts(judged), *titles, "time"]
    body = [
        [
            *(setting_text(key, row[key]) for key in keys),
            *(row["method"], *_told(row, judged)[:-1]),
            *(number(row[key], 3) for key in measures),
            time_text(row),
        ]
        for row in rows
    ]
    settling = (
        "settling: time until the slowest tone is in the band to stay [s], from the start and after the last step"
    )
    rms = "rms: root-mean-square error of each tone over the window [rad/s]; medians over the data sets"
    alarms = " alarms: false ones, in all data sets together." if "false_alarms" in measures else ""
    foot = f"{settling}; - is never, or unknown. {rms}.{alarms} {TIME}."
    table = Table(header, body, "l" * (len(keys) + 1) + "r" * (len(header) - len(keys) - 1))
    return [_heading(results), [table], [f"{RULE} {foot}" if judged else foot]]


def record_blocks(results: Results) -> Blocks:
    """Estimates of a measured record across, parameters with standard errors and measures of fit down."""
    bounds = {item["name"]: item["content"].get("delay_bounds") for item in results.manifest["estimators"]}
    rows = list(results.rows)
    fits = {"fit, estimation part": "fit_percent"}
    if any(item.get("validation_fit_percent") is not None for item in rows):
        fits["fit, validation part"] = "validation_fit_percent"
    blocks = [rows[k : k + ESTIMATES_PER_BLOCK] for k in range(0, len(rows), ESTIMATES_PER_BLOCK)]
    tables: Blocks = [[_record_table(block, bounds, fits)] for block in blocks]
    foot = "± is one standard error. Fit: 100 (1 - ||y - x|| / ||y - mean y||) of the simulated output x."
    return [[f"### {results.experiment}"], *tables, [foot]]


def _record_table(block: Sequence[Row], bounds: Mapping[str, Any], fits: Mapping[str, str]) -> Table:
    body = [[key, "", *(str(row[key]) for row in block)] for key in ("id", "status")]
    body += _parameter_lines([parameters(row, bounds.get(row["estimator"])) for row in block])
    body += [[title, "%", *(number(row.get(key), 4) for row in block)] for title, key in fits.items()]
    body.append(["time", "", *(seconds(row.get("cpu_seconds") or row.get("seconds")) for row in block)])
    header = ["", "unit", *(f"{row['estimator']}, start {_start(row['start'])}" for row in block)]
    return Table(header, body, "ll" + "r" * len(block))


def _parameter_lines(block: Sequence[Sequence[UncertainValue]]) -> list[list[str]]:
    found = [{item.name: item for item in one} for one in block]
    first = {name: item for one in reversed(found) for name, item in one.items()}
    names = dict.fromkeys(itertools.chain(*found))
    return [[name, first[name].unit, *(_with_error(one.get(name)) for one in found)] for name in names]


def _with_error(item: UncertainValue | None) -> str:
    if item is None:
        return "-"
    known = math.isfinite(item.standard_error)
    return with_error(item.estimate, item.standard_error) if known else f"{number(item.estimate)} ({item.status})"


def _start(label: str) -> str:
    try:
        return f"{float(label):g} s"
    except ValueError:
        return label
