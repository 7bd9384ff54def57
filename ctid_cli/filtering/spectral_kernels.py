r"""Compiled loops over the frequencies of finite-record spectra: the input at a delay, and fits at fixed delays.

Kernels use only functions, constants and types of this file: Numba's disk cache checks only the file of a function, so
that it is never stale. Arguments are prepared in NumPy, in :mod:`~ctid_cli.filtering.spectra` and
:mod:`~ctid_cli.estimation.filtered_costs`.

A search over the delay consists of thousands of small successive fits, each started from the result of the previous
one. The whole fit is therefore compiled: vectorised over all filters in NumPy, a search took ten times as long.

At a fixed delay the model ``x = B/A u(t - tau)`` satisfies

.. math:: X = \frac{B(jw)\,U_\tau + T(jw)}{A(jw)}, \qquad \varepsilon = Y - X,

exactly, with one real polynomial T of degree n - 1 for the states at both ends of the window. Its coefficients are
estimated with those of A and B, so that a record need not start or end at rest. The cost ``sum_k g_k |eps_k|^2`` is
over positive and negative frequencies; with the weight ``g = |L(jw)|^2`` it is, by Parseval, the mean square over the
window of the output error after the filter L.
"""

import math

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray, IntArray

#: Added to normal equations of unit diagonal, so that those of linearly dependent columns have a solution.
RIDGE = 1e-14
#: The delay counts as undetermined if projecting out the coefficients leaves less than this share of the curvature.
LEAST_CURVATURE = 1e-12
#: A step is accepted only if the cost decreases by this fraction of the linear prediction (Armijo's rule), up to
#: rounding.
SUFFICIENT_FALL = 0.1
ROUNDING = 1e-13


# --- the input at a delay -----------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _phases(angle: float, count: int) -> ComplexArray:
    """Return ``exp(-j k angle)``, k = 1 … count, by doubling."""
    found = np.empty(count, np.complex128)
    found[0] = complex(math.cos(angle), -math.sin(angle))
    done = 1
    while done < count:
        # Element by element: array assignment would add seconds of compilation, for an error message of Numba.
        for i in range(min(done, count - done)):
            found[done + i] = found[done - 1] * found[i]
        done *= 2
    return found


@njit(cache=True, nogil=True)
def _add_jumps(times: Array, jumps: Array, first: int, last: int, base: float, total: ComplexArray) -> None:
    """Add ``sum jump_i exp(-j k base t_i)`` over the breaks ``first … last - 1`` to ``total``."""
    for i in range(first, last):
        phases = _phases(base * times[i], total.size)
        for k in range(total.size):
            total[k] += jumps[i] * phases[k]


@njit(cache=True, nogil=True)
def partial_sums(times: Array, jumps: Array, marks: IntArray, base: float, count: int) -> ComplexArray:
    """Return the sums over the first ``marks[r]`` breaks, shape (marks, count)."""
    sums = np.zeros((marks.size, count), np.complex128)
    for r in range(1, marks.size):
        for k in range(count):
            sums[r, k] = sums[r - 1, k]
        _add_jumps(times, jumps, marks[r - 1], marks[r], base, sums[r])
    return sums


@njit(cache=True, nogil=True)
def window_spectrum(
    times: Array,
    values: Array,
    slopes: Array,
    jumps: Array,
    integral: Array,
    foh: bool,
    marks: IntArray,
    sums: ComplexArray,
    duration: float,
    delay: float,
    gain: Array,
) -> ComplexArray:
    """Return the spectrum of the signal delayed by ``delay`` at zero and the next ``gain.size`` frequencies.

    The gain multiplies the contribution of the breaks inside the window, not that of its ends.

    With a and b the ends of the window on the undelayed signal's clock, value v and slope r there, and D the sum of
    ``jump exp(-jw t)`` over the breaks between them,

    ``T V = (v(a) e_a - v(b))/jw + (r(a) e_a - r(b))/(jw)^2 + gain exp(-jw delay) D/(jw)^i``,

    i = 1 for a constant hold (whose slopes are zero) and 2 for a linear one. ``e_a`` is 1 unless a precedes the first
    break, where the signal begins with a jump.
    """
    count = gain.size
    spectrum = np.zeros(count + 1, np.complex128)
    # a and b; before its first break the signal is zero.
    begin, end = max(-delay, times[0]), duration - delay
    if end <= begin:
        return spectrum
    # v, r and the integral of v at both ends, from the last break before each.
    left, right = int(np.searchsorted(times, begin, "right")) - 1, int(np.searchsorted(times, end, "right")) - 1
    before, after = begin - times[left], end - times[right]
    value_left, value_right = values[left] + slopes[left] * before, values[right] + slopes[right] * after
    total_left = integral[left] + before * (values[left] + 0.5 * slopes[left] * before)
    total_right = integral[right] + after * (values[right] + 0.5 * slopes[right] * after)
    spectrum[0] = (total_right - total_left) / duration
    if count == 0:
        return spectrum
    # D: stored sums up to the nearest marks, completed break by break.
    base = 2.0 * np.pi / duration
    row, upper = np.searchsorted(marks, left + 1, "right") - 1, np.searchsorted(marks, right + 1, "right") - 1
    total, early = sums[upper, :count].copy(), sums[row, :count].copy()
    _add_jumps(times, jumps, marks[upper], right + 1, base, total)
    _add_jumps(times, jumps, marks[row], left + 1, base, early)
    # e_a, and the equation above.
    phases, starts = _phases(base * delay, count), _phases(base * (delay + begin), count)
    for k in range(count):
        jw = 1j * (base * (k + 1))
        value = value_left * starts[k] - value_right
        slope = slopes[left] * starts[k] - slopes[right]
        inside = gain[k] * phases[k] * (total[k] - early[k])
        if foh:
            slope += inside
        else:
            value += inside
        spectrum[k + 1] = (value + slope / jw) / jw / duration
    return spectrum


