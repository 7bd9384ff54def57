"""Lines at equal distances that one tone makes whose frequency or amplitude swings."""

import math

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, BoolArray, IndexArray

#: So many lines at equal distances may be one tone that is modulated; where lines are missing between them, so many if
#: no two are farther apart than so many distances, or so many wherever they are.
COMB = 3
SPARSE_COMB = 5
MOST_APART = 4
SPARSEST_COMB = 8
#: Distances are equal if they differ by no more than this share, or so many standard errors.
UNEQUAL = 0.05
EQUAL_ERRORS = 5.0
#: Lines so many distances beside a comb belong to it.
BESIDE = 3.0
#: Lines are taken to be this far apart at least [rad/sample]: a distance is divided by.
NO_GAP = 1e-12
#: What should be covered by 3 errors is divided by 3.
COVERED = 3.0


@njit(cache=True, nogil=True)
def find_combs(omega: Array, order: IndexArray, error: Array, gap: Array, low: Array, high: Array) -> None:
    """Distances and bands of the combs of all windows, shape (R, n); lines that something disturbs are lines too.

    Amplitude or frequency that changes periodically makes lines at equal distances, each of them as steady as a tone.
    ``order`` sorts the frequencies of each window.
    """
    gaps = np.empty(omega.shape[1])
    for row in range(omega.shape[0]):
        lines = order[row]
        count = 0
        while count < lines.size and not math.isnan(error[row, lines[count]]):
            count += 1
        for k in range(count - 1):
            gaps[k] = max(omega[row, lines[k + 1]] - omega[row, lines[k]], NO_GAP)
        begin = 0
        while begin < count - COMB + 1:
            # Lines from `begin` to `end` are at equal distances, or at multiples of one: the nearest, or the smallest.
            base = min(gaps[begin], gaps[begin + 1])
            end = _end(gaps, error[row], lines, begin, count, base)
            least = gaps[: count - 1].min()
            other = _end(gaps, error[row], lines, begin, count, least)
            if other > end:
                base, end = least, other
            if end > begin:
                first, last = omega[row, lines[begin]] - BESIDE * base, omega[row, lines[end]] + BESIDE * base
                for k in lines[:count]:
                    if first < omega[row, k] < last:
                        gap[row, k], low[row, k], high[row, k] = base, first, last
            begin = max(end, begin + 1)


@njit(cache=True, nogil=True)
def _end(gaps: Array, error: Array, lines: IndexArray, begin: int, count: int, base: float) -> int:
    """Last line of the comb that begins with a line; that line if there is none."""
    end, found, largest = begin, begin, 0
    while end < count - 1:
        times = round(gaps[end] / base)
        sure = math.hypot(error[lines[end]], error[lines[end + 1]])
        if abs(gaps[end] - times * base) > max(EQUAL_ERRORS * sure, UNEQUAL * base):
            break
        largest = max(largest, times)
        end += 1
        needed = COMB if largest == 1 else SPARSE_COMB if largest <= MOST_APART else SPARSEST_COMB
        if end - begin + 1 >= needed:
            found = end
    return found


@njit(cache=True, nogil=True)
def refute(
    omega: Array,
    error: Array,
    window: IndexArray,
    gap: Array,
    low: Array,
    high: Array,
    bounds: IndexArray,
    refuted: BoolArray,
) -> None:
    """Mark readings that are lines of a comb where a shorter window shows one tone that is elsewhere."""
    for row in range(bounds.size - 1):
        for k in range(bounds[row], bounds[row + 1]):
            best = -1
            for j in range(bounds[row], bounds[row + 1]):
                shorter = window[j] < window[k] and window[j] * gap[k] < 2.0 * math.pi
                if shorter and low[k] < omega[j] < high[k] and (best < 0 or error[j] < error[best]):
                    best = j
            refuted[k] = best >= 0 and abs(omega[k] - omega[best]) > COVERED * error[best]
