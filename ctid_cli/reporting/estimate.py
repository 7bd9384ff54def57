"""One estimate: its parameters with their uncertainty, and as a row of an export."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from ctid_cli.inference.quantile import normal_quantile
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
NORMAL_95 = normal_quantile()


#: Seconds in a unit of time, by the labels that files use.
SECONDS = {
    **dict.fromkeys(("s", "sec", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "μs", "microsecond", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nanosecond", "nanoseconds"), 1e-9),
    **dict.fromkeys(("min", "minute", "minutes"), 60.0),
    **dict.fromkeys(("h", "hr", "hour", "hours"), 3600.0),
    **dict.fromkeys(("d", "day", "days"), 86400.0),
}


@dataclass(frozen=True)
class Units:
    """Units of a record, and those that follow for the parameters of a model."""

    time: str = "s"
    input: str = "in"
    output: str = "out"

    @property
    def gain(self) -> str:
        """Unit of a static gain."""
        return f"{self.output}/{self.input}"

    @property
    def seconds(self) -> float | None:
        """Seconds in the unit of time; None where the label is not known."""
        return SECONDS.get(self.time)

    def of(self, name: str, poles: int, zeros: int) -> str:
        """Unit of a parameter."""
        if name == "delay":
            return self.time
        if name.startswith("offset"):
            return self.output
        kind, k = name[0], int(name[1:].split("_")[0])
        if kind == "a":
            return self._over_time("1", k)
        return self._over_time(self.gain, poles - zeros + k) if kind == "b" else self._over_time(self.output, k - 1)

    def of_submodel(self, name: str, integrators: int = 0) -> str:
        """Unit of a parameter of a submodel, whose denominator has the constant term 1."""
        coefficient = name.split("_")[1]
        power = int(coefficient[1:])
        if coefficient[0] == "b":
            power -= integrators
            return f"{self.gain}*{self._power(power)}" if power > 0 else self._over_time(self.gain, -power)
        return self._power(power)

    def _power(self, power: int) -> str:
        return self.time if power == 1 else f"{self.time}^{power}"

    def _over_time(self, unit: str, power: int) -> str:
        if power == 0:
            return unit
        return f"{unit}/{self.time}" if power == 1 else f"{unit}/{self.time}^{power}"


@dataclass(frozen=True)
class Parameter:
    """One parameter of an estimate."""

    name: str
    estimate: float | None
    standard_error: float | None
    #: Standard error relative to the value [%].
    relative_percent: float | None
    low: float | None
    high: float | None
    unit: str
    status: str

    def as_dict(self) -> dict[str, Any]:
        """The parameter of ``ctid show --json``."""
        return asdict(self)


def parameters(estimate: Mapping[str, Any], delay_bounds: Sequence[float] | None = None) -> list[Parameter]:
    """Parameters of an estimate with their uncertainty."""
    numerator, denominator = estimate.get("numerator"), estimate.get("denominator")
    if not numerator or not denominator:
        return []
    errors = estimate.get("standard_errors") or {}
    poles, zeros, units = len(denominator) - 1, len(numerator) - 1, Units()
    values = {f"b{k}": value for k, value in enumerate(numerator)}
    values |= {f"a{k}": value for k, value in enumerate(denominator[1:], start=1)}
    found = [
        _parameter(name, value, errors.get(name), units.of(name, poles, zeros), "free")
        for name, value in values.items()
    ]
    submodels = estimate.get("parameters") or {}
    if submodels and not values.keys() & errors.keys():
        found = []
    # Integrators have the least natural frequency of all, so that they are those of the first submodel.
    integrators = next(k for k, value in enumerate(reversed(denominator)) if value != 0)
    for name, value in submodels.items():
        unit = units.of_submodel(name, integrators if name.startswith("g1_") else 0)
        found.append(_parameter(name, value, errors.get(name), unit, "free"))
    delay = estimate.get("delay")
    status = "fixed"
    if delay_bounds is not None:
        low, high = delay_bounds
        at_bound = delay is not None and min(abs(delay - low), abs(high - delay)) <= 1e-9 * (high - low)
        status = "at bound" if at_bound else "free"
    found.append(_parameter("delay", delay, errors.get("delay"), "s", status))
    return found


def parameter_table(found: Iterable[Parameter], style: str = "text") -> str:
    """Parameters as an aligned or Markdown table."""
    header = ["parameter", "estimate", "standard error", "relative %", "95 % low", "95 % high", "unit", "status"]
    rows = [
        [
            item.name,
            number(item.estimate),
            number(item.standard_error, 3),
            number(item.relative_percent, 2),
            number(item.low, 5),
            number(item.high, 5),
            item.unit,
            item.status,
        ]
        for item in found
    ]
    return (text_table if style == "text" else markdown_table)(header, rows, "lrrrrrll")


def as_object(estimate: Mapping[str, Any]) -> dict[str, Any]:
    """An estimate for JSON: the documented keys first, then what else is stored."""
    keys = list(ESTIMATE_KEYS)
    if "parameters" in estimate:
        keys.insert(keys.index("standard_errors"), "parameters")
    return {key: estimate.get(key) for key in keys} | {key: item for key, item in estimate.items() if key not in keys}


def _parameter(name: str, value: float | None, error: float | None, unit: str, status: str) -> Parameter:
    if value is None or error is None or not (math.isfinite(value) and math.isfinite(error)):
        return Parameter(name, value, error, None, None, None, unit, status)
    relative = 100 * error / abs(value) if value else None
    return Parameter(name, value, error, relative, value - NORMAL_95 * error, value + NORMAL_95 * error, unit, status)
