r"""Compiled loops over the frequencies of finite-record spectra: the input at a delay, and fits at held delays.

A kernel calls only kernels of this file and reads no constant and no type of another: Numba's cache on disk looks only
at the file of a function, and is then never stale. What makes the arguments is NumPy, in
:mod:`~ctid_cli.filtering.spectra` and :mod:`~ctid_cli.estimation.filtered_costs`.

A search over the delay makes thousands of small fits one after the other, each from the end of the one before. The
whole fit is therefore compiled: with its steps in NumPy, side by side for all filters, a search took ten times as long.

At a held delay the model ``x = B/A u(t - tau)`` obeys

.. math:: X = \frac{B(jw)\,U_\tau + T(jw)}{A(jw)}, \qquad \varepsilon = Y - X,

exactly, with one real polynomial T of degree n - 1 for the states at both ends of the window. T is linear: it is
projected out at every parameter vector, so that a record may start and end in mid-motion. The cost
``sum_k g_k |eps_k|^2`` counts every frequency on both sides of zero; with the weight ``g = |L(jw)|^2`` it is, by
Parseval, the mean square over the window of the output error behind the filter L.
"""

import math

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray, IntArray

#: A column that the earlier ones explain but for this fraction of its power adds nothing.
DEPENDENT = 1e-14
#: The delay counts as undetermined where projecting the coefficients out leaves less of the curvature.
LEAST_CURVATURE = 1e-14
#: A root on the axis is moved off it by this fraction of the largest root.
OFF_THE_AXIS = 1e-6
#: A step is taken only if the cost falls by this fraction of what its slope promises (Armijo's rule), but for rounding.
SUFFICIENT_FALL = 0.1
ROUNDING = 1e-13
#: The signals by which ``(jw)^r/A`` is multiplied to form a column: of the transient, of dx/da, dx/db and dx/dtau, and
#: the output error.
ONE, OUTPUT, INPUT, DRIVE, ERROR = range(5)
#: Number of their pairs.
PAIRS = 15


# --- the input at a delay -----------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _phases(angle: float, count: int, re: Array, im: Array) -> None:
    """Real and imaginary parts of ``exp(-j k angle)``, k = 1 … count, by doubling: vector operations throughout."""
    power_re, power_im = np.cos(angle), -np.sin(angle)
    re[0], im[0] = power_re, power_im
    done = 1
    while done < count:
        for i in range(min(done, count - done)):
            re[done + i] = power_re * re[i] - power_im * im[i]
            im[done + i] = power_re * im[i] + power_im * re[i]
        power_re, power_im = power_re * power_re - power_im * power_im, 2.0 * power_re * power_im
        done *= 2


@njit(cache=True, nogil=True)
def _add_jumps(times: Array, jumps: Array, first: int, last: int, base: float, phases: Array, total: Array) -> None:
    """Add ``sum jump_i exp(-j k base t_i)`` over the breaks ``first … last - 1`` to ``total``."""
    count = total.shape[1]
    phase_re, phase_im = phases[0], phases[1]
    total_re, total_im = total[0], total[1]
    for i in range(first, last):
        _phases(base * times[i], count, phase_re, phase_im)
        for k in range(count):
            total_re[k] += jumps[i] * phase_re[k]
            total_im[k] += jumps[i] * phase_im[k]


@njit(cache=True, nogil=True)
def partial_sums(times: Array, jumps: Array, marks: IntArray, base: float, count: int) -> Array:
    """Sums over the first ``marks[r]`` breaks, shape (marks, 2, count)."""
    sums = np.zeros((marks.size, 2, count))
    phases, total = np.zeros((2, count)), np.zeros((2, count))
    done = marks[0]
    for r in range(marks.size):
        _add_jumps(times, jumps, done, marks[r], base, phases, total)
        done = marks[r]
        # Element by element: for an assignment of arrays Numba compiles the text of an error message, for seconds.
        for k in range(count):
            sums[r, 0, k], sums[r, 1, k] = total[0, k], total[1, k]
    return sums


@njit(cache=True, nogil=True)
def _last_at(grid: Array | IntArray, value: float) -> int:
    """Index of the last entry not above ``value``; 0 if there is none."""
    low, high = 0, grid.size
    while high - low > 1:
        middle = (low + high) // 2
        if grid[middle] <= value:
            low = middle
        else:
            high = middle
    return low


