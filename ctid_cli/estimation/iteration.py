r"""The one refined instrumental variable iteration: ``theta+ = theta + [sum psi phi']^-1 sum psi eps``.

``psi`` are the sensitivities of the simulated output (the optimal instruments), ``phi`` the regressors built with the
measured output, ``eps`` the output error. At a fixed point ``sum psi eps = 0``: the gradient of the output-error cost
vanishes, whatever ``phi`` was. Which signals make up psi and phi (delay or not, regular clock or not) is the business
of the *problem*; this file only iterates.

A search over the delay solves thousands of small problems on records of some hundred samples, where crossing between
Python and compiled code for every matrix of second moments would cost ten times as much as the arithmetic. A problem
that is a NamedTuple of arrays and numbers therefore runs compiled as a whole: numba dispatches `equations` and
`admissible` on its type (`compiled_as`) and caches the result. Other problems, which simulate a loop or several
experiments, run the same text interpreted.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numba import njit
from numba.core.typing.templates import AbstractTemplate, infer_global

from ctid_cli.arrays import Array
from ctid_cli.estimation.stability import with_stable_denominator
from ctid_cli.inference.status import Status

#: How steps are accepted where the solution is a minimum of the output-error cost, and in general.
Variant = Literal["plain", "guarded"]
StepRule = Literal["plain", "relaxed", "guarded"]
#: The same by number for the compiled iteration, and guarded Gauss-Newton steps alone.
PLAIN, RELAXED, GUARDED, GAUSS_NEWTON = range(4)
RULES: Mapping[StepRule, int] = {"plain": PLAIN, "relaxed": RELAXED, "guarded": GUARDED}

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
#: Rows of the path for which room is made at first.
FIRST_ROWS = 64

#: How an iteration ends, by number for the compiled iteration; a start may also be inadmissible.
ENDS = (
    Status.CONVERGED,
    Status.MAX_ITERATIONS,
    Status.STALLED,
    Status.SINGULAR,
    Status.DIVERGED,
    Status.REFLECTED,
)
CONVERGED, MAX_ITERATIONS, STALLED, SINGULAR, DIVERGED, REFLECTED, INADMISSIBLE = range(7)


class Equations(NamedTuple):
    """Second moments at one parameter vector."""

    #: ``sum psi phi'``, shape (p, p).
    instrument_regressor: Array
    #: ``sum psi eps``, shape (p,).
    instrument_error: Array
    #: ``sum psi psi'``, shape (p, p).
    hessian: Array
    #: Infinite where the parameters are inadmissible or the response is not finite.
    squared_error: float
    output_power: float


class Steps(NamedTuple):
    """How steps are taken and when they end."""

    max_iterations: int
    #: Stop when a step changes the simulated output by less than this fraction of its rms value [-].
    tolerance: float
    rule: int
    halvings: int = HALVINGS


class Problem(Protocol):
    """What the iteration needs to know of an estimation problem."""

    @property
    def free(self) -> int:
        """Number of parameters to iterate on, from the first; the others are held."""

    @property
    def samples(self) -> int:
        """Number of samples in the sums."""

    def split(self, theta: Array) -> tuple[Array, Array, float]:
        """Denominator, numerator and delay [s] of a parameter vector."""

    def equations(self, theta: Array) -> Equations:
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
    #: The start and all accepted parameters with their squared errors in the last column, shape (K, p + 1).
    path: Array


def equations(problem: Any, theta: Array) -> Equations:
    """Second moments of a problem; compiled code is told by `compiled_as` what to call."""
    moments: Equations = problem.equations(theta)
    return moments


def admissible(problem: Any, theta: Array) -> Array:
    """Admissible parameters of a problem."""
    inside: Array = problem.admissible(theta)
    return inside


def calls(function: Callable[..., Any], problem_type: type, kernel: Any) -> None:
    """Let compiled code that calls a function with one type of problem first call a kernel.

    An overload would be a function around the kernel, and everything below the kernel would be optimised once more for
    it; a kernel passed as an argument would not be cached.
    """

    @infer_global(function)  # type: ignore[no-untyped-call]
    class _Call(AbstractTemplate):
        key = function

        def generic(self, args: Any, kws: Any) -> Any:
            if getattr(args[0], "instance_class", None) is not problem_type:
                return None
            template, _, args, kws = kernel.get_call_template(args, kws)
            return template(self.context).apply(args, kws)

        def get_impl_key(self, sig: Any) -> Any:
            return kernel.get_overload(sig.args)


@njit(cache=True, nogil=True)
def _stable(problem: Any, theta: Array) -> Array:
    return with_stable_denominator(theta, problem.poles)


def compiled_as(problem_type: type, kernel: Any) -> None:
    """Let compiled code iterate on one type of problem, whose denominator stands at the head of theta."""
    calls(equations, problem_type, kernel)
    calls(admissible, problem_type, _stable)


@njit(cache=True, nogil=True)
def inadmissible(size: int) -> Equations:
    """Equations where there are none."""
    return Equations(np.zeros((size, size)), np.zeros(size), np.zeros((size, size)), np.inf, 0.0)


@njit(cache=True, nogil=True)
def solve_scaled(matrix: Array, right: Array, rows: Array, columns: Array, count: int) -> tuple[bool, Array]:
    """Solve the leading ``count`` equations with rows and columns brought to a common scale; zeros for the rest."""
    solution = np.zeros(right.size)
    scaled, target = np.empty((count, count)), np.empty(count)
    for i in range(count):
        if not (0.0 < rows[i] < np.inf and 0.0 < columns[i] < np.inf):
            return False, solution
    # Units of the parameters may differ by hundreds of decades: unscaled, elimination would pivot on units.
    for i in range(count):
        row_scale = 1.0 / np.sqrt(rows[i])
        target[i] = right[i] * row_scale
        for j in range(count):
            scaled[i, j] = matrix[i, j] * row_scale * (1.0 / np.sqrt(columns[j]))
    try:
        unscaled = np.linalg.solve(scaled, target)
    except Exception:
        # An exactly singular matrix, or one that is not finite.
        return False, solution
    for i in range(count):
        solution[i] = (1.0 / np.sqrt(columns[i])) * unscaled[i]
    return bool(np.isfinite(solution).all()), solution


@njit(cache=True, nogil=True)
def relative_change(current: Equations, step: Array) -> float:
    """Change of the simulated output that a step makes, to first order and relative to its rms value."""
    change = max(float(step @ current.hessian @ step), 0.0)
    return float(np.sqrt(change / current.output_power)) if current.output_power > 0.0 else np.inf


@njit(cache=True, nogil=True)
def _most(current: Equations, trial: Equations, fraction: float, slope: float) -> float:
    """The squared error up to which a guarded step is accepted."""
    rounding = ROUNDING * (trial.output_power + current.output_power)
    promised = 2.0 * fraction * slope
    return current.squared_error * (1.0 + ROUNDING) + rounding * ROUNDING - SUFFICIENT_FALL * promised


@njit(cache=True, nogil=True)
def _step(current: Equations, free: int, newton: bool) -> tuple[bool, Array]:
    """The refined instrumental variable step or the Gauss-Newton step of the output-error cost."""
    lengths = np.diag(current.hessian).copy()
    if newton:
        return solve_scaled(current.hessian, current.instrument_error, lengths, lengths, free)
    columns = np.abs(np.diag(current.instrument_regressor))
    return solve_scaled(current.instrument_regressor, current.instrument_error, lengths, columns, free)


@njit(cache=True, nogil=True)
def _logged(path: Array, row: int, theta: Array, squared_error: float) -> Array:
    """The path with one more row, in a longer array where it is full."""
    if row == path.shape[0]:
        longer = np.empty((2 * row, path.shape[1]))
        longer[:row] = path
        path = longer
    path[row, :-1] = theta
    path[row, -1] = squared_error
    return path


@njit(cache=True, nogil=True)
def run(problem: Any, theta: Array, free: int, steps: Steps) -> tuple[Array, Equations, int, int, Array]:
    """Iterate: the last parameters, their equations, how it ended, the number of steps, and the path."""
    theta = admissible(problem, theta)
    current = equations(problem, theta)
    path = np.empty((FIRST_ROWS, theta.size + 1))
    if not np.isfinite(current.squared_error):
        return theta, current, INADMISSIBLE, 0, path[:0]
    path = _logged(path, 0, theta, current.squared_error)
    guarded, relaxed = steps.rule >= GUARDED, steps.rule == RELAXED
    # Where instruments are regressors the step is Gauss-Newton's already: a second trial would repeat the first.
    instruments = steps.rule != GAUSS_NEWTON
    trials = steps.halvings if steps.rule != PLAIN else 1
    slow = 0
    # Pace of the relaxed variant: which fraction, the shortest full step with it, and how long ago that was.
    pace, shortest, waited = 0, np.inf, 0
    # Where the last step led out of the stable models, what it was moved to is no fixed point of the iteration.
    converged = CONVERGED
    for iteration in range(steps.max_iterations):
        accepted = newton = False
        change, fraction = 0.0, 1.0
        target = candidate = theta
        trial = current
        # First the refined instrumental variable step; where that does not lower a guarded cost, the Gauss-Newton step.
        for attempt in range(0 if instruments else 1, 2 if guarded else 1):
            # A direction in which the cost does not fall will not be better at the next step: it is not tried again.
            newton = attempt == 1
            instruments = not newton
            solved, step = _step(current, free, newton)
            if not solved:
                if newton or not guarded:
                    return theta, current, SINGULAR, iteration, path[: iteration + 1]
                continue
            change, fraction = relative_change(current, step), 1.0
            if relaxed:
                if change < shortest:
                    shortest, waited = change, 0
                else:
                    waited += 1
                if waited == PATIENCE and pace + 1 < len(RELAXATIONS):
                    # What was reached before does not bind: shorter steps lead elsewhere at first.
                    pace, shortest, waited = pace + 1, change, 0
                fraction = RELAXATIONS[pace]
            slope = max(float(step @ current.instrument_error), 0.0)
            # The first acceptable fraction: any with a finite response, unless the cost is guarded.
            for _ in range(trials):
                target = theta + fraction * step
                candidate = admissible(problem, target)
                trial = equations(problem, candidate)
                if np.isfinite(trial.squared_error) and (
                    not guarded or trial.squared_error <= _most(current, trial, fraction, slope)
                ):
                    accepted = True
                    break
                fraction *= 0.5
            if accepted:
                break
        if not accepted:
            if not guarded:
                return theta, current, DIVERGED, iteration, path[: iteration + 1]
            # At the minimum up to rounding no step can lower the cost: that is convergence, not failure.
            done = change <= max(steps.tolerance, 1e-7)
            return theta, current, converged if done else STALLED, iteration, path[: iteration + 1]
        fall = current.squared_error - trial.squared_error
        expected = change**2 * current.output_power
        theta, current = candidate, trial
        converged = CONVERGED if (candidate == target).all() else REFLECTED
        path = _logged(path, iteration + 1, theta, current.squared_error)
        if (fraction == 1.0 or relaxed) and change <= steps.tolerance:
            return theta, current, converged, iteration + 1, path[: iteration + 2]
        # Steps that keep promising more than they give: along a curved valley of equal cost, or across a kink of it.
        slow = slow + 1 if fall < NEGLIGIBLE_FALL * expected else 0
        if guarded and slow == SLOW_STEPS:
            return theta, current, STALLED, iteration + 1, path[: iteration + 2]
    return theta, current, MAX_ITERATIONS, steps.max_iterations, path[: steps.max_iterations + 1]


def iterate(problem: Problem, theta: Array, steps: Steps) -> Iterated | None:
    """Run the iteration; None from an inadmissible start."""
    execute = run if isinstance(problem, tuple) else run.py_func
    theta, found, end, iterations, path = execute(problem, np.array(theta, dtype=np.float64), problem.free, steps)
    return None if end == INADMISSIBLE else Iterated(theta, found, ENDS[end], iterations, path)


@njit(cache=True, nogil=True)
def with_best(problem: Any, theta: Array, first: int, last: int) -> Array:
    """Parameters of which some, on which the output depends linearly, minimise the squared error."""
    best = theta.copy()
    best[first:last] = 0.0
    current = equations(problem, best)
    if not np.isfinite(current.squared_error):
        return theta
    # At zero the output error is what these parameters have to explain: one Gauss-Newton step is the minimum.
    gram = current.hessian[first:last, first:last].copy()
    lengths = np.diag(gram).copy()
    solved, solution = solve_scaled(gram, current.instrument_error[first:last], lengths, lengths, last - first)
    if not solved:
        return theta
    best[first:last] = solution
    return best
