"""A global search over the delay: a coarse grid behind a narrow low-pass filter, finer ones behind wider filters."""

from collections.abc import Sequence

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.delay_search import SMALLEST_STEP, DelayCost, Limits, Minima, Minimum, descend
from ctid_cli.estimation.filtered_costs import FilteredCosts

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


def quarter_periods(low: float, high: float, bandwidth: float, most: int) -> Array:
    """Delays no more than a quarter period of a bandwidth apart, unless these are too many."""
    wanted = int(np.ceil((high - low) * bandwidth / (0.5 * np.pi))) + 1
    return np.linspace(low, high, min(max(wanted, FEWEST_DELAYS), most))


def search_grid(
    costs: FilteredCosts, spacings: Sequence[float], bounds: tuple[float, float]
) -> tuple[Array, Array, list[Minimum]]:
    """Search the whole range of the delay on levels, one for each filter with the spacing of its grid [s].

    The spacing is no more than a quarter period of the highest frequency that passes the filter. At each delay the
    coefficients start from those of both neighbours and from least squares, and the cheapest are kept. Returns the grid
    of the first level [s] with its costs, NaN where the equations were singular, and the lowest minima of the last.
    """
    low, high = bounds
    grid = np.linspace(low, high, max(int(np.ceil((high - low) / spacings[0])) + 1, FEWEST_DELAYS))
    first = found = scan(costs.behind(0), grid)
    coarser = float(grid[1] - grid[0])
    for level, spacing in enumerate(spacings[1:], 1):
        count = int(np.ceil(REACH * coarser / spacing))
        offsets = spacing * np.arange(-count, count + 1)
        # Grids that overlap share their points.
        places = {
            round(float(minimum.delay + offset) / spacing) for minimum in _hopeful(found, KEPT) for offset in offsets
        }
        delays = np.unique(np.clip([place * spacing for place in sorted(places)], low, high))
        found = scan(costs.behind(level), delays)
        coarser = spacing
    limits = Limits(low, high, DESCENT_ITERATIONS, DESCENT_TOLERANCE, SMALLEST_STEP * (high - low))
    last = costs.behind(len(spacings) - 1)
    ends = [descend(last, least.delay, least.theta[None], limits).minimum for least in _hopeful(found, MINIMA)]
    return grid, first.squared_errors, sorted(ends, key=lambda end: end.squared_error)


def scan(cost: DelayCost, delays: Array) -> Minima:
    """Least costs of all samples at given delays, one after the other."""
    found = Minima(np.zeros((delays.size, cost.size)), np.full(delays.size, np.inf))
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


def _hopeful(found: Minima, most: int) -> list[Minimum]:
    """The lowest local minima, without those that are far above the least."""
    lowest = found.lowest(most)
    return [minimum for minimum in lowest if minimum.squared_error <= HOPELESS * lowest[0].squared_error]