@njit(cache=True, nogil=True)
def window_spectrum(
    times: Array,
    values: Array,
    slopes: Array,
    jumps: Array,
    integral: Array,
    foh: bool,
    marks: IntArray,
    sums: Array,
    duration: float,
    delay: float,
    gain: Array,
) -> ComplexArray:
    """Spectrum at zero frequency and at as many above it as there are gains, of the signal later by ``delay``.

    The gain multiplies what happens inside the window, as opposed to its ends.

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
    base = 2.0 * np.pi / duration
    # v, r and the integral of v at both ends, from the last break before each.
    left, right = _last_at(times, begin), _last_at(times, end)
    before, after = begin - times[left], end - times[right]
    value_left, value_right = values[left] + slopes[left] * before, values[right] + slopes[right] * after
    total_left = integral[left] + before * (values[left] + 0.5 * slopes[left] * before)
    total_right = integral[right] + after * (values[right] + 0.5 * slopes[right] * after)
    spectrum[0] = (total_right - total_left) / duration
    if count == 0:
        return spectrum
    phases = np.zeros((2, count))
    # D: kept sums up to the nearest marks, completed break by break.
    row, upper = _last_at(marks, left + 1), _last_at(marks, right + 1)
    total, early = sums[upper, :, :count].copy(), sums[row, :, :count].copy()
    _add_jumps(times, jumps, marks[upper], right + 1, base, phases, total)
    _add_jumps(times, jumps, marks[row], left + 1, base, phases, early)
    _phases(base * delay, count, phases[0], phases[1])
    # e_a, and the equation above.
    starts = np.zeros((2, count))
    if begin > -delay:
        _phases(base * (delay + begin), count, starts[0], starts[1])
    else:
        for k in range(count):
            starts[0, k] = 1.0
    for k in range(count):
        jw = 1j * (base * (k + 1))
        start = complex(starts[0, k], starts[1, k])
        inside = complex(total[0, k] - early[0, k], total[1, k] - early[1, k])
        inside *= gain[k] * complex(phases[0, k], phases[1, k])
        value = value_left * start - value_right
        slope = slopes[left] * start - slopes[right]
        if foh:
            slope += inside
        else:
            value += inside
        spectrum[k + 1] = (value + slope / jw) / jw / duration
    return spectrum


# --- second moments at given coefficients ---------------------------------------------------------------------------


@njit(inline="always")
def _at(coefficients: Array, w: float) -> complex:
    """Polynomial in descending powers at ``jw``."""
    re, im = 0.0, 0.0
    for c in coefficients:
        re, im = c - im * w, re * w
    return complex(re, im)


@njit(inline="always")
def _lane(left: int, right: int) -> int:
    """Place of a pair of signals, ``left <= right``, among the pairs in lexical order."""
    return left * (9 - left) // 2 + right


@njit(inline="always")
def _product(sums: Array, lane: int, r: int, s: int) -> float:
    """``sum Re(conj((jw)^r P) (jw)^s Q)`` from the power sums of ``conj(P) Q``.

    ``conj(j^r) j^s = j^(s - r)``: even powers of w go with the real parts, odd ones with the imaginary parts.
    """
    turn = (s - r) % 4
    value: float = sums[r + s, lane]
    return value if turn == 0 or turn == 3 else -value


@njit(cache=True, nogil=True, error_model="numpy")
def _factor(normal: Array) -> None:
    """Cholesky factor in place of the lower triangle; a dependent column leaves a zero on the diagonal."""
    for i in range(normal.shape[0]):
        own = normal[i, i]
        for j in range(i + 1):
            total = normal[i, j]
            for h in range(j):
                total -= normal[i, h] * normal[j, h]
            if j < i:
                normal[i, j] = total / normal[j, j] if normal[j, j] > 0.0 else 0.0
            else:
                normal[i, i] = np.sqrt(total) if total > DEPENDENT * own else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _forward(factor: Array, vector: Array) -> None:
    """Solve ``L z = vector`` in place; dependent columns take no part."""
    for i in range(vector.size):
        for j in range(i):
            vector[i] -= factor[i, j] * vector[j]
        vector[i] = vector[i] / factor[i, i] if factor[i, i] > 0.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _back(factor: Array, vector: Array) -> None:
    """Solve ``L' z = vector`` in place; dependent columns take no part."""
    for i in range(vector.size - 1, -1, -1):
        for j in range(i + 1, vector.size):
            vector[i] -= factor[j, i] * vector[j]
        vector[i] = vector[i] / factor[i, i] if factor[i, i] > 0.0 else 0.0


