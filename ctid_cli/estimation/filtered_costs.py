"""Output-error costs of a record behind low-pass filters as functions of the delay, on spectra, and their search.

Useful redundancy over the delay: solver paths on the costs of several filters, ranked by the mean of all.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, ComplexArray, IntArray
from ctid_cli.estimation.delay_search import Descent, Limits, Minimum, descend
from ctid_cli.estimation.iteration import Steps
from ctid_cli.estimation.redundancy import Path, RedundantMinimum, SearchStatus, minimise_redundantly
from ctid_cli.estimation.sampled_problem import reflect_unstable
from ctid_cli.filtering.filter_set import FilterSet
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.filtering.spectra import HeldSpectrum, lowpass_weight, record_spectra
from ctid_cli.filtering.spectral_kernels import least_cost, least_squares
from ctid_cli.inference.fit import IterationRecord
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.signals.record import Record

#: Highest frequency, as a multiple of the highest cut-off: a filter of order 10 passes 3e-4 of the power there.
HIGHEST = 1.5
#: Frequencies above the last one whose weight exceeds this fraction of the greatest are left out.
NEGLIGIBLE_WEIGHT = 1e-6
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


class FilteredCosts(NamedTuple):
    """What searches need of a record behind filters, the spectra of which they share."""

    #: Frequencies [rad/s], shape (K,).
    frequencies: Array
    outputs: ComplexArray
    input: HeldSpectrum
    #: ``|L|^2`` of each filter, shape (filters, K), and at how many frequencies it matters, shape (filters,).
    weights: Array
    reach: IntArray
    #: Cut-off of the state-variable filter of the least-squares start [rad/s], shape (filters,).
    svf_cutoffs: Array
    #: Mean square of the filtered output less its mean [output unit^2], shape (filters,).
    spreads: Array
    poles: int
    zeros: int
    #: Poles at the origin besides; with any the mean is left out.
    integrators: int
    #: How hard to work at each delay.
    steps: Steps

    @property
    def size(self) -> int:
        """Number of parameters, the delay included."""
        return self.poles + self.zeros + 2

    def behind(self, k: int) -> "FilteredCost":
        """The cost of one filter."""
        return FilteredCost(self, k)

    def minima_behind_all(self, delay: float) -> tuple[Array, Array]:
        """Coefficients and squared error behind every filter, the narrowest band first.

        Good coefficients are handed from filter to filter, down to the narrowest band and up again.
        """
        many = self.reach.size
        inputs = self.inputs(delay, int(self.reach.max()))
        thetas, squared_errors = np.zeros((many, self.size)), np.full(many, np.inf)
        for k in range(many - 1, -1, -1):
            # Least squares on a narrow band is hopeless in noise: the next wider band knows the system better.
            known = k + 1 < many and bool(np.isfinite(squared_errors[k + 1]))
            found = self.least(k, inputs, delay, thetas[k + 1 : k + 1 + known], not known)
            thetas[k], squared_errors[k] = found.theta, found.squared_error
        for k in range(1, many):
            if np.isfinite(squared_errors[k - 1]):
                found = self.least(k, inputs, delay, thetas[k - 1 : k], False)
                if found.squared_error < squared_errors[k]:
                    thetas[k], squared_errors[k] = found.theta, found.squared_error
        return thetas, squared_errors

    def inputs(self, delay: float, reach: int) -> ComplexArray:
        """Spectrum of the delayed input at the first frequencies."""
        if self.integrators:
            return self.input.at(delay, np.ones(reach))[1:]
        return self.input.at(delay, np.ones(reach - 1))

    def least(self, k: int, inputs: ComplexArray, delay: float, starts: Iterable[Array], own: bool) -> Minimum:
        """Least cost of one filter over starts and, if asked for, from least squares."""
        reach = self.reach[k]
        data = self.frequencies[:reach], self.outputs[:reach], inputs[:reach], self.weights[k, :reach]
        sizes, tried = (self.zeros, self.integrators), [start[: self.poles] for start in starts]
        if own:
            # The state-variable filter 1/(p + w)^n.
            solved, a = least_squares(*data, np.poly(np.full(self.poles, -self.svf_cutoffs[k]))[1:], *sizes)
            if solved:
                tried.append(reflect_unstable(np.append(1.0, a))[1:])
        best = Minimum(np.zeros(self.size), np.inf)
        for start in tried:
            theta, squared_error, step = least_cost(*data, start, *sizes, *self.effort)
            if squared_error < best.squared_error:
                best = Minimum(np.append(theta, delay), squared_error, step)
        return best

    @property
    def effort(self) -> tuple[int, float, int]:
        """Most iterations, tolerance and most halvings."""
        return self.steps.max_iterations, self.steps.tolerance, self.steps.halvings


class FilteredCost(NamedTuple):
    """The cost behind one filter of several."""

    costs: FilteredCosts
    filter: int

    @property
    def size(self) -> int:
        """Number of parameters, the delay included."""
        return self.costs.size

    def minimise(self, delay: float, starts: Array, own: bool) -> Minimum:
        """Least cost at a delay over starts of any delay and, if asked for, from least squares."""
        inputs = self.costs.inputs(delay, int(self.costs.reach[self.filter]))
        return self.costs.least(self.filter, inputs, delay, starts, own)


def percents(squared_errors: Array, spreads: Array | float) -> Array:
    """``100 ||y - x|| / ||y - mean y||`` of filtered data [%]; 100 where nothing could be computed."""
    return np.where(np.isfinite(squared_errors), 100.0 * np.sqrt(squared_errors / spreads), 100.0)


def filtered_costs(
    record: Record,
    lowpasses: Sequence[Lowpass],
    structure: Structure,
    greatest_delay: float,
    *,
    start: float,
    svf_cutoffs: Array,
    steps: Steps,
    integrators: int = 0,
) -> FilteredCosts:
    """Costs of one record behind filters; samples earlier than ``start`` after the first input are not used."""
    highest = HIGHEST * max(lowpass.cutoff for lowpass in lowpasses)
    spectra = record_spectra(record, start, highest, greatest_delay, keep_mean=integrators == 0)
    w = spectra.frequencies
    weights = np.array([lowpass_weight(w, lowpass) for lowpass in lowpasses])
    reach = (weights >= NEGLIGIBLE_WEIGHT * weights.max(axis=1, keepdims=True)).sum(axis=1)
    spreads = weights @ (np.where(w > 0.0, 2.0, 0.0) * np.abs(spectra.outputs) ** 2)
    sizes = structure.poles, structure.zeros, integrators
    return FilteredCosts(w, spectra.outputs, spectra.input, weights, reach, svf_cutoffs, spreads, *sizes, steps)


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


class ReferenceCost(NamedTuple):
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
        self._known: dict[float, ReferenceCost] = {}
        self._descended: dict[tuple[int, float, bool], list[Descent]] = {}

    def on_lattice(self, delay: float) -> float:
        """The nearest point of the lattice within the bounds."""
        step = LATTICE * self.period
        return min(max(round(delay / step) * step, self.limits.low), self.limits.high)

    def at(self, delay: float) -> ReferenceCost:
        """J0 and the minima of all filters at a point of the lattice."""
        if delay not in self._known:
            thetas, squared_errors = self.costs.minima_behind_all(delay)
            self._known[delay] = ReferenceCost(
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
