"""What ``ctid check pmu`` says: the worst error of every test beside its limit."""

from typing import Any

from ctid_cli.frequency.synchrophasor_check import CheckedLimit, SynchrophasorCheck
from ctid_cli.frequency.synchrophasor_limits import QUANTITIES, TESTS
from ctid_cli.reporting.layout import Report, Table, number, picked

#: Short names of the quantities, for a table.
_SHORT = {
    "tve": "TVE",
    "fe": "FE",
    "rfe": "RFE",
    "tve_response": "TVE response",
    "fe_response": "FE response",
    "rfe_response": "RFE response",
    "delay": "delay",
    "overshoot": "overshoot",
    "latency": "latency",
}


def check_object(check: SynchrophasorCheck) -> dict[str, Any]:
    """A check as JSON-able content."""
    return {
        **picked(check, ("passed", "nominal", "performance_class", "reporting_rate", "sampling_rate")),
        "limits": [_row(row) for row in check.rows],
    }


def _row(row: CheckedLimit) -> dict[str, Any]:
    limit = row.limit
    return {
        "test": limit.test,
        "quantity": limit.quantity,
        "unit": QUANTITIES[limit.quantity][1],
        "worst": row.worst,
        "limit": limit.largest,
        "passed": row.passed,
        "condition": row.condition,
        "source": limit.source,
    }


def _table(check: SynchrophasorCheck) -> Table:
    """The worst of every test beside its limit; what has none has a dash."""
    cells, before = [], ""
    for row in check.rows:
        limit, unit = row.limit, QUANTITIES[row.limit.quantity][1].removesuffix(" of the step")
        limited = number(limit.largest, 3) if row.passed else f"{number(limit.largest, 3)} !"
        source = limit.source.partition(", ")[2]
        test = TESTS[limit.test] if limit.test != before else ""
        cells.append([test, f"{_SHORT[limit.quantity]} [{unit}]", number(row.worst, 2), limited, source, row.condition])
        before = limit.test
    return Table(["test", "quantity", "worst", "limit", "source", "worst at"], cells, "llrrll")


def check_report(check: SynchrophasorCheck) -> Report:
    """A check for people."""
    failed = sum(not row.passed for row in check.rows)
    limited = sum(row.limit.largest is not None for row in check.rows)
    which = f"class {check.performance_class} at {check.nominal} Hz, {check.reporting_rate} reports a second"
    verdict = f"PASS: {which}: all {limited} limits are kept."
    if failed:
        verdict = f"NOT PASSED: {which}: {failed} of {limited} limits are exceeded (!)."
    order = min(50, int(0.5 * check.sampling_rate / check.nominal - 1e-9))
    clock = f"One phase, {check.sampling_rate:g} samples a second, harmonics up to the {order}th, no noise."
    foot = (
        "TVE: error of the phasor; FE, RFE: errors of the frequency and its rate of change; response: time from "
        "leaving to keeping the limit of a steady signal for good; a dash: no limit."
    )
    tables = "Table 3 is that of IEEE C37.118.1-2011, the others are those of its amendment IEEE C37.118.1a-2014."
    return Report([[verdict, clock], [_table(check), foot, tables]])
