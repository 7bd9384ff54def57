r"""Whether the frequencies found with one delay explain the signal at another one.

With the delay h alone, a frequency w and all its aliases ``2 pi k/h - w``, ``2 pi k/h + w`` are one and the same. At a
second delay, a whole number of sampling intervals that shares no divisor with the first, they are not.
"""

from __future__ import annotations

from math import gcd

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ctid_cli.frequency.flags import INCONSISTENT
from ctid_cli.frequency.moments import accumulate_row, factorise, least_squares, squared_residual
from ctid_cli.frequency.regression import form_row

Array = NDArray[np.float64]

#: The second delay is near this fraction of the first, as far from every simple ratio as can be.
GOLDEN_FRACTION = (np.sqrt(5.0) - 1.0) / 2.0
#: The frequencies are inconsistent if they leave so many times the smallest possible squared residual.
WORSE_THAN_BEST = 10.0
#: Added to the unit diagonal of the scaled second moments, so that the best fit exists even if it is not unique.
REGULARISATION = 1e-10


def second_lag(lag: int) -> int:
    """Second delay for a given first one.

    Parameters
    ----------
    lag : int
        Delay h in sampling intervals, at least 1.

    Returns
    -------
    int
        A smaller number without a common divisor, or 0 for ``lag = 1``, where only the sampling itself can alias.

    Examples
    --------
    >>> [second_lag(lag) for lag in (1, 2, 10, 100, 700)]
    [0, 1, 7, 61, 433]
    """
    if lag == 1:
        return 0
    wanted = GOLDEN_FRACTION * lag
    return min((m for m in range(1, lag) if gcd(m, lag) == 1), key=lambda m: abs(m - wanted))


@njit(cache=True, nogil=True)
def observe_second_delay(
    history: Array, newest: int, lag: int, table: Array, row: Array, gram: Array, keep: float
) -> None:
    """Take the row at the second delay into account.

    Parameters
    ----------
    history : ndarray, shape (M,)
        Ring of samples.
    newest : int
        Place of the newest one.
    lag : int
        Second delay in sampling intervals; 0 for none.
    table : ndarray, shape (n + 1, 2 n + 1)
        Coefficients of the delay regression.
    row : ndarray, shape (n + 1,)
        Work space.
    gram : ndarray, shape (n + 1, n + 1)
        Second moments of the rows at the second delay; changed in place.
    keep : float
        Factor on what was there before.
    """
    if lag > 0 and form_row(history, newest, lag, table, row):
        accumulate_row(row, gram, keep)


@njit(cache=True, nogil=True)
def check_consistency(gram: Array, omega: Array, delay: float, negligible: float) -> int:
    """Compare the residual that the frequencies leave at the second delay with the smallest possible one.

    Parameters
    ----------
    gram : ndarray, shape (n + 1, n + 1)
        Second moments of the rows at the second delay, lower triangle.
    omega : ndarray, shape (n,)
        Frequencies [rad/s].
    delay : float
        Second delay [s]; 0 for none.
    negligible : float
        Fraction of the regressand's second moment below which a residual is none.

    Returns
    -------
    int
        The flag, or 0.

    Notes
    -----
    Where noise in the regressors leads least squares far astray, the true frequencies are called inconsistent, too;
    they are uncertain there anyway.
    """
    n = omega.size
    if delay == 0.0 or not gram[n, n] > 0.0:
        return 0
    theta = np.zeros(n)
    # Coefficients of prod(x - cos(w_i delay)) after the leading one.
    for i in range(n):
        c = np.cos(omega[i] * delay)
        for k in range(i, 0, -1):
            theta[k] -= c * theta[k - 1]
        theta[0] -= c
    residual = squared_residual(gram, theta)
    factor, scales = np.empty((n, n)), np.empty(n)
    if residual <= negligible * gram[n, n] or not factorise(gram, REGULARISATION, factor, scales):
        return 0
    least_squares(gram, factor, scales, theta)
    return INCONSISTENT if residual > WORSE_THAN_BEST * squared_residual(gram, theta) else 0
