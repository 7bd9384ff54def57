"""Normal equations of sums of decaying chirps, made in one pass over a window: compiled, many samples at a time."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ctid_cli.arrays import Array, IndexArray

#: Numbers of a tone: cosine and sine amplitude, and over half a window logarithmic growth, phase, curvature of phase.
NUMBERS = 5
#: Tones that are so many bins apart do not disturb each other's steps.
FAR = 8.0
#: Samples that are taken together. Each has phasors of its own that turn from one such chunk to the next, so that the
#: loops within a chunk have nothing to wait for; few enough for all of a chunk to stay in the nearest cache.
CHUNK = 128


class Work(NamedTuple):
    """Memory of one window after the other; of what comes twice, one is of the numbers so far and one of a trial."""

    #: Sums of the products of the sensitivities psi, lower triangles; sums of psi times residual; residuals; their
    #: sums of squares; shapes (2, 5 n + 1, 5 n + 1), (2, 5 n + 1), (2, L) and (2,).
    gram: Array
    right: Array
    left: Array
    cost: Array
    #: Which of the two is that of the numbers so far, shape (1,).
    now: IndexArray
    #: Equations of the numbers that are free, their factor, and in three rows their right side, a step, and scales.
    packed: Array
    factor: Array
    vectors: Array
    #: Of a chunk: sensitivities, phasors and their factors; whether there is a sample, two rows for products, and u.
    sensitivities: Array
    phasors: Array
    rows: Array
    #: Pairs of tones, and in the last row the tones that the constant disturbs.
    pairs: IndexArray


@njit(cache=True, nogil=True)
def work_for(tones: int, length: int) -> Work:
    """Memory for windows of a length with no more than so many tones."""
    size, chunk = NUMBERS * tones + 1, min(CHUNK, length)
    return Work(
        np.zeros((2, size, size)),
        np.zeros((2, size)),
        np.empty((2, length)),
        np.zeros(2),
        np.zeros(1, np.int64),
        np.zeros((size, size)),
        np.zeros((size, size)),
        np.zeros((3, size)),
        np.empty((size, chunk)),
        np.empty((4 * max(tones, 1), chunk)),
        np.empty((4, chunk)),
        np.empty((3, tones * (tones + 1) // 2 + 1), np.int64),
    )


@njit(cache=True, nogil=True)
def _first_phasors(tones: Array, length: int, phasors: Array, further: NDArray[np.complex128]) -> None:
    """Phasor of each tone at each sample of the first chunk, its factor to the next chunk, and that factor's factor."""
    du = 2.0 / (length - 1)
    chunk = phasors.shape[1]
    ahead = chunk * du
    for k in range(tones.shape[0]):
        growth, turn, bend = tones[k, 2], tones[k, 3], tones[k, 4]
        z = np.exp(complex(-growth, -turn + bend))
        # phi(u + d) - phi(u) = turn d + bend (2 u d + d^2), at u = -1 to the next sample, and to the next chunk
        q = np.exp(complex(growth * du, turn * du + bend * (du * du - 2.0 * du)))
        p = np.exp(complex(0.0, 2.0 * bend * du * du))
        leap = np.exp(complex(growth * ahead, turn * ahead + bend * (ahead * ahead - 2.0 * ahead)))
        longer = np.exp(complex(0.0, 2.0 * bend * ahead * du))
        further[k] = np.exp(complex(0.0, 2.0 * bend * ahead * ahead))
        for j in range(chunk):
            phasors[4 * k, j], phasors[4 * k + 1, j] = z.real, z.imag
            phasors[4 * k + 2, j], phasors[4 * k + 3, j] = leap.real, leap.imag
            z *= q
            q *= p
            leap *= longer


@njit(cache=True, nogil=True)
def _neighbours(tones: Array, pairs: IndexArray) -> tuple[int, int]:
    """Pairs of tones that disturb each other, each with itself too, and the number of tones that the constant disturbs.

    Those tones are listed in the last row of ``pairs``.
    """
    n = tones.shape[0]
    count, low = 0, 0
    for a in range(n):
        wide = FAR * math.pi + 2.0 * abs(tones[a, 4])
        if abs(tones[a, 3]) < wide:
            pairs[2, low] = a
            low += 1
        for b in range(a + 1):
            if abs(tones[a, 3] - tones[b, 3]) < wide + 2.0 * abs(tones[b, 4]):
                pairs[0, count], pairs[1, count] = a, b
                count += 1
    return count, low


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _product(one: Array, other: Array, count: int) -> float:
    total = 0.0
    for j in range(count):
        total += one[j] * other[j]
    return total


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _sum(one: Array, count: int) -> float:
    total = 0.0
    for j in range(count):
        total += one[j]
    return total


@njit(cache=True, nogil=True, fastmath={"contract"})
def _begin_chunk(y: Array, constant: float, left: Array, there: Array) -> None:
    """The samples of a chunk without the constant, zero where one is missing."""
    for j in range(y.size):
        known = not math.isnan(y[j])
        there[j] = 1.0 if known else 0.0
        left[j] = y[j] - constant if known else 0.0


