"""One estimate: its parameters with their uncertainty, and as a row of an export."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import nan
from typing import TYPE_CHECKING, Any

from ctid_cli.canonical import plain
from ctid_cli.inference.intervals import NORMAL, UncertainValue
from ctid_cli.signals.measurement import SEPARATOR
from ctid_cli.signals.sampled_signal import SECONDS

if TYPE_CHECKING:
    import pandas as pd

#: Keys that every estimate carries in machine-readable output, in this order.
ESTIMATE_KEYS = (
    *("id", "experiment", "estimator", "cell", "replicate", "start", "status"),
    *("delay", "numerator", "denominator", "standard_errors", "cost", "fit_percent", "iterations", "seconds"),
)


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

    def of_input(self, k: int) -> Units:
        """Units of one of several inputs, whose labels stand one after the other."""
        labels = self.input.split(SEPARATOR)
        return replace(self, input=labels[k]) if len(labels) > 1 else self

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


def parameter_object(item: UncertainValue) -> dict[str, Any]:
    """A parameter for JSON."""
    names = ("name", "estimate", "standard_error", "relative_percent", "low", "high", "unit", "status")
    return dict(plain({name: getattr(item, name) for name in names}))


#: Formats of the numbers of a table of parameters.
PARAMETER_FORMATS = {
    "estimate": ".6g",
    "standard error": ".3g",
    "relative %": ".2g",
    "95 % low": ".5g",
    "95 % high": ".5g",
}


def parameter_frame(found: Iterable[UncertainValue]) -> pd.DataFrame:
    """Return parameters as a table."""
    import pandas as pd

    names = ("name", "estimate", "standard_error", "relative_percent", "low", "high", "unit", "status")
    titles = ["parameter", *PARAMETER_FORMATS, "unit", "status"]
    return pd.DataFrame([[getattr(item, name) for name in names] for item in found], columns=titles)


def as_object(estimate: Mapping[str, Any]) -> dict[str, Any]:
    """An estimate for JSON: the documented keys first, then what else is stored."""
    keys = list(ESTIMATE_KEYS)
    if "parameters" in estimate:
        keys.insert(keys.index("standard_errors"), "parameters")
    return {key: estimate.get(key) for key in keys} | {key: item for key, item in estimate.items() if key not in keys}
