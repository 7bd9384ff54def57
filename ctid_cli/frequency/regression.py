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
