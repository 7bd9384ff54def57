r"""Gauss-Newton on the delay, the coefficients estimated anew at every trial delay (separable least squares).

With ``eps = y - B/A u(t - tau)``, ``d eps/d tau = p B/A u(t - tau)`` and psi the sensitivities to the coefficients, the
cost minimised over the coefficients has the gradient ``g = eps_tau' eps`` and the curvature
``H = eps_tau' eps_tau - eps_tau' psi (psi' psi)^-1 psi' eps_tau``; the step is ``-g/H``. Which data the cost is made
of, filtered or not, samples or spectra, is the business of the *cost*.
"""

from typing import Any, NamedTuple, Protocol

import numpy as np
from numba import njit

from ctid_cli.arrays import Array
from ctid_cli.estimation.iteration import (
    CONVERGED,
    INADMISSIBLE,
    MAX_ITERATIONS,
    SINGULAR,
    Equations,
    Steps,
    admissible,
    run,
    solve_scaled,
    with_best,
)

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
    end: int
    iterations: int


def minimise(cost: Any, delay: float, starts: Array, own: bool) -> Minimum:
    """Least cost at a delay; compiled code is told by `calls` what to call."""
    found: Minimum = cost.minimise(delay, starts, own)
    return found


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def best_of(problem: Any, starts: Array, poles: int, steps: Steps) -> Minimum:
    """Least cost from the denominators of several starts; the delay is the last parameter and held."""
    free = starts.shape[1] - 1
    best = Minimum(np.zeros(free + 1), np.inf, np.nan)
    for k in range(starts.shape[0]):
        # The numerator of a start is refitted: only the denominator matters.
        start = with_best(problem, admissible(problem, starts[k].copy()), poles, free)
        theta, current, _, _, _ = run(problem, start, free, steps)
        if current.squared_error < best.squared_error:
            best = Minimum(theta, current.squared_error, delay_step(current, LEAST_CURVATURE))
    return best


@njit(cache=True, nogil=True)
def _descend(cost: Any, delay: float, starts: Array, limits: Limits) -> Descent:
    """Gauss-Newton on the delay, see `descend`."""
    low, high = limits.low, limits.high
    current = minimise(cost, delay, starts, starts.shape[0] == 0)
    path = np.empty((limits.max_iterations + 1, current.theta.size + 1))
    if not np.isfinite(current.squared_error):
        return Descent(current, path[:0], INADMISSIBLE, 0)
    path[0, :-1], path[0, -1] = current.theta, current.squared_error
    for iteration in range(limits.max_iterations):
        if not np.isfinite(current.step):
            return Descent(current, path[: iteration + 1], SINGULAR, iteration)
        before, step = current, min(max(current.step, -limits.largest_step), limits.largest_step)
        start = before.theta.copy().reshape(1, -1)
        while not current.squared_error < before.squared_error:
            target = before.theta[-1] + step
            if limits.reflect and not low <= target <= high:
                target = 2.0 * (low if target < low else high) - target
            while not low <= target <= high:
                step *= 0.5
                target = before.theta[-1] + step
            if abs(step) <= limits.smallest_step:
                return Descent(before, path[: iteration + 1], CONVERGED, iteration)
            current = minimise(cost, target, start, False)
            step *= 0.5
        path[iteration + 1, :-1], path[iteration + 1, -1] = current.theta, current.squared_error
        if 1.0 - current.squared_error / before.squared_error < limits.tolerance:
            return Descent(current, path[: iteration + 2], CONVERGED, iteration + 1)
    return Descent(current, path, MAX_ITERATIONS, limits.max_iterations)


def descend(cost: DelayCost, delay: float, starts: Array, limits: Limits) -> Descent:
    """Gauss-Newton on the delay from the best of several starts, or from the cost's own if there is none.

    A step is halved while it leaves the bounds (unless it is mirrored) or does not lower the cost, and the search ends
    where that makes it shorter than the shortest step.
    """
    execute = _descend if isinstance(cost, tuple) else _descend.py_func
    found: Descent = execute(cost, delay, starts, limits)
    return found


def bound_in_the_way(current: Equations, delay: float, bounds: tuple[float, float]) -> float | None:
    """The bound that keeps the delay, the last parameter, from a lower cost."""
    target = delay + delay_step(current, LEAST_AT_BOUND)
    if target < bounds[0]:
        return bounds[0]
    return bounds[1] if target > bounds[1] else None
