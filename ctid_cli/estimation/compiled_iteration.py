r"""The guarded refined instrumental variable iteration at a fixed delay, compiled as a whole.

A search over the delay solves thousands of small problems, on records of some hundred samples; crossing between Python
and compiled code for every second-moment matrix would cost ten times as much as the arithmetic. The steps are those of
:func:`ctid_cli.estimation.refined_iv.iterate` with ``variant="guarded"``; tests hold the two against each other.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.estimation.delay_search import LEAST_CURVATURE
from ctid_cli.estimation.problems import is_hurwitz
from ctid_cli.estimation.refined_iv import NEGLIGIBLE_FALL, ROUNDING, SLOW_STEPS, SUFFICIENT_FALL
from ctid_cli.filtering.bank import standard_moments
from ctid_cli.filtering.filter_data import FilterData, plain_array
from ctid_cli.filtering.partial_fractions import MODAL_CONDITION_LIMIT
from ctid_cli.filtering.realisation import scaled_roots
from ctid_cli.inference.sensitivity import Structure


@njit(cache=True, nogil=True)
def solve_scaled(matrix: Array, right: Array, rows: Array, columns: Array, out: Array) -> bool:
    """Solve ``matrix x = right`` by Gaussian elimination, rows and columns brought to a common scale first."""
    p = right.size
    work = np.empty((p, p + 1))
    for i in range(p):
        if not (0.0 < rows[i] < np.inf and 0.0 < columns[i] < np.inf):
            return False
    for i in range(p):
        scale = 1.0 / np.sqrt(rows[i])
        for j in range(p):
            work[i, j] = matrix[i, j] * scale / np.sqrt(columns[j])
        work[i, p] = right[i] * scale
    for k in range(p):
        pivot = k
        for i in range(k + 1, p):
            if abs(work[i, k]) > abs(work[pivot, k]):
                pivot = i
        if not abs(work[pivot, k]) > 0.0:
            return False
        if pivot != k:
            for j in range(k, p + 1):
                swap = work[k, j]
                work[k, j] = work[pivot, j]
                work[pivot, j] = swap
        for i in range(k + 1, p):
            factor = work[i, k] / work[k, k]
            if factor != 0.0:
                for j in range(k + 1, p + 1):
                    work[i, j] -= factor * work[k, j]
    for i in range(p - 1, -1, -1):
        total = work[i, p]
        for j in range(i + 1, p):
            total -= work[i, j] * out[j]
        out[i] = total / work[i, i]
    for i in range(p):
        out[i] /= np.sqrt(columns[i])
        if not np.isfinite(out[i]):
            return False
    return True


@njit(cache=True, nogil=True)
def stabilise(theta: Array, n: int) -> None:
    """Reflect the denominator at the head of a parameter vector if it is unstable; in place."""
    a = np.ones(n + 1)
    for i in range(theta.size):
        if not np.isfinite(theta[i]):
            return
    for i in range(n):
        a[i + 1] = theta[i]
    if is_hurwitz(a):
        return
    w0, roots = scaled_roots(a)
    largest = 0.0
    for i in range(n):
        largest = max(largest, abs(roots[i]))
    # A root on the axis is moved off it by a little: filters need strict stability.
    least = 1e-6 * (largest if largest > 0.0 else 1.0)
    expanded = np.zeros(n + 1, np.complex128)
    expanded[0] = 1.0
    for i in range(n):
        root = complex(-max(abs(roots[i].real), least), roots[i].imag)
        for k in range(i + 1, 0, -1):
            expanded[k] -= root * expanded[k - 1]
    for i in range(n):
        theta[i] = expanded[i + 1].real * w0 ** (i + 1)


@njit(cache=True, nogil=True)
def _moments(
    theta: Array,
    n: int,
    delay: float,
    data: FilterData,
    limit: float,
) -> Array:
    a = np.ones(n + 1)
    b = np.empty(theta.size - n)
    for i in range(n):
        a[i + 1] = theta[i]
    for i in range(b.size):
        b[i] = theta[n + i]
    return standard_moments(a, b, delay, data, False, limit)


@njit(cache=True, nogil=True)
def _is_finite(moments: Array) -> bool:
    for i in range(moments.shape[0]):
        for j in range(moments.shape[1]):
            if not np.isfinite(moments[i, j]):
                return False
    return True


@njit(cache=True, nogil=True)
def _output_power(moments: Array, theta: Array, n: int) -> float:
    last = theta.size - 1
    power = 0.0
    for i in range(theta.size - n):
        for j in range(theta.size - n):
            power += theta[last - i] * moments[i, j] * theta[last - j]
    return power


@njit(cache=True, nogil=True)
def _take_submatrix(moments: Array, rows: IndexArray, columns: IndexArray, signs: Array, p: int, out: Array) -> None:
    for i in range(p):
        for j in range(p):
            out[i, j] = moments[rows[i], columns[j]] * signs[i] * signs[j]


@njit(cache=True, nogil=True)
def _refit_numerator(moments: Array, theta: Array, rows: IndexArray, n: int) -> None:
    """Best numerator for the denominator of theta, from moments taken with a zero numerator; in place."""
    q = theta.size - n
    gram, right, diagonal, numerator = np.empty((q, q)), np.empty(q), np.empty(q), np.empty(q)
    for i in range(q):
        right[i] = moments[rows[n + i], 3 * n + 1]
        for j in range(q):
            gram[i, j] = moments[rows[n + i], rows[n + j]]
        diagonal[i] = gram[i, i]
    if solve_scaled(gram, right, diagonal, diagonal, numerator):
        for i in range(q):
            theta[n + i] = numerator[i]


@njit(cache=True, nogil=True)
def _iterate(
    theta: Array,
    n: int,
    sensitivity_rows: IndexArray,
    regressor_rows: IndexArray,
    signs: Array,
    max_iterations: int,
    tolerance: float,
    halvings: int,
    first: int,
    delay: float,
    data: FilterData,
    limit: float,
) -> tuple[bool, Array, int]:
    """Fit the numerator, then iterate, all in place; whether theta is admissible, its moments, number of steps."""
    p = theta.size
    stabilise(theta, n)
    for i in range(n, p):
        theta[i] = 0.0
    start = _moments(theta, n, delay, data, limit)
    if not _is_finite(start):
        return False, start, 0
    _refit_numerator(start, theta, sensitivity_rows, n)
    moments = _moments(theta, n, delay, data, limit)
    if not _is_finite(moments):
        return False, moments, 0
    error_row = 3 * n + 1
    mixed, hessian = np.empty((p, p)), np.empty((p, p))
    right, rows, columns, step = np.empty(p), np.empty(p), np.empty(p), np.empty(p)
    candidate = np.empty(p)
    slow = 0
    for iteration in range(max_iterations):
        _take_submatrix(moments, sensitivity_rows, regressor_rows, signs, p, mixed)
        _take_submatrix(moments, sensitivity_rows, sensitivity_rows, signs, p, hessian)
        for i in range(p):
            right[i] = moments[sensitivity_rows[i], error_row] * signs[i]
            rows[i] = hessian[i, i]
            columns[i] = abs(mixed[i, i])
        error = moments[error_row, error_row]
        power = _output_power(moments, theta, n)
        accepted = False
        fraction, change = 1.0, 0.0
        # First the refined instrumental variable step; where that does not lower the cost, the Gauss-Newton step.
        for attempt in range(first, 2):
            # A direction in which the cost does not fall will not be better at the next step: it is not tried again.
            first = attempt
            if attempt == 0:
                solved = solve_scaled(mixed, right, rows, columns, step)
            else:
                solved = solve_scaled(hessian, right, rows, rows, step)
            if not solved:
                continue
            slope, squared = 0.0, 0.0
            for i in range(p):
                slope += step[i] * right[i]
                for j in range(p):
                    squared += step[i] * hessian[i, j] * step[j]
            slope = max(slope, 0.0)
            change = np.sqrt(max(squared, 0.0) / power) if power > 0.0 else np.inf
            fraction = 1.0
            for _ in range(halvings):
                for i in range(p):
                    candidate[i] = theta[i] + fraction * step[i]
                stabilise(candidate, n)
                trial = _moments(candidate, n, delay, data, limit)
                if _is_finite(trial):
                    rounding = ROUNDING * (_output_power(trial, candidate, n) + power)
                    promised = 2.0 * fraction * slope
                    most = error * (1.0 + ROUNDING) + rounding * ROUNDING - SUFFICIENT_FALL * promised
                    if trial[error_row, error_row] <= most:
                        accepted = True
                        break
                fraction *= 0.5
            if accepted:
                break
        if not accepted:
            return True, moments, iteration
        fall = error - trial[error_row, error_row]
        for i in range(p):
            theta[i] = candidate[i]
        moments = trial
        if fraction == 1.0 and change <= tolerance:
            return True, moments, iteration + 1
        slow = slow + 1 if fall < NEGLIGIBLE_FALL * change * change * power else 0
        if slow == SLOW_STEPS:
            return True, moments, iteration + 1
    return True, moments, max_iterations


@njit(cache=True, nogil=True)
def _delay_step(moments: Array, rows: IndexArray, signs: Array, n: int, p: int) -> float:
    """Gauss-Newton step of the delay with the coefficients projected out; NaN where it is not determined."""
    hessian, mixed, diagonal, projection = np.empty((p, p)), np.empty(p), np.empty(p), np.empty(p)
    _take_submatrix(moments, rows, rows, signs, p, hessian)
    last = 3 * n + 2
    for i in range(p):
        mixed[i] = -moments[rows[i], last] * signs[i]
        diagonal[i] = hessian[i, i]
    if not solve_scaled(hessian, mixed, diagonal, diagonal, projection):
        return np.nan
    curvature = moments[last, last]
    gradient = -moments[last, 3 * n + 1]
    for i in range(p):
        curvature -= projection[i] * mixed[i]
        gradient -= projection[i] * moments[rows[i], 3 * n + 1] * signs[i]
    if not curvature > LEAST_CURVATURE * moments[last, last]:
        return np.nan
    return float(gradient / curvature)


@njit(cache=True, nogil=True)
def _best_of(
    starts: Array,
    n: int,
    sensitivity_rows: IndexArray,
    regressor_rows: IndexArray,
    signs: Array,
    max_iterations: int,
    tolerance: float,
    halvings: int,
    first: int,
    delay: float,
    data: FilterData,
    limit: float,
) -> tuple[float, float, Array, int]:
    """Iterate from every start and keep the least cost: its sum of squares, delay step, parameters, start."""
    p = starts.shape[1]
    best, best_error, best_step = -1, np.inf, np.nan
    found = np.full(p, np.nan)
    for s in range(starts.shape[0]):
        theta = np.empty(p)
        for i in range(p):
            theta[i] = starts[s, i]
        admissible, moments, _ = _iterate(
            theta,
            n,
            sensitivity_rows,
            regressor_rows,
            signs,
            max_iterations,
            tolerance,
            halvings,
            first,
            delay,
            data,
            limit,
        )
        if admissible and moments[3 * n + 1, 3 * n + 1] < best_error:
            best, best_error = s, moments[3 * n + 1, 3 * n + 1]
            best_step = _delay_step(moments, sensitivity_rows, signs, n, p)
            found = theta
    return best_error, best_step, found, best


def best_coefficients(
    data: FilterData,
    structure: Structure,
    delay: float,
    starts: Array,
    *,
    max_iterations: int,
    tolerance: float,
    halvings: int,
    gauss_newton: bool = False,
) -> tuple[Array, float, float | None] | None:
    """Least output-error cost over the coefficients at a fixed delay, from several starts."""
    usable = np.array(starts, dtype=np.float64, order="C", ndmin=2)
    usable = plain_array(usable[np.isfinite(usable).all(axis=1)])
    error, step, theta, best = _best_of(
        usable,
        structure.poles,
        structure.sensitivity_rows,
        structure.regressor_rows,
        structure.signs,
        max_iterations,
        tolerance,
        halvings,
        1 if gauss_newton else 0,
        float(delay),
        data,
        MODAL_CONDITION_LIMIT,
    )
    if best < 0:
        return None
    return theta, error, None if np.isnan(step) else step
