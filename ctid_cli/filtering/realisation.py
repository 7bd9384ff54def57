"""State-space realisations that are accurate for stiff and for repeated poles, and their exact steps.

A polynomial A of degree n is realised as a *chain* of first-order (real pole) and second-order (complex pair)
sections of unit static gain, fastest first. No partial fractions are formed, so repeated poles are no special case.
Each section filters the settled output of a faster one, so that cancellation does not grow with the spread of the
poles. The time unit is ``1/w0``, ``w0 = |a_n|^(1/n)``.
"""

from math import copysign, sqrt
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, ComplexArray, IntArray

#: A matrix is halved until its norm is below this, so that the remainder of its Taylor polynomial is below 1e-17.
TAYLOR_NORM = 0.25
TAYLOR_DEGREE = 12
#: Norm of the dynamics over the smallest digit of a transition: the remainder (2^-7)^7/7! of the Taylor polynomial
#: that covers the rest is below rounding.
QUANTUM_NORM = 2.0**-7


def time_scale(denominator: Array) -> float:
    """Return the characteristic frequency of a monic polynomial."""
    for k in range(denominator.size - 1, 0, -1):
        if denominator[k] != 0.0:
            return float(abs(denominator[k]) ** (1.0 / k))
    return 1.0


def scaled_roots(denominator: Array) -> tuple[float, ComplexArray]:
    """Return the characteristic frequency w0 of a monic polynomial, and its roots in the time unit 1/w0."""
    w0 = time_scale(denominator)
    return w0, polynomial_roots(denominator / w0 ** np.arange(denominator.size))


def polynomial_roots(coefficients: Array) -> ComplexArray:
    """Return the roots of a monic real polynomial; those of a pair are adjacent, the upper one first."""
    n = coefficients.size - 1
    if n == 1:
        return np.array([complex(-coefficients[1])])
    if n == 2:
        half = -0.5 * float(coefficients[1])
        discriminant = half * half - float(coefficients[2])
        if discriminant < 0.0:
            root = complex(half, sqrt(-discriminant))
            return np.array([root, root.conjugate()])
        # The larger root has no cancellation, and the product of both is the last coefficient.
        large = half + copysign(sqrt(discriminant), half)
        return np.array([large, float(coefficients[2]) / large if large else 0.0], dtype=np.complex128)
    from ctid_cli.filtering import kernels  # numba is slow to import

    companion = np.zeros((n, n))
    companion.flat[n :: n + 1] = 1.0
    companion[:1] = -coefficients[1:]
    roots = np.linalg.eigvals(companion).astype(np.complex128)
    kernels.polish_roots(coefficients, roots)
    return roots


class Chain(NamedTuple):
    """``z' = F z + g v``, in the time unit ``1/w0``, and the map from its states to ``p^k/A v``, k = 0 … n - 1."""

    dynamics: Array
    gain: Array
    powers: Array


def chain(roots: ComplexArray) -> Chain:
    """Return the chain of unit-gain sections with given poles (pairs adjacent), fastest first."""
    roots, n = roots[np.argsort(-np.abs(roots), kind="stable")], roots.size
    dynamics, gain = np.zeros((n, n)), np.zeros(n)
    i, last, static = 0, -1, 1.0
    while i < n:
        # A pair w^2/(s^2 + 2 d s + w^2): z1' = w z2, z2' = w v - w z1 - 2 d z2. A real pole r/(s + r): z' = r v - r z.
        # An integrator has no static gain to bring to 1: its rate is 1.
        rate = float(abs(roots[i])) or 1.0
        entry = i
        if roots[i].imag != 0.0:
            entry, static = i + 1, static * rate
            dynamics[i, entry], dynamics[entry, i], dynamics[entry, entry] = rate, -rate, 2.0 * roots[i].real
        else:
            dynamics[i, i] = roots[i].real
        if last < 0:
            gain[entry] = rate
        else:
            dynamics[entry, last] = rate
        i, last, static = entry + 1, i, static * rate
    # The output of the last section is 1/A v, up to the static gain, and the derivative of p^k/A v is p^(k+1)/A v.
    powers = np.zeros((n, n))
    for k in range(n):
        powers[k] = powers[k - 1] @ dynamics if k > 0 else np.eye(n)[last] / static
    return Chain(dynamics, gain, powers)


