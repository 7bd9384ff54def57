"""Compiled recursions of dynamic regressor extension and mixing (DREM)."""

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, IntArray


@njit(cache=True, nogil=True)
def gradient_steps(mixed: Array, gains: Array, initial: Array, finite_time: bool, steps: Array, theta: Array) -> None:
    """Solve ``theta_k' = gamma_k Delta (Psi_k - Delta theta_k)`` exactly over intervals with constant Delta and Psi.

    ``theta = z + (1 - q) theta(0)``, with z and q in ``steps``; the finite-time estimate is ``z/q``. Rows with NaN are
    ignored.
    """
    z, q = steps
    for k in range(len(mixed)):
        delta = mixed[k, -1]
        for i in range(gains.size):
            if np.isfinite(delta):
                # m = 1 - exp(-x), the share of the new row; gain = gamma m/x without 0/0 for zero Delta.
                x = gains[i] * delta * delta
                m = -np.expm1(-x)
                gain = gains[i] * (m / x if x > 1e-8 else 1.0 - 0.5 * x)
                z[i] += gain * delta * mixed[k, i] - m * z[i]
                q[i] += m * (1.0 - q[i])
            theta[k, i] = z[i] / q[i] if finite_time and q[i] > 0.0 else z[i] + (1.0 - q[i]) * initial[i]


@njit(cache=True, nogil=True)
def slide(entries: Array, window: Array, newer: Array, place: IntArray, sums: Array) -> None:
    """Sum entries over a sliding window.

    A block of old entries is summed backwards once, and the newer ones forwards, without subtractions, so that rounding
    errors do not outlast the entries. ``window`` contains single entries before ``place`` and, from there on, sums of
    each entry with all following ones.
    """
    last = len(window) - 1
    for k in range(len(entries)):
        # Element by element: array arithmetic would add seconds of compilation, for an error message of Numba.
        for i in range(newer.size):
            window[place[0], i] = entries[k, i]
            newer[i] += entries[k, i]
            sums[k, i] = newer[i]
            if place[0] < last:
                # The next place contains the sum of all older entries in the window.
                sums[k, i] += window[place[0] + 1, i]
        if place[0] < last:
            place[0] += 1
            continue
        for j in range(last - 1, -1, -1):
            for i in range(newer.size):
                window[j, i] += window[j + 1, i]
        newer[:] = 0.0
        place[0] = 0