@njit(inline="always")
def _transient(w: Array, power: Array, remainder: ComplexArray, n: int) -> tuple[Array, Array]:
    """Least squares of R = A Y - B U on the powers ``0 … n - 1`` of jw.

    Returns the factor of the normal equations and the polynomial in descending powers.
    """
    # Lane 0: power sums of 1/|A|^2, of which the normal matrix is made, a Hankel matrix up to signs; lane 1: of R.
    sums = np.zeros((2 * n - 1, 2))
    for k in range(w.size):
        weight = power[k]
        for q in range(2 * n - 1):
            sums[q, 0] += weight if q % 2 == 0 else 0.0
            sums[q, 1] += weight * (remainder[k].real if q % 2 == 0 else remainder[k].imag)
            weight *= w[k]
    factor, solution, falling = np.empty((n, n)), np.empty(n), np.empty(n)
    for i in range(n):
        solution[i] = _product(sums, 1, i, 0)
        for j in range(n):
            factor[i, j] = _product(sums, 0, i, j)
    _factor(factor)
    _forward(factor, solution)
    _back(factor, solution)
    for i in range(n):
        falling[n - 1 - i] = solution[i]
    return factor, falling


@njit(cache=True, nogil=True, error_model="numpy")
def projected_moments(
    frequencies: Array,
    outputs: ComplexArray,
    inputs: ComplexArray,
    weights: Array,
    a: Array,
    b: Array,
    integrators: int,
) -> tuple[Array, float]:
    """Moments of the columns (dx/da, dx/db, dx/dtau, eps), the transient projected out of all.

    Every column is ``(jw)^r/(p^l A)`` times a signal: dx/da takes the model's output, or where B is zero the measured
    one, dx/db the input, dx/dtau ``jw B U``. All products of columns are therefore sums of powers of w times few
    products of signals, as in a Hankel matrix. Also returns the power of the model's output. With integrators no
    frequency may be zero.
    """
    n, m, count = a.size - 1, b.size - 1, inputs.size
    order = n + integrators
    # In units of the highest frequency powers of w stay below one.
    unit = frequencies[count - 1] if frequencies[count - 1] > 0.0 else 1.0
    size, measured = n + m + 3, True
    den, num, scale = np.zeros(order + 1), np.empty(m + 1), np.ones(size)
    den[0] = 1.0
    for i in range(1, n + 1):
        den[i] = a[i] / unit**i
        scale[i - 1] = unit ** (-i)
    for j in range(m + 1):
        scale[n + j] = unit ** (m - order - j)
        num[j] = b[j] * scale[n + j]
        measured = measured and b[j] == 0.0
    scale[n + m + 1] = unit

    w, side, power = np.empty(count), np.empty(count), np.empty(count)
    inverse, drive, remainder = np.empty(count, np.complex128), np.empty(count, np.complex128), inputs.copy()
    for k in range(count):
        w[k] = frequencies[k] / unit
        at = _at(den, w[k])
        gain = 1.0 / (at.real * at.real + at.imag * at.imag)
        inverse[k] = at.conjugate() * gain
        # A frequency above zero stands for its negative too.
        side[k] = weights[k] if w[k] == 0.0 else 2.0 * weights[k]
        power[k] = side[k] * gain
        drive[k] = _at(num, w[k]) * inputs[k]
        remainder[k] = at * outputs[k] - drive[k]
    factor, polynomial = _transient(w, power, remainder, order)

    # Power sums of the products of all pairs of signals.
    sums = np.zeros((2 * order - 1, PAIRS))
    signals, re, im = np.ones(5, np.complex128), np.empty(PAIRS), np.empty(PAIRS)
    output_power = 0.0
    for k in range(count):
        explained = _at(polynomial, w[k])
        response = (drive[k] + explained) * inverse[k]
        output_power += side[k] * (response.real * response.real + response.imag * response.imag)
        signals[OUTPUT] = outputs[k] if measured else response
        signals[INPUT] = inputs[k]
        signals[DRIVE] = 1j * w[k] * drive[k]
        signals[ERROR] = remainder[k] - explained
        lane = 0
        for i in range(5):
            for j in range(i, 5):
                re[lane] = signals[i].real * signals[j].real + signals[i].imag * signals[j].imag
                im[lane] = signals[i].real * signals[j].imag - signals[i].imag * signals[j].real
                lane += 1
        scaled = power[k]
        for q in range(2 * order - 1):
            part = re if q % 2 == 0 else im
            for lane in range(PAIRS):
                sums[q, lane] += scaled * part[lane]
            scaled *= w[k]

    # Signal, power of jw and sign of every column.
    signal, exponent, sign = np.empty(size, np.int64), np.zeros(size, np.int64), np.ones(size)
    for i in range(n):
        signal[i], exponent[i], sign[i] = OUTPUT, order - 1 - i, -1.0
    for j in range(m + 1):
        signal[n + j], exponent[n + j] = INPUT, m - j
    signal[n + m + 1], sign[n + m + 1] = DRIVE, -1.0
    signal[size - 1] = ERROR

    projected = np.zeros((size, order))
    for j in range(size - 1):  # the error is orthogonal to the transient already
        for i in range(order):
            projected[j, i] = sign[j] * _product(sums, _lane(ONE, signal[j]), i, exponent[j])
        _forward(factor, projected[j])
    gram = np.empty((size, size))
    for i in range(size):
        for j in range(i, size):
            total = sign[i] * sign[j] * _product(sums, _lane(signal[i], signal[j]), exponent[i], exponent[j])
            for h in range(order):
                total -= projected[i, h] * projected[j, h]
            gram[i, j] = total * scale[i] * scale[j]
            gram[j, i] = gram[i, j]
    return gram, output_power


