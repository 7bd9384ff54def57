r"""Searches over the delay, with the coefficients estimated at every trial delay (separable least squares).

With ``eps = y - B/A u(t - tau)``, ``d eps/d tau = p B/A u(t - tau)`` and psi the sensitivities to the coefficients, the
cost minimised over the coefficients has the gradient ``g = eps_tau' eps`` and the curvature
``H = eps_tau' eps_tau - eps_tau' psi (psi' psi)^-1 psi' eps_tau``; the Gauss-Newton step of the delay is ``-g/H``.
The *cost* defines the data: filtered or not, samples or spectra.
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
#: Least share of the curvature that remains after projecting out the coefficients, below which the delay is
#: undetermined; and the larger share that is required before a bound counts as active.
LEAST_CURVATURE = 1e-14
LEAST_AT_BOUND = 1e-8
#: Fewest delays of a grid over the whole range, for any bandwidth.
FEWEST_DELAYS = 24
#: Number of local minima, of those compared with an estimate, that are refined.
MINIMA = 3
#: Largest number of delays compared with an estimate, and steps for refining the lowest minima among them.
MOST_COMPARED = 400
EFFORT = Steps(10, 1e-3, GUARDED)
#: Relative decrease by which the cost counts as lower at another delay.
LOWER = 1e-3


class Minimum(NamedTuple):
    """Least cost at one delay."""

    #: ``(a_1 … a_n, b_0 … b_m, delay [s])``, shape (n + m + 2,).
    theta: Array
    #: Sum of squared output errors [output unit^2]; infinite if it could not be computed.
    squared_error: float
    #: Gauss-Newton step of the delay [s]; NaN if the data do not determine it.
    step: float = np.nan

    @property
    def delay(self) -> float:
        """Delay [s]."""
        return float(self.theta[-1])


class Minima(NamedTuple):
    """Least costs at several delays."""

    #: ``(a_1 … a_n, b_0 … b_m, delay [s])``, shape (K, n + m + 2).
    thetas: Array
    #: Infinite if it could not be computed, shape (K,).
    squared_errors: Array


def lowest_minima(costs: Array, most: int) -> IndexArray:
    """Return the indices of the lowest local minima of a profile, lowest first; of equal neighbours only the last."""
    padded = np.concatenate(([np.inf], costs, [np.inf]))
    indices = np.flatnonzero((costs <= padded[:-2]) & (costs < padded[2:]))
    return indices[np.argsort(costs[indices], kind="stable")][:most]


class DelayCost(Protocol):
    """Cost as a function of the delay, minimised over the coefficients."""

    @property
    def size(self) -> int:
        """Number of parameters, including the delay."""

    def minimise(self, delay: float, starts: Array, own: bool) -> Minimum:
        """Return the least cost at a delay from given starts, shape (K, n + m + 2), and with ``own`` least squares."""


class Limits(NamedTuple):
    """Bounds, step lengths and end of a descent."""

    low: float
    high: float
    max_iterations: int
    tolerance: float
    smallest_step: float
    largest_step: float = np.inf
    #: Whether steps beyond a bound are reflected, not halved.
    reflect: bool = False


class Descent(NamedTuple):
    """Descent: its minimum, its start and accepted steps, its status and its number of iterations."""

    minimum: Minimum
    #: Parameters with their squared errors in the last column, shape (K, n + m + 3); empty without a start.
    path: Array
    #: None if the cost could not be computed.
    end: Status | None
    iterations: int


def delay_step(current: Equations, least_curvature: float) -> float:
    """Return the Gauss-Newton step of the delay, the last parameter, with coefficients projected out; or NaN."""
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
    """Cost of a record's samples as a function of the delay, minimised by refined instrumental variables."""

    #: Problem of the coefficients at a fixed delay.
    problem: SampledProblem
    steps: Steps
    #: Cut-offs of the state-variable filters of least-squares starts [rad/s].
    svf_cutoffs: Sequence[float]

    @property
    def size(self) -> int:
        """Number of parameters, including the delay."""
        return self.problem.free + 1

    def minimise(self, delay: float, starts: Array, own: bool) -> Minimum:
        """Return the least cost at one delay, from given coefficients and with ``own`` from least squares."""
        problem, refit, cutoffs = self.problem, self.steps.rule == GUARDED, self.svf_cutoffs if own else ()
        tried = [*least_squares_starts(problem.data, problem.structure, delay, cutoffs, refit), *starts]
        ends = (iterate(problem, np.append(start[:-1], delay), self.steps) for start in tried)
        best = min((end for end in ends if end is not None), key=lambda end: end.equations.squared_error, default=None)
        if best is None:
            return Minimum(np.zeros(self.size), np.inf)
        return Minimum(best.theta, best.equations.squared_error, delay_step(best.equations, LEAST_CURVATURE))


# --- from one delay -----------------------------------------------------------------------------------------------


def descend(cost: DelayCost, delay: float, starts: Array, limits: Limits) -> Descent:
    """Run Gauss-Newton on the delay from the best of several starts, or without any from least squares.

    A step is halved while it leaves the bounds (unless it is reflected) or does not reduce the cost; the search ends
    when the step is shorter than the shortest one.
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
    """Return the minimum after one step of the delay, or the status that ends the search."""
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
    """Return the bound that prevents a lower cost by the delay, the last parameter; else None."""
    target = delay + delay_step(current, LEAST_AT_BOUND)
    if target < bounds[0]:
        return bounds[0]
    return bounds[1] if target > bounds[1] else None


# --- over the whole range ---------------------------------------------------------------------------------------------


def quarter_periods(low: float, high: float, bandwidth: float, most: int) -> Array:
    """Return delays with a spacing of at most a quarter period of a bandwidth, unless these are too many."""
    wanted = int(np.ceil((high - low) * bandwidth / (0.5 * np.pi))) + 1
    return np.linspace(low, high, min(max(wanted, FEWEST_DELAYS), most))


def scan(costs: Sequence[DelayCost], delays: Sequence[float], own: bool = True) -> Minima:
    """Return the least of each cost at its delay.

    Each starts from the coefficients of both neighbours, and from least squares; if not ``own``, from least squares
    only if the neighbour has none.
    """
    found = Minima(np.zeros((len(costs), costs[0].size)), np.full(len(costs), np.inf))
    # Forward and backward pass: the backward pass only transfers good coefficients to worse neighbours.
    for order in (range(len(costs)), range(len(costs) - 1, -1, -1)):
        neighbour = np.empty((0, costs[0].size))
        for k in order:
            alone = bool(np.isinf(found.squared_errors[k])) and (own or not neighbour.size)
            trial = costs[k].minimise(delays[k], neighbour, alone)
            if trial.squared_error < found.squared_errors[k]:
                found.thetas[k], found.squared_errors[k] = trial.theta, trial.squared_error
            neighbour = found.thetas[k : k + 1] if np.isfinite(found.squared_errors[k]) else neighbour[:0]
    return found


def lower_elsewhere(problem: SampledProblem, fit: Fit, bandwidth: float) -> bool:
    """Return whether the cost is lower at another delay: first only the numerator is fitted, then all parameters."""
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