# --- a fit at a fixed delay -----------------------------------------------------------------------------------------


@njit(inline="always")
def _at(coefficients: Array, s: complex) -> complex:
    """Return the value of a polynomial in descending powers."""
    value = 0.0j
    for c in coefficients:
        value = value * s + c
    return value


@njit(cache=True, nogil=True, error_model="numpy")
def _moments(
    frequencies: Array,
    outputs: ComplexArray,
    inputs: ComplexArray,
    weights: Array,
    theta: Array,
    poles: int,
) -> tuple[Array, float]:
    """Return products of the columns (dx/da, dx/db, dx/dT, dx/dtau, eps) at ``theta = (a, b, T)``, and output power.

    If B is zero, dx/da uses the measured output, as least squares require.
    """
    size, ahead = theta.size + 2, theta.size - poles
    denominator = np.empty(poles + 1)
    denominator[0] = 1.0
    for i in range(poles):
        denominator[i + 1] = theta[i]
    numerator, transient = theta[poles:ahead], theta[ahead:]
    measured, power = True, 0.0
    for b in numerator:
        measured = measured and b == 0.0
    rising, column = np.empty(poles, np.complex128), np.empty(size, np.complex128)
    columns = np.empty((2 * frequencies.size, size))
    for k in range(frequencies.size):
        jw = complex(0.0, frequencies[k])
        # A positive frequency also represents its negative.
        root = math.sqrt(weights[k] if frequencies[k] == 0.0 else 2.0 * weights[k])
        # No complex division, for which Numba would add a check for zero.
        at = _at(denominator, jw)
        inverse = at.conjugate() * (1.0 / (at.real * at.real + at.imag * at.imag))
        forced = _at(numerator, jw) * inputs[k] * inverse
        output = forced + _at(transient, jw) * inverse
        power += root * root * (output.real * output.real + output.imag * output.imag)
        # (jw)^i/A
        rising[0] = root * inverse
        for i in range(1, poles):
            rising[i] = rising[i - 1] * jw
        filtered = outputs[k] if measured else output
        for i in range(poles):
            column[i] = -rising[poles - 1 - i] * filtered
        for i in range(poles, ahead):
            column[i] = rising[ahead - 1 - i] * inputs[k]
        for i in range(poles):
            column[ahead + i] = rising[poles - 1 - i]
        column[size - 2] = -root * jw * forced
        column[size - 1] = root * (outputs[k] - output)
        for i in range(size):
            columns[2 * k, i], columns[2 * k + 1, i] = column[i].real, column[i].imag
    return np.dot(columns.T, columns), power


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(gram: Array, right: int, first: int, last: int) -> tuple[bool, Array]:
    """Project one column on columns ``first … last - 1``; also return whether the projection succeeded."""
    count, solution = last - first, np.zeros(last)
    scale, matrix = np.empty(count), np.empty((count, count + 1))
    for i in range(count):
        length = math.sqrt(gram[first + i, first + i])
        if not 0.0 < length < np.inf:
            return False, solution
        scale[i] = 1.0 / length
        for j in range(i):
            matrix[i, j] = matrix[j, i] = gram[first + i, first + j] * scale[i] * scale[j]
        matrix[i, i], matrix[i, count] = 1.0 + RIDGE, gram[first + i, right] * scale[i]
    # Elimination; a positive definite matrix needs no pivoting.
    for i in range(count):
        for row in range(i + 1, count):
            ratio = matrix[row, i] / matrix[i, i]
            for j in range(i + 1, count + 1):
                matrix[row, j] -= ratio * matrix[i, j]
    for i in range(count - 1, -1, -1):
        found = matrix[i, count]
        for j in range(i + 1, count):
            found -= matrix[i, j] * solution[first + j] / scale[j]
        solution[first + i] = found / matrix[i, i] * scale[i]
        if not math.isfinite(solution[first + i]):
            return False, solution
    return True, solution


