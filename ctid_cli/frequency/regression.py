r"""The delay regression of a multi-sinusoidal signal, and its mixing into scalar regressions.

For ``y = sum A_i sin(w_i t + p_i)`` and a delay h, with ``c_i = cos(w_i h)`` and
``prod(c - c_i) = c^n + theta_1 c^(n-1) + ... + theta_n``, the operator ``prod(Z^2 + 1 - 2 c_i Z)`` annihilates y, where
Z delays by h. Written out, ``psi = phi' theta`` with ``psi = -(Z^2 + 1)^n y`` and
``phi_k = (2 Z)^k (Z^2 + 1)^(n-k) y``: a linear regression for theta that holds exactly from t = 2 n h on.

Dynamic regressor extension and mixing (DREM) stacks the regression at n instants, d apart, and multiplies by the
adjugate of the regressor matrix: ``Psi_k = Delta theta_k`` with one determinant Delta for all k.
"""

from __future__ import annotations

from math import comb

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from ctid_cli.signals.checks import require_integer, require_positive

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: More tones than this cannot be told apart in double precision.
MOST_TONES = 8
#: Longest delay in sampling intervals: the samples of twice n delays are kept.
LONGEST_DELAY = 10_000_000


def delay_table(tones: int) -> IntArray:
    """Coefficients of the delay regression.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.

    Returns
    -------
    ndarray of int, shape (n + 1, 2 n + 1)
        ``[phi_1 ... phi_n psi] = T [y(t) y(t - h) ... y(t - 2 n h)]``.

    Raises
    ------
    ValueError
        If the number of tones is out of range.

    Examples
    --------
    >>> delay_table(1)
    array([[ 0,  2,  0],
           [-1,  0, -1]])
    """
    require_integer("tones", tones, 1, MOST_TONES)
    table = np.zeros((tones + 1, 2 * tones + 1), np.int64)
    for k in range(1, tones + 1):
        for i in range(tones - k + 1):
            table[k - 1, k + 2 * i] = 2**k * comb(tones - k, i)
    for i in range(tones + 1):
        table[tones, 2 * i] = -comb(tones, i)
    return table


def whole_delay(name: str, delay: float, interval: float) -> int:
    """Sampling intervals nearest to a delay.

    Parameters
    ----------
    name : str
        The option as the user writes it.
    delay : float
        Delay [s].
    interval : float
        Sampling interval [s].

    Returns
    -------
    int
        At least 1.

    Raises
    ------
    ValueError
        If the delay is shorter than half an interval, or longer than ten million.
    """
    require_positive("interval", interval, "s")
    if delay / interval > LONGEST_DELAY:
        raise ValueError(
            f"{name} = {delay:g} s is more than {LONGEST_DELAY:,} sampling intervals of {interval:g} s; keep fewer "
            "of the samples."
        )
    count = round(delay / interval)
    if count < 1:
        raise ValueError(f"{name} = {delay:g} s is shorter than half a sampling interval of {interval:g} s.")
    return count


def regression_rows(samples: ArrayLike, tones: int, lag: int) -> tuple[Array, Array]:
    """Regressand and regressors of a whole record.

    Parameters
    ----------
    samples : array_like, shape (N,)
        Signal at a regular clock [signal unit]; NaN where missing.
    tones : int
        Number of sinusoids n.
    lag : int
        Delay h in sampling intervals.

    Returns
    -------
    psi : ndarray, shape (N,)
        Regressand [signal unit]; NaN before sample ``2 n lag`` and wherever a sample it needs is missing.
    phi : ndarray, shape (N, n)
        Regressors [signal unit].
    """
    y = np.asarray(samples, dtype=float)
    table = delay_table(tones)
    rows = np.full((y.size, tones + 1), np.nan)
    span = 2 * tones * lag
    if y.size > span:
        delayed = np.column_stack([y[span - j * lag : y.size - j * lag] for j in range(2 * tones + 1)])
        rows[span:] = delayed @ table.T
    return rows[:, tones], rows[:, :tones]


def theta_of(omega: ArrayLike, delay: float) -> Array:
    """Parameters of the regression that belong to given frequencies.

    Parameters
    ----------
    omega : array_like, shape (n,)
        Frequencies [rad/s].
    delay : float
        Delay h [s].

    Returns
    -------
    ndarray, shape (n,)
        theta [-].

    Examples
    --------
    >>> theta_of([2.0, 3.0], 0.7).round(4)
    array([ 0.3349, -0.0858])
    """
    return np.asarray(np.poly(np.cos(np.asarray(omega, dtype=float) * delay))[1:])


