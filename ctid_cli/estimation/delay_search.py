r"""Gauss-Newton on the delay, the coefficients estimated anew at every trial delay (separable least squares).

With ``eps = y - B/A u(t - tau)``, ``d eps/d tau = p B/A u(t - tau)`` and psi the sensitivities to the coefficients, the
cost minimised over the coefficients has the gradient ``g = eps_tau' eps`` and the curvature
``H = eps_tau' eps_tau - eps_tau' psi (psi' psi)^-1 psi' eps_tau``; the step is ``-g/H``. Which data the cost is made
of, filtered or not, samples or spectra, is the business of the *cost*.
"""

from collections.abc import Iterable
from typing import NamedTuple, Protocol

import numpy as np

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.estimation.iteration import Problem, Steps, iterate, solve_scaled, with_best
from ctid_cli.filtering.bank import Equations
from ctid_cli.inference.fit import Status

#: The smallest delay step, as a fraction of the range of the delay.
SMALLEST_STEP = 1e-5
#: The delay counts as undetermined where projecting the coefficients out leaves less of the curvature; more has to be
#: left before a bound counts as being in the way.
LEAST_CURVATURE = 1e-14
LEAST_AT_BOUND = 1e-8


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


def best_of(problem: Problem, starts: Iterable[Array], poles: int, steps: Steps) -> Minimum:
    """Least cost from the denominators of several starts; the delay is the last parameter and held."""
    best: Minimum | None = None
    for start in starts:
        # The numerator of a start is refitted: only the denominator matters.
        theta = with_best(problem, problem.admissible(start.copy()), poles, start.size - 1)
        end = iterate(problem, theta, steps)
        if end is not None and (best is None or end.equations.squared_error < best.squared_error):
            best = Minimum(end.theta, end.equations.squared_error, delay_step(end.equations, LEAST_CURVATURE))
    return best or Minimum(np.zeros(problem.free + 1), np.inf)


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
