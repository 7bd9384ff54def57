"""Starts of searches: optima of smaller models, given estimates, and random points."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import product
from typing import NamedTuple, TypeVar

import numpy as np

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.estimation.delay_search import lowest_minima
from ctid_cli.estimation.optimum.box import LIMITS, Box, Point, point_of
from ctid_cli.estimation.optimum.known import NOTHING, KnownCoefficients
from ctid_cli.estimation.optimum.projection import Problem, responses
from ctid_cli.estimation.optimum.search import Descent, Local
from ctid_cli.models.additive import Term
from ctid_cli.progress import report

#: Largest product of evaluations and samples for pairs of the least damping: all resolved frequencies up to 1,000
#: samples. Number of the best pairs, and of delays, that are compared together.
RESOLVED, LOOKED_AT = 1_000_000, 16
#: Delays tried on both sides of the best one, in sampling intervals: every sample has a kink, and minima may be a
#: two-hundredth of an interval apart.
CLOSE_DELAYS = 0.5 ** np.arange(1, 9)
#: Number of optima kept for each structure.
KEPT = 3
#: Squared errors that differ by less than this fraction belong to one minimum.
SAME = 1e-6
#: Other minima are reported if their squared error exceeds the least by at most this multiple of the noise variance:
#: three times the 95 % quantile of one degree of freedom.
COMPETING = 3 * 3.84
#: Starts whose poles differ by less than this in logarithms count as equal.
APART = 0.7
#: Poles are fast if their magnitude times the sampling interval exceeds this.
FAST = 0.25
#: Number of starts of a whole sum of fractions that are refined.
REFINED_TOGETHER = 6
#: Largest number of delays of a profile.
MOST_DELAYS = 100


T = TypeVar("T")


class Effort(NamedTuple):
    """Numbers of starts for a structure."""

    #: Numbers of frequencies of a pole, and of a pair, added to a smaller model; dampings of a pair.
    poles: int
    pairs: int
    dampings: tuple[float, ...]
    #: Number of these that are kept, and number refined in addition to models nested in the structure.
    looked_at: int
    refined: int
    #: Number of starts with one pole or pair only, and factor of their number of frequencies: a pair has a minimum at
    #: every peak of the noise.
    alone: int
    denser: int
    #: Greatest number of poles for which the whole range of the delay is searched.
    along_delay: float
    #: Numbers of poles, those of the best starts, for which it is: of structures with up to two poles, and of others.
    bases: tuple[int, int]
    #: Number of random starts, plus the same number for each pole.
    random: int


#: For one structure; and for a range of structures, where each has starts from many others.
THOROUGH = Effort(
    24, 24, (0.02, 0.1, 0.5), looked_at=3, refined=3, alone=6, denser=4, along_delay=np.inf, bases=(6, 1), random=2
)
QUICK = Effort(12, 20, (0.03, 0.3), looked_at=1, refined=2, alone=3, denser=1, along_delay=2, bases=(1, 1), random=0)


class StructureSearch:
    """Lowest minima of structures, each found from those of its nested smaller structures."""

    def __init__(
        self,
        problem: Problem,
        box: Box,
        *,
        effort: Effort = THOROUGH,
        known: KnownCoefficients = NOTHING,
        pilot: "StructureSearch | None" = None,
        first_delays: tuple[float, ...] | None = None,
    ) -> None:
        self.problem, self.box, self.effort = problem, box, effort
        #: Known coefficients; with any, only the requested structure is searched.
        self.known = known
        #: Search of a part of the records, whose minima are starts.
        self.pilot = pilot
        self._given_delays = first_delays
        self._descents: dict[int, Descent] = {}
        self._minima: dict[tuple[int, int], list[Local]] = {}
        self._competing: dict[tuple[int, int], list[Local]] = {}
        self._ends: dict[tuple[int, int], list[float]] = {}

    def descent(self, zeros: int) -> Descent:
        """Return the local searches with a numerator of that degree."""
        if zeros not in self._descents:
            self._descents[zeros] = Descent(self.problem._replace(zeros=zeros), self.box, self.known)
        return self._descents[zeros]

    @property
    def evaluations(self) -> int:
        """Number of evaluations of the cost and of its gradient."""
        return sum(descent.evaluations for descent in self._descents.values())

    @property
    def most_zeros(self) -> int:
        """Largest difference of the numerator degree and the number of searched poles."""
        return self.problem.integrators - int(self.box.delay_free)

    def climb(self, poles: int, zeros: int) -> None:
        """Search a structure and all nested ones, the smallest first."""
        for n in range(min(poles, int(not self.problem.integrators)), poles + 1):
            for m in range(min(zeros, n + self.most_zeros) + 1):
                if (n, m) in self._minima:
                    continue
                report("", note=f"{n} of {poles} poles, {m} of {zeros} zeros")
                if self.pilot is not None:
                    points = self._from_pilot(self.pilot, n, m)
                else:
                    # Random starts too, so that a larger structure starts from all minima of this one.
                    points = self.from_below(n, m) + self.random_points(n)
                self.refine(n, m, points)

    def minima(self, poles: int, zeros: int) -> list[Local]:
        """Return the known minima of a structure, the lowest first."""
        return self._minima.get((poles, zeros), [])

    def best(self, poles: int, zeros: int) -> Point:
        """Return the point of the lowest minimum of a structure."""
        return self._minima[poles, zeros][0].point

    def put_first(self, poles: int, zeros: int, point: Point) -> None:
        """Replace the lowest minimum of a structure by another point of equal cost."""
        self._minima[poles, zeros][0] = self.descent(zeros).local(point)

    def ends(self, poles: int, zeros: int) -> list[float]:
        """Return the final squared errors of the searches for a structure."""
        return self._ends[poles, zeros]

    def settled(self, poles: int, zeros: int) -> Local:
        """Return the fully converged and classified lowest minimum of a structure."""
        minima = self._minima[poles, zeros]
        if minima[0].ending is None:
            minima[0] = self.descent(zeros).settle(minima[0])
        return minima[0]

    def refine(self, poles: int, zeros: int, points: Iterable[Point], *, slow_too: bool = False) -> None:
        """Search from points, then in delay cells adjacent to that of the best minimum; keep the lowest minima.

        The adjacent cells are searched if there is a fast pole, with ``slow_too`` always.
        """
        descent, kept = self.descent(zeros), self._competing.setdefault((poles, zeros), [])
        ends = self._ends.setdefault((poles, zeros), [])
        queue, cells = list(points), set[tuple[int, int]]()
        while queue:
            report("start", len(ends) + 1, len(ends) + len(queue))
            local = descent.descend(queue.pop(0), kept)
            ends.append(local.squared_error)
            kept.append(local)
            if not queue:
                lowest = min(kept, key=lambda local: local.squared_error)
                queue = self._in_adjacent_cells(lowest.point, cells, slow_too)
        kept.sort(key=lambda local: local.squared_error)
        distinct: list[Local] = []
        for local in kept:
            if not distinct or local.squared_error > distinct[-1].squared_error * (1 + SAME):
                distinct.append(local)
        self._minima[poles, zeros] = distinct[:KEPT]
        limit = distinct[0].squared_error * (1 + COMPETING / descent.count) + descent.floor if distinct else 0.0
        self._competing[poles, zeros] = [
            local for k, local in enumerate(distinct) if k < KEPT or local.squared_error <= limit
        ]

    def others(self, poles: int, zeros: int) -> list[Local]:
        """Return the further minima of a structure that are nearly as low as its lowest, in ascending order.

        Their searches, which may have ended early because a lower minimum was known, are continued to convergence.
        """
        descent, found = self.descent(zeros), [self._minima[poles, zeros][0]]
        limit = found[0].squared_error * (1 + COMPETING / descent.count) + descent.floor
        for local in self._competing[poles, zeros]:
            if local.squared_error <= limit:
                reached = descent.descend(local.point, found, to_end=True)
                if all(reached is not one for one in found):
                    found.append(reached)
        first = found[0].squared_error * (1 + SAME) + descent.floor
        return sorted((one for one in found[1:] if one.squared_error > first), key=lambda one: one.squared_error)

    def _from_pilot(self, pilot: "StructureSearch", poles: int, zeros: int) -> list[Point]:
        """Return starts from the optimum of a part of the records, and from nested models."""
        there = pilot.best(poles, zeros)
        points = [point_of(there.poles, there.seconds, self.box)]
        if zeros > 0:
            points.append(self.best(poles, zeros - 1))
        if poles > 1 and zeros > 0:
            within = self.best(poles - 1, zeros - 1)
            added = [-np.sqrt(self.box.spread[0] * self.box.fastest)]
            points.append(point_of(np.concatenate((within.poles, added)), within.seconds, self.box))
        return points

    def _alone(self, zeros: int, poles: int) -> list[Point]:
        """Return the best models with one pole, or one pair."""
        delay = self.best(1, 0).seconds if poles > 1 else self.first_delays
        return self._extended(zeros, np.zeros(0, dtype=complex), delay, poles, self.effort.alone, self.effort.denser)

    def _in_adjacent_cells(self, point: Point, cells: set[tuple[int, int]], slow_too: bool) -> list[Point]:
        """Return starts in the delay cells adjacent to that of a minimum, except ``cells`` already visited.

        With a fast pole the cost is smooth only within each cell, and a minimum in one does not determine the next.
        With slow poles this is rare.
        """
        width, points = self.box.cell, list[Point]()
        slow_too = slow_too or self.box.several_delays
        slow = not slow_too and float(point.speed.max(initial=0.0)) * width < FAST
        if not width or not point.speed.size or slow:
            return []
        for k in self.box.free_delays:
            (low, high), own = self.box.each_delay[k], point.delays[k].cell
            cells.add((k, own))
            for cell in (own - 1, own + 1):
                if (k, cell) not in cells and (cell + 1) * width > low and cell * width < high:
                    cells.add((k, cell))
                    # From the middle a step may jump into the cell of the minimum: also start at the common border.
                    border = max(own, cell) * width
                    for tau in ((cell + 0.5) * width, border):
                        seconds, within = list(point.seconds), [delay.cell for delay in point.delays]
                        seconds[k], within[k] = tau, cell
                        points.append(point_of(point.poles, seconds, self.box, within))
        return points

    @cached_property
    def first_delays(self) -> tuple[float, ...]:
        """Initial delays: the middle of the range; for several inputs from a fit of one pole for each."""
        problem, count = self.problem, len(self.problem.fewer_zeros)
        if self._given_delays is not None or count < 2:
            return self._given_delays or self.box.middle
        apart = problem._replace(terms=(Term(1, 0, problem.integrators),) * count, inputs=tuple(range(count)))
        return block_starts(apart, replace(self.box, parts=apart.parts), self.effort)[0].seconds

    def from_below(self, poles: int, zeros: int) -> list[Point]:
        """Return starts from smaller models and along the delay."""
        if poles == 0:
            middle = point_of(np.zeros(0, dtype=complex), self.first_delays, self.box)
            return self.along_delay(zeros, [middle])
        contained = self._alone(zeros, poles) if poles <= 2 else []
        others: list[Point] = []
        if zeros > 0:
            contained.append(self.best(poles, zeros - 1))
        if poles > 1 and zeros > 0:
            # Nested in this structure for any added pole, as is the previous one.
            grown = self._grown(poles - 1, zeros - 1, zeros, 1)
            contained, others = contained + grown[:1], grown[1:]
        for n, m in ((poles - 1, zeros), (poles - 2, zeros - 2), (poles - 2, zeros)):
            if n > 0 and 0 <= m <= n + self.most_zeros:
                others += self._grown(n, m, zeros, poles - n)
        descent = self.descent(zeros)
        points = descent.sorted(contained) + descent.sorted(others)[: self.effort.refined]
        if poles > self.effort.along_delay:
            return points
        extended = self.along_delay(zeros, points, self.effort.bases[poles > 2])
        # Single poles at the first delay, which no model has determined, only lead to the others.
        undetermined = (poles, zeros) == (1, 0) and self.effort is THOROUGH and len(extended) > len(points)
        return extended[len(points) :] if undetermined else extended

    def resonances(self, poles: int, zeros: int) -> list[Point]:
        """Return starts with a pair of the least damping, added to the poles of a smaller model.

        Such a pair fits one frequency of the noise, and the cost has a minimum at every frequency that the record
        resolves: all are tried by elimination only, the best of them at delays of the whole range.
        """
        samples = sum(data.count for data in self.problem.records)
        # Half the frequency resolution.
        resolution, highest = (
            0.5 * np.pi * self.box.spread[0],
            min(self.box.imaginary, self.box.fastest, self.box.highest),
        )
        count = min(int(highest / resolution), RESOLVED // samples)
        if poles < 2 or count < self.effort.pairs:
            return []
        roots, delay = np.zeros(0, dtype=complex), self.first_delays
        if poles > 2:
            smaller = self.best(poles - 2, min(zeros, poles - 3))
            roots, delay = smaller.poles, smaller.seconds
        zeta = self.box.least_damping
        frequencies = np.linspace(resolution, highest, count).tolist()
        alone = self._with_pairs(zeros, roots, [(w, zeta, delay) for w in frequencies])
        best = [alone[k] for k in lowest_minima(np.array([cost for cost, _, _ in alone]), LOOKED_AT)]
        single = len(delay) == 1
        delays = [(tau,) for tau in self.delays(LOOKED_AT)] if single and self.box.delay_free else [delay]
        if self.box.delay_free and single:
            best += self._with_pairs(zeros, roots, [(w, zeta, tau) for _, w, _ in best for tau in delays])
        lowest: dict[float, Point] = {}
        for _, w, point in sorted(best, key=lambda entry: entry[0]):
            lowest.setdefault(w, point)
        found = list(lowest.values())[: LOOKED_AT // 2]
        if self.box.imaginary < self.box.fastest:
            # The response of a pair at the Nyquist frequency differs at every delay.
            places = [(self.box.imaginary, damping, tau) for damping in (zeta, *self.effort.dampings) for tau in delays]
            edge = sorted(self._with_pairs(zeros, roots, places), key=lambda entry: entry[0])
            found += [point for _, _, point in edge[: self.effort.refined]]
        return found

    def _with_pairs(
        self, zeros: int, roots: ComplexArray, places: Iterable[tuple[float, float, tuple[float, ...]]]
    ) -> list[tuple[float, float, Point]]:
        """Return squared errors, frequencies and points with a pair of each frequency, damping and delay."""
        frequencies, points = [], []
        for w, zeta, tau in places:
            pair = w * complex(-zeta, 1.0)
            frequencies.append(w)
            points.append(point_of(np.concatenate((roots, [pair, pair.conjugate()])), tau, self.box))
        errors = self.descent(zeros).squared_errors(points).tolist()
        return list(zip(errors, frequencies, points, strict=True))

    def close_delays(self, poles: int, zeros: int) -> list[Point]:
        """Return starts with the best poles at delays within half a sampling interval of the best one.

        On an irregular clock the cost has a kink if a sample coincides with an edge of the input, and minima between.
        """
        if not self.box.beyond_edges or not self.box.delay_free:
            return []
        best = self.best(poles, zeros)
        interval = LIMITS["fastest"].rest / self.box.fastest
        points = []
        for k in self.box.free_delays:
            delays = best.seconds[k] + interval * np.concatenate((-CLOSE_DELAYS, CLOSE_DELAYS))
            inside = np.unique(np.clip(delays, *self.box.each_delay[k]))
            for tau in inside.tolist():
                points.append(best.with_delays(_at(best.delays, k, best.delays[k]._replace(seconds=tau))))
        return [self.descent(zeros).at_its_delay(point) for point in points]

    def _grown(self, poles: int, zeros: int, new_zeros: int, added: int) -> list[Point]:
        """Return the best starts from a smaller structure with added poles, for another numerator."""
        point = self.best(poles, zeros)
        return self._extended(new_zeros, point.poles, point.seconds, added, self.effort.looked_at)

    def _extended(
        self, zeros: int, roots: ComplexArray, delay: tuple[float, ...], added: int, most: int, denser: int = 1
    ) -> list[Point]:
        """Return the best poles, or pairs, added to given ones, by elimination only."""
        effort, box = self.effort, self.box
        slowest, count = box.spread[0], denser * (effort.poles if added == 1 else effort.pairs)
        frequencies = np.geomspace(slowest, box.fastest, count + 2)[1:-1]
        if added == 1 and box.slowest < slowest:
            # One frequency for all poles close to integrators.
            frequencies = np.append(frequencies, np.sqrt(box.slowest * slowest))
        dampings = effort.dampings if added == 2 else ()
        return with_added_poles(self.descent(zeros), box, (roots, delay), frequencies.tolist(), dampings, most)

    def along_delay(self, zeros: int, points: list[Point], bases: int = 1) -> list[Point]:
        """Return the points, and starts at the minima of the profile over the delay for the poles of the first points.

        Several delays are optimised cyclically, twice, for the poles of the best point.
        """
        free = self.box.free_delays
        if not points or not free:
            return points
        if len(free) == 1:
            seconds = [_at(points[0].seconds, free[0], tau) for tau in self.delays(MOST_DELAYS, free[0])]
            tried = [[point_of(base.poles, each, self.box) for each in seconds] for base in points[:bases]]
            errors = self.descent(zeros).squared_errors([trial for row in tried for trial in row])
            rows = zip(tried, errors.reshape(len(tried), -1), strict=True)
            lowest = [(float(costs[i]), row[i]) for row, costs in rows for i in lowest_minima(costs, KEPT)]
            # The lowest first: many of the other searches then end early.
            found = [trial for _, trial in sorted(lowest, key=lambda pair: pair[0])]
            return points + found
        point, found = points[0], []
        for k in (*free, *free):
            seconds = [_at(point.seconds, k, tau) for tau in self.delays(MOST_DELAYS, k)]
            trials = [point_of(point.poles, each, self.box) for each in seconds]
            minima = [trials[i] for i in lowest_minima(self.descent(zeros).squared_errors(trials), KEPT)]
            point = minima[0]
            found += minima
        return points + found[-KEPT * len(free) :]

    def delays(self, most: int, k: int = 0) -> list[float]:
        """Return delays of an input spread over its range, at most one for each cell."""
        low, high = self.box.each_delay[k]
        spacing = max(self.box.cell or 0.25 * self.box.quarter, (high - low) / most)
        count = int(np.ceil((high - low) / spacing))
        delays: list[float] = (low + (high - low) * (np.arange(count) + 0.5) / count).tolist()
        return delays

    def random_points(self, poles: int) -> list[Point]:
        """Return starts with uniformly distributed delays and logarithms of frequencies and dampings."""
        rng, box, points = np.random.default_rng(0), self.box, []
        for _ in range(self.effort.random * (1 + poles)):
            roots = [self._random_poles(rng, order) for order in box.parts or (poles,)]
            delays = [float(rng.uniform(*pair)) for pair in box.each_delay]
            points.append(point_of(np.concatenate(roots), delays, box))
        return points

    def _random_poles(self, rng: np.random.Generator, poles: int) -> ComplexArray:
        """Return random poles of one denominator."""
        slowest, least_damping = self.box.spread
        pairs = int(rng.integers(0, poles // 2 + 1))
        w = np.exp(rng.uniform(np.log(slowest), np.log(self.box.fastest), poles - pairs))
        zeta = np.exp(rng.uniform(np.log(least_damping), 0.0, pairs))
        upper = w[:pairs] * (-zeta + 1j * np.sqrt(1 - zeta**2))
        return np.concatenate((upper, upper.conj(), -w[pairs:]))


def _at(values: tuple[T, ...], k: int, value: T) -> tuple[T, ...]:
    """Return ``values`` with element ``k`` replaced."""
    return (*values[:k], value, *values[k + 1 :])


def with_added_poles(
    descent: Descent,
    box: Box,
    base: tuple[ComplexArray, float | Sequence[float]],
    frequencies: Sequence[float],
    dampings: Sequence[float],
    most: int,
) -> list[Point]:
    """Return the best starts with a pole, or a pair of one of the dampings, added to given ones, by elimination only.

    ``base``: poles, and delays. The added poles of the starts differ by at least ``APART``.
    """
    where, points, (roots, delays) = [], [], base
    for w in frequencies:
        for zeta in dampings or (1.0,):
            pole = w * complex(-zeta, np.sqrt(1 - zeta * zeta))
            new = [pole, pole.conjugate()] if dampings else [complex(-w)]
            where.append((np.log(w), np.log(zeta)))
            points.append(point_of(np.concatenate((roots, new)), delays, box))
    chosen: list[int] = []
    for k in np.argsort(descent.squared_errors(points), kind="stable").tolist():
        apart = all(np.abs(np.subtract(where[k], where[other])).max() > APART for other in chosen)
        if apart and len(chosen) < most:
            chosen.append(k)
    return [points[k] for k in chosen]


# --- several denominators: each is fitted to the residual of the others -------------------------------


def block_starts(problem: Problem, box: Box, effort: Effort) -> list[Point]:
    """Return starts of a sum of fractions with several denominators, in order of ascending squared error.

    Each denominator is fitted to the output minus the current response of the others, in two sweeps in ascending and
    two in descending order. The lowest minima of all denominators are combined.
    """
    blocks, found = range(len(problem.terms)), list[Point]()
    for order in (blocks, blocks[::-1]):
        searches: dict[int, StructureSearch] = {}
        parts: dict[int, list[Array]] = {}
        for block in (*order, *order):
            others = [part for other, part in parts.items() if other != block]
            own, own_box = _alone(problem, box, block, others)
            searches[block] = search = StructureSearch(own, own_box, effort=effort)
            poles = problem.terms[block].poles
            search.climb(poles, own.zeros)
            search.refine(poles, own.zeros, search.resonances(poles, own.zeros))
            parts[block] = responses(own, search.minima(poles, own.zeros)[0].projected)
        minima = [searches[k].minima(term.poles, term.zeros) for k, term in enumerate(problem.terms)]
        for chosen in product(*minima):
            seconds = list(box.middle)
            for driver, local in zip(problem.inputs, chosen, strict=True):
                seconds[driver] = local.point.delay.seconds
            found.append(point_of(np.concatenate([local.point.poles for local in chosen]), seconds, box))
    return Descent(problem, box).sorted(found)[:REFINED_TOGETHER]


def _alone(problem: Problem, box: Box, block: int, others: Sequence[list[Array]]) -> tuple[Problem, Box]:
    """Return the problem of one denominator, with the response of the others subtracted, and its box."""
    driver, term, records = problem.inputs[block], problem.terms[block], []
    for k, data in enumerate(problem.sampled):
        y = data.y.copy()
        y[data.use] -= np.sum([part[k] for part in others], axis=0) if others else 0.0
        records.append(data.inputs[driver]._replace(y=y, use=data.use, further=()))
    single = problem._replace(
        records=tuple(records),
        zeros=term.zeros,
        integrators=term.integrators,
        fewer_zeros=(0,),
        terms=(),
        inputs=(),
        numerator=np.zeros(0),
    )
    return single, replace(box, delays=(box.each_delay[driver],), parts=())
