"""One estimate: its parameters with their uncertainty, and as a row of an export."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from ctid_cli.reporting.layout import markdown_table, number, text_table

#: Keys that every estimate carries in machine-readable output, in this order.
ESTIMATE_KEYS = (
    "id",
    "experiment",
    "estimator",
    "cell",
    "replicate",
    "start",
    "status",
    "delay",
    "numerator",
    "denominator",
    "standard_errors",
    "cost",
    "fit_percent",
    "iterations",
    "seconds",
)

#: Half-width of a 95 % interval of a normal estimate, in standard errors.
NORMAL_95 = 1.959963984540054


@dataclass(frozen=True)
class Parameter:
    """One parameter of an estimate.

    Parameters
    ----------
    name : str
        ``b0``, ``a1``, ..., or ``delay``.
    estimate : float or None
        Its value, in ``unit``.
    standard_error : float or None
        Its asymptotic standard error, in ``unit``.
    relative_percent : float or None
        Standard error relative to the value [%].
    low, high : float or None
        95 % confidence interval, in ``unit``.
    unit : str
        Its unit, with the units of input and output written ``in`` and ``out``.
    status : str
        ``free``, ``fixed`` or ``at bound``.
    """

    name: str
    estimate: float | None
    standard_error: float | None
    relative_percent: float | None
    low: float | None
    high: float | None
    unit: str
    status: str

    def as_dict(self) -> dict[str, Any]:
        """The parameter of ``ctid show --json``."""
        return asdict(self)


def parameters(estimate: Mapping[str, Any], delay_bounds: Sequence[float] | None = None) -> list[Parameter]:
    """Parameters of an estimate with their uncertainty.

    Parameters
    ----------
    estimate : mapping
        A stored estimate: ``numerator``, ``denominator``, ``delay``, ``standard_errors``.
    delay_bounds : sequence of float, optional
        Range that the delay was searched in [s]; without one the delay was fixed.

    Returns
    -------
    list of Parameter
        Numerator, denominator (without its leading 1), delay; empty if there is no model.

    Examples
    --------
    >>> fit = {"numerator": [8.0], "denominator": [1.0, 4.0], "delay": 2.0, "standard_errors": {"b0": 0.4, "a1": 0.1}}
    >>> b0, a1, delay = parameters(fit)
    >>> b0.unit, b0.relative_percent, a1.unit, delay.status
    ('out/in/s', 5.0, '1/s', 'fixed')
    """
    numerator, denominator = estimate.get("numerator"), estimate.get("denominator")
    if not numerator or not denominator:
        return []
    errors = estimate.get("standard_errors") or {}
    order = len(denominator) - 1
    found = []
    for k, value in enumerate(numerator):
        power = order - (len(numerator) - 1 - k)
        found.append(_parameter(f"b{k}", value, errors.get(f"b{k}"), "out/in" + _per_second(power, "/"), "free"))
    for k, value in enumerate(denominator[1:], start=1):
        found.append(_parameter(f"a{k}", value, errors.get(f"a{k}"), _per_second(k, "1/"), "free"))
    delay = estimate.get("delay")
    status = "fixed"
    if delay_bounds is not None:
        low, high = delay_bounds
        at_bound = delay is not None and min(abs(delay - low), abs(high - delay)) <= 1e-9 * (high - low)
        status = "at bound" if at_bound else "free"
    found.append(_parameter("delay", delay, errors.get("delay"), "s", status))
    return found


def parameter_table(found: Iterable[Parameter], style: str = "text") -> str:
    """Parameters as an aligned or Markdown table.

    Parameters
    ----------
    found : iterable of Parameter
        Parameters.
    style : {"text", "md"}, default "text"
        Kind of table.

    Returns
    -------
    str
        The table.
    """
    header = ["parameter", "estimate", "standard error", "relative %", "95 % low", "95 % high", "unit", "status"]
    rows = [
        [
            item.name,
            number(item.estimate),
            number(item.standard_error, 3),
            number(item.relative_percent, 2),
            number(item.low),
            number(item.high),
            item.unit,
            item.status,
        ]
        for item in found
    ]
    return (text_table if style == "text" else markdown_table)(header, rows, "lrrrrrll")


def as_object(estimate: Mapping[str, Any]) -> dict[str, Any]:
    """An estimate for JSON: the documented keys first, then what else is stored.

    Parameters
    ----------
    estimate : mapping
        A stored estimate.

    Returns
    -------
    dict
        ``ESTIMATE_KEYS`` in order, then the others.
    """
    return {key: estimate.get(key) for key in ESTIMATE_KEYS} | {
        key: value for key, value in estimate.items() if key not in ESTIMATE_KEYS
    }


def _parameter(name: str, value: float | None, error: float | None, unit: str, status: str) -> Parameter:
    if value is None or error is None or not (math.isfinite(value) and math.isfinite(error)):
        return Parameter(name, value, error, None, None, None, unit, status)
    relative = 100 * error / abs(value) if value else None
    return Parameter(name, value, error, relative, value - NORMAL_95 * error, value + NORMAL_95 * error, unit, status)


def _per_second(power: int, prefix: str) -> str:
    if power == 0:
        return ""
    return f"{prefix}s" if power == 1 else f"{prefix}s^{power}"
