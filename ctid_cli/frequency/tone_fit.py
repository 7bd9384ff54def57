"""Sums of decaying chirps fitted to many windows of a signal at once: nonlinear least squares, compiled."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, BoolArray, IndexArray
from ctid_cli.frequency.moments import factorise, substitute
from ctid_cli.frequency.tone_equations import NUMBERS, Work, make_equations, work_for

#: Numbers of a tone that do not curve: what curves is fitted when what turns is nearly right.
STRAIGHT = 4
#: Largest logarithmic growth over half a window, and phase bent over half a window [rad].
MOST_GROWTH = 4.0
MOST_BEND = 1e4
#: How many numbers of each tone are free, and how many steps are taken at most, one stage after the other.
STAGES = ((2, 1), (STRAIGHT, 4), (NUMBERS, 30))
#: A stage ends when the step would lower the sum of squares by less than this share of one sample's, or change no phase
#: by more than this [rad] and no amplitude by more than this share.
SMALL = 1e-3
SMALLEST = 1e-9
#: Longest step of a phase over half a window [rad].
MOST_TURNED = 2.0
#: Marquardt's damping, in units of the diagonal: at first, its factors, and where it gives up.
DAMPING = 1e-4
RAISED = 10.0
LOWERED = 0.1
MOST_DAMPING = 1e6
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
    #: Variances of the numbers in units of the noise: the diagonal of the inverse normal matrix, shape (R, n, 5).
    variances: Array
    #: Whether the iteration ended at a minimum, shape (R,).
    converged: BoolArray


def windows_at(first: IndexArray, most_tones: int) -> Windows:
    """Windows without a tone yet."""
    rows = first.size
    return Windows(
        first=np.ascontiguousarray(first, dtype=np.int64),
        used=np.zeros(rows, np.int64),
        numbers=np.zeros((rows, most_tones, NUMBERS)),
        variances=np.zeros((rows, most_tones, NUMBERS)),
        converged=np.zeros(rows, np.bool_),
    )


@njit(cache=True, nogil=True)
def _solve(factor: Array, scales: Array, right: Array, step: Array) -> None:
    """Solve the scaled normal equations whose factor is known."""
    for a in range(scales.size):
        step[a] = right[a] / scales[a]
    substitute(factor, step[: scales.size])
    for a in range(scales.size):
        step[a] /= scales[a]


@njit(cache=True, nogil=True)
def _pack(work: Work, tones: int, free: int) -> None:
    """Choose the equations of the first numbers of each tone, and of the constant."""
    size, place = free * tones + 1, work.now[0]
    right = work.vectors[0]
    for a in range(size):
        from_a = NUMBERS * (a // free) + a % free if a < size - 1 else NUMBERS * tones
        right[a] = work.right[place, from_a]
        for b in range(a + 1):
            from_b = NUMBERS * (b // free) + b % free if b < size - 1 else NUMBERS * tones
            work.packed[a, b] = work.gram[place, from_a, from_b]


@njit(cache=True, nogil=True)
def _iterate(y: Array, tones: Array, constant: float, free: int, most: int, work: Work) -> tuple[float, bool]:
    """Levenberg-Marquardt steps; the constant and whether they ended at a minimum. ``tones`` is changed in place.

    The equations of the first numbers are known, and those of the last ones are when it is done.
    """
    n = tones.shape[0]
    size = free * n + 1
    right, step, scales = work.vectors[0], work.vectors[1], work.vectors[2, :size]
    trial = np.empty_like(tones)
    damping = DAMPING
    for _ in range(most):
        _pack(work, n, free)
        cost = work.cost[work.now[0]]
        while True:
            if damping > MOST_DAMPING:
                return constant, True
            if factorise(work.packed, damping, work.factor, scales):
                _solve(work.factor, scales, right, step)
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
                if gain <= SMALL * cost / work.packed[size - 1, size - 1] or largest <= SMALLEST:
                    return constant, True
                # A longer step may land on any of the minima. Nearly every step is taken: its equations are the next.
                if turned < MOST_TURNED and make_equations(y, trial, level, work, 1 - work.now[0]) <= cost:
                    for k in range(n):
                        for j in range(NUMBERS):
                            tones[k, j] = trial[k, j]
                    constant = level
                    work.now[0] = 1 - work.now[0]
                    damping = max(damping * LOWERED, 1e-12)
                    break
            damping *= RAISED
    return constant, False


@njit(cache=True, nogil=True)
def fit_windows(samples: Array, length: int, windows: Windows, chosen: IndexArray, residuals: Array) -> None:
    """Fit the tones of some windows, beginning with the numbers that they have; what is left goes to ``residuals``."""
    work = work_for(windows.numbers.shape[1], length)
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
        make_equations(y, tones, constant, work, work.now[0])
        for free, most in STAGES:
            constant, windows.converged[row] = _iterate(y, tones, constant, free, most, work)
        for i in range(length):
            residuals[row, i] = np.nan if math.isnan(y[i]) else work.left[work.now[0], i]
        _pack(work, n, NUMBERS)
        _variances(work, NUMBERS * n + 1, windows.variances[row])


@njit(cache=True, nogil=True)
def _variances(work: Work, size: int, variances: Array) -> None:
    """Diagonal of the inverse of the equations: squares of the columns of the inverse of their factor."""
    scales, column = work.vectors[2, :size], work.vectors[1]
    known = factorise(work.packed, RIDGE, work.factor, scales)
    for a in range(size - 1):
        total = 0.0
        for i in range(a, size if known else a):
            value = 1.0 if i == a else 0.0
            for k in range(a, i):
                value -= work.factor[i, k] * column[k]
            column[i] = value / work.factor[i, i]
            total += column[i] * column[i]
        variances[a // NUMBERS, a % NUMBERS] = total / (scales[a] * scales[a]) if known else np.nan
