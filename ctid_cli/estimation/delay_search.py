r"""Gauss-Newton on the delay, the coefficients estimated anew at every trial delay (separable least squares).

With ``eps = y - B/A u(t - tau)``, ``d eps/d tau = p B/A u(t - tau)`` and psi the sensitivities to the coefficients, the
cost minimised over the coefficients has the gradient ``g = eps_tau' eps`` and the curvature
``H = eps_tau' eps_tau - eps_tau' psi (psi' psi)^-1 psi' eps_tau``; the step is ``-g/H``. Which data the cost is made
of, filtered or not, samples or spectra, is the business of the *cost*.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numba import njit

from ctid_cli.arrays import Array
from ctid_cli.estimation.iteration import Equations, Steps, admissible, run, solve_scaled, with_best
from ctid_cli.inference.status import Status

#: The smallest delay step, as a fraction of the range of the delay.
SMALLEST_STEP = 1e-5
#: The delay counts as undetermined where projecting the coefficients out leaves less of the curvature; more has to be
#: left before a bound counts as being in the way.
LEAST_CURVATURE = 1e-14
LEAST_AT_BOUND = 1e-8


@dataclass(frozen=True, eq=False)
class Minimum:
    """Least cost at one delay."""

    #: ``(a_1 … a_n, b_0 … b_m, delay [s])``, shape (n + m + 2,).
    theta: Array
    #: Sum of squared output errors [output unit^2].
    squared_error: float
    #: Gauss-Newton step of the delay [s]; NaN where the data do not determine it.
    step: float = float("nan")

    @property
    def delay(self) -> float:
        """The delay [s]."""
        return float(self.theta[-1])


class DelayCost(Protocol):
    """A cost as a function of the delay, minimised over the coefficients."""

    def minimise(self, delay: float, theta: Array | None) -> Minimum | None:
        """Minimise over the coefficients at one delay, from the coefficients at the head of theta."""


@dataclass(frozen=True, eq=False)
class Descent:
    """Where a descent went: its start and what it accepted, how it ended, and after how many iterations."""

    steps: Sequence[Minimum]
    status: Status
    iterations: int

    @property
    def minimum(self) -> Minimum:
        """Where it ended."""
        return self.steps[-1]


@njit(cache=True, nogil=True)
def delay_step(current: Equations, least_curvature: float, project_gradient: bool) -> float:
    """Gauss-Newton step of the delay, the last parameter, with the coefficients projected out; NaN if undetermined.

    At a minimum over the coefficients their gradient vanishes; elsewhere it has to be projected out as well.
    """
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
    slope = gradient[last]
    if project_gradient:
        slope -= projection[:last] @ gradient[:last]
    return float(slope / curvature)


@njit(cache=True, nogil=True)
def best_of(
    problem: Any, starts: Array, poles: int, steps: Steps, project_gradient: bool
) -> tuple[Array, float, float]:
    """Best coefficients from the denominators of several starts: parameters, squared error and step of the delay.

    The delay is the last parameter and held. Without any admissible start the squared error is infinite.
    """
    free = starts.shape[1] - 1
    found, least, step = starts[0], np.inf, np.nan
    for k in range(starts.shape[0]):
        # The numerator of a start is refitted: only the denominator matters.
        start = with_best(problem, admissible(problem, starts[k].copy()), poles, free)
        theta, current, _, _, _ = run(problem, start, free, steps)
        if current.squared_error < least:
            found, least = theta, current.squared_error
            step = delay_step(current, LEAST_CURVATURE, project_gradient)
    return found, least, step


def best_minimum(
    problem: Any, delay: float, starts: Sequence[Array], poles: int, steps: Steps, project_gradient: bool = True
) -> Minimum | None:
    """Least cost at a delay over the denominators of several starts, compiled as a whole."""
    if not starts:
        return None
    thetas = np.array(starts)
    thetas[:, -1] = delay
    theta, squared_error, step = best_of(problem, thetas, poles, steps, project_gradient)
    return Minimum(theta, squared_error, step) if np.isfinite(squared_error) else None


def descend(
    cost: DelayCost,
    delay: float,
    theta: Array | None,
    bounds: tuple[float, float],
    *,
    max_iterations: int,
    tolerance: float,
    smallest_step: float | None = None,
    largest_step: float = np.inf,
    reflect: bool = False,
) -> Descent | None:
    """Gauss-Newton on the delay from one start.

    A step is halved while it leaves the bounds (unless it is mirrored) or does not lower the cost, and the search ends
    where that makes it shorter than the shortest step.
    """
    smallest = SMALLEST_STEP * (bounds[1] - bounds[0]) if smallest_step is None else smallest_step
    start = cost.minimise(delay, theta)
    if start is None:
        return None
    steps = [start]
    for iteration in range(max_iterations):
        current = steps[-1]
        if not np.isfinite(current.step):
            return Descent(steps, Status.SINGULAR, iteration)
        accepted = _lower(cost, current, bounds, smallest, largest_step, reflect)
        if accepted is None:
            return Descent(steps, Status.CONVERGED, iteration)
        steps.append(accepted)
        if 1.0 - accepted.squared_error / current.squared_error < tolerance:
            return Descent(steps, Status.CONVERGED, iteration + 1)
    return Descent(steps, Status.MAX_ITERATIONS, max_iterations)


def _lower(
    cost: DelayCost, current: Minimum, bounds: tuple[float, float], smallest: float, largest: float, reflect: bool
) -> Minimum | None:
    """A lower cost in the direction of the step; None where that is too short."""
    low, high = bounds
    step = current.step if abs(current.step) <= largest else float(np.copysign(largest, current.step))
    while True:
        target = current.delay + step
        if reflect and not low <= target <= high:
            target = 2.0 * (low if target < low else high) - target
        while not low <= target <= high:
            step *= 0.5
            target = current.delay + step
        if abs(step) <= smallest:
            return None
        trial = cost.minimise(target, current.theta)
        if trial is not None and trial.squared_error < current.squared_error:
            return trial
        step *= 0.5


def bound_in_the_way(current: Equations, delay: float, bounds: tuple[float, float]) -> float | None:
    """The bound that keeps the delay, the last parameter, from a lower cost."""
    target = delay + delay_step(current, LEAST_AT_BOUND, False)
    if target < bounds[0]:
        return bounds[0]
    return bounds[1] if target > bounds[1] else None
