"""Measures of an experiment as tables: what is measured of the same parameters side by side."""

from collections.abc import Callable, Sequence
from typing import Any

from ctid_cli.inference.monte_carlo import Measure
from ctid_cli.reporting.layout import Report, Table, delay_label, number, with_error
from ctid_cli.reporting.measures import counted_in, measure_of, measure_rows
from ctid_cli.reporting.percentages import Row, settings_of
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.table_blocks import NOT_RUN, setting_text, setting_title

#: What stands before the measures beside the swept fields, and how it is written.
TEXTS: dict[str, Callable[[Any], str]] = {"initial_delay": delay_label, "method": str, "parameter": number}


def measure_report(results: Results, names: Sequence[str], notes: Sequence[str] = ()) -> Report:
    """Measures by name, those of parameters in one table, those of estimates in another, failures in a third."""
    rows = measure_rows(results, names)
    tables: dict[str, list[str]] = {}
    for name in dict.fromkeys(names):
        source = measure_of(name, results).source
        kind = source if source in ("errors", "status") else "estimates"
        tables.setdefault("poles" if name.endswith(":poles") else kind, []).append(name)
    blocks = [[_table(results, [row for row in rows if row["measure"] in own], own)] for own in tables.values()]
    told = {name.partition(":")[0]: measure_of(name, results).meaning for name in names}
    meanings = "; ".join(f"{name}: {meaning}" for name, meaning in told.items())
    foot = f"{meanings}. ± is one Monte Carlo standard error, [ ] a 95 % interval; --format csv and json have both."
    if any(row["without_value"] for row in rows):
        foot += " n: estimates that count; no value: those without what is measured, failed ones among them."
    return Report([[f"### {results.experiment}"], *blocks, [foot]], rows, notes)


def _table(results: Results, rows: Sequence[Row], names: Sequence[str]) -> Table:
    """Swept fields, starts, estimators and parameters down, measures across."""
    fields = [key for key in settings_of(rows) if any(row[key] is not None for row in rows)]
    keys = [*fields, *(key for key in TEXTS if any(row[key] is not None for row in rows))]
    lacking = any(row["without_value"] for row in rows)
    lines: dict[tuple[Any, ...], dict[str, Row]] = {}
    for row in rows:
        lines.setdefault(tuple(row[key] for key in keys), {})[row["measure"]] = row
    body = []
    for place, found in lines.items():
        # What most measures count; a measure of fewer estimates has its number beside it.
        some = max(found.values(), key=lambda row: (counted_in(row), row["without_value"]))
        n = counted_in(some)
        cells = [TEXTS[key](at) if key in TEXTS else setting_text(key, at) for key, at in zip(keys, place, strict=True)]
        cells += [_cell(found.get(name), n) for name in names]
        cells += [str(n), str(some["failed"])] if some["n"] else [NOT_RUN, ""]
        body.append(cells + ([str(some["without_value"])] if lacking else []))
    titles = {"initial_delay": "initial delay", "parameter": "status" if "failures" in names else "parameter"}
    header = [titles.get(key) or setting_title(key) for key in keys]
    header += [_title(name, measure_of(name, results)) for name in names]
    header += ["n", "failed", *(["no value"] if lacking else [])]
    return Table(header, body, "l" * len(keys) + "r" * (len(header) - len(keys)))


def _title(name: str, measure: Measure) -> str:
    """A measure with its unit; one in the unit of its parameter has none."""
    of_parameter = measure.source == "errors" and measure.unit != "%"
    return name if of_parameter or measure.unit == "-" else f"{name} [{measure.unit}]"


def _cell(row: Row | None, n: int) -> str:
    """Value with its Monte Carlo error or interval; its number of estimates where that is not the n of the line."""
    if row is None or row["value"] is None:
        return "-"
    own = "" if counted_in(row) == n else f" (n {counted_in(row)})"
    if row["unit"] == "%" and row["low"] is not None and row["high"] is not None:
        return f"{row['value']:.1f} [{row['low']:.1f}, {row['high']:.1f}]{own}"
    return (number(row["value"], 4) if row["error"] is None else with_error(row["value"], row["error"])) + own
