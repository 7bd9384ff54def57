"""A global search over the delay: a coarse grid behind a narrow low-pass filter, finer ones behind wider filters."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.delay_search import Minimum, descend
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


class GridCost(Protocol):
    """A cost that offers starts of its own at every delay."""

    def starts(self, delay: float) -> list[Array]:
        """Parameters with the delay last from which to minimise; more may be found than one."""

    def minimise_from(self, delay: float, starts: Sequence[Array]) -> Minimum | None:
        """Least cost at a delay over several starts."""


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
    found = scan(cost, delays)
    costs = costs_of(found)
    coarser = float(delays[1] - delays[0])
    for cost, spacing in finer:
        count = int(np.ceil(REACH * coarser / spacing))
        offsets = spacing * np.arange(-count, count + 1)
        # Grids that overlap share their points.
        centres = [minimum.delay for minimum in _hopeful(found, KEPT)]
        places = {round(float(centre + offset) / spacing) for centre in centres for offset in offsets}
        delays = np.unique(np.clip([place * spacing for place in sorted(places)], low, high))
        found = scan(cost, delays)
        coarser = spacing
    minima = [_descended(cost, minimum, bounds) for minimum in _hopeful(found, MINIMA)]
    return grid, costs, sorted(minima, key=lambda minimum: minimum.squared_error)


def scan(cost: GridCost, delays: Array) -> list[Minimum | None]:
    """Least costs at given delays."""
    found: list[Minimum | None] = [None] * delays.size
    # Along the grid and back, so that good coefficients reach both neighbours.
    for order in (range(delays.size), range(delays.size - 1, -1, -1)):
        neighbour: Minimum | None = None
        for k in order:
            here = found[k]
            starts = [] if neighbour is None else [neighbour.theta]
            # The way back only hands good coefficients on to worse neighbours.
            if here is None:
                starts += cost.starts(float(delays[k]))
            trial = cost.minimise_from(float(delays[k]), starts)
            if trial is not None and (here is None or trial.squared_error < here.squared_error):
                found[k] = here = trial
            neighbour = here
    return found


def lowest_minima(found: Sequence[Minimum | None], most: int) -> list[Minimum]:
    """The lowest local minima of a profile, lowest first."""
    costs = costs_of(found)
    padded = np.concatenate(([np.inf], np.where(np.isnan(costs), np.inf, costs), [np.inf]))
    lowest = (padded[1:-1] <= padded[:-2]) & (padded[1:-1] <= padded[2:]) & np.isfinite(padded[1:-1])
    indices = np.flatnonzero(lowest)
    chosen = [found[k] for k in indices[np.argsort(costs[indices], kind="stable")][:most]]
    return [minimum for minimum in chosen if minimum is not None]


def _hopeful(found: Sequence[Minimum | None], most: int) -> list[Minimum]:
    """The lowest local minima, without those that are far above the least."""
    lowest = lowest_minima(found, most)
    return [minimum for minimum in lowest if minimum.squared_error <= HOPELESS * lowest[0].squared_error]


def costs_of(found: Sequence[Minimum | None]) -> Array:
    """Squared errors, NaN where nothing was found."""
    return np.array([np.nan if minimum is None else minimum.squared_error for minimum in found])


def _descended(cost: FilteredCost, minimum: Minimum, bounds: tuple[float, float]) -> Minimum:
    effort: Any = {"max_iterations": DESCENT_ITERATIONS, "tolerance": DESCENT_TOLERANCE}
    found = descend(cost, minimum.delay, minimum.theta, bounds, **effort)
    return minimum if found is None or found.minimum.squared_error > minimum.squared_error else found.minimum
