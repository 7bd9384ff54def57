"""Bounds of single parameters: coefficients, and gain, time constant and damping of small models.

If the least cost violates a bound, the estimate is at the bound: the bounded quantity is fixed there and the other
parameters are refitted. A coefficient, or the time constant of one pole, is then a known coefficient. A gain
``b_m/a_n`` and the damping ``a_1/(2 sqrt(a_2))`` relate a coefficient to the last one of the denominator, over which
the cost is minimised.
"""

from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimation.common import Bound
from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.best_model import Begin, Optimum
from ctid_cli.estimation.optimum.known import KnownCoefficients, null_space
from ctid_cli.estimation.parameter_layout import Degrees, Layout
from ctid_cli.text import listed

#: Quantities of small models in addition to their coefficients.
DERIVED = ("gain", "time_constant", "damping")
#: Relative tolerance of a bound.
MET = 1e-9
#: Search of the last coefficient of a denominator: factor of the range about its last value, and relative accuracy.
REACH, ACCURACY = 50.0, 1e-7
#: Shares of the interval between two bounds at which minima inside are computed.
INSIDE = 0.01, 0.03, 0.1, 0.2, 0.4, 0.7, 1.0


@dataclass(frozen=True)
class Quantity:
    """Bounded quantity as a function of coefficients by their names."""

    bound: Bound
    #: Coefficients: b_m and a_n for a gain, a_1 for a time constant, a_1 and a_2 for a damping, else the bounded one.
    names: tuple[str, ...]
    kind: str

    @property
    def along(self) -> str | None:
        """Last coefficient of the denominator, if another one is fixed relative to it."""
        return self.names[1] if len(self.names) == 2 else None

    def value(self, values: Mapping[str, float]) -> float:
        """Return the value of the bounded quantity."""
        first, *last = (values[name] for name in self.names)
        if self.kind == "gain":
            return first / last[0]
        if self.kind == "damping":
            return float(0.5 * first / np.sqrt(last[0]))
        return 1.0 / first if self.kind == "time_constant" else first

    def slopes(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return the derivatives with respect to the coefficients."""
        first, value = values[self.names[0]], self.value(values)
        if self.along is None:
            return {self.names[0]: -(value**2) if self.kind == "time_constant" else 1.0}
        last = values[self.along]
        shares = (1.0 / last, -value / last) if self.kind == "gain" else (value / first, -0.5 * value / last)
        return dict(zip(self.names, shares, strict=True))

    def held(self, end: float, last: float) -> float:
        """Return the first coefficient that puts the quantity at an end of its interval."""
        if self.kind == "gain":
            return end * last
        if self.kind == "damping":
            return float(2.0 * end * np.sqrt(last))
        return 1.0 / end if self.kind == "time_constant" else end

    def end(self, values: Mapping[str, float]) -> float | None:
        """Return the violated end of the interval."""
        low, high, value = self.bound.low, self.bound.high, self.value(values)
        slack = MET * self.bound.scale
        return low if value < low - slack else high if value > high + slack else None


def quantities_of(bounds: Sequence[Bound], degrees: Degrees) -> list[Quantity]:
    """Return the bounded quantities; raise OptionError for impossible ones."""
    found, coefficients = list[Quantity](), degrees.names
    for bound in bounds:
        if bound.name in coefficients:
            if bound.name in [coefficients[k] for own in degrees.a for k in range(own.start, own.stop)]:
                _require_positive(bound)
            found.append(Quantity(bound, (bound.name,), "coefficient"))
            continue
        places = [k for k, own in enumerate(degrees.prefixes) if bound.name.removeprefix(own) in DERIVED]
        inputs = [k for k in places if bound.name.startswith(degrees.prefixes[k])]
        if not inputs:
            shown = [own + kind for own in degrees.prefixes for kind in DERIVED]
            known = listed(coefficients + shown)
            raise OptionError("bounds", f"there is no {bound.name!r} to bound; there are {known}")
        found.append(_derived(bound, degrees, inputs[0]))
    if len({one.bound.name for one in found}) < len(found):
        raise OptionError("bounds", "a parameter is bounded twice; give each one bound")
    return found


def _derived(bound: Bound, degrees: Degrees, k: int) -> Quantity:
    """Return the gain, time constant or damping of an input."""
    kind, block = bound.name.removeprefix(degrees.prefixes[k]), 0 if degrees.common else k
    order, letters = degrees.orders[block], degrees.block_prefixes[block] + "a"
    wanted = {"gain": (1, 2), "time_constant": (1,), "damping": (2,)}[kind]
    if order not in wanted:
        poles = " or ".join(f"{n} pole{'s' * (n > 1)}" for n in wanted)
        raise OptionError(
            "bounds", f"{kind} can be bounded with {poles}, and this model has {order}; bound its coefficients instead"
        )
    if kind == "gain":
        return Quantity(bound, (f"{degrees.prefixes[k]}b{degrees.zeros[k]}", f"{letters}{order}"), kind)
    _require_positive(bound)
    return Quantity(bound, (f"{letters}1",) if kind == "time_constant" else (f"{letters}1", f"{letters}2"), kind)


def _require_positive(bound: Bound) -> None:
    """Refuse bounds that exclude all stable models."""
    if not bound.low > 0:
        raise OptionError(
            "bounds", f"the lower bound of {bound.name} must be above zero, as in every stable model; got {bound.low:g}"
        )


class BoundedSearch:
    """Search of records within bounds."""

    def __init__(
        self, measured: MeasuredRecords, quantities: Sequence[Quantity], degrees: Degrees, known: Mapping[int, float]
    ) -> None:
        self.measured, self.quantities, self.degrees = measured, quantities, degrees
        self.names = degrees.names
        self.known = {self.names[place]: value for place, value in known.items()}

    def within(self, free: Optimum) -> tuple[Optimum, dict[Quantity, float]]:
        """Return the least cost within the bounds, from that without bounds, and the active quantities with their ends.

        The relatively most violated bound is added until none is violated; bounds that become inactive are dropped.
        """
        found, ends = free, dict[Quantity, float]()
        while violated := self._violated(found):
            if len(ends) == len(self.quantities) or any(one in ends for one in violated):
                raise DataError("no model within the bounds was found; widen them, or bound fewer parameters")
            values = self._values(found)
            worst = max(violated, key=lambda one: abs(one.value(values) - violated[one]) / one.bound.scale)
            ends[worst] = violated[worst]
            found = self._least(found, ends)
        for one in list(ends) if len(ends) > 1 else ():
            fewer = {other: end for other, end in ends.items() if other is not one}
            trial = self._least(found, fewer)
            if not self._violated(trial) and trial.squared_error <= found.squared_error:
                found, ends = trial, fewer
        return found, ends

    def inside(self, begin: Begin, ends: Mapping[str, float], name: str) -> Iterator[Optimum]:
        """Yield minima with one of the active quantities, by name, ever farther inside its bounds."""
        active = {one: ends[one.bound.name] for one in self.quantities if one.bound.name in ends}
        moved = next(one for one in active if one.bound.name == name)
        far = moved.bound.low + moved.bound.high - active[moved]
        found = self.measured.local(begin)
        for share in INSIDE:
            try:
                end = active[moved] + share * (far - active[moved])
                found = self._least(found, active | {moved: end}, near=True)
            except DataError:
                return
            yield found

    def _values(self, found: Optimum) -> dict[str, float]:
        layout, theta = self.measured.parameters(found)
        values = dict(zip(layout.names, theta.tolist(), strict=True))
        if not values.keys() >= set(self.names):
            raise DataError("a pole runs to infinity, and what is bounded has no value; fit a model with fewer poles")
        return values

    def _violated(self, found: Optimum) -> dict[Quantity, float]:
        """Return the quantities outside their bounds, with the nearest end."""
        values = self._values(found)
        each = {one: one.end(values) for one in self.quantities}
        return {one: end for one, end in each.items() if end is not None}

    def _least(self, start: Optimum, ends: Mapping[Quantity, float], *, near: bool = False) -> Optimum:
        """Return the least cost with quantities fixed at ends of their bounds, or the minimum near the start."""
        held = self.known | {one.names[0]: one.held(end, 0.0) for one, end in ends.items() if one.along is None}
        related = [(one, end) for one, end in ends.items() if one.along is not None]
        along = {str(one.along) for one, _ in related} - held.keys()
        if len(along) > 1:
            raise DataError("bounds of gains or dampings of several denominators are met at once; drop all but one")

        def values(last: float | None) -> dict[str, float]:
            own = held if last is None else held | dict.fromkeys(along, last)
            return own | {one.names[0]: one.held(end, own[str(one.along)]) for one, end in related}

        if not along:
            measured = self._knowing(values(None))
            begin = self._begin(measured, start)
            return measured.local(begin) if near else measured.best([begin])
        from scipy.optimize import minimize_scalar

        best, middle = [start], float(np.log(self._values(start)[next(iter(along))]))

        def cost(logarithm: float) -> float:
            measured = self._knowing(values(float(np.exp(logarithm))))
            best.append(measured.local(self._begin(measured, best[-1])))
            return best[-1].squared_error

        limits = middle - np.log(REACH), middle + np.log(REACH)
        least = minimize_scalar(cost, bounds=limits, method="bounded", options={"xatol": ACCURACY})
        cost(float(least.x))
        return best[-1]

    def _knowing(self, values: Mapping[str, float]) -> MeasuredRecords:
        """Return the records for models with known coefficients."""
        degrees, other = self.degrees, copy(self.measured)
        places = {self.names.index(name): value for name, value in values.items()}
        parts = () if degrees.common else degrees.orders
        other.known = KnownCoefficients.of(degrees.poles, degrees.numerators - 1, places, parts)
        return other

    def _begin(self, measured: MeasuredRecords, start: Optimum) -> Begin:
        """Return the start of a search with known coefficients."""
        known = measured.known
        if not known.all_poles:
            return start.start[0], start.delays
        return known.poles if known.parts else np.append(1.0, known.denominator), start.delays

    def tangent(self, layout: Layout, theta: Array, ends: Mapping[Quantity, float], free: Array) -> Array:
        """Return the free directions along which all quantities stay at their bounds."""
        values, slopes = dict(zip(layout.names, theta.tolist(), strict=True)), np.zeros((len(ends), layout.size))
        for row, one in zip(slopes, ends, strict=True):
            for name, slope in one.slopes(values).items():
                row[layout.names.index(name)] = slope
        # In the units of the parameters, which differ by orders of magnitude.
        scale = np.abs(theta) + (theta == 0.0)
        free = free / np.max(np.abs(free) / scale[:, None], axis=0)
        within = slopes @ free
        inner = free @ null_space(within / np.maximum(np.linalg.norm(within, axis=1, keepdims=True), 1e-300))
        return np.asarray(inner / np.linalg.norm(inner, axis=0))
