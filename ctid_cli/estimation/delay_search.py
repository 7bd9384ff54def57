r"""Gauss-Newton on the delay, the coefficients estimated anew at every trial delay (separable least squares).

With ``eps = y - B/A u(t - tau)``, ``d eps/d tau = p B/A u(t - tau)`` and psi the sensitivities to the coefficients, the
cost minimised over the coefficients has the gradient ``g = eps_tau' eps`` and the curvature
``H = eps_tau' eps_tau - eps_tau' psi (psi' psi)^-1 psi' eps_tau``; the step is ``-g/H``. Which data the cost is made
of, filtered or not, samples or spectra, is the business of the *cost*.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.refined_iv import Equations, scaled_solve
from ctid_cli.inference.status import Status

#: The smallest delay step, as a fraction of the range of the delay.
SMALLEST_STEP = 1e-5
#: The delay counts as undetermined where projecting the coefficients out leaves less of the curvature.
LEAST_CURVATURE = 1e-14


@dataclass(frozen=True, eq=False)
class Minimum:
    """Least cost at one delay."""

    #: Delay [s].
    delay: float
    #: Coefficients there, ``(a_1 … a_n, b_0 … b_m)``, shape (n + m + 1,).
    theta: Array
    #: Sum of squared output errors [output unit^2].
    squared_error: float
    #: Gauss-Newton step of the delay [s]; None where it is not known yet or the data do not determine it.
    step: float | None = None


class DelayCost(Protocol):
    """A cost as a function of the delay, minimised over the coefficients."""

    def minimise(self, delay: float, theta: Array | None) -> Minimum | None:
        """Minimise over the coefficients at one delay."""

    def step(self, minimum: Minimum) -> float | None:
        """Gauss-Newton step of the delay from a minimum of this cost."""


@dataclass(frozen=True, eq=False)
class Descent:
    """Where a descent ended."""

    minimum: Minimum
    status: Status
    iterations: int


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
    on_step: Callable[[Minimum], None] | None = None,
) -> Descent | None:
    """Gauss-Newton on the delay from one start.

    A step is halved while it leaves the bounds (unless it is mirrored) or does not lower the cost, and the search ends
    where that makes it shorter than the shortest step.
    """
    low, high = bounds
    smallest = SMALLEST_STEP * (high - low) if smallest_step is None else smallest_step
    current = cost.minimise(delay, theta)
    if current is None:
        return None
    if on_step:
        on_step(current)
    for iteration in range(max_iterations):
        step = cost.step(current)
        if step is None or not np.isfinite(step):
            return Descent(current, Status.SINGULAR, iteration)
        if abs(step) > largest_step:
            step = largest_step if step > 0 else -largest_step
        accepted = None
        while accepted is None:
            target = current.delay + step
            if reflect and not low <= target <= high:
                target = 2.0 * (low if target < low else high) - target
            while not low <= target <= high:
                step *= 0.5
                target = current.delay + step
            if abs(step) <= smallest:
                return Descent(current, Status.CONVERGED, iteration)
            trial = cost.minimise(target, current.theta)
            if trial is not None and trial.squared_error < current.squared_error:
                accepted = trial
            else:
                step *= 0.5
        fall = 1.0 - accepted.squared_error / current.squared_error
        current = accepted
        if on_step:
            on_step(current)
        if fall < tolerance:
            return Descent(current, Status.CONVERGED, iteration + 1)
    return Descent(current, Status.MAX_ITERATIONS, max_iterations)


def delay_step(equations: Equations, least_curvature: float = LEAST_CURVATURE) -> float | None:
    """Gauss-Newton step of the delay with the coefficients projected out."""
    hessian, gradient = equations.hessian, equations.instrument_error
    diagonal = np.diag(hessian)[:-1]
    projection = scaled_solve(hessian[:-1, :-1], hessian[:-1, -1], diagonal, diagonal)
    if projection is None:
        return None
    curvature = hessian[-1, -1] - projection @ hessian[:-1, -1]
    if not curvature > least_curvature * hessian[-1, -1]:
        return None
    return float(gradient[-1] / curvature)


def bound_in_the_way(equations: Equations, delay: float, bounds: tuple[float, float]) -> float | None:
    """The bound that keeps the delay from a lower cost."""
    step = delay_step(equations, least_curvature=1e-8)
    if step is None:
        return None
    if delay + step < bounds[0]:
        return bounds[0]
    return bounds[1] if delay + step > bounds[1] else None
