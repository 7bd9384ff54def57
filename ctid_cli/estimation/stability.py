"""Stability of polynomials, and the reflection of unstable ones."""

import numpy as np
from numba import njit

from ctid_cli.arrays import Array
from ctid_cli.filtering.realisation import scaled_roots

#: A root on the axis is moved off it by this fraction of the largest root: filters need strict stability.
OFF_THE_AXIS = 1e-6


@njit(cache=True, nogil=True)
def is_hurwitz(a: Array) -> bool:
    """Whether every root of a monic polynomial lies in the open left half-plane (Routh's criterion)."""
    n = a.size - 1
    # All coefficients positive: necessary, for n <= 2 sufficient too; refuses NaN as well.
    for k in range(n + 1):
        if not a[k] > 0.0:
            return False
    if n <= 2:
        return True
    # The first two rows of Routh's array hold the even and the odd coefficients.
    upper = np.zeros(n // 2 + 2)
    lower = np.zeros(n // 2 + 2)
    for k in range(n + 1):
        if k % 2 == 0:
            upper[k // 2] = a[k]
        else:
            lower[k // 2] = a[k]
    # Each new row replaces the older of its two predecessors; a first column of one sign means no unstable root.
    for _ in range(n - 1):
        ratio = upper[0] / lower[0]
        for k in range(n // 2 + 1):
            upper[k] = upper[k + 1] - ratio * lower[k + 1]
        upper, lower = lower, upper
        if not lower[0] > 0.0:
            return False
    return True


@njit(cache=True, nogil=True)
def reflect_unstable(a: Array) -> Array:
    """A monic polynomial with its right-half-plane roots mirrored into the left half-plane."""
    if is_hurwitz(a):
        return a
    n = a.size - 1
    # In the polynomial's own unit of time, where its coefficients neither overflow nor vanish.
    w0, roots = scaled_roots(a)
    largest = np.abs(roots).max()
    least = OFF_THE_AXIS * (largest if largest > 0.0 else 1.0)
    # Multiplied out root by root; the imaginary parts cancel but for rounding.
    expanded = np.zeros(n + 1, np.complex128)
    expanded[0] = 1.0
    for i in range(n):
        root = complex(-max(abs(roots[i].real), least), roots[i].imag)
        for k in range(i + 1, 0, -1):
            expanded[k] -= root * expanded[k - 1]
    mirrored = np.ones(n + 1)
    for i in range(1, n + 1):
        mirrored[i] = expanded[i].real * w0**i
    return mirrored


@njit(cache=True, nogil=True)
def with_stable_denominator(theta: Array, poles: int) -> Array:
    """A parameter vector with the denominator at its head reflected if it is unstable."""
    if not np.isfinite(theta).all():
        return theta
    a = np.ones(poles + 1)
    a[1:] = theta[:poles]
    if is_hurwitz(a):
        return theta
    stable = theta.copy()
    stable[:poles] = reflect_unstable(a)[1:]
    return stable
