r"""Searches over the delay, the coefficients estimated anew at every trial delay (separable least squares).

With ``eps = y - B/A u(t - tau)``, ``d eps/d tau = p B/A u(t - tau)`` and psi the sensitivities to the coefficients, the
cost minimised over the coefficients has the gradient ``g = eps_tau' eps`` and the curvature
``H = eps_tau' eps_tau - eps_tau' psi (psi' psi)^-1 psi' eps_tau``; the Gauss-Newton step of the delay is ``-g/H``.
Which data the cost is made of, filtered or not, samples or spectra, is the business of the *cost*.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.estimation.iteration import GUARDED, Steps, iterate, solve_scaled, with_best
from ctid_cli.estimation.sampled_problem import SampledProblem, least_squares_starts
from ctid_cli.filtering.bank import Equations
from ctid_cli.inference.fit import Fit, Status

#: The smallest delay step, as a fraction of the range of the delay.
SMALLEST_STEP = 1e-5
#: The delay counts as undetermined where projecting the coefficients out leaves less of the curvature; more has to be
#: left before a bound counts as being in the way.
LEAST_CURVATURE = 1e-14
LEAST_AT_BOUND = 1e-8
#: Fewest delays of a grid over the whole range, whatever the bandwidth asks for.
FEWEST_DELAYS = 24
#: Local minima of a level around which the next level looks, and those of the last level that are returned.
KEPT = 8
MINIMA = 3
#: Spacings of a level's grid on either side of its minima that the next level covers.
REACH = 1.5
#: A minimum whose cost exceeds the least of its level by more than this factor is given up.
HOPELESS = 4.0
#: Gauss-Newton steps on the delay that end the search on levels.
DESCENT_ITERATIONS = 10
DESCENT_TOLERANCE = 1e-4
#: Most delays that are compared with an estimate, and how hard the lowest minima among them are refined.
MOST_COMPARED = 400
EFFORT = Steps(10, 1e-3, GUARDED)
#: The cost counts as lower elsewhere where it is so by this fraction.
LOWER = 1e-3


class Minimum(NamedTuple):
    """Least cost at one delay."""

    #: ``(a_1 … a_n, b_0 … b_m, delay [s])``, shape (n + m + 2,).
    theta: Array
    #: Sum of squared output errors [output unit^2]; infinite where nothing could be computed.
    squared_error: float
    #: Gauss-Newton step of the delay [s]; NaN where the data do not determine it.
    step: float = np.nan

    @property
    def delay(self) -> float:
        """The delay [s]."""
        return float(self.theta[-1])


class Minima(NamedTuple):
    """Least costs at several delays."""

    #: ``(a_1 … a_n, b_0 … b_m, delay [s])``, shape (K, n + m + 2).
    thetas: Array
    #: Infinite where nothing could be computed, shape (K,).
    squared_errors: Array

    def lowest(self, most: int) -> list[Minimum]:
        """The lowest local minima over rising delays, lowest first."""
        places = lowest_minima(self.squared_errors, most).tolist()
        return [Minimum(self.thetas[k], float(self.squared_errors[k])) for k in places]


def lowest_minima(costs: Array, most: int) -> IndexArray:
    """Where the lowest local minima of a profile are, lowest first."""
    padded = np.concatenate(([np.inf], costs, [np.inf]))
    lowest = (costs <= padded[:-2]) & (costs <= padded[2:]) & np.isfinite(costs)
    indices = np.flatnonzero(lowest)
    return indices[np.argsort(costs[indices], kind="stable")][:most]


class DelayCost(Protocol):
    """A cost as a function of the delay, minimised over the coefficients."""

    @property
    def size(self) -> int:
        """Number of parameters, the delay included."""

    def minimise(self, delay: float, starts: Array, own: bool) -> Minimum:
        """Least cost at a delay over starts of any delay, shape (K, n + m + 2), and those that the cost has itself."""


class Limits(NamedTuple):
    """Where a descent may go, how far in one step, and when it ends."""

    low: float
    high: float
    max_iterations: int
    tolerance: float
    smallest_step: float
    largest_step: float = np.inf
    #: Whether steps beyond a bound are mirrored there, not halved.
    reflect: bool = False


class Descent(NamedTuple):
    """Where a descent went: its end, the start and all it accepted, how it ended, and after how many iterations."""

    minimum: Minimum
    #: Parameters with their squared errors in the last column, shape (K, n + m + 3); none without a start.
    path: Array
    #: None where the cost could be computed nowhere.
    end: Status | None
    iterations: int


def delay_step(current: Equations, least_curvature: float) -> float:
    """Gauss-Newton step of the delay, the last parameter, with the coefficients projected out; NaN if undetermined."""
    hessian, gradient = current.hessian, current.instrument_error
    last = gradient.size - 1
    lengths, mixed = np.diag(hessian).copy(), hessian[:, last].copy()
    solved, projection = solve_scaled(hessian, mixed, lengths, lengths, last)
    if not solved:
        return np.nan
    # H = eps_tau' eps_tau - eps_tau' psi (psi' psi)^-1 psi' eps_tau; the sign of eps_tau cancels in it.
    curvature = hessian[last, last] - projection[:last] @ mixed[:last]
    if not curvature > least_curvature * hessian[last, last]:
        return np.nan
    return float(gradient[last] / curvature)


@dataclass(frozen=True, eq=False)
class SampledCost:
    """The cost of a record's samples as a function of the delay, by refined instrumental variables at each."""

    #: The coefficients, at a delay that is held.
    problem: SampledProblem
    steps: Steps
    #: Cut-offs of the state-variable filters of its own starts [rad/s].
    svf_cutoffs: Sequence[float]

    @property
    def size(self) -> int:
        """Number of parameters, the delay included."""
        return self.problem.free + 1

    def minimise(self, delay: float, starts: Array, own: bool) -> Minimum:
        """Least cost at one delay, from given coefficients and, if asked for, from the least-squares starts."""
        problem, refit, cutoffs = self.problem, self.steps.rule == GUARDED, self.svf_cutoffs if own else ()
        tried = [*least_squares_starts(problem.data, problem.structure, delay, cutoffs, refit), *starts]
        ends = (iterate(problem, np.append(start[:-1], delay), self.steps) for start in tried)
        best = min((end for end in ends if end is not None), key=lambda end: end.equations.squared_error, default=None)
        if best is None:
            return Minimum(np.zeros(self.size), np.inf)
        return Minimum(best.theta, best.equations.squared_error, delay_step(best.equations, LEAST_CURVATURE))


