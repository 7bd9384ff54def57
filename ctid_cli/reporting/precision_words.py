"""How far the data cells of an experiment are from the precision that it asks for, in words and as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ctid_cli.reporting.layout import Table, count, number

if TYPE_CHECKING:
    from ctid_cli.inference.monte_carlo import CellPrecision, Widest

#: Data cells that a summary lists.
LISTED = 5
_STATES = {"enough": "precise enough", "open": "goes on", "at_most": "at_most reached"}


def precision_table(cells: Sequence[CellPrecision]) -> Table:
    """Every data cell with its widest interval."""
    swept = list(dict.fromkeys(name for cell in cells for name in cell.swept))
    rows = []
    for cell in cells:
        widest = cell.widest
        shown = [_measure(widest), _width(widest), _asked(widest)] if widest is not None else ["-", "-", "-"]
        row = [*(number(cell.swept.get(name)) for name in swept), str(cell.finished), str(cell.needed)]
        rows.append([*row, *shown, _STATES[cell.state]])
    header = [*swept, "data sets", "needed", "widest interval", "half-width", "asked", ""]
    return Table(header, rows, "l" * len(swept) + "rrlrrl")


def block_sentence(cells: Sequence[CellPrecision]) -> str:
    """What a finished block has brought."""
    more = [cell for cell in cells if cell.state == "open"]
    text = f"{len(more)} of {count(len(cells), 'data cell')} need more data sets, up to {max(c.needed for c in more)}"
    widest = max((cell for cell in more if cell.widest), key=_excess, default=None)
    return text if widest is None else f"{text}; widest interval: {_cell_sentence(widest)}"


def precision_lines(cells: Sequence[CellPrecision]) -> list[str]:
    """What a run has come to: how many data sets there are, and which data cells are not as precise as asked for."""
    if not cells or any(cell.state == "open" for cell in cells):
        return []
    sizes, missed = [cell.needed for cell in cells], [cell for cell in cells if cell.state == "at_most"]
    several = f"{min(sizes)} to {max(sizes)}" if min(sizes) < max(sizes) else str(max(sizes))
    if not missed:
        return [f"{several} data sets in each data cell: all intervals are as narrow as asked for"]
    lines = [f"{len(missed)} of {count(len(cells), 'data cell')} ended at {max(sizes)} data sets with wider intervals:"]
    lines += [f"  {_cell_sentence(cell)}" for cell in sorted(missed, key=_excess, reverse=True)[:LISTED]]
    return [*lines, f"  and {len(missed) - LISTED} more"] if len(missed) > LISTED else lines


def _cell_sentence(cell: CellPrecision) -> str:
    widest = cell.widest
    assert widest is not None
    return f"{_options(cell.swept)}{_measure(widest)}: {_width(widest)}, {_asked(widest)} asked"


def _options(values: Mapping[str, Any]) -> str:
    return "".join(f"{name} = {number(value)}, " for name, value in values.items())


def _measure(widest: Widest) -> str:
    start = "" if widest.start == "none" else f", start {widest.start}"
    options = "".join(f", {name} = {number(value)}" for name, value in widest.options.items())
    of = f"rmse of {widest.parameter}" if widest.measure == "rmse" else "percentage"
    return f"{of} ({widest.estimator}{options}{start})"


def _width(widest: Widest) -> str:
    return "not known" if widest.half_width is None else _with_unit(widest.half_width, widest)


def _asked(widest: Widest) -> str:
    return _with_unit(widest.asked, widest)


def _with_unit(half_width: float, widest: Widest) -> str:
    shown, unit = (100 * half_width, "%") if widest.measure == "rmse" else (half_width, "points")
    return f"± {shown:.3g} {unit}"


def _excess(cell: CellPrecision) -> float:
    assert cell.widest is not None
    return cell.widest.excess
