r"""Set of admissible models, and the coordinates in which it is searched.

``LIMITS`` contains its bounds, with a reason for each. The delay has separate bounds. Without such a set an optimum
need not exist: with a free initial state an undamped or very slow pole can fit noise without limit.

A pair has the coordinates ln w and ln zeta, which are smooth at a damping of 1; therefore two close real poles form a
section too. Real poles further apart, or at a bound of the set, have ln p each, and a pair with the greatest imaginary
part has the logarithms of its real and imaginary part: in these coordinates the set is a box at every bound.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from math import copysign, exp, sqrt
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, ComplexArray
from ctid_cli.estimation.optimum.chain import (
    Rows,
    block_diagonal,
    order_of,
    poles_of,
    polynomial,
    polynomial_slopes,
    split,
)
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.estimation.optimum.triangle import Delay
from ctid_cli.filtering.frequency_lines import FrequencyLines

#: Least and greatest delay [s], or one such pair for each input.
Bounds = tuple[float, float] | tuple[tuple[float, float], ...]


class Limit(NamedTuple):
    """A bound of the poles."""

    #: Bounded quantity, and unit of the values.
    what: str
    unit: str
    #: Bounds for a record that begins at rest, for a periodic one, and for an estimated initial state.
    rest: float
    periodic: float
    estimated: float
    #: Reason for the value, and meaning of a fit that ends at the bound.
    reason: str
    meaning: str


#: Costs were compared with 40-digit arithmetic on 200 samples, noise 80 dB below the output, for poles at several
#: bounds at once. At rest: relative difference 3e-12 down to a damping of 1e-6 and to poles of .0001 over the length.
#: Periodic: 1e-11 with pairs of a damping of 1e-6; 1e-7 with two poles of .01 over the length, 1e-4 with two of .001.
#: For an integrating drive at rest (``benchmarks/bench_optimum.py --likes``) the cost is 4811 times its optimum if
#: poles end at 1 over the length, .9 % higher at .001 and .02 % higher at .0001.
LIMITS = {
    "slowest": Limit(
        "least magnitude of a pole",
        "1/(length of the record)",
        1e-4,
        1e-2,
        1.0,
        "with an estimated state slower poles fit noise as free responses, and the cost has no interior minimum; with "
        "a known state such a pole is hardly distinguishable from an integrator, and is still computed to the digits "
        "that a minimum needs",
        "a pole is indistinguishable from an integrator over this record",
    ),
    "fastest": Limit(
        "greatest magnitude of a pole",
        "1/(sampling interval)",
        10.0,
        10.0,
        10.0,
        "after one interval the response of a faster pole has settled to four digits: samples show a delay only",
        "a pole is too fast for the sampling interval",
    ),
    "least_damping": Limit(
        "least damping of a pair",
        "-",
        1e-5,
        1e-5,
        1e-3,
        "with an estimated state an undamped pair fits noise as a free response, ever better; with a known state a "
        "periodic record of two hundred periods shows a damping of .0005, and no digits are lost at 1e-5",
        "a pair of poles is too little damped for this record to show its damping",
    ),
    "imaginary": Limit(
        "greatest imaginary part of a pole",
        "Nyquist frequency",
        0.999,
        0.999,
        0.999,
        "on a regular clock samples cannot tell a faster oscillation from a slower one or from a decay, and at the "
        "Nyquist frequency they see no phase",
        "a pair of poles oscillates as fast as the samples can show",
    ),
}
#: Two real poles with a ratio below this form one section.
NEAR = 4.0
#: Tolerance of instants, as a fraction of the shortest interval; closer ones count as equal.
JUST_BEYOND = 1e-6
#: Distance within which a coordinate is at a bound; the larger one after computing roots of a polynomial.
TOUCH, CLOSE_TO_BOUND = 1e-9, 1e-6


@dataclass(frozen=True)
class Box:
    """Bounds of the poles [rad/s], of their damping [-] and of the delay [s]."""

    slowest: float
    fastest: float
    #: Greatest imaginary part [rad/s].
    imaginary: float = np.inf
    delays: Bounds = (0.0, 0.0)
    #: Sampling interval [s] if the cost has kinks at delays of whole intervals, else 0.
    cell: float = 0.0
    #: Unit of the delay coordinate [s]: a quarter period of the output's RMS frequency.
    quarter: float = 1.0
    least_damping: float = LIMITS["least_damping"].estimated
    #: Least delay [s] for derivatives on an irregular clock. Without a delay all samples may coincide with edges of the
    #: input, where only the right-hand derivative exists.
    beyond_edges: float = 0.0
    #: Slowest pole [rad/s] and least damping [-] of the starts, which may be narrower than the set, and the highest
    #: frequency in the data [rad/s].
    slowest_spread: float = 0.0
    least_damping_spread: float = 0.0
    highest: float = np.inf
    #: Number of poles of each of several denominators, empty for one; and whether known coefficients refer to monic
    #: denominators, or to constant terms of 1.
    parts: tuple[int, ...] = ()
    monic: bool = True

    @cached_property
    def each_delay(self) -> tuple[tuple[float, float], ...]:
        """Bounds of the delay of each input."""
        return each_bounds(self.delays)

    @property
    def several_delays(self) -> bool:
        """Whether there are several inputs."""
        return len(self.each_delay) > 1

    @cached_property
    def free_delays(self) -> tuple[int, ...]:
        """Inputs whose delays are searched."""
        return tuple(k for k, (low, high) in enumerate(self.each_delay) if low < high)

    @cached_property
    def delay_places(self) -> dict[int, int]:
        """Places of the free delays among the coordinates, counted from the end, by their inputs."""
        return {k: place - len(self.free_delays) for place, k in enumerate(self.free_delays)}

    @property
    def delay_free(self) -> bool:
        """Whether a delay is searched."""
        return bool(self.free_delays)

    @property
    def middle(self) -> tuple[float, ...]:
        """Middle of the range of each delay."""
        return tuple(0.5 * (low + high) for low, high in self.each_delay)

    @property
    def spread(self) -> tuple[float, float]:
        """Slowest pole [rad/s] and least damping [-] of starts."""
        return max(self.slowest, self.slowest_spread), max(self.least_damping, self.least_damping_spread)

    def met_by(self, pole: complex) -> tuple[str, ...]:
        """Return the names in ``LIMITS`` of the bounds that a pole is at."""
        size = abs(pole)
        met = {
            "slowest": size <= self.slowest * (1 + CLOSE_TO_BOUND),
            "fastest": size >= self.fastest * (1 - CLOSE_TO_BOUND),
            "least_damping": pole.imag != 0 and -pole.real <= self.least_damping * size * (1 + CLOSE_TO_BOUND),
            "imaginary": abs(pole.imag) >= self.imaginary * (1 - CLOSE_TO_BOUND),
        }
        return tuple(name for name, at in met.items() if at)

    def limits_met(self, poles: Iterable[complex]) -> list[tuple[str, Limit, float]]:
        """Return the bounds reached by poles: their names, entries of ``LIMITS`` and values."""
        met = {name for pole in poles for name in self.met_by(pole)}
        return [(name, limit, getattr(self, name)) for name, limit in LIMITS.items() if name in met]

    def sentence(self, time_unit: str) -> str:
        """Return the bounds of the poles in words."""
        rate = f"rad/{time_unit}"
        swing = f", imaginary parts up to {self.imaginary:.4g} {rate}" if np.isfinite(self.imaginary) else ""
        poles = f"poles from {self.slowest:.4g} to {self.fastest:.4g} {rate}{swing}"
        return f"{poles}; pairs with a damping of at least {self.least_damping:g}"


def each_bounds(delays: Bounds) -> tuple[tuple[float, float], ...]:
    """Return the bounds of the delay of each input."""
    low, high = delays[0], delays[-1]
    if isinstance(low, tuple) or isinstance(high, tuple):
        return tuple(pair for pair in delays if isinstance(pair, tuple))
    return ((low, high),)


def widened(box: Box, poles: ComplexArray) -> Box:
    """Return a box enlarged to contain given stable poles inside its bounds."""
    sizes, pairs, more = np.abs(poles), poles[poles.imag > 0], 1.0 + JUST_BEYOND
    return replace(
        box,
        slowest=min(box.slowest, float(sizes.min()) / more),
        fastest=max(box.fastest, float(sizes.max()) * more),
        imaginary=max(box.imaginary, float(pairs.imag.max(initial=0.0)) * more),
        least_damping=min(box.least_damping, float((-pairs.real / np.abs(pairs)).min(initial=1.0)) / more),
    )


#: Box without bounds.
ANYWHERE = Box(0.0, np.inf, delays=(0.0, np.inf), least_damping=0.0)


@dataclass(frozen=True, eq=False)
class Point:
    """Sections of each denominator, fastest first, and the delay of each input."""

    speed: Array
    #: Damping of a pair; -1 marks a real pole.
    damping: Array
    #: Whether the imaginary part of a pair is at its bound.
    edge: BoolArray
    delays: tuple[Delay, ...]
    #: See :class:`Box`.
    parts: tuple[int, ...] = ()
    monic: bool = True

    @property
    def delay(self) -> Delay:
        """Delay of the first input."""
        return self.delays[0]

    @property
    def seconds(self) -> tuple[float, ...]:
        """Delay of each input [s]."""
        return tuple(delay.seconds for delay in self.delays)

    @cached_property
    def cells(self) -> tuple[int, ...]:
        """Cell of each delay."""
        return tuple(delay.cell for delay in self.delays)

    def with_delays(self, delays: Iterable[Delay]) -> "Point":
        """Return a copy with other delays."""
        return replace(self, delays=tuple(delays))

    @property
    def poles(self) -> ComplexArray:
        """Poles [rad/s], shape (n,)."""
        return np.array(poles_of(self.speed, self.damping), dtype=complex)

    @property
    def rows(self) -> Rows:
        """Sections of each denominator."""
        return split(self.speed, self.damping, self.parts) if self.parts else [(self.speed, self.damping)]

    @property
    def denominators(self) -> list[Array]:
        """Monic polynomials, descending powers."""
        return [polynomial(*own) for own in self.rows]

    @property
    def denominator(self) -> Array:
        """First denominator."""
        return self.denominators[0]

    @property
    def coefficients(self) -> Array:
        """Coefficients ``a_1 ... a_n`` of each denominator; if not monic, with the constant term 1."""
        if self.monic:
            return np.concatenate([a[1:] for a in self.denominators])
        return np.concatenate([a[-2::-1] / a[-1] for a in self.denominators])

    def jacobian(self) -> Array:
        """Return the block-diagonal Jacobian of ``ln w, ln zeta`` (or ln p) of all sections by the coordinates."""
        result, k = np.eye(order_of(self.damping)), 0
        for zeta, edge in zip(self.damping.tolist(), self.edge.tolist(), strict=True):
            if edge:
                swing = 1 - zeta * zeta
                result[k : k + 2, k : k + 2] = [[1 - swing, swing], [swing, -swing]]
            k += 1 if zeta < 0 else 2
        return result

    def coefficient_slopes(self) -> Array:
        """Return the derivatives of the coefficients with respect to the coordinates, shape (n, n)."""
        found = [polynomial_slopes(*own) for own in self.rows]
        if not self.monic:
            found = [_with_constant_one(a, own) for a, own in zip(self.denominators, found, strict=True)]
        return np.asarray(block_diagonal(found) @ self.jacobian())

    def whole_sections(self, chosen: BoolArray) -> BoolArray:
        """Return the mask of all coordinates, or poles, of the sections that contain a chosen one."""
        sizes = np.where(self.damping < 0, 1, 2)
        starts = np.cumsum(sizes) - sizes
        return np.repeat(np.logical_or.reduceat(chosen, starts), sizes)

    def shifted(self, step: Array) -> tuple[Array, Array]:
        """Return the speeds and dampings after a step in the coordinates of the poles."""
        speed, damping, k = self.speed.copy(), self.damping.copy(), 0
        for i, (w, zeta, edge) in enumerate(
            zip(self.speed.tolist(), self.damping.tolist(), self.edge.tolist(), strict=True)
        ):
            if zeta < 0:
                speed[i] = w * exp(step[k])
                k += 1
                continue
            first, second = exp(step[k]), exp(step[k + 1])
            if edge:
                real, imaginary = zeta * w * first, sqrt(1 - zeta * zeta) * w * second
                speed[i] = np.hypot(real, imaginary)
                damping[i] = real / speed[i]
            else:
                speed[i], damping[i] = w * first, zeta * second
            k += 2
        return speed, damping


def _with_constant_one(a: Array, slopes: Array) -> Array:
    """Return the derivatives of ``a_1 ... a_n`` scaled so that the constant term is 1, from those of the monic ones."""
    rising, each = a[::-1], np.vstack((np.zeros(a.size - 1), slopes))[::-1]
    return np.asarray((each[1:] - np.outer(rising[1:] / rising[0], each[0])) / rising[0])


def box_of(problem: Problem, delays: Bounds) -> Box:
    """Return the admissible set for records, or for a frequency response."""
    if problem.lines is not None:
        box = _box_of_lines(problem.lines, each_bounds(delays)[0])
        return replace(box, parts=problem.parts, monic=problem.monic)
    length, interval, rate, cells = 0.0, np.inf, 0.0, set()
    for data in problem.sampled:
        used, steps = data.t[data.use], np.diff(data.t)
        # On the finer clock of the input the output samples are a subset of the points.
        points = max(1, round(float(np.diff(used).min()) / data.interval)) if data.interval > 0 and used.size > 1 else 1
        length, interval = max(length, float(used[-1] - used[0])), min(interval, points * float(np.median(steps)))
        # Root mean square frequency of the output, from its differences.
        power = float(np.sum((data.y[1:] - data.y.mean()) ** 2 * steps))
        if power > 0:
            rate = max(rate, float(np.sqrt(np.sum(np.diff(data.y) ** 2 / steps) / power)))
        cells |= {one.interval for one in data.inputs}
    widest = max(high - low for low, high in each_bounds(delays))
    quarter = min(0.5 * np.pi / rate if rate > 0 else length, widest)
    state = "estimated" if problem.free_response else "periodic" if any(problem.periods) else "rest"
    bounds = {name: getattr(limit, state) for name, limit in LIMITS.items()}
    greatest = bounds["imaginary"] * np.pi / interval if min(cells) > 0 else np.inf
    # With different sampling intervals the kinks have no common grid.
    cell = cells.pop() if len(cells) == 1 else 0.0
    beyond = 0.0 if cell else JUST_BEYOND * min(float(np.diff(data.t).min()) for data in problem.sampled)
    return Box(
        bounds["slowest"] / length,
        bounds["fastest"] / interval,
        greatest,
        delays,
        cell,
        max(quarter, interval),
        bounds["least_damping"],
        beyond,
        LIMITS["slowest"].estimated / length,
        LIMITS["least_damping"].estimated,
        parts=problem.parts,
        monic=problem.monic,
    )


#: Slowest and fastest pole for a frequency response, relative to its lowest and highest frequency: at 80 dB such a pole
#: is detectable by the phase at the nearest line.
SLOWEST_OF_LINES, FASTEST_OF_LINES = 1e-4, 1e2


def _box_of_lines(lines: FrequencyLines, delays: tuple[float, float]) -> Box:
    """Return the admissible set for a frequency response: that of a record at rest, from its range of lines."""
    power = np.abs(lines.weights * lines.response) ** 2
    rate = float(np.sqrt(np.sum(power * lines.frequencies**2) / max(float(power.sum()), 1e-300)))
    interval, fastest, greatest = lines.interval, FASTEST_OF_LINES * lines.highest, np.inf
    if interval:
        fastest = LIMITS["fastest"].rest / interval
        greatest = LIMITS["imaginary"].rest * np.pi / interval
    quarter = min(0.5 * np.pi / max(rate, lines.lowest), delays[1] - delays[0])
    return Box(
        SLOWEST_OF_LINES * lines.lowest,
        fastest,
        greatest,
        delays,
        interval,
        max(quarter, interval or 1e-3 / lines.highest),
        LIMITS["least_damping"].rest,
        slowest_spread=1.0 / lines.length,
        least_damping_spread=LIMITS["least_damping"].estimated,
        highest=lines.highest,
    )


def admissible(pole: complex, box: Box) -> complex:
    """Return the nearest admissible pole."""
    size = min(max(abs(pole), box.slowest), box.fastest)
    if pole.imag == 0:
        return complex(-size)
    damping = max(-pole.real / abs(pole), box.least_damping)
    real, imaginary = size * damping, size * sqrt(max(1 - damping * damping, 0.0))
    if imaginary > box.imaginary:
        # At the greatest imaginary part the real part is kept.
        real, imaginary = max(real, box.imaginary * box.least_damping), box.imaginary
    return complex(-real, copysign(imaginary, pole.imag))


def point_of(
    poles: ComplexArray, delays: float | Sequence[float], box: Box, cells: Sequence[int | None] | None = None
) -> Point:
    """Return admissible sections with given poles, concatenated for several denominators."""
    moved, units, first = [admissible(pole, box) for pole in poles.tolist()], [], 0
    for order in box.parts or (len(moved),):
        units += _units(moved[first : first + order], box)
        first += order
    each = [delays] * len(box.each_delay) if isinstance(delays, float | int) else delays
    placed = []
    for (low, high), delay, cell in zip(box.each_delay, each, cells or [None] * len(each), strict=True):
        tau = min(max(float(delay), low), high)
        if cell is None:
            cell = int(np.floor(tau / box.cell)) if low < high and box.cell > 0 else -1
        placed.append(Delay(tau, cell))
    return Point(
        np.array([unit[0] for unit in units]),
        np.array([unit[1] for unit in units]),
        np.array([unit[2] for unit in units]),
        tuple(placed),
        box.parts,
        box.monic,
    )


def _units(poles: list[complex], box: Box) -> list[tuple[float, float, bool]]:
    """Return the sections of one denominator: speed, damping, and whether the imaginary part is at its bound."""
    units = [(abs(p), -p.real / abs(p), p.imag >= box.imaginary * (1 - TOUCH)) for p in poles if p.imag > 0]
    units += _real_sections(sorted(-p.real for p in poles if p.imag == 0), box)
    return sorted(units, key=lambda unit: -unit[0])


def _real_sections(reals: list[float], box: Box) -> list[tuple[float, float, bool]]:
    """Return sections of real poles in ascending order: the closest are paired first, others stay single."""
    sections = []
    # A pole at a bound stays single, so that it can be held there.
    while len(reals) > 1:
        ratios = [
            b / a if a > box.slowest * (1 + TOUCH) and b < box.fastest * (1 - TOUCH) else np.inf
            for a, b in pairwise(reals)
        ]
        k = int(np.argmin(ratios))
        if ratios[k] > NEAR:
            break
        a, b = reals[k], reals[k + 1]
        sections.append((sqrt(a * b), 0.5 * (a + b) / sqrt(a * b), False))
        del reals[k : k + 2]
    return sections + [(p, -1.0, False) for p in reals]


def moved_by(point: Point, step: Array, box: Box) -> Point:
    """Return the point after a step, the free delays in quarter periods last, projected onto the admissible set."""
    speed, damping = point.shifted(step)
    poles = np.array(poles_of(speed, damping), dtype=complex)
    seconds, cells = list(point.seconds), [None if k in box.free_delays else -1 for k in range(len(point.delays))]
    for k, place in box.delay_places.items():
        seconds[k] += step[place] * box.quarter
        if point.delays[k].cell < 0:
            continue
        # The delay keeps its cell until it leaves it; at a sample the cell determines the side.
        low, high = point.delays[k].cell * box.cell, (point.delays[k].cell + 1) * box.cell
        for edge in (low, high):
            if abs(seconds[k] - edge) < TOUCH * box.cell:
                seconds[k] = edge
        cells[k] = point.delays[k].cell if low <= seconds[k] <= high else None
    return point_of(poles, seconds, box, cells)


def frozen(point: Point, gradient: Array, box: Box) -> BoolArray:
    """Return which coordinates are at a bound with an outward descent direction."""
    at_low, at_high = at_bounds(point, box)
    return (at_low & (gradient > 0)) | (at_high & (gradient < 0))


def at_bounds(point: Point, box: Box) -> tuple[BoolArray, BoolArray]:
    """Return which coordinates are at their lower and upper bound; a delay is bounded by its cell."""
    at_low: list[bool] = []
    at_high: list[bool] = []
    for w, zeta, edge in zip(point.speed.tolist(), point.damping.tolist(), point.edge.tolist(), strict=True):
        slow, fast = w <= box.slowest * (1 + TOUCH), w >= box.fastest * (1 - TOUCH)
        undamped = 0 <= zeta <= box.least_damping * (1 + TOUCH)
        if zeta < 0:
            at_low.append(slow)
            at_high.append(fast)
        elif edge:
            at_low += [undamped, False]
            at_high += [False, True]
        else:
            at_low += [slow, undamped]
            at_high += [fast, False]
    for k in box.free_delays:
        edges, delay = box.each_delay[k], point.delays[k]
        if delay.cell >= 0:
            edges = max(edges[0], delay.cell * box.cell), min(edges[1], (delay.cell + 1) * box.cell)
        slack = TOUCH * (edges[1] - edges[0])
        at_low.append(delay.seconds <= edges[0] + slack)
        at_high.append(delay.seconds >= edges[1] - slack)
    return np.array(at_low, dtype=bool), np.array(at_high, dtype=bool)
