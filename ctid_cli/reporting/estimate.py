"""Parameters of an estimate with their uncertainty."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from math import nan
from typing import Any

from ctid_cli.inference.intervals import NORMAL, UncertainValue
from ctid_cli.inference.units import Units
from ctid_cli.reporting.document import Column
from ctid_cli.reporting.layout import picked


def parameters(estimate: Mapping[str, Any], delay_bounds: Sequence[float] | None = None) -> list[UncertainValue]:
    """Return the parameters of an estimate with their uncertainty."""
    numerator, denominator = estimate.get("numerator"), estimate.get("denominator")
    given, units = estimate.get("parameters") or {}, Units()
    # Estimates stored without quantiles have intervals of the normal distribution.
    reach = estimate.get("quantiles") or {}
    errors = {name: (error, reach.get(name)) for name, error in (estimate.get("standard_errors") or {}).items()}
    if not numerator or not denominator:
        return [_found(name, value, errors, "") for name, value in given.items()]
    submodels = {name: value for name, value in given.items() if re.match(r"g\d+_", name)}
    values = {f"b{k}": value for k, value in enumerate(numerator)}
    values |= {f"a{k}": value for k, value in enumerate(denominator[1:], start=1)}
    if submodels and not values.keys() & errors.keys():
        values = {}
    named = {name: units.of(name, len(denominator) - 1, len(numerator) - 1) for name in values}
    # Integrators have the least natural frequency, so they belong to the first submodel.
    integrators = next(k for k, value in enumerate(reversed(denominator)) if value != 0)
    named |= {name: units.of_submodel(name, integrators if name.startswith("g1_") else 0) for name in submodels}
    delay = estimate.get("delay")
    # Parameters of a custom estimator, in unknown units.
    free = {name: "" for name in given if name not in (*named, "delay")}
    values |= {**given, "delay": delay}
    found = [_found(name, values[name], errors, unit) for name, unit in {**named, **free, "delay": units.time}.items()]
    unknown = re.search(r"Not determined: ([^.:]*)", estimate.get("marks") or "")
    names = set(re.split(", | and ", unknown[1])) if unknown else set()
    found = [replace(one, status="undetermined") if one.name in names else one for one in found]
    return [*found[:-1], replace(found[-1], status="free" if "delay" in given else _delay_status(delay, delay_bounds))]


def _found(
    name: str, value: float | None, errors: Mapping[str, tuple[float | None, float | None]], unit: str
) -> UncertainValue:
    error, reach = errors.get(name, (None, None))
    return UncertainValue.symmetric(name, _or_nan(value), _or_nan(error), unit, reach or NORMAL)


def _or_nan(value: float | None) -> float:
    return nan if value is None else value


def _delay_status(delay: float | None, bounds: Sequence[float] | None) -> str:
    if bounds is None:
        return "fixed"
    low, high = bounds
    at_bound = delay is not None and min(abs(delay - low), abs(high - delay)) <= 1e-9 * (high - low)
    return "at bound" if at_bound else "free"


#: Reported fields of a parameter.
PARAMETER = (
    Column("name", "parameter"),
    Column("shown", "estimate"),
    Column("standard_error", "std error", ".3g"),
    Column("relative_percent", "rel. %", ".2g"),
    Column("low", "95 % low", ".5g"),
    Column("high", "95 % high", ".5g"),
    Column("unit"),
    Column("status"),
)


def parameter_rows(found: Iterable[UncertainValue]) -> list[dict[str, Any]]:
    """Return parameters as data; an undetermined one has no estimate."""
    return [rows_of(item, [column.key for column in PARAMETER]) for item in found]


def rows_of(item: UncertainValue, keys: Iterable[str]) -> dict[str, Any]:
    """Return fields of a quantity as data, with separate intervals and alternatives if it has any."""
    found = {"estimate" if key == "shown" else key: value for key, value in picked(item, keys).items()}
    more = {"intervals": [list(pair) for pair in item.intervals], "alternatives": list(item.alternatives)}
    return found | {key: own for key, own in more.items() if own}
