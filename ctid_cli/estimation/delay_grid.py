"""A global search over the delay: a coarse grid behind a narrow low-pass filter, finer ones behind wider filters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.delay_search import Minimum, descend
from ctid_cli.estimation.filtered_costs import FilteredCost

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


@dataclass(frozen=True, eq=False)
class Level:
    """One level of the search."""

    cost: FilteredCost
    #: Spacing of the grid [s]: no more than a quarter period of the highest frequency that passes the filter.
    spacing: float


@dataclass(frozen=True, eq=False)
class GridSearch:
    """What a search over a grid has found."""

    #: Grid of the first level [s] and its costs; NaN where the equations were singular, shape (K,).
    delays: Array
    costs: Array
    minima: tuple[Minimum, ...]


def search_grid(levels: Sequence[Level], bounds: tuple[float, float], fewest: int) -> GridSearch:
    """Search the whole range of the delay.

    At each delay the coefficients start from those of both neighbours and from least squares, and the cheapest are
    kept.
    """
    low, high = bounds
    wanted = max(int(np.ceil((high - low) / levels[0].spacing)) + 1, fewest)
    grid = delays = np.linspace(low, high, wanted)
    first = found = scan(levels[0].cost, delays)
    spacing = float(delays[1] - delays[0])
    for level in levels[1:]:
        centres = [delays[k] for k in _hopeful(costs_of(found), KEPT)]
        count = int(np.ceil(REACH * spacing / level.spacing))
        offsets = level.spacing * np.arange(-count, count + 1)
        # Grids that overlap share their points.
        places = {round(float(centre + offset) / level.spacing) for centre in centres for offset in offsets}
        delays = np.array([place * level.spacing for place in sorted(places)])
        delays = np.unique(np.clip(delays, low, high))
        found = scan(level.cost, delays)
        spacing = level.spacing
    minima = [_descended(levels[-1].cost, found[k], bounds) for k in _hopeful(costs_of(found), MINIMA)]
    minima.sort(key=lambda minimum: minimum.squared_error)
    return GridSearch(grid, costs_of(first), tuple(minima))


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


def local_minima(costs: Array, most: int) -> list[int]:
    """Indices of the lowest local minima of a profile, lowest first."""
    padded = np.concatenate(([np.inf], np.where(np.isnan(costs), np.inf, costs), [np.inf]))
    lowest = (padded[1:-1] <= padded[:-2]) & (padded[1:-1] <= padded[2:]) & np.isfinite(padded[1:-1])
    indices = np.flatnonzero(lowest)
    return [int(k) for k in indices[np.argsort(costs[indices], kind="stable")][:most]]


def _hopeful(costs: Array, most: int) -> list[int]:
    """The lowest local minima, without those that are far above the least."""
    lowest = local_minima(costs, most)
    return [k for k in lowest if costs[k] <= HOPELESS * costs[lowest[0]]]


def costs_of(found: list[Minimum | None]) -> Array:
    """Squared errors, NaN where nothing was found."""
    return np.array([np.nan if minimum is None else minimum.squared_error for minimum in found])


def _descended(cost: FilteredCost, minimum: Minimum | None, bounds: tuple[float, float]) -> Minimum:
    assert minimum is not None
    found = descend(
        cost,
        minimum.delay,
        minimum.theta,
        bounds,
        max_iterations=DESCENT_ITERATIONS,
        tolerance=DESCENT_TOLERANCE,
    )
    return minimum if found is None or found.minimum.squared_error > minimum.squared_error else found.minimum
