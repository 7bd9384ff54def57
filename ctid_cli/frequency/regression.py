r"""The delay regression of a multi-sinusoidal signal, and its mixing into scalar regressions.

For ``y = sum A_i sin(w_i t + p_i)`` and a delay h, with ``c_i = cos(w_i h)`` and
``prod(c - c_i) = c^n + theta_1 c^(n-1) + ... + theta_n``, the operator ``prod(Z^2 + 1 - 2 c_i Z)`` annihilates y, where
Z delays by h. Written out, ``psi = phi' theta`` with ``psi = -(Z^2 + 1)^n y`` and
``phi_k = (2 Z)^k (Z^2 + 1)^(n-k) y``: a linear regression for theta that holds exactly from t = 2 n h on.

Dynamic regressor extension and mixing (DREM) stacks the regression at n instants, d apart, and multiplies by the
adjugate of the regressor matrix: ``Psi_k = Delta theta_k`` with one determinant Delta for all k.
"""

from math import comb

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, IntArray
from ctid_cli.errors import OptionError
from ctid_cli.frequency.inputs import MOST_TONES
from ctid_cli.signals.checks import require_integer, require_positive

#: Longest delay in sampling intervals: the samples of twice n delays are kept.
LONGEST_DELAY = 10_000_000


def delay_table(tones: int) -> Array:
    """Coefficients of the delay regression: ``[phi psi] = table @ [y(t), y(t - h), ... y(t - 2 n h)]``."""
    require_integer("tones", tones, 1, MOST_TONES)
    table = np.zeros((tones + 1, 2 * tones + 1))
    for k in range(1, tones + 1):
        for i in range(tones - k + 1):
            table[k - 1, k + 2 * i] = 2**k * comb(tones - k, i)
    for i in range(tones + 1):
        table[tones, 2 * i] = -comb(tones, i)
    return table


def whole_delay(name: str, delay: float, interval: float) -> int:
    """Sampling intervals nearest to a delay."""
    require_positive("interval", interval, "s")
    if delay / interval > LONGEST_DELAY:
        longest = f"{LONGEST_DELAY:,} sampling intervals of {interval:g} s"
        raise OptionError(name, f"{name} = {delay:g} s is more than {longest}; keep fewer of the samples.")
    count = round(delay / interval)
    if count < 1:
        raise OptionError(name, f"{name} = {delay:g} s is shorter than half a sampling interval of {interval:g} s.")
    return count


def theta_of(omega: ArrayLike, delay: float) -> Array:
    """Parameters of the regression that belong to given frequencies."""
    return np.asarray(np.poly(np.cos(np.asarray(omega, dtype=float) * delay))[1:])


def determinant_from_tones(components: ArrayLike, omega: ArrayLike, lag: int, spacing: int, interval: float) -> Array:
    r"""Determinant of the stacked regressors by its closed form.

    ``phi(t) = 2^n sum_i [c_i^(n-1) ... c_i 1] y_i(t - n h)``, hence
    ``det = 2^(n n) det[y_i(t - n h - j d)] prod_(i<j) (c_i - c_j)``. It vanishes identically if two c_i agree or if all
    ``w_i d`` are multiples of pi of one parity.
    """
    parts = np.asarray(components, dtype=float)
    count, tones = parts.shape
    c = np.cos(np.asarray(omega, dtype=float) * lag * interval)
    vandermonde = np.prod([c[i] - c[j] for i in range(tones) for j in range(i + 1, tones)])
    result = np.full(count, np.nan)
    instants = np.arange(2 * tones * lag + (tones - 1) * spacing, count)
    stacked = parts[instants[:, None] - tones * lag - spacing * np.arange(tones)]
    result[instants] = 2.0 ** (tones * tones) * vandermonde * np.linalg.det(stacked)
    return result


def minor_plan(tones: int) -> IntArray:
    """Order in which all maximal minors of an n x (n + 1) matrix are built up from smaller ones."""
    steps = []
    for pattern in range(1, 2 ** (tones + 1) - 1):
        columns = [c for c in range(tones + 1) if pattern >> c & 1]
        for place, column in enumerate(columns):
            sign = -1 if (len(columns) - 1 - place) % 2 else 1
            steps.append((pattern, len(columns) - 1, column, pattern & ~(1 << column), sign))
    return np.array(steps, np.int64)


@njit(cache=True, nogil=True)
def following(place: int, size: int) -> int:
    """The next place of a ring."""
    return place + 1 if place + 1 < size else 0


@njit(cache=True, nogil=True)
def form_row(history: Array, newest: int, lag: int, table: Array, row: Array) -> bool:
    """Regression row ``[phi psi]`` at the newest sample of a ring; whether no sample of it is missing."""
    count, width = table.shape
    row[:count] = 0.0
    place = newest
    complete = True
    # One delayed sample after the other, from y(t) to y(t - 2 n h).
    for j in range(width):
        value = history[place]
        complete = complete and np.isfinite(value)
        for k in range(count):
            row[k] += table[k, j] * value
        # The ring holds 2 n lags and one sample: one step beyond its start at most.
        place -= lag
        if place < 0:
            place += history.size
    return complete


@njit(cache=True, nogil=True)
def mix_rows(
    rows: Array, newest: int, first: int, spacing: int, plan: IntArray, matrix: Array, minors: Array, mixed: Array
) -> float:
    """``[adj(Phi) Psi_f, det Phi]`` of the rows ``first`` to ``first + n - 1`` spacings ago; returns their scale."""
    n = matrix.shape[0]
    size = rows.shape[0]
    place = newest - first * spacing
    # Hadamard: no minor exceeds the product of the lengths of the rows, nor does its rounding by much.
    scale = 1.0
    for i in range(n):
        if place < 0:
            place += size
        square = 0.0
        for k in range(n + 1):
            value = rows[place, k]
            matrix[i, k] = value
            square += value * value
        scale *= np.sqrt(square)
        place -= spacing
    # Laplace expansion along the last row: every minor of the first rows is computed once, and finite though singular.
    minors[:] = 0.0
    minors[0] = 1.0
    for step in range(plan.shape[0]):
        minors[plan[step, 0]] += plan[step, 4] * matrix[plan[step, 1], plan[step, 2]] * minors[plan[step, 3]]
    everything = minors.size - 1
    for k in range(n):
        # Column psi moves from the last place to place k: n - 1 - k exchanges.
        sign = -1.0 if (n - 1 - k) % 2 else 1.0
        mixed[k] = sign * minors[everything - (1 << k)]
    mixed[n] = minors[everything - (1 << n)]
    return scale