@njit(cache=True, nogil=True, error_model="numpy")
def _is_stable(theta: Array, poles: int) -> bool:
    """Return whether the denominator ``(1, a_1 … a_n)``, the first parameters, is stable, by Routh's criterion."""
    rows = np.zeros((2, poles // 2 + 2))
    rows[0, 0] = 1.0
    for i in range(1, poles + 1):
        if not theta[i - 1] > 0.0:
            return False
        rows[i % 2, i // 2] = theta[i - 1]
    for i in range(2, poles + 1):
        older, newer = rows[i % 2], rows[(i + 1) % 2]
        ratio = older[0] / newer[0]
        for k in range(older.size - 1):
            older[k] = older[k + 1] - ratio * newer[k + 1]
        older[-1] = 0.0
        if not older[0] > 0.0:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def least_squares(
    frequencies: Array,
    outputs: ComplexArray,
    inputs: ComplexArray,
    weights: Array,
    start: Array,
    poles: int,
) -> tuple[bool, Array]:
    """Return the least-squares estimate of ``(a, b, T)`` with filter 1/F, ``start = (f_1 … f_n, 0 … 0)``.

    ``A Y = B U + T`` divided by F reads ``Y = -sum (a_i - f_i) (jw)^(n-i)/F Y + B/F U + T/F``.
    """
    gram, _ = _moments(frequencies, outputs, inputs, weights, start, poles)
    solved, step = _solve(gram, start.size + 1, 0, start.size)
    return solved, start + step


@njit(cache=True, nogil=True, error_model="numpy")
def least_cost(
    frequencies: Array,
    outputs: ComplexArray,
    inputs: ComplexArray,
    weights: Array,
    start: Array,
    poles: int,
    max_iterations: int,
    tolerance: float,
    halvings: int,
) -> tuple[Array, float, float]:
    """Minimise the cost over the coefficients by Gauss-Newton from ``start = (a, 0, 0)``, with a stable.

    B and T are first fitted to the given a. A step to an unstable model, or one that does not lower the cost, is halved
    at most ``halvings`` times. The iteration ends when a step changes the model's output by less than the relative
    tolerance. Returns the coefficients, the squared error, infinite if the computation failed, and the Gauss-Newton
    step of the delay [s], NaN if the data do not determine it.
    """
    size, coefficients = start.size, start.size - poles
    gram, power = _moments(frequencies, outputs, inputs, weights, start, poles)
    # The output is linear in B and T: one step from zero gives the minimum.
    solved, step = _solve(gram, size + 1, poles, size)
    theta = start + step
    gram, power = _moments(frequencies, outputs, inputs, weights, theta, poles)
    if not (solved and math.isfinite(gram[-1, -1])):
        return theta[:coefficients], np.inf, np.nan
    for _ in range(max_iterations):
        solved, step = _solve(gram, size + 1, 0, size)
        if not solved:
            break
        # Product of gradient and step; it equals the squared change of the output, as the step solves the normal
        # equations.
        slope = 0.0
        for i in range(size):
            slope += step[i] * gram[i, size + 1]
        fraction, accepted = 1.0, False
        for _ in range(halvings):
            trial = theta + fraction * step
            if _is_stable(trial, poles):
                tried, its_power = _moments(frequencies, outputs, inputs, weights, trial, poles)
                bound = gram[-1, -1] - SUFFICIENT_FALL * 2.0 * fraction * slope
                if tried[-1, -1] <= bound + ROUNDING * (power + its_power):
                    accepted = True
                    break
            fraction *= 0.5
        if not accepted:
            break
        settled = fraction == 1.0 and slope <= tolerance * tolerance * power
        theta, gram, power = trial, tried, its_power
        if settled:
            break
    # H = eps_tau' eps_tau - eps_tau' psi (psi' psi)^-1 psi' eps_tau; the sign of eps_tau cancels in it.
    solved, step = _solve(gram, size, 0, size)
    curvature = gram[size, size]
    for i in range(size):
        curvature -= step[i] * gram[i, size]
    determined = solved and curvature > LEAST_CURVATURE * gram[size, size]
    delay_step = gram[size, size + 1] / curvature if determined else np.nan
    return theta[:coefficients], gram[-1, -1], delay_step
