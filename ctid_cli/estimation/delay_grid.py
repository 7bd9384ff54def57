"""A global search over the delay: a coarse grid behind a narrow low-pass filter, finer ones behind wider filters."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.estimation.delay_search import SMALLEST_STEP, DelayCost, Limits, Minimum, descend
from ctid_cli.estimation.filtered_costs import FilteredCost

#: Fewest delays of a grid over the whole range, whatever the bandwidth asks for.
FEWEST_DELAYS = 24
#: Local minima of a level around which the next level looks, and those of the last level that are returned.
KEPT = 8
MINIMA = 3
#: Spacings of a level's grid on either side of its minima that the next level covers.
REACH = 1.5
#: A minimum whose cost exceeds the least of its level by more than this factor is given up.
HOPELESS = 4.0
#: Gauss-Newton steps on the delay that end the search.
DESCENT_ITERATIONS = 10
DESCENT_TOLERANCE = 1e-4


class Scan(NamedTuple):
    """Least costs at several delays."""

    #: ``(a_1 … a_n, b_0 … b_m, delay)`` of each, shape (K, n + m + 2).
    thetas: Array
    #: Infinite where nothing could be computed, shape (K,).
    squared_errors: Array

    def lowest(self, most: int) -> list[Minimum]:
        """The lowest local minima, lowest first."""
        return [
            Minimum(self.thetas[k], float(self.squared_errors[k])) for k in lowest_minima(self.squared_errors, most)
        ]


def quarter_periods(low: float, high: float, bandwidth: float, most: int) -> Array:
    """Delays no more than a quarter period of a bandwidth apart, unless these are too many."""
    wanted = int(np.ceil((high - low) * bandwidth / (0.5 * np.pi))) + 1
    return np.linspace(low, high, min(max(wanted, FEWEST_DELAYS), most))


def search_grid(
    levels: Sequence[tuple[FilteredCost, float]], bounds: tuple[float, float]
) -> tuple[Array, Array, list[Minimum]]:
    """Search the whole range of the delay, each level a cost with the spacing of its grid [s].

    The spacing is no more than a quarter period of the highest frequency that passes the filter. At each delay the
    coefficients start from those of both neighbours and from least squares, and the cheapest are kept. Returns the grid
    of the first level [s] with its costs, NaN where the equations were singular, and the lowest minima of the last.
    """
    low, high = bounds
    (cost, first_spacing), *finer = levels
    grid = delays = np.linspace(low, high, max(int(np.ceil((high - low) / first_spacing)) + 1, FEWEST_DELAYS))
    first = found = scan(cost, delays)
    coarser = float(delays[1] - delays[0])
    for cost, spacing in finer:
        count = int(np.ceil(REACH * coarser / spacing))
        offsets = spacing * np.arange(-count, count + 1)
        # Grids that overlap share their points.
        places = {
            round(float(minimum.delay + offset) / spacing) for minimum in _hopeful(found, KEPT) for offset in offsets
        }
        delays = np.unique(np.clip([place * spacing for place in sorted(places)], low, high))
        found = scan(cost, delays)
        coarser = spacing
    limits = Limits(low, high, DESCENT_ITERATIONS, DESCENT_TOLERANCE, SMALLEST_STEP * (high - low))
    ends = [descend(cost, least.delay, least.theta[None], limits).minimum for least in _hopeful(found, MINIMA)]
    return grid, first.squared_errors, sorted(ends, key=lambda end: end.squared_error)


def scan(cost: DelayCost, delays: Array) -> Scan:
    """Least costs at given delays."""
    found = Scan(np.zeros((delays.size, cost.size)), np.full(delays.size, np.inf))
    # Along the delays and back, so that good coefficients reach both neighbours.
    for order in (range(delays.size), range(delays.size - 1, -1, -1)):
        neighbour = np.empty((0, cost.size))
        for k in order:
            # The way back only hands good coefficients on to worse neighbours.
            trial = cost.minimise(float(delays[k]), neighbour, bool(np.isinf(found.squared_errors[k])))
            if trial.squared_error < found.squared_errors[k]:
                found.thetas[k], found.squared_errors[k] = trial.theta, trial.squared_error
            neighbour = found.thetas[k : k + 1] if np.isfinite(found.squared_errors[k]) else neighbour[:0]
    return found


def lowest_minima(costs: Array, most: int) -> IndexArray:
    """Where the lowest local minima of a profile are, lowest first."""
    padded = np.concatenate(([np.inf], costs, [np.inf]))
    lowest = (costs <= padded[:-2]) & (costs <= padded[2:]) & np.isfinite(costs)
    indices = np.flatnonzero(lowest)
    return indices[np.argsort(costs[indices], kind="stable")][:most]


def _hopeful(found: Scan, most: int) -> list[Minimum]:
    """The lowest local minima, without those that are far above the least."""
    lowest = found.lowest(most)
    return [minimum for minimum in lowest if minimum.squared_error <= HOPELESS * lowest[0].squared_error]
