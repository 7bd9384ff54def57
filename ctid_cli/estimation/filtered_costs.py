"""Output-error costs of a low-pass filtered record as functions of the delay, computed from spectra, and their search.

Useful redundancy over the delay: solver paths on the costs of several filters, ranked by the mean of all costs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.delay_search import Descent, Limits, Minima, Minimum, descend, scan
from ctid_cli.estimation.iteration import Steps
from ctid_cli.estimation.redundancy import RedundantMinimum, minimise_redundantly
from ctid_cli.estimation.sampled_problem import reflect_unstable
from ctid_cli.filtering.filter_set import FilterSet
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.filtering.spectra import RecordSpectra, lowpass_weight, record_spectra
from ctid_cli.inference.fit import IterationRecord
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.signals.record import Record

#: Highest frequency, as a multiple of the highest cut-off: a filter of order 10 passes 3e-4 of the power there.
HIGHEST = 1.5
#: Frequencies above the last one with a weight over this fraction of the greatest are omitted.
NEGLIGIBLE_WEIGHT = 1e-6
#: Spacing of the lattice of delays, as a fraction of the shortest period: equal candidates coincide, and searches of
#: one record from different initial delays share costs and paths.
LATTICE = 0.1
#: The shortest Gauss-Newton step of the search, as a fraction of the shortest period.
SMALLEST_STEP = 0.01
#: The longest Gauss-Newton step, as a fraction of the range of the delay: values from 0.2 to 0.8 work; with 0.1 the
#: paths end in shallow local minima far from the global one.
LARGEST_STEP = 1 / 3
#: If no path reduces J0 and J0 exceeds this [%], the paths are restarted one period of their filter away.
POOR = 25.0


@dataclass(frozen=True, eq=False)
class FilteredCost:
    """Output-error cost of a low-pass filtered record as a function of the delay."""

    spectra: RecordSpectra
    #: ``|L|^2`` at the lowest frequencies, where it is significant.
    weights: Array
    #: Variance of the filtered output [output unit^2].
    spread: float
    #: Cut-off of the state-variable filter of the least-squares start [rad/s].
    svf_cutoff: float
    structure: Structure
    #: Steps of the minimisation at each delay.
    steps: Steps

    @property
    def size(self) -> int:
        """Number of parameters, including the delay."""
        return self.structure.size + 1

    def minimise(self, delay: float, starts: Array, own: bool) -> Minimum:
        """Return the least cost at a delay from given starts and with ``own`` from least squares."""
        from ctid_cli.filtering.spectral_kernels import least_cost, least_squares  # numba is slow to import

        spectra, reach, steps = self.spectra, self.weights.size, self.steps
        data = spectra.frequencies[:reach], spectra.outputs[:reach], spectra.inputs(delay, reach), self.weights
        poles = self.structure.poles
        # B, and the terms of the states at the ends of the window.
        linear = np.zeros(self.structure.zeros + 1 + poles)
        tried = [np.concatenate((start[:poles], linear)) for start in starts]
        if own:
            # The state-variable filter 1/(p + w)^n; without poles np.poly returns a scalar.
            filter_ = np.concatenate((np.atleast_1d(np.poly(np.full(poles, -self.svf_cutoff)))[1:], linear))
            solved, theta = least_squares(*data, filter_, poles)
            if solved:
                tried.append(np.concatenate((reflect_unstable(np.append(1.0, theta[:poles]))[1:], linear)))
        best, effort = Minimum(np.zeros(self.size), np.inf), (steps.max_iterations, steps.tolerance, steps.halvings)
        for start in tried:
            theta, squared_error, step = least_cost(*data, start, poles, *effort)
            if squared_error < best.squared_error:
                best = Minimum(np.append(theta, delay), squared_error, step)
        return best


def percents(squared_errors: Array, spreads: Array | float) -> Array:
    """Return ``100 ||y - x|| / ||y - mean y||`` of filtered data [%]; 100 if it could not be computed."""
    return np.where(np.isfinite(squared_errors), 100.0 * np.sqrt(squared_errors / spreads), 100.0)


def filtered_costs(
    record: Record,
    lowpasses: Sequence[Lowpass],
    structure: Structure,
    greatest_delay: float,
    *,
    start: float,
    svf_cutoffs: Sequence[float],
    steps: Steps,
) -> list[FilteredCost]:
    """Return the costs of one record for several filters; samples until ``start`` after the first input are unused."""
    highest = HIGHEST * max(lowpass.cutoff for lowpass in lowpasses)
    spectra = record_spectra(record, start, highest, greatest_delay)
    power = np.where(spectra.frequencies > 0.0, 2.0, 0.0) * np.abs(spectra.outputs) ** 2
    costs = []
    for lowpass, svf_cutoff in zip(lowpasses, svf_cutoffs, strict=True):
        weights = lowpass_weight(spectra.frequencies, lowpass)
        reach = int((weights >= NEGLIGIBLE_WEIGHT * weights.max()).sum())
        costs.append(FilteredCost(spectra, weights[:reach], float(weights @ power), svf_cutoff, structure, steps))
    return costs


@dataclass(frozen=True, eq=False)
class FilterPath:
    """Solver path: Gauss-Newton on the delay with one filter."""

    round: int
    filter: int
    #: Start at the incumbent, or one period of the filter away from it.
    descent: Descent
    #: Variance of the filtered output, or its sum of squares about the mean.
    spread: float
    #: Candidate at the end of the path [s].
    end: float

    @cached_property
    def delays(self) -> Array:
        """Start and accepted trial delays [s], shape (K,)."""
        return self.descent.path[:, -2]

    @cached_property
    def costs(self) -> Array:
        """``100 ||y - x|| / ||y - mean y||`` of the filtered data at these delays [%], shape (K,)."""
        return percents(self.descent.path[:, -1], self.spread)


def path_history(
    stage: str, search: RedundantMinimum[float], paths: Sequence[FilterPath], poles: int, samples: int = 1
) -> list[IterationRecord]:
    """Describe the steps of the paths between successive incumbents."""
    led = {(path.round, path.filter, path.end): path for path in reversed(paths)}
    return [
        IterationRecord(
            *(stage.format(visit.path + 1), k, row[-2], row[-1] / samples),
            *((1.0, *row[:poles]), tuple(row[poles:-2])),
        )
        for visit in search.trajectory[1:]
        for k, row in enumerate(led[visit.round, visit.path, visit.point].descent.path.tolist())
    ]


class FilterSearch:
    """Costs of a record for a set of filters, and the search over them."""

    def __init__(self, costs: Sequence[FilteredCost], filters: FilterSet, limits: Limits) -> None:
        #: Ascending cut-offs.
        self.costs = costs
        self.filters = filters
        self.period = float(filters.periods[-1])
        self.limits = limits._replace(smallest_step=SMALLEST_STEP * self.period, reflect=True)
        self.at = cache(self._minima)
        self._descended = cache(self._descend)

    def on_lattice(self, delay: float) -> float:
        """Return the nearest point of the lattice within the bounds."""
        step = LATTICE * self.period
        return min(max(round(delay / step) * step, self.limits.low), self.limits.high)

    def reference_cost(self, delay: float) -> float:
        """Return J0 (45), the mean of the costs of all filters, at the nearest point of the lattice [%]."""
        spreads = np.array([cost.spread for cost in self.costs])
        return float(percents(self.at(self.on_lattice(delay)).squared_errors, spreads).mean())

    def run(self, delay: float, max_rounds: int) -> tuple[RedundantMinimum[float], list[FilterPath]]:
        """Follow the paths of all filters from successive incumbents, round by round."""
        found = minimise_redundantly(
            self.on_lattice(delay),
            self.reference_cost,
            [partial(self._ends, k) for k in range(self.filters.count)],
            choice="best",
            settled=lambda before, now: abs(now - before) <= self.limits.tolerance * max(abs(now), self.period),
            max_rounds=max_rounds,
        )
        incumbents = [visit.point for visit in found.trajectory]
        paths = [
            FilterPath(number, k, descent, self.costs[k].spread, self.on_lattice(descent.minimum.delay))
            for number, incumbent in enumerate(incumbents[: found.rounds], 1)
            for k in range(self.filters.count)
            for descent in self._followed(k, incumbent)
        ]
        return found, paths

    def _minima(self, delay: float) -> Minima:
        """Return the least costs of all filters at a delay."""
        # Least squares on a narrow band fails in noise: start from the estimate of the next wider band.
        found = scan(self.costs[::-1], [delay] * len(self.costs), own=False)
        return Minima(found.thetas[::-1], found.squared_errors[::-1])

    def _ends(self, k: int, delay: float) -> list[float]:
        """Return the ends of the paths of one filter from an incumbent, on the lattice."""
        return [self.on_lattice(descent.minimum.delay) for descent in self._followed(k, delay)]

    def _followed(self, k: int, delay: float) -> list[Descent]:
        """Return descents from an incumbent, and from adjacent valleys if it is poor and no filter improves it."""
        near, cost = self._descended(k, delay, 0), self.reference_cost(delay)
        if cost <= POOR:
            return near
        others = (descent for other in range(self.filters.count) for descent in self._descended(other, delay, 0))
        if any(self.reference_cost(descent.minimum.delay) < cost for descent in others):
            return near
        return near + self._descended(k, delay, -1) + self._descended(k, delay, 1)

    def _descend(self, k: int, delay: float, periods: int) -> list[Descent]:
        """Return descents of one filter's cost, started a number of its periods away from a point of the lattice."""
        none, here = np.empty((0, self.costs[k].size)), self.at(delay)
        start = delay + periods * float(self.filters.periods[k])
        if not self.limits.low <= start <= self.limits.high:
            return []
        # From the coefficients of J0 and from least squares: often only one of these is trapped.
        known = periods == 0 and np.isfinite(here.squared_errors[k])
        thetas = [here.thetas[k : k + 1], none] if known else [none]
        found = [descend(self.costs[k], start, theta, self.limits) for theta in thetas]
        return [descent for descent in found if descent.path.size]
