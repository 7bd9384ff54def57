"""Useful redundancy over the delay: solver paths on the costs of several low-pass filters, ranked by their mean."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.delay_search import Descent, Limits, descend
from ctid_cli.estimation.filtered_costs import FilteredCosts, percents
from ctid_cli.estimation.redundancy import Path, RedundantMinimum, SearchStatus, minimise_redundantly
from ctid_cli.filtering.filter_set import FilterSet
from ctid_cli.inference.fit import IterationRecord

#: The search moves on a lattice of delays of this fraction of the shortest period: candidates that agree are one, and
#: searches of the same data from different initial delays share costs and paths.
LATTICE = 0.1
#: The shortest Gauss-Newton step of the search, as a fraction of the shortest period.
SMALLEST_STEP = 0.01
#: The longest Gauss-Newton step, as a fraction of the range of the delay: from a fifth to four fifths all serve, with a
#: tenth the paths end in small bumps far from the minimum.
LARGEST_STEP = 1 / 3
#: Where no path leads lower and J0 exceeds this [%], the paths start once more a period of their filter away.
POOR = 25.0


@dataclass(frozen=True, eq=False)
class FilterPath:
    """One solver path: Gauss-Newton on the delay with one filter."""

    round: int
    filter: int
    #: From the incumbent, or a period of the filter away from it.
    descent: Descent
    #: Mean square of the filtered output less its mean, or the sum of these squares.
    spread: float
    #: The candidate that the end of the path became [s].
    end: float

    @cached_property
    def delays(self) -> Array:
        """Accepted trial delays [s], where it started first, shape (K,)."""
        return self.descent.path[:, -2]

    @cached_property
    def costs(self) -> Array:
        """``100 ||y - x|| / ||y - mean y||`` of the filtered data there [%], shape (K,)."""
        return percents(self.descent.path[:, -1], self.spread)


def path_history(
    stage: str, search: RedundantMinimum[float], paths: Sequence[FilterPath], poles: int, samples: int = 1
) -> list[IterationRecord]:
    """The steps of the paths that led from incumbent to incumbent."""
    led = {(path.round, path.filter, path.end): path for path in reversed(paths)}
    return [
        IterationRecord(
            *(stage.format(visit.path + 1), k, row[-2], row[-1] / samples),
            *((1.0, *row[:poles]), tuple(row[poles:-2])),
        )
        for visit in search.trajectory[1:]
        for k, row in enumerate(led[visit.round, visit.path, visit.point].descent.path.tolist())
    ]


class Minima(NamedTuple):
    """J0 at one delay and what it is made of."""

    #: Mean of the costs of all filters [%].
    mean: float
    #: ``(a_1 … a_n, b_0 … b_m, delay)`` of each filter, shape (filters, n + m + 2).
    thetas: Array
    #: Infinite where nothing could be computed, shape (filters,).
    squared_errors: Array


class FilterSearch:
    """The costs of a record behind a set of filters, and the search through them."""

    def __init__(
        self,
        costs: FilteredCosts,
        filters: FilterSet,
        bounds: tuple[float, float],
        max_iterations: int,
        tolerance: float,
        max_delay_step: float,
    ) -> None:
        self.costs = costs
        self.filters = filters
        self.period = float(filters.periods[-1])
        shortest = SMALLEST_STEP * self.period
        self.limits = Limits(*bounds, max_iterations, tolerance, shortest, max_delay_step, reflect=True)
        self._known: dict[float, Minima] = {}
        self._descended: dict[tuple[int, float, bool], list[Descent]] = {}

    def on_lattice(self, delay: float) -> float:
        """The nearest point of the lattice within the bounds."""
        step = LATTICE * self.period
        return min(max(round(delay / step) * step, self.limits.low), self.limits.high)

    def at(self, delay: float) -> Minima:
        """J0 and the minima of all filters at a point of the lattice."""
        if delay not in self._known:
            thetas, squared_errors = self.costs.minima_behind_all(delay)
            self._known[delay] = Minima(
                float(percents(squared_errors, self.costs.spreads).mean()), thetas, squared_errors
            )
        return self._known[delay]

    def reference_cost(self, delay: float) -> float:
        """J0 at the nearest point of the lattice [%]."""
        return self.at(self.on_lattice(delay)).mean

    def run(self, delay: float, max_rounds: int, paths: list[FilterPath]) -> RedundantMinimum[float]:
        """Rounds over all filters, and a look at the next valleys before a poor incumbent is settled for."""

        def rounds_from(delay: float, done: int, hop: bool) -> RedundantMinimum[float]:
            return minimise_redundantly(
                delay,
                lambda delay: self.at(delay).mean,
                [self._path(k, paths, done, hop) for k in range(self.filters.count)],
                choice="best",
                settled=lambda before, now: abs(now - before) <= self.limits.tolerance * max(abs(now), self.period),
                max_rounds=1 if hop else max_rounds - done,
            )

        found = rounds_from(self.on_lattice(delay), 0, False)
        while found.status is SearchStatus.EXHAUSTED and found.cost > POOR and found.rounds < max_rounds - 1:
            beyond = rounds_from(found.point, found.rounds, True)
            improved = len(beyond.trajectory) > 1
            found = _joined(found, beyond)
            if not improved:
                break
            found = _joined(found, rounds_from(found.point, found.rounds, False))
        return found

    def _path(self, k: int, paths: list[FilterPath], done: int, hop: bool) -> Path[float]:
        """Solver path of one filter after a number of rounds; what it does goes to ``paths``."""
        rounds = done

        def follow(delay: float) -> list[float]:
            nonlocal rounds
            rounds += 1
            if (k, delay, hop) not in self._descended:
                self._descended[k, delay, hop] = self._descents(k, delay, hop)
            ends = [(found, self.on_lattice(found.minimum.delay)) for found in self._descended[k, delay, hop]]
            paths.extend(FilterPath(rounds, k, found, self.costs.spreads[k], end) for found, end in ends)
            return [end for _, end in ends]

        return follow

    def _descents(self, k: int, delay: float, hop: bool) -> list[Descent]:
        """Descents of one filter's cost from a point of the lattice, or from a period of the filter away from it."""
        none = np.empty((0, self.costs.size))
        if hop:
            low, high, period = self.limits.low, self.limits.high, float(self.filters.periods[k])
            starts = [(start, none) for start in (delay - period, delay + period) if low <= start <= high]
        else:
            # From the coefficients of J0 and from least squares: where one is trapped the other often is not.
            here = self.at(delay)
            starts = [(delay, here.thetas[k : k + 1])] if np.isfinite(here.squared_errors[k]) else []
            starts.append((delay, none))
        found = [descend(self.costs.behind(k), start, theta, self.limits) for start, theta in starts]
        return [descent for descent in found if descent.path.size]


def _joined(first: RedundantMinimum[float], then: RedundantMinimum[float]) -> RedundantMinimum[float]:
    """A search and the one that went on from its end as one."""
    later = tuple(replace(visit, round=visit.round + first.rounds) for visit in then.visits[1:])
    return replace(then, rounds=first.rounds + then.rounds, visits=first.visits + later)
