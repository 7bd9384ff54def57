"""Units of a record, and the parameters of an estimate with their uncertainty."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import nan
from typing import Any

from ctid_cli.inference.intervals import NORMAL, UncertainValue
from ctid_cli.reporting.document import Column
from ctid_cli.reporting.layout import picked
from ctid_cli.signals.measurement import Measurement
from ctid_cli.signals.sampled_signal import SECONDS
from ctid_cli.signals.table import Role, split_header

#: What stands for a unit of input or output that is not known.
INPUT, OUTPUT = "in", "out"
UNKNOWN = {INPUT, OUTPUT}


@dataclass(frozen=True)
class Units:
    """Units of a record, and those that follow for the parameters of a model."""

    time: str = "s"
    input: str = INPUT
    output: str = OUTPUT

    @property
    def gain(self) -> str:
        """Unit of a static gain."""
        return f"{self.output}/{self.input}"

    def label(self, name: str, unit: str) -> str:
        """Return a name with its unit in brackets, where the unit is known."""
        return f"{name} [{unit}]" if self.is_known(unit) else name

    def column(self, measurement: Measurement, role: Role) -> str:
        """Return the name of a column of a record with its unit."""
        return self.label(split_header(str(getattr(measurement, role)))[0], getattr(self, role))

    def amount(self, text: str, unit: str) -> str:
        """Return a number with its unit, where the unit is known."""
        return f"{text} {unit}" if self.is_known(unit) else text

    def is_known(self, unit: str) -> bool:
        """Whether a unit is made of those of the record, and not of what stands for unknown ones."""
        return UNKNOWN.isdisjoint(re.findall(r"\w+", unit))

    @property
    def square(self) -> str:
        """Unit of a squared output."""
        return f"({self.output})^2"

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
        if name.startswith("drift"):
            return self._over_time(self.output, 1 if name[5:6] in ("", "_") else int(name[5]))
        k = int(name[1:].split("_")[0])
        unit, power = {"a": ("1", k), "b": (self.gain, poles - zeros + k)}.get(name[0], (self.output, k - 1))
        return self._over_time(unit, power)

    def of_submodel(self, name: str, integrators: int = 0) -> str:
        """Unit of a parameter of a submodel, whose denominator has the constant term 1."""
        coefficient = name.split("_")[1]
        power = int(coefficient[1:])
        if coefficient[0] == "a":
            return self._power(power)
        power -= integrators
        return f"{self.gain}*{self._power(power)}" if power > 0 else self._over_time(self.gain, -power)

    def _power(self, power: int) -> str:
        return self.time if power == 1 else f"{self.time}^{power}"

    def _over_time(self, unit: str, power: int) -> str:
        return f"{unit}/{self._power(power)}" if power else unit


def parameters(estimate: Mapping[str, Any], delay_bounds: Sequence[float] | None = None) -> list[UncertainValue]:
    """Parameters of an estimate with their uncertainty."""
    numerator, denominator = estimate.get("numerator"), estimate.get("denominator")
    given, units = estimate.get("parameters") or {}, Units()
    # What was stored before quantiles were has intervals of the normal distribution.
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
    # Integrators have the least natural frequency of all, so that they are those of the first submodel.
    integrators = next(k for k, value in enumerate(reversed(denominator)) if value != 0)
    named |= {name: units.of_submodel(name, integrators if name.startswith("g1_") else 0) for name in submodels}
    delay = estimate.get("delay")
    # Of a custom estimator, in units that it alone knows.
    free = {name: "" for name in given if name not in (*named, "delay")}
    values |= {**given, "delay": delay}
    found = [_found(name, values[name], errors, unit) for name, unit in {**named, **free, "delay": units.time}.items()]
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


#: What is told of a parameter.
PARAMETER = (
    Column("name", "parameter"),
    Column("estimate"),
    Column("standard_error", "standard error", ".3g"),
    Column("relative_percent", "relative %", ".2g"),
    Column("low", "95 % low", ".5g"),
    Column("high", "95 % high", ".5g"),
    Column("unit"),
    Column("status"),
)


def parameter_rows(found: Iterable[UncertainValue]) -> list[dict[str, Any]]:
    """Return parameters as data."""
    return [picked(item, [column.key for column in PARAMETER]) for item in found]
