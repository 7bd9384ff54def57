"""Compiled loops over the samples of windows: fit of decaying chirps, and tests for changes within a window."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ctid_cli.arrays import Array, BoolArray, ComplexArray, IndexArray

#: Parameters of a tone over u in [-1, 1], the window: amplitudes a and b of ``exp(g u) (a cos + b sin)(w u + c u^2)``,
#: then g, w and c.
PARAMETERS = 5
#: Products of tones at least this many bins apart are negligible and omitted from the normal equations.
SEPARATE_BINS = 8.0
#: Samples processed together, few enough for the L1 cache: their loops have no dependence between iterations.
CHUNK = 128
#: Number of free parameters of each tone and most steps of each stage: amplitudes first, curvature last.
STAGES = ((2, 1), (4, 4), (PARAMETERS, 60))
#: Largest logarithmic growth, and largest quadratic phase, over half a window [rad].
MOST_GROWTH = 4.0
MOST_BEND = 1e4
#: A stage ends when a step would lower the sum of squares by less than this share of one sample's, or changes no
#: phase by more than this [rad] and no amplitude by more than this share.
SMALL_GAIN = 1e-3
SMALL_STEP = 1e-9
#: Longest step of a phase over half a window [rad]; longer ones may end in another local minimum.
LONGEST_STEP = 2.0
#: Marquardt's damping in units of the diagonal: first value, factors, and largest value.
DAMPING = 1e-4
RAISED = 10.0
LOWERED = 0.1
LEAST_DAMPING = 1e-12
MOST_DAMPING = 1e6
#: Added to the diagonal before a covariance is computed, as a share of it.
RIDGE = 1e-13
#: Share of the window at each end in which no change is searched for.
ENDS = 0.05


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _product(one: Array, other: Array, count: int) -> float:
    total = 0.0
    for j in range(count):
        total += one[j] * other[j]
    return total


@njit(cache=True, nogil=True)
def _phasor(growth: float, angle: float) -> complex:
    """Return ``exp(growth + i angle)``, which compiles faster than cmath.exp."""
    size = math.exp(growth)
    return complex(size * math.cos(angle), size * math.sin(angle))


@njit(cache=True, nogil=True)
def _first_phasors(tone: Array, du: float, phasors: ComplexArray) -> complex:
    """Fill in the phasors of the first chunk and their factors to the next one; return the factor of these factors."""
    growth, turn, bend = tone[2], tone[3], tone[4]
    chunk = phasors.shape[1]
    ahead = chunk * du
    # phi(u + d) - phi(u) = w d + c (2 u d + d^2), at u = -1 to the next sample, and to the next chunk
    z = _phasor(-growth, bend - turn)
    q = _phasor(growth * du, turn * du + bend * (du * du - 2.0 * du))
    p = _phasor(0.0, 2.0 * bend * du * du)
    leap = _phasor(growth * ahead, turn * ahead + bend * (ahead * ahead - 2.0 * ahead))
    longer = _phasor(0.0, 2.0 * bend * ahead * du)
    for j in range(chunk):
        phasors[0, j], phasors[1, j] = z, leap
        z *= q
        q *= p
        leap *= longer
    return _phasor(0.0, 2.0 * bend * ahead * ahead)


@njit(cache=True, nogil=True, fastmath={"contract"})
def _take_tone(
    tone: Array, phasors: ComplexArray, further: complex, there: Array, u: Array, rows: Array, left: Array
) -> None:
    """Subtract a tone from the residual of a chunk, and advance its phasors to the next chunk.

    ``rows`` are its derivatives with respect to its parameters. Short loops compile to vector instructions.
    """
    now, leap = phasors[0], phasors[1]
    of_cosine, of_sine, of_growth, of_turn, of_bend = rows[0], rows[1], rows[2], rows[3], rows[4]
    cosine, sine = tone[0], tone[1]
    for j in range(left.size):
        of_cosine[j] = there[j] * now[j].real
        of_sine[j] = there[j] * now[j].imag
        now[j] *= leap[j]
        leap[j] *= further
    for j in range(left.size):
        value = cosine * of_cosine[j] + sine * of_sine[j]
        left[j] -= value
        of_growth[j] = u[j] * value
        of_turn[j] = u[j] * (sine * of_cosine[j] - cosine * of_sine[j])
        of_bend[j] = u[j] * of_turn[j]


@njit(cache=True, nogil=True)
def _equations(
    y: Array,
    there: Array,
    tones: Array,
    constant: float,
    gram: Array,
    right: Array,
    left: Array,
    rows: Array,
    phasors: ComplexArray,
) -> float:
    """Compute the normal equations ``gram step = right`` of all parameters, the constant last; return the cost.

    ``rows`` and ``phasors`` are working memory for a chunk of samples.
    """
    length, n = y.size, tones.shape[0]
    last = PARAMETERS * n
    chunk, u = rows.shape[1], rows[-1]
    du = 2.0 / (length - 1)
    further = np.empty(n, np.complex128)
    for k in range(n):
        further[k] = _first_phasors(tones[k], du, phasors[k])
    for a in range(last + 1):
        right[a] = 0.0
        for b in range(a + 1):
            gram[a, b] = 0.0
    total = 0.0
    for first in range(0, length, chunk):
        here = min(chunk, length - first)
        known, rest = there[first : first + here], left[first : first + here]
        for j in range(here):
            u[j] = (first + j) * du - 1.0
            rest[j] = y[first + j] - constant * known[j]
            rows[last, j] = known[j]
        for k in range(n):
            of_tone = rows[PARAMETERS * k : PARAMETERS * (k + 1)]
            _take_tone(tones[k], phasors[k], further[k], known, u, of_tone, rest)
        total += _product(rest, rest, here)
        for a in range(last + 1):
            right[a] += _product(rows[a], rest, here)
            # Frequency of the parameter's tone, and range within which others matter; the constant is at zero.
            k = min(a // PARAMETERS, n - 1)
            turn = tones[k, 3] if a < last else 0.0
            wide = SEPARATE_BINS * math.pi + (2.0 * abs(tones[k, 4]) if a < last else 0.0)
            for m in range(k + 1):
                if abs(turn - tones[m, 3]) < wide + 2.0 * abs(tones[m, 4]):
                    for b in range(PARAMETERS * m, min(PARAMETERS * (m + 1), a + 1)):
                        gram[a, b] += _product(rows[a], rows[b], here)
        gram[last, last] += _product(rows[last], rows[last], here)
    return total


@njit(cache=True, nogil=True)
def _factorise(gram: Array, free: BoolArray, ridge: float, factor: Array, scales: Array) -> bool:
    """Compute the Cholesky factor of the equations of the free parameters, scaled to a unit diagonal."""
    n = scales.size
    for i in range(n):
        scales[i] = 1.0
        if free[i]:
            scales[i] = math.sqrt(gram[i, i])
            if not (math.isfinite(scales[i]) and scales[i] > 0.0):
                return False
    for i in range(n):
        for j in range(i + 1):
            if not (free[i] and free[j]):
                factor[i, j] = 1.0 if i == j else 0.0
                continue
            total = gram[i, j] / (scales[i] * scales[j]) + (ridge if i == j else 0.0)
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = total / factor[j, j]
            elif total > 4e-16 * n:
                factor[i, i] = math.sqrt(total)
            else:
                # The remainder of a linearly dependent column is rounding error: not positive definite.
                return False
    return True


@njit(cache=True, nogil=True)
def _solve(factor: Array, scales: Array, right: Array, free: BoolArray, step: Array) -> None:
    """Solve the scaled equations; the step of a parameter that is not free is zero."""
    n = scales.size
    for i in range(n):
        total = right[i] / scales[i] if free[i] else 0.0
        for k in range(i):
            total -= factor[i, k] * step[k]
        step[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            step[i] -= factor[k, i] * step[k]
        step[i] /= factor[i, i]
    for i in range(n):
        step[i] /= scales[i]


@njit(cache=True, nogil=True)
def _covariances(
    gram: Array, free: BoolArray, factor: Array, scales: Array, right: Array, column: Array, covariances: Array
) -> None:
    """Compute the blocks of the inverse of the equations that belong to one tone each, shape (n, 5, 5)."""
    for i in range(scales.size):
        free[i], right[i] = True, 0.0
    known = _factorise(gram, free, RIDGE, factor, scales)
    for i in range(scales.size - 1):
        right[i] = 1.0
        if known:
            _solve(factor, scales, right, free, column)
        right[i] = 0.0
        k = i // PARAMETERS
        for a in range(PARAMETERS):
            covariances[k, i - PARAMETERS * k, a] = column[PARAMETERS * k + a] if known else math.nan


@njit(cache=True, nogil=True)
def _set_free(tones: Array, right: Array, stage: int, free: BoolArray) -> None:
    """Mark the free parameters of a stage and the constant, except those that a step would move out of bounds."""
    for k in range(tones.shape[0]):
        for j in range(PARAMETERS):
            i = PARAMETERS * k + j
            bound = MOST_GROWTH if j == 2 else MOST_BEND if j == 4 else math.inf
            free[i] = j < stage and (abs(tones[k, j]) < bound or tones[k, j] * right[i] < 0.0)
    free[PARAMETERS * tones.shape[0]] = True


@njit(cache=True, nogil=True)
def fit_windows(
    samples: Array,
    length: int,
    first: IndexArray,
    chosen: IndexArray,
    most_steps: int,
    used: IndexArray,
    parameters: Array,
    covariances: Array,
    converged: BoolArray,
    residuals: Array,
) -> None:
    """Fit the tones of windows by Levenberg-Marquardt steps, starting from ``parameters``.

    A stage takes at most ``most_steps``. ``parameters`` are of shape (R, n, 5), and their ``covariances``, in units of
    the noise variance, (R, n, 5, 5); ``residuals`` are of shape (R, L).
    """
    most = PARAMETERS * parameters.shape[1] + 1
    gram, trial_gram = np.zeros((2, most, most))
    right, trial_right, step = np.zeros((3, most))
    left, trial_left, y, there = np.empty((4, length))
    factor, scales, free = np.zeros((most, most)), np.ones(most), np.ones(most, np.bool_)
    chunk = min(CHUNK, length)
    rows, phasors = np.empty((most + 1, chunk)), np.empty((parameters.shape[1], 2, chunk), np.complex128)
    for row in chosen:
        n = used[row]
        tones = parameters[row, :n]
        size = PARAMETERS * n + 1
        constant, count = 0.0, 0.0
        for j in range(length):
            value = samples[first[row] + j]
            there[j] = 0.0 if math.isnan(value) else 1.0
            y[j] = 0.0 if math.isnan(value) else value
            constant += y[j]
            count += there[j]
        converged[row] = False
        if count <= size:
            residuals[row] = np.nan
            continue
        constant /= count
        cost = _equations(y, there, tones, constant, gram, right, left, rows, phasors)
        trial = np.empty_like(tones)
        for stage, steps in STAGES:
            damping, taken, done = DAMPING, 0, False
            while taken < min(steps, most_steps) and not done:
                _set_free(tones, right, stage, free)
                if damping > MOST_DAMPING:
                    done = True
                elif _factorise(gram, free, damping, factor, scales[:size]):
                    _solve(factor, scales[:size], right, free, step)
                    gain, largest, turned = step[size - 1] * right[size - 1], 0.0, 0.0
                    for k in range(n):
                        height = math.hypot(tones[k, 0], tones[k, 1]) + 1e-300
                        for j in range(PARAMETERS):
                            gain += step[PARAMETERS * k + j] * right[PARAMETERS * k + j]
                            trial[k, j] = tones[k, j] + step[PARAMETERS * k + j]
                        trial[k, 2] = min(max(trial[k, 2], -MOST_GROWTH), MOST_GROWTH)
                        trial[k, 4] = min(max(trial[k, 4], -MOST_BEND), MOST_BEND)
                        for j in range(PARAMETERS):
                            moved = abs(trial[k, j] - tones[k, j])
                            largest = max(largest, moved / height if j < 2 else moved)
                            turned = max(turned, 0.0 if j < 2 else moved)
                    level = constant + step[size - 1]
                    if gain <= SMALL_GAIN * cost / count or largest <= SMALL_STEP:
                        done = True
                    elif turned < LONGEST_STEP:
                        lower = _equations(y, there, trial, level, trial_gram, trial_right, trial_left, rows, phasors)
                        if lower <= cost:
                            # Nearly every step is accepted, so its equations are those of the next step.
                            for k in range(n):
                                for j in range(PARAMETERS):
                                    tones[k, j] = trial[k, j]
                            constant, cost, taken = level, lower, taken + 1
                            gram, trial_gram = trial_gram, gram
                            right, trial_right = trial_right, right
                            left, trial_left = trial_left, left
                            damping = max(damping * LOWERED, LEAST_DAMPING)
                            continue
                    damping *= RAISED
                else:
                    damping *= RAISED
            converged[row] = done
        for j in range(length):
            residuals[row, j] = left[j] if there[j] else np.nan
        _covariances(gram, free, factor, scales[:size], right, step, covariances[row])


@njit(cache=True, nogil=True)
def find_changes(white: Array, filters: Array, parameters: Array, used: IndexArray, energy: Array, cube: Array) -> None:
    """Compute test statistics for changes of the tones within each window.

    ``energy``, shape (R, n), is the largest reduction of the sum of squares of the whitened residual by a change of
    phase and amplitude at one instant, in units of the noise. The variance of the partial sums of a demodulated noise
    residual is reduced by the fitted polynomials (phase 1, u, u^2; amplitude 1, u). ``cube``, shape (R, n), is the sum
    of the demodulated residual's quadrature times ``P3(u)``.
    """
    length = white.shape[1]
    begin = max(1, int(ENDS * length))
    # Integrals of the orthonormal Legendre polynomials from -1 to v, squared.
    of_amplitude, of_phase = np.empty(length), np.empty(length)
    for i in range(length):
        x = (i + 1) / length
        v = 2.0 * x - 1.0
        of_amplitude[i] = 1.0 / (length * (x - x * x - 3.0 * (0.25 * (v * v - 1.0)) ** 2) + 1e-300)
        of_phase[i] = 1.0 / (1.0 / of_amplitude[i] - length * 5.0 * (0.25 * (v**3 - v)) ** 2 + 1e-300)
    du = 2.0 / (length - 1)
    for row in range(white.shape[0]):
        for k in range(used[row]):
            cosine, sine = parameters[row, k, 0], parameters[row, k, 1]
            turn, bend = parameters[row, k, 3], parameters[row, k, 4]
            response = 0.0j
            for lag in range(filters.shape[1]):
                response += filters[row, lag] * _phasor(0.0, -turn * du * lag)
            phase = math.atan2(-sine, cosine) + math.atan2(response.imag, response.real)
            z = _phasor(0.0, turn - bend - phase)
            q = _phasor(0.0, -turn * du - bend * (du * du - 2.0 * du))
            p = _phasor(0.0, -2.0 * bend * du * du)
            real, imag, largest, third = 0.0, 0.0, 0.0, 0.0
            for i in range(length):
                u = du * i - 1.0
                value = white[row, i]
                real += value * z.real
                imag += value * z.imag
                third += value * z.imag * 0.5 * (5.0 * u * u - 3.0) * u
                if begin <= i < length - begin:
                    largest = max(largest, real * real * of_amplitude[i] + imag * imag * of_phase[i])
                z *= q
                q *= p
            energy[row, k] = largest
            cube[row, k] = third


@njit(cache=True, nogil=True)
def keep_readings(
    readings: Array, bounds: IndexArray, reach: float, errors: float, agree: float, closed: BoolArray
) -> NDArray[np.bool_]:
    """Return which readings of each instant are kept: none that is close to one of a longer, or nearer, window.

    ``readings``, shape (5, N), are frequencies, their errors, relative errors of amplitudes, windows and their middles.
    Readings of one window are of different tones. If the residual of the longest window masks a tone, so that a
    shorter one that agrees has half the relative error and a smaller standard error, the shorter one is kept.
    """
    omega, error, unclear, window, middle = readings
    kept = np.zeros(omega.size, np.bool_)
    for row in range(bounds.size - 1):
        for first in range(bounds[row], bounds[row + 1]):
            if closed[first]:
                continue
            best = first
            for k in range(first + 1, bounds[row + 1]):
                if closed[k] or (window[k] == window[first] and middle[k] == middle[first]):
                    continue
                off = abs(omega[k] - omega[first])
                sure = math.hypot(error[k], error[first])
                closed[k] = off < max(reach * 2.0 * math.pi / window[k], errors * sure)
                if off <= agree * sure and 2.0 * unclear[k] < unclear[first] and error[k] < error[best]:
                    best = k
            kept[best] = True
    return kept
