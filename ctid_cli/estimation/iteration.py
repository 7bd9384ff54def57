r"""Refined instrumental variable iteration: ``theta+ = theta + [sum psi phi']^-1 sum psi eps``.

``psi`` are the sensitivities of the simulated output (the optimal instruments), ``phi`` the regressors built with the
measured output, ``eps`` the output error. At a fixed point ``sum psi eps = 0``: the gradient of the output-error cost
is zero for any ``phi``. The *problem* defines the signals of psi and phi (with or without delay, regular or irregular
clock).
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.filtering.bank import Equations
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.inference.fit import Status

#: Step rules if the solution is a minimum of the output-error cost, and in general.
Variant = Literal["plain", "guarded"]
StepRule = Literal["plain", "relaxed", "guarded"]
GUARDED: StepRule = "guarded"

#: Largest number of halvings of a step.
HALVINGS = 12
#: The guarded variant ends after SLOW_STEPS consecutive steps that reduce the cost by less than the fraction
#: NEGLIGIBLE_FALL of the prediction of the linearised problem.
SLOW_STEPS = 8
NEGLIGIBLE_FALL = 1e-2
#: The guarded variant accepts a step only if the cost decreases by this fraction of the prediction of its slope; a step
#: that overshoots is halved instead (Armijo's rule).
SUFFICIENT_FALL = 0.1
#: The relaxed variant proceeds to the next of these fractions of a full step after PATIENCE iterations without shorter
#: steps.
RELAXATIONS = (1.0, 0.7, 0.5)
PATIENCE = 10
#: Relative increase of the cost that counts as rounding.
ROUNDING = 1e-13
#: Relative change of the output that counts as convergence if rounding prevents a lower cost.
AT_ROUNDING = 1e-7


class Steps(NamedTuple):
    """Step rule and end of an iteration."""

    max_iterations: int
    #: Stop when a step changes the simulated output by less than this fraction of its rms value [-].
    tolerance: float
    rule: StepRule
    halvings: int = HALVINGS


class Problem(Protocol):
    """Interface of an estimation problem for the iteration."""

    @property
    def free(self) -> int:
        """Number of leading parameters to iterate on; the others are fixed."""

    @property
    def data(self) -> FilterData:
        """Record."""

    @property
    def samples(self) -> int:
        """Number of samples in the sums."""

    def split(self, theta: Array) -> tuple[Array, Array, float]:
        """Return denominator, numerator and delay [s] of a parameter vector."""

    def equations(self, theta: Array) -> Equations:
        """Return second moments of sensitivities, regressors and output error."""

    def rows(self, theta: Array) -> tuple[Array, Array] | None:
        """Return sensitivities and output error at the used samples; None if the response is not finite."""

    def admissible(self, theta: Array) -> Array:
        """Project parameters onto the admissible set: unstable models are reflected."""


@dataclass(frozen=True, eq=False)
class Iterated:
    """Result of an iteration."""

    #: Last accepted parameters, shape (p,).
    theta: Array
    equations: Equations
    status: Status
    iterations: int
    #: Start and all accepted parameters with their squared errors in the last column, shape (K, p + 1).
    path: Array


def inadmissible(size: int) -> Equations:
    """Return the equations of an inadmissible point."""
    return Equations(np.zeros((size, size)), np.zeros(size), np.zeros((size, size)), np.inf, 0.0)


def solve_scaled(matrix: Array, right: Array, rows: Array, columns: Array, count: int) -> tuple[bool, Array]:
    """Solve the leading ``count`` equations with scaled rows and columns; return zeros for the rest."""
    solution = np.zeros(right.size)
    scales = np.array((rows[:count], columns[:count]))
    # Parameters may differ by hundreds of decades: without scaling, units would determine the pivots.
    if not ((scales > 0.0) & (scales < np.inf)).all():
        return False, solution
    row, column = 1.0 / np.sqrt(scales)
    try:
        unscaled = np.linalg.solve(matrix[:count, :count] * row[:, None] * column, right[:count] * row)
    except np.linalg.LinAlgError:
        return False, solution
    solution[:count] = column * unscaled
    return bool(np.isfinite(solution).all()), solution


def relative_change(current: Equations, step: Array) -> float:
    """Return the first-order change of the simulated output by a step, relative to its rms value."""
    change = max(float(step @ current.hessian @ step), 0.0)
    return float(np.sqrt(change / current.output_power)) if current.output_power > 0.0 else np.inf


def _accepted_up_to(current: Equations, trial: Equations, fraction: float, slope: float) -> float:
    """Return the largest squared error at which a guarded step is accepted."""
    rounding = ROUNDING * (trial.output_power + current.output_power)
    promised = 2.0 * fraction * slope
    return current.squared_error * (1.0 + ROUNDING) + rounding * ROUNDING - SUFFICIENT_FALL * promised


def _step(current: Equations, free: int, gauss_newton: bool) -> tuple[bool, Array]:
    """Return the refined instrumental variable step or the Gauss-Newton step of the output-error cost."""
    lengths = np.diag(current.hessian)
    if gauss_newton:
        return solve_scaled(current.hessian, current.instrument_error, lengths, lengths, free)
    columns = np.abs(np.diag(current.instrument_regressor))
    return solve_scaled(current.instrument_regressor, current.instrument_error, lengths, columns, free)


class _Pace:
    """Step fraction of the relaxed variant, reduced when full steps no longer become shorter."""

    def __init__(self) -> None:
        self.place, self.shortest, self.waited = 0, np.inf, 0

    def fraction(self, change: float) -> float:
        """Return the fraction for a full step of some length."""
        if change < self.shortest:
            self.shortest, self.waited = change, 0
        else:
            self.waited += 1
        if self.waited == PATIENCE and self.place + 1 < len(RELAXATIONS):
            # Earlier step lengths are discarded, since reduced steps follow another path at first.
            self.place, self.shortest, self.waited = self.place + 1, change, 0
        return RELAXATIONS[self.place]


class _Move(NamedTuple):
    """Accepted step: its end, its fraction of the full step, and the output change of the full step."""

    theta: Array
    equations: Equations
    #: False if an unstable model was reflected after the step.
    as_aimed: bool
    fraction: float
    change: float
    gauss_newton: bool


def iterate(problem: Problem, theta: Array, steps: Steps) -> Iterated | None:
    """Run the iteration; return None for an inadmissible start."""
    theta = problem.admissible(np.array(theta, dtype=np.float64))
    current = problem.equations(theta)
    if not np.isfinite(current.squared_error):
        return None
    path = [np.append(theta, current.squared_error)]
    guarded, pace = steps.rule == GUARDED, _Pace()
    # After the first failure of an instrumental variable step, only Gauss-Newton steps are tried.
    gauss_newton = False
    slow, converged, ending = 0, Status.CONVERGED, Status.MAX_ITERATIONS
    for _ in range(steps.max_iterations):
        move: _Move | Status = Status.SINGULAR
        for newton in (True,) if gauss_newton else (False, True) if guarded else (False,):
            move = _moved(problem, theta, current, steps, newton, pace)
            if isinstance(move, _Move):
                break
        if isinstance(move, Status):
            # At the minimum up to rounding no step reduces the cost: this is convergence.
            ending = converged if move is Status.CONVERGED else move
            break
        gauss_newton = gauss_newton or (guarded and move.gauss_newton)
        fall = current.squared_error - move.equations.squared_error
        expected = move.change**2 * current.output_power
        theta, current = move.theta, move.equations
        # A reflected model is not a fixed point of the iteration.
        converged = Status.CONVERGED if move.as_aimed else Status.REFLECTED
        path.append(np.append(theta, current.squared_error))
        if (move.fraction == 1.0 or steps.rule == "relaxed") and move.change <= steps.tolerance:
            ending = converged
            break
        # Decreases remain below the prediction in a curved valley of equal cost, or across a kink.
        slow = slow + 1 if fall < NEGLIGIBLE_FALL * expected else 0
        if guarded and slow == SLOW_STEPS:
            ending = Status.STALLED
            break
    return Iterated(theta, current, ending, len(path) - 1, np.array(path))


def _moved(
    problem: Problem, theta: Array, current: Equations, steps: Steps, gauss_newton: bool, pace: _Pace
) -> _Move | Status:
    """Take a step of one kind; return the final status of the iteration if none is accepted.

    The first acceptable fraction is taken: any with a finite response, unless the cost is guarded.
    """
    guarded = steps.rule == GUARDED
    solved, step = _step(current, problem.free, gauss_newton)
    if not solved:
        return Status.SINGULAR
    change, fraction = relative_change(current, step), 1.0
    if steps.rule == "relaxed":
        fraction = pace.fraction(change)
    slope = max(float(step @ current.instrument_error), 0.0)
    for _ in range(1 if steps.rule == "plain" else steps.halvings):
        target = theta + fraction * step
        candidate = problem.admissible(target)
        trial = problem.equations(candidate)
        if np.isfinite(trial.squared_error) and (
            not guarded or trial.squared_error <= _accepted_up_to(current, trial, fraction, slope)
        ):
            as_aimed = bool((candidate == target).all())
            return _Move(candidate, trial, as_aimed, fraction, change, gauss_newton)
        fraction *= 0.5
    if not guarded:
        return Status.DIVERGED
    return Status.CONVERGED if change <= max(steps.tolerance, AT_ROUNDING) else Status.STALLED


def with_best(problem: Problem, theta: Array, first: int, last: int) -> Array:
    """Return parameters with the linear ones, ``first`` to ``last``, minimising the squared error."""
    best = theta.copy()
    best[first:last] = 0.0
    current = problem.equations(best)
    if not np.isfinite(current.squared_error):
        return theta
    # From zero, one Gauss-Newton step reaches the minimum of a linear problem.
    gram = current.hessian[first:last, first:last]
    lengths = np.diag(gram)
    solved, solution = solve_scaled(gram, current.instrument_error[first:last], lengths, lengths, last - first)
    if not solved:
        return theta
    best[first:last] = solution
    return best
