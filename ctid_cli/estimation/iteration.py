r"""The one refined instrumental variable iteration: ``theta+ = theta + [sum psi phi']^-1 sum psi eps``.

``psi`` are the sensitivities of the simulated output (the optimal instruments), ``phi`` the regressors built with the
measured output, ``eps`` the output error. At a fixed point ``sum psi eps = 0``: the gradient of the output-error cost
vanishes, whatever ``phi`` was. Which signals make up psi and phi (delay or not, regular clock or not) is the business
of the *problem*; this file only iterates.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.filtering.bank import Equations
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.inference.fit import Status

#: How steps are accepted where the solution is a minimum of the output-error cost, and in general.
Variant = Literal["plain", "guarded"]
StepRule = Literal["plain", "relaxed", "guarded"]
GUARDED: StepRule = "guarded"

#: Halvings of a step before a direction is given up.
HALVINGS = 12
#: The guarded variant gives up after this many steps in a row that lower the cost by less than this fraction of what
#: the linearised problem promises.
SLOW_STEPS = 8
NEGLIGIBLE_FALL = 1e-2
#: The guarded variant takes a step only if the cost falls by this fraction of what its slope promises: a step that
#: overshoots and lands as high on the other side is halved instead (Armijo's rule).
SUFFICIENT_FALL = 0.1
#: The relaxed variant takes the next of these fractions of every step once steps have not become shorter for this
#: number of iterations.
RELAXATIONS = (1.0, 0.7, 0.5)
PATIENCE = 10
#: A rise of the cost below this fraction is rounding, not a rise.
ROUNDING = 1e-13
#: A change of the output below this fraction is convergence where rounding leaves no lower cost.
AT_ROUNDING = 1e-7


class Steps(NamedTuple):
    """How steps are taken and when they end."""

    max_iterations: int
    #: Stop when a step changes the simulated output by less than this fraction of its rms value [-].
    tolerance: float
    rule: StepRule
    halvings: int = HALVINGS


class Problem(Protocol):
    """What the iteration needs to know of an estimation problem."""

    @property
    def free(self) -> int:
        """Number of parameters to iterate on, from the first; the others are held."""

    @property
    def data(self) -> FilterData:
        """The record."""

    @property
    def samples(self) -> int:
        """Number of samples in the sums."""

    def split(self, theta: Array) -> tuple[Array, Array, float]:
        """Denominator, numerator and delay [s] of a parameter vector."""

    def equations(self, theta: Array) -> Equations:
        """Second moments of sensitivities, regressors and output error."""

    def rows(self, theta: Array) -> tuple[Array, Array] | None:
        """Sensitivities and output error at the used samples; None where the response is not finite."""

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
    #: The start and all accepted parameters with their squared errors in the last column, shape (K, p + 1).
    path: Array


def inadmissible(size: int) -> Equations:
    """Return equations where there are none."""
    return Equations(np.zeros((size, size)), np.zeros(size), np.zeros((size, size)), np.inf, 0.0)


def solve_scaled(matrix: Array, right: Array, rows: Array, columns: Array, count: int) -> tuple[bool, Array]:
    """Solve the leading ``count`` equations with rows and columns brought to a common scale; zeros for the rest."""
    solution = np.zeros(right.size)
    scales = np.array((rows[:count], columns[:count]))
    # Units of the parameters may differ by hundreds of decades: unscaled, elimination would pivot on units.
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
    """Return the change of the simulated output that a step makes, to first order and relative to its rms value."""
    change = max(float(step @ current.hessian @ step), 0.0)
    return float(np.sqrt(change / current.output_power)) if current.output_power > 0.0 else np.inf


def _accepted_up_to(current: Equations, trial: Equations, fraction: float, slope: float) -> float:
    """Return the squared error up to which a guarded step is accepted."""
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
    """Fraction of every step of the relaxed variant, smaller once full steps no longer become shorter."""

    def __init__(self) -> None:
        self.place, self.shortest, self.waited = 0, np.inf, 0

    def fraction(self, change: float) -> float:
        """Return the fraction for a full step of some length."""
        if change < self.shortest:
            self.shortest, self.waited = change, 0
        else:
            self.waited += 1
        if self.waited == PATIENCE and self.place + 1 < len(RELAXATIONS):
            # What was reached before does not bind: shorter steps lead elsewhere at first.
            self.place, self.shortest, self.waited = self.place + 1, change, 0
        return RELAXATIONS[self.place]


class _Move(NamedTuple):
    """An accepted step: where it led, what fraction of the full one it was, and how far the full one reaches."""

    theta: Array
    equations: Equations
    #: Whether the step ended where it aimed; not where an unstable model was reflected.
    as_aimed: bool
    fraction: float
    change: float
    gauss_newton: bool


def iterate(problem: Problem, theta: Array, steps: Steps) -> Iterated | None:
    """Run the iteration; None from an inadmissible start."""
    theta = problem.admissible(np.array(theta, dtype=np.float64))
    current = problem.equations(theta)
    if not np.isfinite(current.squared_error):
        return None
    path = [np.append(theta, current.squared_error)]
    guarded, pace = steps.rule == GUARDED, _Pace()
    # A direction in which the cost does not fall will not be better at the next step: it is not tried again.
    gauss_newton = False
    slow, converged, ending = 0, Status.CONVERGED, Status.MAX_ITERATIONS
    for _ in range(steps.max_iterations):
        move: _Move | Status = Status.SINGULAR
        for newton in (True,) if gauss_newton else (False, True) if guarded else (False,):
            move = _moved(problem, theta, current, steps, newton, pace)
            if isinstance(move, _Move):
                break
        if isinstance(move, Status):
            # At the minimum up to rounding no step can lower the cost: that is convergence, not failure.
            ending = converged if move is Status.CONVERGED else move
            break
        gauss_newton = gauss_newton or (guarded and move.gauss_newton)
        fall = current.squared_error - move.equations.squared_error
        expected = move.change**2 * current.output_power
        theta, current = move.theta, move.equations
        # Where the last step led out of the stable models, what it was moved to is no fixed point of the iteration.
        converged = Status.CONVERGED if move.as_aimed else Status.REFLECTED
        path.append(np.append(theta, current.squared_error))
        if (move.fraction == 1.0 or steps.rule == "relaxed") and move.change <= steps.tolerance:
            ending = converged
            break
        # Steps that keep promising more than they give: along a curved valley of equal cost, or across a kink of it.
        slow = slow + 1 if fall < NEGLIGIBLE_FALL * expected else 0
        if guarded and slow == SLOW_STEPS:
            ending = Status.STALLED
            break
    return Iterated(theta, current, ending, len(path) - 1, np.array(path))


def _moved(
    problem: Problem, theta: Array, current: Equations, steps: Steps, gauss_newton: bool, pace: _Pace
) -> _Move | Status:
    """Take a step of one kind; the status says how the iteration ends if none is accepted.

    The first acceptable fraction: any with a finite response, unless the cost is guarded.
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
    """Return parameters of which some, on which the output depends linearly, minimise the squared error."""
    best = theta.copy()
    best[first:last] = 0.0
    current = problem.equations(best)
    if not np.isfinite(current.squared_error):
        return theta
    # At zero the output error is what these parameters have to explain: one Gauss-Newton step is the minimum.
    gram = current.hessian[first:last, first:last]
    lengths = np.diag(gram)
    solved, solution = solve_scaled(gram, current.instrument_error[first:last], lengths, lengths, last - first)
    if not solved:
        return theta
    best[first:last] = solution
    return best