# --- least squares at a held delay --------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(matrix: Array, right: Array, last: int, count: int, solution: Array) -> bool:
    """Solve normal equations of some parameters in a row, brought to a common scale; zeros for dependent ones."""
    first = last - count
    factor, scaled = np.empty((count, count)), np.empty(count)
    for i in range(count):
        own = matrix[first + i, first + i]
        if not (own > 0.0 and own < np.inf):
            return False
        scale = 1.0 / math.sqrt(own)
        for j in range(count):
            factor[i, j] = matrix[first + i, first + j] * scale / math.sqrt(matrix[first + j, first + j])
        scaled[i] = right[first + i] * scale
    _factor(factor)
    _forward(factor, scaled)
    _back(factor, scaled)
    for i in range(count):
        solution[first + i] = scaled[i] / math.sqrt(matrix[first + i, first + i])
        if not math.isfinite(solution[first + i]):
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _is_stable(a: Array) -> bool:
    """Routh's criterion for a monic polynomial."""
    for c in a:
        if not c > 0.0:
            return False
    rows = np.zeros((2, a.size // 2 + 2))
    for i in range(a.size):
        rows[i % 2, i // 2] = a[i]
    for i in range(2, a.size):
        older, newer = rows[i % 2], rows[(i + 1) % 2]
        ratio = older[0] / newer[0]
        for k in range(older.size - 1):
            older[k] = older[k + 1] - ratio * newer[k + 1]
        older[-1] = 0.0
        if not older[0] > 0.0:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _mirror(a: Array) -> bool:
    """Mirror the right half-plane roots of a monic polynomial in place; whether its roots could be found.

    By the Aberth-Ehrlich iteration.
    """
    n = a.size - 1
    unit, roots = 0.0, np.empty(n, np.complex128)
    for k in range(1, n + 1):
        unit = max(unit, abs(a[k]) ** (1.0 / k))
    if not (unit > 0.0 and unit < np.inf):
        return False
    scaled = np.ones(n + 1)
    for i in range(n):
        scaled[i + 1] = a[i + 1] / unit ** (i + 1)
        # Points without symmetry about the real axis, which conjugate roots could not break.
        angle = 2.0 * math.pi * i / n + 0.4
        roots[i] = complex(math.cos(angle), math.sin(angle))
    for _ in range(60):
        largest = 0.0
        for i in range(n):
            value, slope, repulsion = complex(1.0, 0.0), complex(0.0, 0.0), complex(0.0, 0.0)
            for k in range(1, n + 1):
                slope = slope * roots[i] + value
                value = value * roots[i] + scaled[k]
            for j in range(n):
                if j != i:
                    repulsion += 1.0 / (roots[i] - roots[j])
            change = value / (slope - value * repulsion) if value != 0.0 else value
            roots[i] -= change
            largest = max(largest, abs(change))
        if largest < 1e-12:
            break
    product, size = np.zeros(n + 1, np.complex128), 0.0
    product[0] = 1.0
    for i in range(n):
        size = max(size, abs(roots[i]))
    for i in range(n):
        root = complex(-max(abs(roots[i].real), OFF_THE_AXIS * size), roots[i].imag)
        for k in range(i + 1, 0, -1):
            product[k] -= root * product[k - 1]
    for k in range(1, n + 1):
        a[k] = product[k].real * unit**k
    return _is_stable(a)


@njit(cache=True, nogil=True, error_model="numpy")
def least_cost(
    frequencies: Array,
    outputs: ComplexArray,
    inputs: ComplexArray,
    weights: Array,
    start: Array,
    poles: int,
    integrators: int,
    max_iterations: int,
    tolerance: float,
    halvings: int,
) -> tuple[Array, float, float]:
    """Gauss-Newton on the coefficients from a stable denominator, whose numerator is fitted first.

    A step that does not lower the cost is halved, so often at most. It ends where a step changes the model's output by
    less than a fraction of its size. Returns the coefficients, the squared error, infinite where nothing could be
    computed, and the Gauss-Newton step of the delay [s], NaN where the data do not determine it.
    """
    free = start.size
    theta, step = start.copy(), np.zeros(free + 1)
    b, denominator = np.zeros(free - poles), np.ones(poles + 1)
    for i in range(poles):
        denominator[i + 1] = start[i]
    # At a zero numerator the output error is what B explains: one step is the minimum.
    gram, power = projected_moments(frequencies, outputs, inputs, weights, denominator, b, integrators)
    fitted = _solve(gram, gram[:, -1].copy(), free, free - poles, step)
    for i in range(poles, free):
        b[i - poles] = theta[i] = step[i] if fitted else start[i]
    gram, power = projected_moments(frequencies, outputs, inputs, weights, denominator, b, integrators)
    squared_error = gram[free + 1, free + 1]
    if not math.isfinite(squared_error):
        return theta, np.inf, np.nan
    for _ in range(max_iterations):
        gradient = gram[:, -1].copy()
        if not _solve(gram, gradient, free, free, step):
            break
        slope, change = 0.0, 0.0
        for i in range(free):
            slope += step[i] * gradient[i]
            for j in range(free):
                change += step[i] * gram[i, j] * step[j]
        change = math.sqrt(max(change, 0.0) / power) if power > 0.0 else np.inf
        fraction, accepted = 1.0, False
        for _ in range(halvings):
            for i in range(poles):
                denominator[i + 1] = theta[i] + fraction * step[i]
            for i in range(poles, free):
                b[i - poles] = theta[i] + fraction * step[i]
            if _is_stable(denominator) or _mirror(denominator):
                tried, its_power = projected_moments(frequencies, outputs, inputs, weights, denominator, b, integrators)
                bound = squared_error - SUFFICIENT_FALL * 2.0 * fraction * max(slope, 0.0)
                if tried[free + 1, free + 1] <= bound + ROUNDING * (power + its_power):
                    accepted = True
                    break
            fraction *= 0.5
        if not accepted:
            break
        for i in range(free):
            theta[i] = denominator[i + 1] if i < poles else b[i - poles]
        gram, power, squared_error = tried, its_power, tried[free + 1, free + 1]
        if fraction == 1.0 and change <= tolerance:
            break
    # H = eps_tau' eps_tau - eps_tau' psi (psi' psi)^-1 psi' eps_tau; the sign of eps_tau cancels in it.
    mixed, curvature = gram[:, free].copy(), gram[free, free]
    if not _solve(gram, mixed, free, free, step):
        return theta, squared_error, np.nan
    for i in range(free):
        curvature -= step[i] * mixed[i]
    if not curvature > LEAST_CURVATURE * gram[free, free]:
        return theta, squared_error, np.nan
    return theta, squared_error, gram[free, free + 1] / curvature
