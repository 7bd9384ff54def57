"""Compiled loops: normal equations of sums of decaying chirps in windows, and selection of readings."""

import math

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, BoolArray, ComplexArray, IndexArray

#: Parameters of a tone over u in [-1, 1], the window: amplitudes a and b of ``exp(g u) (a cos + b sin)(w u + c u^2)``,
#: then g, w and c.
PARAMETERS = 5
#: Products of tones at least this many bins apart are negligible and omitted from the normal equations.
SEPARATE_BINS = 8.0
#: Samples processed together, few enough for the L1 cache: their loops have no dependence between iterations.
CHUNK = 128


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
def normal_equations(
    samples: Array, length: int, first: IndexArray, used: IndexArray, parameters: Array, constants: Array
) -> tuple[Array, Array, Array, Array]:
    """Return costs, gradients, normal matrices and residuals of a constant and the first ``used`` tones in windows.

    The constant is the first unknown; ``parameters`` are of shape (R, n, 5). Rows of unused tones are zero, residuals
    of missing samples NaN.
    """
    size = 1 + PARAMETERS * parameters.shape[1]
    costs, right = np.zeros(first.size), np.zeros((first.size, size))
    gram, residuals = np.zeros((first.size, size, size)), np.empty((first.size, length))
    chunk, du = min(CHUNK, length), 2.0 / (length - 1)
    rows, phasors = np.empty((size, chunk)), np.empty((parameters.shape[1], 2, chunk), np.complex128)
    further, u = np.empty(parameters.shape[1], np.complex128), np.empty(chunk)
    for row in range(first.size):
        tones, n = parameters[row], used[row]
        for k in range(n):
            further[k] = _first_phasors(tones[k], du, phasors[k])
        for begin in range(0, length, chunk):
            here = min(chunk, length - begin)
            known, rest = rows[0, :here], residuals[row, begin : begin + here]
            for j in range(here):
                u[j] = (begin + j) * du - 1.0
                value = samples[first[row] + begin + j]
                known[j] = 0.0 if math.isnan(value) else 1.0
                rest[j] = 0.0 if math.isnan(value) else value - constants[row]
            for k in range(n):
                own = rows[1 + PARAMETERS * k : 1 + PARAMETERS * (k + 1)]
                _take_tone(tones[k], phasors[k], further[k], known, u, own, rest)
            costs[row] += _product(rest, rest, here)
            right[row, 0] += _product(known, rest, here)
            gram[row, 0, 0] += _product(known, known, here)
            for k in range(n):
                wide = SEPARATE_BINS * math.pi + 2.0 * abs(tones[k, 4])
                for a in range(1 + PARAMETERS * k, 1 + PARAMETERS * (k + 1)):
                    right[row, a] += _product(rows[a], rest, here)
                    if abs(tones[k, 3]) < wide:
                        gram[row, a, 0] += _product(rows[a], known, here)
                    for m in range(k + 1):
                        if abs(tones[k, 3] - tones[m, 3]) < wide + 2.0 * abs(tones[m, 4]):
                            for b in range(1 + PARAMETERS * m, min(1 + PARAMETERS * (m + 1), a + 1)):
                                gram[row, a, b] += _product(rows[a], rows[b], here)
            for j in range(here):
                rest[j] = rest[j] if known[j] else math.nan
        for a in range(size):
            for b in range(a):
                gram[row, b, a] = gram[row, a, b]
    return costs, right, gram, residuals


@njit(cache=True, nogil=True)
def keep_readings(
    readings: Array, bounds: IndexArray, reach: float, errors: float, agree: float, closed: BoolArray
) -> BoolArray:
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