class HeldStep(NamedTuple):
    """``z+ = F z + g v + h (change of v)``: a linear system over one step with v constant or linear."""

    #: F, shape (n, n).
    transition: Array
    #: g and h, shape (n,).
    from_value: Array
    from_change: Array


def exponential_minus_identity(matrix: Array) -> Array:
    r"""Return ``exp(M) - I`` of a small matrix.

    Scaling and squaring on ``X = exp(M/2^s) - I`` by ``X <- 2 X + X X``. Squaring X instead of I + X keeps the
    relative accuracy of slow modes when a fast one forces many squarings (poles spread over six decades).
    """
    norm = float(np.abs(matrix).sum(axis=1).max(initial=0.0))
    squarings = min(max(int(np.ceil(np.log2(norm / TAYLOR_NORM))), 0), 200) if 0.0 < norm < np.inf else 0
    scaled = matrix * 0.5**squarings
    result = scaled / TAYLOR_DEGREE
    for degree in range(TAYLOR_DEGREE - 1, 0, -1):
        result = (scaled + scaled @ result) / degree
    for _ in range(squarings):
        result = 2.0 * result + result @ result
    return np.asarray(result)


def held_step(dynamics: Array, gain: Array, step: float) -> HeldStep:
    """Return the exact map of ``z' = F z + g v`` over one step."""
    n = gain.size
    # v and its change over the step are two further states: the exponential contains the integrals over both.
    augmented = np.zeros((n + 2, n + 2))
    augmented[:n, :n], augmented[:n, n] = dynamics * step, gain * step
    augmented[n, n + 1] = 1.0
    result = exponential_minus_identity(augmented)
    return HeldStep(result[:n, :n] + np.eye(n), result[:n, n].copy(), result[:n, n + 1].copy())


class Transitions(NamedTuple):
    """Transitions of ``[z, v, v']`` over any step: by the digits of its whole quanta, then by a Taylor polynomial."""

    #: exp(M digit BASE^level quantum), shape (levels, BASE, n + 2, n + 2).
    powers: Array
    quantum: float
    #: Nonzero entries, row by row, of M, the dynamics with the held signal and its slope as states: index of the first
    #: entry of each row, columns, and values.
    starts: IntArray
    columns: IntArray
    values: Array


def transitions(dynamics: Array, gain: Array, longest: float) -> Transitions:
    """Return the table for all steps up to the longest."""
    from ctid_cli.filtering.kernels import BASE  # numba is slow to import

    n = gain.size
    # [z, v, v']' = M [z, v, v'] with v' constant over a step: no separate integrals of the input are needed.
    augmented = np.zeros((n + 2, n + 2))
    augmented[:n, :n], augmented[:n, n], augmented[n, n + 1] = dynamics, gain, 1.0
    quantum = QUANTUM_NORM / float(np.abs(augmented).sum(axis=1).max())
    levels = 1
    while quantum * float(BASE) ** levels <= longest and levels < 40:
        levels += 1
    powers = np.zeros((levels, BASE, n + 2, n + 2))
    for level in range(levels):
        first = exponential_minus_identity(augmented * (quantum * float(BASE) ** level))
        power = np.zeros((n + 2, n + 2))
        for digit in range(BASE):
            powers[level, digit] = power + np.eye(n + 2)
            # (I + X)(I + Y) - I = X + Y + X Y, which keeps the accuracy of slow modes if there is a fast one.
            power = power + first + power @ first
    rows, columns = np.nonzero(augmented)
    starts = np.searchsorted(rows, np.arange(n + 3)).astype(np.int64)
    return Transitions(powers, quantum, starts, columns.astype(np.int64), augmented[rows, columns])
