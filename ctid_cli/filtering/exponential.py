"""Exact one-step maps of a linear system under a held input."""

from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array


class HeldStep(NamedTuple):
    """``z+ = F z + g v + h (change of v)``: a linear system over one step with v constant or linear."""

    #: F, shape (n, n).
    transition: Array
    #: g and h, shape (n,).
    from_value: Array
    from_change: Array


@njit(cache=True, nogil=True)
def place(target: Array, row: int, column: int, source: Array) -> None:
    """Copy a small matrix into a larger one. (Slice assignment costs seconds of compilation in every kernel.)"""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[row + i, column + j] = source[i, j]


@njit(cache=True, nogil=True)
def multiply(left: Array, right: Array, out: Array) -> None:
    """``out = left @ right`` for small matrices, without the call into BLAS."""
    n = left.shape[0]
    for i in range(n):
        for j in range(n):
            out[i, j] = 0.0
        for k in range(n):
            scale = left[i, k]
            if scale != 0.0:
                for j in range(n):
                    out[i, j] += scale * right[k, j]


@njit(cache=True, nogil=True)
def row_norm(matrix: Array) -> float:
    """Largest sum of magnitudes in a row."""
    norm = 0.0
    for i in range(matrix.shape[0]):
        total = 0.0
        for j in range(matrix.shape[1]):
            total += abs(matrix[i, j])
        norm = max(norm, total)
    return norm


@njit(cache=True, nogil=True)
def exponential_minus_identity(matrix: Array) -> Array:
    r"""``exp(M) - I`` of a small matrix.

    Scaling and squaring on ``X = exp(M/2^s) - I`` by ``X <- 2 X + X X``. Squaring X instead of I + X keeps the
    relative accuracy of slow modes when a fast one forces many squarings (poles spread over six decades).
    """
    n = matrix.shape[0]
    norm = row_norm(matrix)
    squarings = 0
    while norm > 0.25 and squarings < 200:
        norm *= 0.5
        squarings += 1
    scaled = matrix * 0.5**squarings
    # Taylor polynomial of degree 12, Horner form: the remainder is below 1e-17 at norm 1/4.
    result = scaled / 12.0
    work = np.empty((n, n))
    for degree in range(11, 0, -1):
        multiply(scaled, result, work)
        for i in range(n):
            for j in range(n):
                result[i, j] = (scaled[i, j] + work[i, j]) / degree
    # (I + X)^2 - I = 2 X + X X.
    for _ in range(squarings):
        multiply(result, result, work)
        for i in range(n):
            for j in range(n):
                result[i, j] = 2.0 * result[i, j] + work[i, j]
    return result


@njit(cache=True, nogil=True)
def held_step(dynamics: Array, gain: Array, step: float) -> HeldStep:
    """Exact map of ``z' = F z + g v`` over one step."""
    n = gain.size
    # v and its change over the step are two further states: the exponential holds the integrals over both.
    augmented = np.zeros((n + 2, n + 2))
    for i in range(n):
        for j in range(n):
            augmented[i, j] = dynamics[i, j] * step
        augmented[i, n] = gain[i] * step
    augmented[n, n + 1] = 1.0
    result = exponential_minus_identity(augmented)
    transition = result[:n, :n].copy()
    for i in range(n):
        transition[i, i] += 1.0
    return HeldStep(transition, result[:n, n].copy(), result[:n, n + 1].copy())


@njit(cache=True, nogil=True)
def held_readout(dynamics: Array, gain: Array, interval: float, fraction: float) -> Array:
    """States a fraction of an interval after a break, from ``[z, v, change of v]``, v's change over the interval."""
    n = gain.size
    readout = np.eye(n, n + 2)
    if fraction > 0.0:
        part = held_step(dynamics, gain, fraction * interval)
        place(readout, 0, 0, part.transition)
        for i in range(n):
            readout[i, n] = part.from_value[i]
            readout[i, n + 1] = part.from_change[i] * fraction
    return readout
