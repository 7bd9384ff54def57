"""Sums of decaying chirps fitted to many windows of a signal at once: nonlinear least squares, compiled."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ctid_cli.arrays import Array, BoolArray, IndexArray
from ctid_cli.frequency.moments import factorise, substitute

#: Numbers of a tone: cosine and sine amplitude, and over half a window logarithmic growth, phase, curvature of phase.
NUMBERS = 5
#: Of them only so many are free in the first steps: what curves is fitted when what turns is nearly right.
STRAIGHT = 4
#: Largest logarithmic growth over half a window, and phase bent over half a window [rad].
MOST_GROWTH = 4.0
MOST_BEND = 1e4
#: Iterations at most; stop when the step would lower the sum of squares by less than this share of one sample's, or
#: change no phase by more than this [rad] and no amplitude by more than this share.
ITERATIONS = 30
SMALL = 1e-3
SMALLEST = 1e-9
#: Longest step of a phase over half a window [rad].
MOST_TURNED = 2.0
#: Marquardt's damping, in units of the diagonal: at first, its factors, and where it gives up.
DAMPING = 1e-4
RAISED = 10.0
LOWERED = 0.1
MOST_DAMPING = 1e6
#: Tones that are so many bins apart do not disturb each other's steps.
FAR = 8.0
#: Added to the diagonal before a covariance is found, as a share of it.
RIDGE = 1e-13


class Windows(NamedTuple):
    """Windows of one length, and the tones that are fitted in each."""

    #: First sample of each window, shape (R,).
    first: IndexArray
    #: Number of tones in each window, shape (R,).
    used: IndexArray
    #: Numbers of the tones, shape (R, n, 5).
    numbers: Array
    #: Inverse of the scaled normal matrix, tones first and the constant last, shape (R, 5 n + 1, 5 n + 1).
    inverse: Array
    #: Whether the iteration ended at a minimum, shape (R,).
    converged: BoolArray


def windows_at(first: IndexArray, most_tones: int) -> Windows:
    """Windows without a tone yet."""
    rows, size = first.size, NUMBERS * most_tones + 1
    return Windows(
        first=np.ascontiguousarray(first, dtype=np.int64),
        used=np.zeros(rows, np.int64),
        numbers=np.zeros((rows, most_tones, NUMBERS)),
        inverse=np.zeros((rows, size, size)),
        converged=np.zeros(rows, np.bool_),
    )


@njit(cache=True, nogil=True)
def _starts(
    tones: Array, length: int, z: NDArray[np.complex128], q: NDArray[np.complex128], p: NDArray[np.complex128]
) -> None:
    """Phasor of each tone at the first sample, its factor from there to the next, and the factor of that factor."""
    du = 2.0 / (length - 1)
    for k in range(tones.shape[0]):
        growth, turn, bend = tones[k, 2], tones[k, 3], tones[k, 4]
        z[k] = np.exp(complex(-growth, -turn + bend))
        # phi(u + du) - phi(u) = turn du + bend (2 u du + du^2), at u = -1
        q[k] = np.exp(complex(growth * du, turn * du + bend * (du * du - 2.0 * du)))
        p[k] = np.exp(complex(0.0, 2.0 * bend * du * du))


@njit(cache=True, nogil=True)
def _left_over(y: Array, tones: Array, constant: float, out: Array) -> float:
    """What the tones leave of a window; its sum of squares."""
    length, n = y.size, tones.shape[0]
    z, q, p = np.empty(n, np.complex128), np.empty(n, np.complex128), np.empty(n, np.complex128)
    _starts(tones, length, z, q, p)
    total = 0.0
    for i in range(length):
        r = y[i] - constant
        for k in range(n):
            r -= tones[k, 0] * z[k].real + tones[k, 1] * z[k].imag
            z[k] *= q[k]
            q[k] *= p[k]
        out[i] = r
        if not math.isnan(r):
            total += r * r
    return total


@njit(cache=True, nogil=True)
def _neighbours(tones: Array, free: int, pairs: IndexArray) -> tuple[int, int]:
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


@njit(cache=True, nogil=True)
def _normal_equations(y: Array, tones: Array, constant: float, free: int, work: Array, pairs: IndexArray) -> float:
    """``sum psi psi'`` and ``sum psi r`` of the free numbers, and the sum of squares of what is left.

    Products of tones that are far from each other are left out: they vary so fast that their sums are nearly nothing.
    """
    gram, right, rows = work[0], work[2, 0], work[3]
    length, n = y.size, tones.shape[0]
    size = free * n + 1
    last = size - 1
    count, low = _neighbours(tones, free, pairs)
    z, q, p = np.empty(n, np.complex128), np.empty(n, np.complex128), np.empty(n, np.complex128)
    _starts(tones, length, z, q, p)
    gram[:size, :size] = 0.0
    right[:size] = 0.0
    total = 0.0
    step = 2.0 / (length - 1)
    for i in range(length):
        u = step * i - 1.0
        r = y[i] - constant
        for k in range(n):
            real, imag = z[k].real, z[k].imag
            s = tones[k, 0] * real + tones[k, 1] * imag
            turned = tones[k, 1] * real - tones[k, 0] * imag
            r -= s
            row = rows[k]
            row[0] = real
            row[1] = imag
            if free >= STRAIGHT:
                row[2] = u * s
                row[3] = u * turned
            if free == NUMBERS:
                row[4] = u * u * turned
            z[k] *= q[k]
            q[k] *= p[k]
        if math.isnan(r):
            continue
        total += r * r
        gram[last, last] += 1.0
        right[last] += r
        for k in range(n):
            for a in range(free):
                right[free * k + a] += rows[k, a] * r
        for j in range(low):
            k = pairs[2, j]
            for a in range(free):
                gram[last, free * k + a] += rows[k, a]
        for j in range(count):
            one, two = pairs[0, j], pairs[1, j]
            for a in range(free):
                value = rows[one, a]
                for b in range(a + 1 if one == two else free):
                    gram[free * one + a, free * two + b] += value * rows[two, b]
    return total


@njit(cache=True, nogil=True)
def _solve(factor: Array, scales: Array, right: Array, step: Array) -> None:
    """Solve the scaled normal equations whose factor is known."""
    for a in range(scales.size):
        step[a] = right[a] / scales[a]
    substitute(factor, step[: scales.size])
    for a in range(scales.size):
        step[a] /= scales[a]


@njit(cache=True, nogil=True)
def _iterate(
    y: Array, tones: Array, constant: float, free: int, most: int, work: Array, pairs: IndexArray, residual: Array
) -> tuple[float, bool]:
    """Levenberg-Marquardt steps; the constant and whether they ended at a minimum. ``tones`` is changed in place."""
    n = tones.shape[0]
    size = free * n + 1
    gram, factor = work[0], work[1]
    right, scales, step = work[2, 0], work[2, 1, :size], work[2, 2]
    trial = np.empty_like(tones)
    damping = DAMPING
    cost = _normal_equations(y, tones, constant, free, work, pairs)
    for _ in range(most):
        while True:
            if damping > MOST_DAMPING:
                return constant, True
            if factorise(gram, damping, factor, scales):
                _solve(factor, scales, right, step)
                largest, turned = 0.0, 0.0
                for k in range(n):
                    for j in range(NUMBERS):
                        trial[k, j] = tones[k, j] + (step[free * k + j] if j < free else 0.0)
                    trial[k, 2] = min(max(trial[k, 2], -MOST_GROWTH), MOST_GROWTH)
                    trial[k, 4] = min(max(trial[k, 4], -MOST_BEND), MOST_BEND)
                    height = math.hypot(tones[k, 0], tones[k, 1]) + 1e-300
                    for j in range(free):
                        moved = abs(trial[k, j] - tones[k, j])
                        largest = max(largest, moved / height if j < 2 else moved)
                        turned = max(turned, 0.0 if j < 2 else moved)
                level = constant + step[size - 1]
                gain = 0.0
                for a in range(size):
                    gain += step[a] * right[a]
                # So small a share of the standard errors matters to nobody, nor does rounding.
                if gain <= SMALL * cost / gram[size - 1, size - 1] or largest <= SMALLEST:
                    return constant, True
                # A longer step may land on any of the minima.
                if turned < MOST_TURNED:
                    reached = _left_over(y, trial, level, residual)
                    if reached <= cost:
                        tones[:] = trial
                        constant = level
                        damping = max(damping * LOWERED, 1e-12)
                        break
            damping *= RAISED
        cost = _normal_equations(y, tones, constant, free, work, pairs)
    return constant, False


@njit(cache=True, nogil=True)
def fit_windows(samples: Array, length: int, windows: Windows, chosen: IndexArray, residuals: Array) -> None:
    """Fit the tones of some windows, beginning with the numbers that they have; what is left goes to ``residuals``."""
    most = windows.numbers.shape[1]
    full = NUMBERS * most + 1
    work = np.empty((4, max(full, NUMBERS), max(full, NUMBERS)))
    pairs = np.empty((3, most * (most + 1) // 2 + 1), np.int64)
    residual = np.empty(length)
    for row in chosen:
        y = samples[windows.first[row] : windows.first[row] + length]
        n = windows.used[row]
        tones = windows.numbers[row, :n]
        constant = 0.0
        there = 0
        for value in y:
            if not math.isnan(value):
                constant += value
                there += 1
        constant = constant / there if there else 0.0
        if there <= NUMBERS * n + 1:
            windows.converged[row] = False
            residuals[row] = np.nan
            continue
        constant, done = _iterate(y, tones, constant, 2, 1, work, pairs, residual)
        constant, done = _iterate(y, tones, constant, STRAIGHT, 4, work, pairs, residual)
        constant, done = _iterate(y, tones, constant, NUMBERS, ITERATIONS, work, pairs, residual)
        windows.converged[row] = done
        size = NUMBERS * n + 1
        _normal_equations(y, tones, constant, NUMBERS, work, pairs)
        _left_over(y, tones, constant, residuals[row])
        scales = work[2, 1, :size]
        if factorise(work[0], RIDGE, work[1], scales):
            for a in range(size):
                work[2, 0, :size] = 0.0
                work[2, 0, a] = 1.0
                _solve(work[1], scales, work[2, 0], work[2, 2])
                windows.inverse[row, a, :size] = work[2, 2, :size]
        else:
            windows.inverse[row, :size, :size] = np.nan