def determinant_from_tones(components: ArrayLike, omega: ArrayLike, lag: int, spacing: int, interval: float) -> Array:
    r"""Determinant of the stacked regressors by its closed form.

    Parameters
    ----------
    components : array_like, shape (N, n)
        The sinusoids of the signal one by one, on the clock [signal unit].
    omega : array_like, shape (n,)
        Their frequencies [rad/s].
    lag, spacing : int
        Delay h and distance d of the stacked rows, in sampling intervals.
    interval : float
        Sampling interval [s].

    Returns
    -------
    ndarray, shape (N,)
        Determinant of the matrix with rows ``phi(t - j d)``, j = 0 ... n - 1 [signal unit^n]; NaN before it is defined.

    Notes
    -----
    ``phi(t) = 2^n sum_i [c_i^(n-1) ... c_i 1] y_i(t - n h)``, hence
    ``det = 2^(n n) det[y_i(t - n h - j d)] prod_(i<j) (c_i - c_j)``. It vanishes identically if two c_i agree or if all
    ``w_i d`` are multiples of pi of one parity.
    """
    parts = np.asarray(components, dtype=float)
    n_samples, tones = parts.shape
    c = np.cos(np.asarray(omega, dtype=float) * lag * interval)
    vandermonde = np.prod([c[i] - c[j] for i in range(tones) for j in range(i + 1, tones)])
    stacked = np.full((n_samples, tones, tones), np.nan)
    for j in range(tones):
        shift = tones * lag + j * spacing
        if shift < n_samples:
            stacked[shift:, j, :] = parts[: n_samples - shift]
    result = np.full(n_samples, np.nan)
    first = 2 * tones * lag + (tones - 1) * spacing
    result[first:] = 2.0 ** (tones * tones) * vandermonde * np.linalg.det(stacked[first:])
    return result


def minor_plan(tones: int) -> IntArray:
    """Order in which all maximal minors of an n x (n + 1) matrix are built up from smaller ones.

    Parameters
    ----------
    tones : int
        Number of rows n.

    Returns
    -------
    ndarray of int, shape (steps, 5)
        Each step: bit pattern of the minor's columns, row and column of the factor, pattern of the smaller minor, sign.
        The minor of the first k rows is expanded along the last of them. There are ``(n + 1) 2^n`` steps at most,
        against n! products of a plain expansion, and no division: a singular matrix is no special case.
    """
    steps = []
    for pattern in range(1, 2 ** (tones + 1) - 1):
        columns = [c for c in range(tones + 1) if pattern >> c & 1]
        for place, column in enumerate(columns):
            sign = -1 if (len(columns) - 1 - place) % 2 else 1
            steps.append((pattern, len(columns) - 1, column, pattern & ~(1 << column), sign))
    return np.array(steps, np.int64)


@njit(cache=True, nogil=True)
def form_row(history: Array, newest: int, lag: int, table: Array, row: Array) -> bool:
    """Regression row at the newest sample.

    Parameters
    ----------
    history : ndarray, shape (M,)
        Ring of the last M > 2 n lag samples; NaN where missing or not yet arrived.
    newest : int
        Place of the newest sample in the ring.
    lag : int
        Delay h in sampling intervals.
    table : ndarray, shape (n + 1, 2 n + 1)
        :func:`delay_table` as floating-point numbers.
    row : ndarray, shape (n + 1,)
        Receives ``[phi_1 ... phi_n psi]``.

    Returns
    -------
    bool
        Whether every sample that the row needs is there.
    """
    count, width = table.shape
    for k in range(count):
        row[k] = 0.0
    place = newest
    complete = True
    for j in range(width):
        value = history[place]
        complete = complete and np.isfinite(value)
        for k in range(count):
            row[k] += table[k, j] * value
        place -= lag
        if place < 0:
            place += history.size
    return complete


@njit(cache=True, nogil=True)
def mix_rows(
    rows: Array, newest: int, first: int, spacing: int, plan: IntArray, matrix: Array, minors: Array, mixed: Array
) -> float:
    """Determinant and right-hand sides of the scalar regressions at the newest row.

    Parameters
    ----------
    rows : ndarray, shape (M, n + 1)
        Ring of the last regression rows.
    newest : int
        Place of the newest row in the ring.
    first : int
        Number j0 of the first stacked row: rows ``t - j0 d ... t - (j0 + n - 1) d`` are stacked.
    spacing : int
        Distance d in sampling intervals.
    plan : ndarray of int, shape (steps, 5)
        :func:`minor_plan`.
    matrix : ndarray, shape (n, n + 1)
        Work space.
    minors : ndarray, shape (2^(n + 1),)
        Work space.
    mixed : ndarray, shape (n + 1,)
        Receives ``[Psi_1 ... Psi_n Delta]``; not finite if a row is missing.

    Returns
    -------
    float
        Product of the lengths of the rows: rounding makes errors of Delta and Psi_k of this size times 1e-16.
    """
    n = matrix.shape[0]
    size = rows.shape[0]
    place = newest - first * spacing
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
    for pattern in range(minors.size):
        minors[pattern] = 0.0
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
