"""Useful redundancy over the delay: solver paths on the costs of several low-pass filters, ranked by their mean."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.delay_search import Minimum, descend
from ctid_cli.estimation.filtered_costs import FilteredCost
from ctid_cli.estimation.redundancy import Path, RedundantMinimum, SearchStatus, minimise_redundantly
from ctid_cli.filtering.filter_set import FilterSet
from ctid_cli.inference.fit import IterationRecord

#: J0 is evaluated on a lattice of delays of this fraction of the shortest period, so that candidates that agree share
#: it, and so do searches of the same data from different initial delays.
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
    #: Accepted trial delays [s], where it started first: the incumbent, or a period of the filter away from it, shape
    #: (K,).
    delays: Array
    #: ``100 ||y - x|| / ||y - mean y||`` of the filtered data there [%], shape (K,).
    costs: Array
    #: ``(a_1 … a_n, b_0 … b_m)`` there, shape (K, n + m + 1).
    coefficients: Array


class Limits(NamedTuple):
    """Where a search may go and when it ends."""

    bounds: tuple[float, float]
    max_iterations: int
    tolerance: float
    max_rounds: int
    max_delay_step: float


class FilterSearch:
    """The costs of a record behind a set of filters, and the search through them."""

    def __init__(self, costs: Sequence[FilteredCost], filters: FilterSet, limits: Limits) -> None:
        self.costs = costs
        self.filters = filters
        self.limits = limits
        self.period = float(filters.periods[-1])
        self._known: dict[int, tuple[float, list[Minimum | None]]] = {}

    def reference_cost(self, delay: float) -> float:
        """J0 at the nearest point of a lattice of a tenth of the shortest period: the mean of all members' costs."""
        return self.at(delay)[0]

    def run(self, delay: float, paths: list[FilterPath]) -> RedundantMinimum[float]:
        """Rounds over all filters, and a look at the next valleys before a poor incumbent is settled for."""
        limits = self.limits

        def rounds_from(delay: float, done: int, hop: bool) -> RedundantMinimum[float]:
            return minimise_redundantly(
                delay,
                self.reference_cost,
                [self._path(k, paths, done, hop) for k in range(len(self.costs))],
                choice="best",
                settled=lambda before, now: abs(now - before) <= limits.tolerance * max(abs(now), self.period),
                max_rounds=1 if hop else limits.max_rounds - done,
            )

        found = rounds_from(delay, 0, False)
        while found.status is SearchStatus.EXHAUSTED and found.cost > POOR and found.rounds < limits.max_rounds - 1:
            beyond = rounds_from(found.point, found.rounds, True)
            improved = len(beyond.trajectory) > 1
            found = _joined(found, beyond)
            if not improved:
                break
            found = _joined(found, rounds_from(found.point, found.rounds, False))
        return found

    def history(self, search: RedundantMinimum[float], paths: list[FilterPath]) -> list[IterationRecord]:
        """The steps of the paths that led from incumbent to incumbent."""
        history: list[IterationRecord] = []
        n = self.costs[0].structure.poles
        for visit in search.trajectory[1:]:
            ends = {(path.round, path.filter, float(path.delays[-1])): path for path in reversed(paths)}
            path = ends[visit.round, visit.path, visit.point]
            cost = self.costs[path.filter]
            squares = (path.costs / 100.0) ** 2 * cost.spread * cost.mean_factor
            stage = f"filter {path.filter + 1}"
            for i, (delay, square) in enumerate(zip(path.delays.tolist(), squares.tolist(), strict=True)):
                theta = path.coefficients[i].tolist()
                history.append(IterationRecord(stage, i, delay, square, (1.0, *theta[:n]), tuple(theta[n:])))
        return history

    def _path(self, k: int, paths: list[FilterPath], done: int, hop: bool) -> Path[float]:
        """Solver path of one filter after a number of rounds; what it does goes to ``paths``."""
        cost = self.costs[k]
        low, high = self.limits.bounds
        period = float(self.filters.periods[k])
        rounds = done

        def follow(delay: float) -> list[float]:
            nonlocal rounds
            rounds += 1
            starts: list[tuple[float, Array | None]]
            if hop:
                starts = [(start, None) for start in (delay - period, delay + period) if low <= start <= high]
            else:
                # From the coefficients of J0 and from least squares: where one is trapped the other often is not.
                here = self.at(delay)[1][k]
                starts = [(delay, theta) for theta in ((None,) if here is None else (here.theta, None))]
            ends: list[float] = []
            for start, theta in starts:
                found = descend(
                    cost,
                    start,
                    theta,
                    (low, high),
                    max_iterations=self.limits.max_iterations,
                    tolerance=self.limits.tolerance,
                    smallest_step=SMALLEST_STEP * self.period,
                    largest_step=self.limits.max_delay_step,
                    reflect=True,
                )
                if found is not None:
                    costs = np.array([cost.percent(step) for step in found.steps])
                    thetas = np.array([step.theta for step in found.steps])
                    paths.append(FilterPath(rounds, k, thetas[:, -1], costs, thetas[:, :-1]))
                    ends.append(found.minimum.delay)
            return ends

        return follow

    def at(self, delay: float) -> tuple[float, list[Minimum | None]]:
        """J0 and the minima of all filters at the lattice point next to a delay."""
        place = round(delay / (LATTICE * self.period))
        if place not in self._known:
            minima = self._minima(float(np.clip(place * LATTICE * self.period, *self.limits.bounds)))
            percents = [cost.percent(minimum) for cost, minimum in zip(self.costs, minima, strict=True)]
            mean = float(np.mean(percents))
            self._known[place] = mean, minima
        return self._known[place]

    def _minima(self, delay: float) -> list[Minimum | None]:
        """Coefficients of every filter at a delay: good ones are handed from filter to filter, down and up again."""
        minima: list[Minimum | None] = [None] * len(self.costs)
        neighbour: Array | None = None
        for k in reversed(range(len(self.costs))):
            # Least squares on a narrow band is hopeless in noise: the next wider band knows the system better.
            found = minima[k] = self.costs[k].minimise(delay, neighbour)
            neighbour = neighbour if found is None else found.theta
        for k in range(1, len(self.costs)):
            below, here = minima[k - 1], minima[k]
            if below is not None:
                found = self.costs[k].minimise_from(delay, [below.theta])
                if found is not None and (here is None or found.squared_error < here.squared_error):
                    minima[k] = found
        return minima


def _joined(first: RedundantMinimum[float], then: RedundantMinimum[float]) -> RedundantMinimum[float]:
    """A search and the one that went on from its end as one."""
    later = tuple(replace(visit, round=visit.round + first.rounds) for visit in then.visits[1:])
    return replace(then, rounds=first.rounds + then.rounds, visits=first.visits + later)
