"""Partial fractions over simple poles, and how much rounding they amplify."""

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray

#: Partial fractions are used while they amplify rounding by less than this; beyond, poles count as repeated.
MODAL_CONDITION_LIMIT = 1e4


@njit(cache=True, nogil=True)
def pole_slopes(roots: ComplexArray) -> tuple[bool, ComplexArray, ComplexArray]:
    """``A'`` and ``A''/A'`` of the monic A at its roots, conjugates side by side; whether they can be divided by."""
    n = roots.size
    slopes, curvatures = np.zeros(n, np.complex128), np.zeros(n, np.complex128)
    for i in range(n):
        if roots[i].imag < 0.0:
            slopes[i], curvatures[i] = np.conj(slopes[i - 1]), np.conj(curvatures[i - 1])
            continue
        slope = 1.0 + 0.0j  # A'(pole), as a product: exact where the polynomial form would cancel
        curvature = 0.0j  # A''/A' = 2 sum 1/(pole - other)
        for j in range(n):
            if j != i:
                slope *= roots[i] - roots[j]
                if roots[j] != roots[i]:
                    curvature += 2.0 / (roots[i] - roots[j])
        slopes[i], curvatures[i] = slope, curvature
        # A pole at the origin has no bandwidth; a slope that is 0, or underflows when squared, belongs to a double one.
        if slope * slope == 0.0 or roots[i] == 0.0:
            return False, slopes, curvatures
    return True, slopes, curvatures


@njit(cache=True, nogil=True)
def modal_condition(roots: ComplexArray, slopes: ComplexArray, curvatures: ComplexArray) -> float:
    """How much the partial fractions of ``p^k/A^2`` amplify rounding, against the peak gain of each."""
    n = roots.size
    worst = 0.0
    # Rounding matters against the largest gain, which lies near the frequency of some pole, or at zero.
    for k in range(n):
        peak, spread = 0.0, 0.0
        for at in range(n + 1):
            s = 1j * (abs(roots[at - 1]) if at > 0 else 0.0)
            exact, total = 1.0, 0.0
            for i in range(n):
                distance = s - roots[i]
                exact /= abs(distance) ** 2
                power = roots[i] ** k
                lower = k * roots[i] ** (k - 1) if k > 0 else 0.0j
                square = slopes[i] * slopes[i]
                # p^k/A^2 near a double pole of A^2: one term for 1/(s - p)^2, one for 1/(s - p).
                total += abs(power / (square * distance * distance))
                total += abs((lower - power * curvatures[i]) / (square * distance))
            peak = max(peak, exact * abs(s) ** k if k > 0 else exact)
            spread = max(spread, total)
        if not peak > 0.0:
            return np.inf
        worst = max(worst, spread / peak)
    return worst


@njit(cache=True, nogil=True, forceinline=True)
def add_mode(mapping: Array, row: int, column: int, paired: bool, weight: complex) -> None:
    """Add ``Re(weight z)`` of a mode, twice for a pair, to a row of a map."""
    if paired:
        mapping[row, column] += 2.0 * weight.real
        mapping[row, column + 1] -= 2.0 * weight.imag
    else:
        mapping[row, column] += weight.real
