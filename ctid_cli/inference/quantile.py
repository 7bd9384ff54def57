"""The quantiles and probabilities on which intervals and tests rest, and a deviation from one.

`scipy.special` is slow to import, and most searches never ask for a probability.
"""

import math
from statistics import NormalDist

import numpy as np

from ctid_cli.arrays import Array


def normal_quantile(level: float = 0.95) -> float:
    """Half the width of a two-sided interval of that probability [standard errors]."""
    return NormalDist().inv_cdf(0.5 + level / 2)


def normal_tail(z: float) -> float:
    """Probability that a standard normal variable exceeds z."""
    return 0.5 * math.erfc(z / math.sqrt(2.0))


def chi_square_tail(degrees_of_freedom: int, x: float) -> float:
    """Probability that a chi-square variable exceeds x."""
    from scipy.special import chdtrc

    return float(chdtrc(degrees_of_freedom, x))


def student_quantile(degrees_of_freedom: float, level: float = 0.95) -> float:
    """The same where the standard error itself is known only as well as these degrees of freedom tell."""
    from scipy.special import stdtrit

    return float(stdtrit(degrees_of_freedom, 0.5 + level / 2))


def robust_deviation(x: Array) -> float:
    """Standard deviation from the median size of values about zero, which outliers hardly change."""
    return 1.4826 * float(np.median(np.abs(x)))