# --- from one delay -----------------------------------------------------------------------------------------------


def descend(cost: DelayCost, delay: float, starts: Array, limits: Limits) -> Descent:
    """Gauss-Newton on the delay from the best of several starts, or from the cost's own if there is none.

    A step is halved while it leaves the bounds (unless it is mirrored) or does not lower the cost, and the search ends
    where that makes it shorter than the shortest step.
    """
    current = cost.minimise(delay, starts, starts.shape[0] == 0)
    if not np.isfinite(current.squared_error):
        return Descent(current, np.empty((0, current.theta.size + 1)), None, 0)
    path = [current]
    end = Status.MAX_ITERATIONS
    while end is Status.MAX_ITERATIONS and len(path) <= limits.max_iterations:
        lower = _lower(cost, current, limits)
        if isinstance(lower, Status):
            end = lower
        else:
            path.append(lower)
            if 1.0 - lower.squared_error / current.squared_error < limits.tolerance:
                end = Status.CONVERGED
            current = lower
    rows = np.array([np.append(minimum.theta, minimum.squared_error) for minimum in path])
    return Descent(current, rows, end, len(path) - 1)


def _lower(cost: DelayCost, current: Minimum, limits: Limits) -> Minimum | Status:
    """The minimum after one step of the delay, or why there is none."""
    if not np.isfinite(current.step):
        return Status.SINGULAR
    step = min(max(current.step, -limits.largest_step), limits.largest_step)
    while abs(step) > limits.smallest_step:
        target = current.delay + step
        if limits.reflect and not limits.low <= target <= limits.high:
            target = 2.0 * (limits.low if target < limits.low else limits.high) - target
        if limits.low <= target <= limits.high:
            found = cost.minimise(target, current.theta[None], False)
            if found.squared_error < current.squared_error:
                return found
        step *= 0.5
    return Status.CONVERGED


def bound_in_the_way(current: Equations, delay: float, bounds: tuple[float, float]) -> float | None:
    """The bound that keeps the delay, the last parameter, from a lower cost."""
    target = delay + delay_step(current, LEAST_AT_BOUND)
    if target < bounds[0]:
        return bounds[0]
    return bounds[1] if target > bounds[1] else None


# --- over the whole range ---------------------------------------------------------------------------------------------


