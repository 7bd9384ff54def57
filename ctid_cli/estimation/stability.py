"""Stability of polynomials, and the reflection of unstable ones."""

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.filtering.realisation import scaled_roots

#: A root on the axis is moved off it by this fraction of the largest root: filters need strict stability.
OFF_THE_AXIS = 1e-6


def is_hurwitz(a: Array) -> bool:
    """Return whether every root of a monic polynomial lies in the open left half-plane (Routh's criterion)."""
    coefficients = a.tolist()
    # All coefficients positive: necessary, for n <= 2 sufficient too; refuses NaN as well.
    if not all(c > 0.0 for c in coefficients):
        return False
    # The first two rows of Routh's array hold the even and the odd coefficients.
    upper, lower = coefficients[0::2], coefficients[1::2]
    # Each new row replaces the older of its two predecessors; a first column of one sign means no unstable root.
    while len(lower) > 0 and len(upper) > 1:
        ratio = upper[0] / lower[0]
        padded = [*lower, 0.0]
        upper, lower = lower, [upper[k] - ratio * padded[k] for k in range(1, len(upper))]
        if not lower[0] > 0.0:
            return False
    return True


def reflect_unstable(a: Array) -> Array:
    """Return a monic polynomial with its right-half-plane roots mirrored into the left half-plane."""
    if is_hurwitz(a):
        return a
    # In the polynomial's own unit of time, where its coefficients neither overflow nor vanish.
    w0, roots = scaled_roots(a)
    least = OFF_THE_AXIS * (float(np.abs(roots).max()) or 1.0)
    mirrored = -np.maximum(np.abs(roots.real), least) + 1j * roots.imag
    return np.asarray(np.poly(mirrored).real * w0 ** np.arange(a.size))


def with_stable_denominator(theta: Array, poles: int) -> Array:
    """Return a parameter vector with the denominator at its head reflected if it is unstable."""
    if not np.isfinite(theta).all():
        return theta
    a = np.concatenate(([1.0], theta[:poles]))
    if is_hurwitz(a):
        return theta
    stable = theta.copy()
    stable[:poles] = reflect_unstable(a)[1:]
    return stable
