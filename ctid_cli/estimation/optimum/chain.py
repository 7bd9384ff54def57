r"""Sections in a row, fastest first: the state space that every column and every derivative is read from.

Section i has unit static gain, ``p/(s + p)`` or ``w^2/(s^2 + 2 zeta w s + w^2)``, and is driven by the output of the
section before it. The state ``s/w`` times the output stands before the output itself, so that state i of n has, over
the common denominator, a numerator of degree ``n-1-i``: the last m + 1 states span all ``B/A u`` of degree m, and no
polynomial, no root and no partial fraction is ever formed. Real poles may meet and become a pair.
"""

import numpy as np
from numba import njit

from ctid_cli.arrays import Array
from ctid_cli.filtering.exponential import place


@njit(cache=True, nogil=True)
def order_of(damping: Array) -> int:
    """Number of poles: a real pole, marked by a negative damping, has one, a pair two."""
    n = 0
    for i in range(damping.size):
        n += 1 if damping[i] < 0.0 else 2
    return n


@njit(cache=True, nogil=True)
def chain_dynamics(speed: Array, damping: Array) -> tuple[Array, Array]:
    """Dynamics F and gain g of ``z' = F z + g v``."""
    n = order_of(damping)
    F, g = np.zeros((n, n)), np.zeros(n)
    row = 0
    for i in range(speed.size):
        w = speed[i]
        entry = row  # where the section is driven
        # A pair has the states (s/w) x and x: x' = w (s/w) x, and ((s/w) x)' = -2 zeta w (s/w) x - w x + w v.
        if damping[i] < 0.0:
            F[row, row] = -w
            row += 1
        else:
            F[row, row], F[row, row + 1] = -2.0 * damping[i] * w, -w
            F[row + 1, row] = w
            row += 2
        if entry == 0:
            g[0] = w
        else:
            F[entry, entry - 1] = w
    return F, g


@njit(cache=True, nogil=True)
def driven_chain(F: Array, g: Array, output: Array, direct: float) -> tuple[Array, Array]:
    """The chain with a second one behind it, driven by ``x = output z + direct v``."""
    n = g.size
    dynamics, gain = np.zeros((2 * n, 2 * n)), np.zeros(2 * n)
    # Both have the same poles; no partial fraction needs them to be distinct.
    place(dynamics, 0, 0, F)
    place(dynamics, n, n, F)
    for i in range(n):
        gain[i] = g[i]
        gain[n + i] = g[i] * direct
        for j in range(n):
            dynamics[n + i, j] = g[i] * output[j]
    return dynamics, gain


@njit(cache=True, nogil=True)
def _times(row: Array, F: Array, constant: float, linear: float, quadratic: float) -> Array:
    """``row (constant + linear F + quadratic F^2)``: a signal read by ``row`` passed through that polynomial of s."""
    once = row @ F
    if quadratic == 0.0:
        return constant * row + linear * once
    return constant * row + linear * once + quadratic * (once @ F)


@njit(cache=True, nogil=True)
def logarithmic_slopes(speed: Array, damping: Array, F: Array) -> Array:
    """Readings of ``d ln A/d alpha_j v`` from the states of a chain driven by v, shape (n, n).

    With section j ``s^2 + 2 zeta w s + w^2``: ``(2 zeta w s + 2 w^2)/section`` for ln w and ``2 zeta w s/section`` for
    ln zeta; ``p/(s + p)`` for the ln p of a real pole.
    """
    n = F.shape[0]
    slopes = np.zeros((n, n))
    last, coordinate = -1, 0
    for j in range(speed.size):
        w, zeta = speed[j], damping[j]
        last += 1 if zeta < 0.0 else 2
        # 1/A_j v is read by one entry, A_j the product of the sections up to j. Times the numerator, and times the
        # sections before j, from the slowest: each cancels its own dynamics from the row before a faster one is met,
        # so that nothing large is ever subtracted.
        for kind in range(1 if zeta < 0.0 else 2):
            row = np.zeros(n)
            row[last] = 1.0
            if zeta >= 0.0:
                row = _times(row, F, 2.0 if kind == 0 else 0.0, 2.0 * zeta / w, 0.0)
            for i in range(j - 1, -1, -1):
                if damping[i] < 0.0:
                    row = _times(row, F, 1.0, 1.0 / speed[i], 0.0)
                else:
                    row = _times(row, F, 1.0, 2.0 * damping[i] / speed[i], 1.0 / speed[i] ** 2)
            slopes[coordinate] = row
            coordinate += 1
    return slopes


def polynomial(speed: Array, damping: Array) -> Array:
    """Monic product of the sections, descending powers."""
    product = np.ones(1)
    for w, zeta in zip(speed.tolist(), damping.tolist(), strict=True):
        product = np.convolve(product, [1.0, w] if zeta < 0 else [1.0, 2.0 * zeta * w, w * w])
    return product


def numerators(speed: Array, damping: Array) -> Array:
    """Numerators of the states over the monic polynomial, descending powers, shape (n, n)."""
    n = order_of(damping)
    result = np.zeros((n, n))
    gain, row = 1.0, 0
    for i, (w, zeta) in enumerate(zip(speed.tolist(), damping.tolist(), strict=True)):
        rest = polynomial(speed[i + 1 :], damping[i + 1 :])
        gain *= w if zeta < 0 else w * w
        if zeta >= 0:
            result[row, n - 1 - rest.size : n - 1] = gain / w * rest
            row += 1
        result[row, n - rest.size :] = gain * rest
        row += 1
    return result
