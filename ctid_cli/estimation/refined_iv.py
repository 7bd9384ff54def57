r"""The one refined instrumental variable iteration: ``theta+ = theta + [sum psi phi']^-1 sum psi eps``.

``psi`` are the sensitivities of the simulated output (the optimal instruments), ``phi`` the regressors built with the
measured output, ``eps`` the output error. At a fixed point ``sum psi eps = 0``: the gradient of the output-error cost
vanishes, whatever ``phi`` was. Which signals make up psi and phi (delay or not, regular clock or not) is the business
of the *problem*; this file only iterates.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.status import Status

#: How steps are accepted where the solution is a minimum of the output-error cost, and in general.
Variant = Literal["plain", "guarded"]
StepRule = Literal["plain", "guarded", "relaxed"]

#: Halvings of a step before a direction is given up.
HALVINGS = 12
#: The guarded variant gives up after this many steps in a row that lower the cost by less than this fraction of what
#: the linearised problem promises.
SLOW_STEPS = 8
NEGLIGIBLE_FALL = 1e-2
#: The guarded variant takes a step only if the cost falls by this fraction of what its slope promises: a step that
#: overshoots and lands as high on the other side is halved instead (Armijo's rule).
SUFFICIENT_FALL = 0.1
#: The relaxed variant takes the next of these fractions of every step once steps have not become shorter for so many
#: iterations.
RELAXATIONS = (1.0, 0.7, 0.5)
PATIENCE = 10
#: A rise of the cost below this fraction is rounding, not a rise.
ROUNDING = 1e-13


@dataclass(frozen=True, eq=False)
class Equations:
    """Second moments at one parameter vector."""

    #: ``sum psi phi'``, shape (p, p).
    instrument_regressor: Array
    #: ``sum psi eps``, shape (p,).
    instrument_error: Array
    #: ``sum psi psi'``, shape (p, p).
    hessian: Array
    squared_error: float
    output_power: float


class Problem(Protocol):
    """What the iteration needs to know of an estimation problem."""

    def equations(self, theta: Array) -> Equations | None:
        """Second moments of sensitivities, regressors and output error."""

    def admissible(self, theta: Array) -> Array:
        """Bring parameters into the admissible set: unstable models are reflected."""


@dataclass(frozen=True, eq=False)
class Iterated:
    """Result of an iteration."""

    #: The last accepted parameters, shape (p,).
    theta: Array
    equations: Equations
    status: Status
    iterations: int


def scaled_solve(matrix: Array, right: Array, rows: Array, columns: Array) -> Array | None:
    """Solve ``matrix x = right`` with rows and columns brought to a common scale first."""
    if not ((rows > 0) & (rows < np.inf)).all() or not ((columns > 0) & (columns < np.inf)).all():
        return None
    left_scale = 1.0 / np.sqrt(rows)
    right_scale = left_scale if rows is columns else 1.0 / np.sqrt(columns)
    try:
        solution: Array = right_scale * np.linalg.solve(matrix * left_scale[:, None] * right_scale, right * left_scale)
    except np.linalg.LinAlgError:
        return None
    return solution if np.isfinite(solution).all() else None


def iterate(
    problem: Problem,
    theta: Array,
    *,
    max_iterations: int,
    tolerance: float,
    variant: StepRule,
    halvings: int = HALVINGS,
    on_step: Callable[[Array, Equations], None] | None = None,
) -> Iterated | None:
    """Run the refined instrumental variable iteration."""
    theta = problem.admissible(theta)
    current = problem.equations(theta)
    if current is None:
        return None
    if on_step:
        on_step(theta, current)
    slow = 0
    # Where instruments are regressors the step is Gauss-Newton's already: a second trial would repeat the first.
    instruments = variant != "guarded" or current.instrument_regressor is not current.hessian
    pace = _Pace()
    for iteration in range(max_iterations):
        step, accepted = None, None
        if instruments:
            step = scaled_solve(
                current.instrument_regressor,
                current.instrument_error,
                current.hessian.diagonal(),
                np.abs(current.instrument_regressor.diagonal()),
            )
            if step is None and variant != "guarded":
                return Iterated(theta, current, Status.SINGULAR, iteration)
            if step is not None:
                first = pace.fraction(relative_change(current, step)) if variant == "relaxed" else 1.0
                accepted = _take(problem, theta, current, step, variant, halvings, first)
        newton = accepted is None and variant == "guarded"
        if newton:
            # A direction in which the cost does not fall will not be better at the next step: it is not tried again.
            instruments = False
            step = gauss_newton_step(current)
            if step is None:
                return Iterated(theta, current, Status.SINGULAR, iteration)
            accepted = _take(problem, theta, current, step, variant, halvings)
        assert step is not None
        change = relative_change(current, step)
        if accepted is None:
            if variant != "guarded":
                return Iterated(theta, current, Status.DIVERGED, iteration)
            # At the minimum up to rounding no step can lower the cost: that is convergence, not failure.
            done = newton and change <= max(tolerance, 1e-7)
            return Iterated(theta, current, Status.CONVERGED if done else Status.STALLED, iteration)
        fall = current.squared_error - accepted[1].squared_error
        expected = change**2 * current.output_power
        theta, current, fraction = accepted
        if on_step:
            on_step(theta, current)
        if (fraction == 1.0 or variant == "relaxed") and change <= tolerance:
            return Iterated(theta, current, Status.CONVERGED, iteration + 1)
        # Steps that keep promising more than they give: along a curved valley of equal cost, or across a kink of it.
        slow = slow + 1 if fall < NEGLIGIBLE_FALL * expected else 0
        if variant == "guarded" and slow == SLOW_STEPS:
            return Iterated(theta, current, Status.STALLED, iteration + 1)
    return Iterated(theta, current, Status.MAX_ITERATIONS, max_iterations)


class _Pace:
    """Fraction of the steps that the relaxed variant takes."""

    def __init__(self) -> None:
        self.stage = 0
        self.shortest = math.inf
        self.waited = 0

    def fraction(self, change: float) -> float:
        """The fraction, from the length of the full step."""
        if change < self.shortest:
            self.shortest, self.waited = change, 0
        else:
            self.waited += 1
        if self.waited == PATIENCE and self.stage + 1 < len(RELAXATIONS):
            # What was reached before does not bind: shorter steps lead elsewhere at first.
            self.stage, self.shortest, self.waited = self.stage + 1, change, 0
        return RELAXATIONS[self.stage]


def gauss_newton_step(equations: Equations) -> Array | None:
    """Gauss-Newton step of the output-error cost."""
    diagonal = equations.hessian.diagonal()
    return scaled_solve(equations.hessian, equations.instrument_error, diagonal, diagonal)


def relative_change(equations: Equations, step: Array) -> float:
    """Change of the simulated output that a step makes, to first order and relative to its rms value."""
    power = equations.output_power
    change = max(float(step @ equations.hessian @ step), 0.0)
    return math.sqrt(change / power) if power > 0 else math.inf


def _take(
    problem: Problem,
    theta: Array,
    current: Equations,
    step: Array,
    variant: StepRule,
    halvings: int,
    fraction: float = 1.0,
) -> tuple[Array, Equations, float] | None:
    """The first acceptable fraction of a step, or None."""
    slope = max(float(step @ current.instrument_error), 0.0)
    for _ in range(1 if variant == "plain" else halvings):
        candidate = problem.admissible(theta + fraction * step)
        trial = problem.equations(candidate)
        if trial is not None and np.isfinite(trial.squared_error):
            rounding = ROUNDING * (trial.output_power + current.output_power)
            promised = 2.0 * fraction * slope
            limit = current.squared_error * (1.0 + ROUNDING) + rounding * ROUNDING - SUFFICIENT_FALL * promised
            if variant != "guarded" or trial.squared_error <= limit:
                return candidate, trial, fraction
        fraction *= 0.5
    return None