@njit(cache=True, nogil=True, fastmath={"contract"})
def _take_tone(tone: Array, phasors: Array, there: Array, signal: Array, turned: Array, left: Array) -> None:
    """Take a tone from what is left of a chunk; its signal, and that a quarter of a period on."""
    real, imag = phasors[0], phasors[1]
    cosine, sine = tone[0], tone[1]
    for j in range(left.size):
        signal[j] = there[j] * (cosine * real[j] + sine * imag[j])
    for j in range(left.size):
        turned[j] = there[j] * (sine * real[j] - cosine * imag[j])
    for j in range(left.size):
        left[j] -= signal[j]


@njit(cache=True, nogil=True, fastmath={"contract"})
def _sensitivities(phasors: Array, there: Array, signal: Array, turned: Array, u: Array, rows: Array) -> None:
    """Derivatives of a tone with respect to its numbers."""
    of_cosine, of_sine, of_growth, of_turn, of_bend = rows[0], rows[1], rows[2], rows[3], rows[4]
    count = signal.size
    for j in range(count):
        of_cosine[j] = there[j] * phasors[0, j]
    for j in range(count):
        of_sine[j] = there[j] * phasors[1, j]
    for j in range(count):
        of_growth[j] = u[j] * signal[j]
    for j in range(count):
        of_turn[j] = u[j] * turned[j]
    for j in range(count):
        of_bend[j] = u[j] * of_turn[j]


@njit(cache=True, nogil=True, fastmath={"contract"})
def _turn(phasors: Array, further: complex, scratch: Array) -> None:
    """Phasors of the next chunk."""
    real, imag, leap_real, leap_imag = phasors[0], phasors[1], phasors[2], phasors[3]
    for j in range(scratch.size):
        scratch[j] = real[j] * leap_real[j] - imag[j] * leap_imag[j]
    for j in range(scratch.size):
        imag[j] = real[j] * leap_imag[j] + imag[j] * leap_real[j]
    for j in range(scratch.size):
        real[j] = scratch[j]
    for j in range(scratch.size):
        scratch[j] = leap_real[j] * further.real - leap_imag[j] * further.imag
    for j in range(scratch.size):
        leap_imag[j] = leap_real[j] * further.imag + leap_imag[j] * further.real
    for j in range(scratch.size):
        leap_real[j] = scratch[j]


@njit(cache=True, nogil=True)
def _advance(values: Array, by: float) -> None:
    for j in range(values.size):
        values[j] += by


@njit(cache=True, nogil=True)
def make_equations(y: Array, tones: Array, constant: float, work: Work, place: int) -> float:
    """``sum psi psi'`` and ``sum psi r`` of all numbers, what is left, and its sum of squares.

    Products of tones that are far from each other are left out: they vary so fast that their sums are nearly nothing.
    """
    gram, right, rows, pairs = work.gram[place], work.right[place], work.sensitivities, work.pairs
    length, n = y.size, tones.shape[0]
    last = NUMBERS * n
    further = np.empty(n, np.complex128)
    _first_phasors(tones, length, work.phasors, further)
    count, low = _neighbours(tones, pairs)
    gram[: last + 1, : last + 1] = 0.0
    right[: last + 1] = 0.0
    total = 0.0
    chunk = work.rows.shape[1]
    u = work.rows[3]
    for j in range(chunk):
        u[j] = 2.0 * j / (length - 1) - 1.0
    for first in range(0, length, chunk):
        here = min(chunk, length - first)
        there, signal, turned = work.rows[0, :here], work.rows[1, :here], work.rows[2, :here]
        left = work.left[place, first : first + here]
        _begin_chunk(y[first : first + here], constant, left, there)
        for k in range(n):
            phasors = work.phasors[4 * k : 4 * k + 4]
            _take_tone(tones[k], phasors, there, signal, turned, left)
            _sensitivities(phasors, there, signal, turned, u, rows[NUMBERS * k : NUMBERS * k + NUMBERS])
            if first + chunk < length:
                _turn(phasors, further[k], work.rows[1])
        total += _product(left, left, here)
        _advance(u, 2.0 * chunk / (length - 1))
        gram[last, last] += _sum(there, here)
        right[last] += _sum(left, here)
        for a in range(last):
            right[a] += _product(rows[a], left, here)
        for j in range(low):
            for a in range(NUMBERS * pairs[2, j], NUMBERS * pairs[2, j] + NUMBERS):
                gram[last, a] += _sum(rows[a], here)
        for j in range(count):
            one, two = NUMBERS * pairs[0, j], NUMBERS * pairs[1, j]
            for a in range(one, one + NUMBERS):
                for b in range(two, a + 1 if one == two else two + NUMBERS):
                    gram[a, b] += _product(rows[a], rows[b], here)
    work.cost[place] = total
    return total
