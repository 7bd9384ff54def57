"""The refined instrumental variable iteration once more, in numpy: the compiled one is held against it."""

from dataclasses import dataclass

import numpy as np

from ctid_cli.estimation.iteration import HALVINGS, NEGLIGIBLE_FALL, ROUNDING, SLOW_STEPS, SUFFICIENT_FALL
from ctid_cli.estimation.stability import is_hurwitz
from ctid_cli.inference.fit import Status


@dataclass
class Reference:
    theta: np.ndarray
    equations: object
    status: Status
    iterations: int


def reflected(a):
    """A monic polynomial with its right-half-plane roots mirrored, by numpy's roots."""
    if is_hurwitz(a):
        return a
    roots = np.roots(a)
    damping = np.maximum(np.abs(roots.real), 1e-6 * (np.abs(roots).max() or 1.0))
    return np.real(np.poly(-damping + 1j * roots.imag))


def stable(theta, poles):
    """Parameters with the denominator at their head reflected."""
    if not np.isfinite(theta).all():
        return theta
    return np.concatenate((reflected(np.append(1.0, theta[:poles]))[1:], theta[poles:]))


def solved(matrix, right, rows, columns):
    """Solution of scaled equations, None where they are singular."""
    if not (np.all((rows > 0) & (rows < np.inf)) and np.all((columns > 0) & (columns < np.inf))):
        return None
    left, back = 1 / np.sqrt(rows), 1 / np.sqrt(columns)
    try:
        solution = back * np.linalg.solve(matrix * np.outer(left, back), right * left)
    except np.linalg.LinAlgError:
        return None
    return solution if np.isfinite(solution).all() else None


def guarded(problem, theta, *, max_iterations, tolerance, halvings=HALVINGS, gauss_newton=False, slow_steps=SLOW_STEPS):
    """The guarded variant; ``problem`` gives equations, or None where there are none."""
    current = problem.equations(theta)
    if current is None:
        return None
    directions, slow = ["gauss_newton"] if gauss_newton else ["instruments", "gauss_newton"], 0
    for iteration in range(max_iterations):
        accepted = None
        for direction in list(directions):
            # Once the first direction has failed it is not tried again.
            directions = directions[directions.index(direction) :]
            matrix = current.hessian if direction == "gauss_newton" else current.instrument_regressor
            step = solved(matrix, current.instrument_error, np.diag(current.hessian), np.abs(np.diag(matrix)))
            if step is None:
                if direction == "gauss_newton":
                    return Reference(theta, current, Status.SINGULAR, iteration)
                continue
            power = current.output_power
            change = np.sqrt(max(step @ current.hessian @ step, 0.0) / power) if power > 0 else np.inf
            for fraction in 0.5 ** np.arange(halvings):
                candidate = problem.admissible(theta + fraction * step)
                trial = problem.equations(candidate)
                if trial is None:
                    continue
                promised = 2.0 * fraction * max(step @ current.instrument_error, 0.0)
                rounding = ROUNDING**2 * (trial.output_power + power)
                most = current.squared_error * (1.0 + ROUNDING) + rounding - SUFFICIENT_FALL * promised
                if trial.squared_error <= most:
                    accepted = candidate, trial, fraction
                    break
            if accepted:
                break
        if accepted is None:
            done = change <= max(tolerance, 1e-7)
            return Reference(theta, current, Status.CONVERGED if done else Status.STALLED, iteration)
        fall = current.squared_error - accepted[1].squared_error
        slow = slow + 1 if fall < NEGLIGIBLE_FALL * change**2 * current.output_power else 0
        theta, current, fraction = accepted
        if fraction == 1.0 and change <= tolerance:
            return Reference(theta, current, Status.CONVERGED, iteration + 1)
        if slow == slow_steps:
            return Reference(theta, current, Status.STALLED, iteration + 1)
    return Reference(theta, current, Status.MAX_ITERATIONS, max_iterations)
