"""A cheap look over the whole range of delays after a local search."""

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.delay_grid import quarter_periods
from ctid_cli.estimation.delay_search import lowest_minima
from ctid_cli.estimation.iteration import GUARDED, Steps, iterate, with_best
from ctid_cli.estimation.sampled_problem import SampledProblem
from ctid_cli.inference.fit import Fit

#: Most delays that are looked at, four to a period of the bandwidth.
MOST_DELAYS = 400
#: Lowest minima of the look from which coefficients and delay are refined, and how hard.
MINIMA = 3
EFFORT = Steps(10, 1e-3, GUARDED)
#: The cost counts as lower elsewhere where it is so by this fraction.
LOWER = 1e-3


def lower_elsewhere(problem: SampledProblem, fit: Fit, bandwidth: float) -> bool:
    """Whether the cost is lower at another delay: the numerator alone is fitted there first, then all parameters."""
    n, m = problem.poles, problem.zeros
    held = problem._replace(free_delay=False)

    def looked_at(delay: float) -> Array:
        there = np.concatenate((fit.model.denominator[1:], np.zeros(m + 1), [delay]))
        return np.asarray(with_best(held, there, n, n + m + 1))

    delays = quarter_periods(problem.low, problem.high, bandwidth, MOST_DELAYS)
    thetas = [looked_at(delay) for delay in delays.tolist()]
    lowest = lowest_minima(np.array([held.equations(theta).squared_error for theta in thetas]), MINIMA)
    refined = (iterate(problem, thetas[k], EFFORT) for k in lowest)
    bound = (1.0 - LOWER) * fit.cost * fit.count
    return any(found is not None and found.equations.squared_error < bound for found in refined)
