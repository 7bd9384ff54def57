"""What ``ctid check filters`` says of a filter set: whether it leads from every delay error to zero, and how."""

from typing import Any

from ctid_cli.filtering.filter_set import FilterCheck, FilterSet, convergence_region, sufficient_number_of_filters
from ctid_cli.reporting.layout import Report, Table, count, number


def filter_object(filters: FilterSet, check: FilterCheck) -> dict[str, Any]:
    """A check of a filter set as JSON-able content."""
    regions = (convergence_region(float(cutoff), exact=check.exact) for cutoff in filters.cutoffs)
    rows = zip(range(1, filters.count + 1), filters.periods.tolist(), filters.cutoffs.tolist(), regions, strict=True)
    return {
        "passes": check.passes,
        "bandwidth": filters.bandwidth,
        "beta": filters.beta,
        "largest_error": check.largest_error,
        "filters": [dict(zip(("filter", "period", "cutoff", "convergence_region"), row, strict=True)) for row in rows],
        "intervals": _best(check),
        "gaps": [{"low": low, "high": high} for low, high in check.gaps],
        "path": [{"filter": k + 1, "error": error} for k, error in check.path(check.largest_error)],
        "sufficient_number": sufficient_number_of_filters(filters.beta, filters.bandwidth, check.largest_error),
    }


def _best(check: FilterCheck) -> list[dict[str, Any]]:
    """Intervals of delay errors with their best filter, neighbours with the same one merged."""
    rows: list[dict[str, Any]] = []
    for interval in check.intervals:
        best = interval.filters[0] + 1
        last = rows[-1] if rows else {}
        if (last.get("high"), last.get("filter"), last.get("minimum")) == (interval.low, best, interval.minimum):
            last["high"] = interval.high
        else:
            rows.append({"low": interval.low, "high": interval.high, "filter": best, "minimum": interval.minimum})
    return rows


def filter_text(filters: FilterSet, check: FilterCheck) -> str:
    """A check of a filter set for people."""
    content = filter_object(filters, check)
    top = _time(check.largest_error)
    keys = ("period", "cutoff", "convergence_region")
    filter_rows = [[str(row["filter"]), *(number(row[key], 4) for key in keys)] for row in content["filters"]]
    error_rows = []
    for row in sorted([*content["intervals"], *content["gaps"]], key=lambda row: float(row["low"])):
        leads = number(row["minimum"], 5) if "minimum" in row else "nothing closer"
        span = f"{number(row['low'], 5)} to {number(row['high'], 5)}"
        error_rows.append([span, str(row.get("filter", "none")), leads])
    longest = f"periods from {number(filters.beta, 4)} to 1 times {_time(float(filters.periods[-1]))}"
    text = f"{count(filters.count, 'filter')}, {longest}, that of the bandwidth {number(filters.bandwidth, 4)} rad/s."
    alone = Table(["filter", "period [s]", "cut-off [rad/s]", "alone from [s]"], filter_rows, "rrrr")
    leading = Table(["delay error [s]", "filter", "leads to [s]"], error_rows, "lrr")
    remark = "Checked is the necessary condition for ideal filters, white input and a known rational part, no noise."
    blocks: list[list[str | Table]] = [
        [_verdict(content, top)],
        [text],
        [alone, "alone from: delay errors up to this one lead to zero with this filter alone."],
        [leading, "filter: of those that lead closer to zero, the one that leads closest."],
        [_path(content)],
        [_sufficient(content, top)],
        [remark],
    ]
    return Report(blocks).draw()


def _time(value: float) -> str:
    return f"{number(value, 5)} s"


def _verdict(content: dict[str, Any], top: str) -> str:
    gaps = content["gaps"]
    if not gaps:
        return f"PASS: from every delay error up to {top} some filter leads closer to zero, and so on down to zero."
    where = ", ".join(f"{number(gap['low'], 5)} to {_time(gap['high'])}" for gap in gaps[:3])
    more = f" and {count(len(gaps) - 3, 'more gap')}" if len(gaps) > 3 else ""
    text = f"NOT PASSED: from some delay errors up to {top} no filter leads closer to zero: {where}{more}."
    return f"{text} Up to {_time(gaps[0]['low'])} there is no gap."


def _path(content: dict[str, Any]) -> str:
    steps = [f"{number(step['error'], 5)} (filter {step['filter']})" for step in content["path"]]
    if not steps:
        return "No path: no filter leads closer to zero from the largest error."
    stuck = "" if content["path"][-1]["error"] == 0 else "; from there no filter leads closer"
    return f"Path [s] from {number(content['largest_error'], 5)}: {', '.join(steps)}{stuck}."


def _sufficient(content: dict[str, Any], top: str) -> str:
    enough, filters = content["sufficient_number"], content["filters"]
    if filters[0]["convergence_region"] >= content["largest_error"]:
        return f"One filter suffices: that of the longest period leads from {top} to zero by itself."
    if enough == 1 or (len(filters) >= enough and not content["passes"]):
        asks = f"Equation (56) asks for {count(enough, 'filter')}"
        return f"{asks}, but rests on extrema that are up to 0.15 % off, too much here: a larger beta helps."
    text = f"Sufficient by (56) for delay errors up to {top}: {count(enough, 'filter')}."
    return f"{text} Fewer may do, and more of them may fail: below that number check each set."
