"""What useful redundancy sees of a record: the costs of its filters over the delay, and its way through them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.estimation.common import Start
from ctid_cli.estimation.delay_search import Minimum
from ctid_cli.estimation.filter_search import NOTHING, FilterSearch
from ctid_cli.estimation.filtered_costs import FilteredCost
from ctid_cli.estimators.useful_redundancy import RedundantFit, UsefulRedundancy
from ctid_cli.simulation.dataset import DataSet

#: How often the delays are gone through, up and down in turn: more does not lower the costs visibly.
SWEEPS = 2


@dataclass(frozen=True, eq=False)
class Leg:
    """An accepted solver path: from one incumbent to the next."""

    filter: int
    #: Gauss-Newton steps [s], the incumbent it started from first, shape (K,).
    delays: Array
    #: J0 there, as the search evaluates it [%], shape (K,).
    costs: Array
    switched: bool


@dataclass(frozen=True, eq=False)
class Landscape:
    """Costs over the delay and a search through them."""

    #: Delays [s], rising, shape (N,).
    delays: Array
    #: Least costs over the coefficients that were found [%], of the filter of longest period first, shape (N, filters).
    members: Array
    #: J0 as the search evaluates it [%], shape (N,).
    evaluated: Array
    #: True delay [s].
    true_delay: float
    fit: RedundantFit
    legs: tuple[Leg, ...]

    @property
    def reference(self) -> Array:
        """J0, the mean of the members [%], shape (N,)."""
        return np.asarray(self.members.mean(axis=1))

    @property
    def cutoffs(self) -> Array:
        """Cut-off frequencies of the filters [rad/s], shape (filters,)."""
        assert self.fit.filters is not None
        return self.fit.filters.cutoffs


def landscape(
    estimator: UsefulRedundancy, data_set: DataSet, delays: ArrayLike, initial_delay: float, sweeps: int = SWEEPS
) -> Landscape:
    """Costs over the delay, and the search from one initial delay.

    Far from the true delay the costs have local minima over the coefficients, and which one the search ends in changes
    from delay to delay. The least costs come from a continuation: coefficients that are good at one delay and for one
    filter are tried at the next one and for its neighbours.
    """
    grid = np.asarray(delays, dtype=float)
    prepared = estimator.prepare(data_set.record)
    assert data_set.true_model is not None
    fit, search = prepared.fit(Start(delay=initial_delay)), prepared.laid_out.filtered
    return Landscape(
        delays=grid,
        members=_least_costs(search.costs, grid, sweeps),
        evaluated=np.array([search.reference_cost(delay) for delay in grid]),
        true_delay=data_set.true_model.delay,
        fit=fit,
        legs=_legs(search, fit),
    )


def _least_costs(costs: Sequence[FilteredCost], delays: Array, sweeps: int) -> Array:
    best: list[list[Minimum | None]] = [[None] * len(costs) for _ in delays]
    for sweep in range(sweeps):
        before: list[Minimum | None] = [None] * len(costs)
        for i in range(delays.size) if sweep % 2 == 0 else reversed(range(delays.size)):
            _improve(best[i], before, costs, float(delays[i]), first=sweep == 0)
            before = best[i]
    least = np.full((delays.size, len(costs)), float(NOTHING))
    for (i, k), minimum in np.ndenumerate(np.array(best, dtype=object)):
        if minimum is not None:
            least[i, k] = 100.0 * float(np.sqrt(minimum.squared_error / costs[k].spread))
    return least


def _improve(
    here: list[Minimum | None], before: list[Minimum | None], costs: Sequence[FilteredCost], delay: float, first: bool
) -> None:
    """Try at one delay what was found at the delay before and for the neighbouring filters, the widest band last."""
    for k in reversed(range(len(costs))):
        known = [before[k], *here[k + 1 : k + 2], *here[max(k - 1, 0) : k]]
        starts = [minimum.theta for minimum in known if minimum is not None]
        # Least squares on a narrow band is hopeless in noise.
        if first and (k == len(costs) - 1 or not starts):
            starts += costs[k].starts(delay)
        found, old = costs[k].minimise_from(delay, starts), here[k]
        if found is not None and (old is None or found.squared_error < old.squared_error):
            here[k] = found


def _legs(search: FilterSearch, fit: RedundantFit) -> tuple[Leg, ...]:
    assert fit.search is not None
    legs = []
    for visit in fit.search.trajectory[1:]:
        place = visit.round, visit.path, visit.point
        path = next(path for path in fit.paths if (path.round, path.filter, float(path.delays[-1])) == place)
        costs = np.array([search.reference_cost(float(delay)) for delay in path.delays])
        legs.append(Leg(path.filter, path.delays, costs, visit in fit.switches))
    return tuple(legs)
