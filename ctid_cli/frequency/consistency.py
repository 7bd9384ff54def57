r"""Whether the frequencies found explain the newest samples, and the signal at another delay.

With the delay h alone, a frequency w and all its aliases ``2 pi k/h - w``, ``2 pi k/h + w`` are one and the same. At a
second delay, a whole number of sampling intervals that shares no divisor with the first, they are not.
"""

from math import gcd

import numpy as np
from numba import njit

from ctid_cli.arrays import Array
from ctid_cli.frequency.flags import INCONSISTENT
from ctid_cli.frequency.moments import factorise, least_squares, squared_residual

#: The second delay is near this fraction of the first, as far from every simple ratio as can be.
GOLDEN_FRACTION = (np.sqrt(5.0) - 1.0) / 2.0
#: A number without a common divisor lies within this distance of any place, for all delays that are allowed.
SEARCHED = 100
#: The frequencies are inconsistent if they leave so many times the smallest possible squared residual.
WORSE_THAN_BEST = 10.0
#: Time constant of the detector of changes as a fraction of h.
DETECTOR_SPAN = 1.0 / 14.0
#: The signal changed if residuals are so much larger than before (mean squares), and than rounding.
ALARM_RATIO = 30.0
ROUNDING_FLOOR = 1e-18
#: The usual level of a residual is that of so many times n h.
USUAL_SPANS = 20
#: It sinks so many times as fast as it rises, so that it follows an estimate that converges; in noise it is too low
#: therefore, and so much more is needed to contradict an estimate.
SINKING = 50.0
CONTRADICTION_RATIO = 300.0
#: Added to the unit diagonal of the scaled second moments, so that the best fit exists even if it is not unique.
REGULARISATION = 1e-10


def second_lag(lag: int) -> int:
    """Second delay for a given first one."""
    if lag == 1:
        return 0
    wanted = GOLDEN_FRACTION * lag
    near = range(max(1, round(wanted) - SEARCHED), min(lag, round(wanted) + SEARCHED + 1))
    return min((m for m in near if gcd(m, lag) == 1), key=lambda m: abs(m - wanted))


@njit(cache=True, nogil=True)
def contradicts(row: Array, theta: Array, levels: Array, fast: float, slow: float) -> bool:
    """Whether the newest row leaves a residual unlike those of the rows before."""
    # levels: rows so far, mean squares of the newest residuals, of the usual ones, and of psi.
    n = theta.size
    residual = row[n]
    for i in range(n):
        residual -= theta[i] * row[i]
    square = residual * residual
    if not np.isfinite(square):
        return False
    # Plain means at first, exponential ones once they span their time.
    levels[0] += 1.0
    levels[1] += max(fast, 1.0 / levels[0]) * (square - levels[1])
    usual = max(slow, 1.0 / levels[0])
    levels[3] += usual * (row[n] * row[n] - levels[3])
    if levels[1] < levels[2]:
        usual = max(min(SINKING * slow, fast), 1.0 / levels[0])
    levels[2] += usual * (levels[1] - levels[2])
    return bool(levels[1] > CONTRADICTION_RATIO * levels[2] + ROUNDING_FLOOR * levels[3])


@njit(cache=True, nogil=True)
def check_consistency(gram: Array, omega: Array, delay: float, negligible: float) -> int:
    """Compare the residual that the frequencies leave at the second delay with the smallest possible one.

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
    # Far below the regressand nothing is inconsistent, and the best fit need not be found.
    residual = squared_residual(gram, theta)
    factor, scales = np.empty((n, n)), np.empty(n)
    if residual <= negligible * gram[n, n] or not factorise(gram, REGULARISATION, factor, scales):
        return 0
    least_squares(gram, factor, scales, theta)
    return INCONSISTENT if residual > WORSE_THAN_BEST * squared_residual(gram, theta) else 0