def quarter_periods(low: float, high: float, bandwidth: float, most: int) -> Array:
    """Delays no more than a quarter period of a bandwidth apart, unless these are too many."""
    wanted = int(np.ceil((high - low) * bandwidth / (0.5 * np.pi))) + 1
    return np.linspace(low, high, min(max(wanted, FEWEST_DELAYS), most))


def search_levels(
    costs: Sequence[DelayCost], spacings: Sequence[float], bounds: tuple[float, float]
) -> tuple[Array, Array, list[Minimum]]:
    """Search the whole range of the delay on levels, one for each cost with the spacing of its grid [s].

    The spacing is no more than a quarter period of the highest frequency that matters to the cost. At each delay the
    coefficients start from those of both neighbours and from least squares, and the cheapest are kept. Returns the grid
    of the first level [s] with its costs, NaN where the equations were singular, and the lowest minima of the last.
    """
    low, high = bounds
    grid = np.linspace(low, high, max(int(np.ceil((high - low) / spacings[0])) + 1, FEWEST_DELAYS))
    first = found = scan([costs[0]] * grid.size, grid.tolist())
    coarser = float(grid[1] - grid[0])
    for level, spacing in enumerate(spacings[1:], 1):
        count = int(np.ceil(REACH * coarser / spacing))
        offsets = spacing * np.arange(-count, count + 1)
        # Grids that overlap share their points.
        places = {
            round(float(minimum.delay + offset) / spacing) for minimum in _hopeful(found, KEPT) for offset in offsets
        }
        delays = np.unique(np.clip([place * spacing for place in sorted(places)], low, high))
        found = scan([costs[level]] * delays.size, delays.tolist())
        coarser = spacing
    limits = Limits(low, high, DESCENT_ITERATIONS, DESCENT_TOLERANCE, SMALLEST_STEP * (high - low))
    last = costs[-1]
    ends = [descend(last, least.delay, least.theta[None], limits).minimum for least in _hopeful(found, MINIMA)]
    return grid, first.squared_errors, sorted(ends, key=lambda end: end.squared_error)


def scan(costs: Sequence[DelayCost], delays: Sequence[float], own: bool = True) -> Minima:
    """Least costs at delays, of one cost each, one after the other.

    Each starts from the coefficients of both neighbours, and from its own; or, if not ``own``, from its own only where
    the neighbour has none.
    """
    found = Minima(np.zeros((len(costs), costs[0].size)), np.full(len(costs), np.inf))
    # Along the delays and back: the way back only hands good coefficients on to worse neighbours.
    for order in (range(len(costs)), range(len(costs) - 1, -1, -1)):
        neighbour = np.empty((0, costs[0].size))
        for k in order:
            alone = bool(np.isinf(found.squared_errors[k])) and (own or not neighbour.size)
            trial = costs[k].minimise(delays[k], neighbour, alone)
            if trial.squared_error < found.squared_errors[k]:
                found.thetas[k], found.squared_errors[k] = trial.theta, trial.squared_error
            neighbour = found.thetas[k : k + 1] if np.isfinite(found.squared_errors[k]) else neighbour[:0]
    return found


def _hopeful(found: Minima, most: int) -> list[Minimum]:
    """The lowest local minima, without those that are far above the least."""
    lowest = found.lowest(most)
    return [minimum for minimum in lowest if minimum.squared_error <= HOPELESS * lowest[0].squared_error]


def lower_elsewhere(problem: SampledProblem, fit: Fit, bandwidth: float) -> bool:
    """Whether the cost is lower at another delay: the numerator alone is fitted there first, then all parameters."""
    n, m = problem.poles, problem.zeros
    held = problem._replace(free_delay=False)

    def looked_at(delay: float) -> Array:
        there = np.concatenate((fit.model.denominator[1:], np.zeros(m + 1), [delay]))
        return np.asarray(with_best(held, there, n, n + m + 1))

    delays = quarter_periods(problem.low, problem.high, bandwidth, MOST_COMPARED)
    thetas = [looked_at(delay) for delay in delays.tolist()]
    lowest = lowest_minima(np.array([held.equations(theta).squared_error for theta in thetas]), MINIMA)
    refined = (iterate(problem, thetas[k], EFFORT) for k in lowest)
    bound = (1.0 - LOWER) * fit.cost * fit.count
    return any(found is not None and found.equations.squared_error < bound for found in refined)
