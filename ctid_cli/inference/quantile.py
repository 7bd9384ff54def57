"""The quantiles on which intervals of estimates rest, and a deviation from one."""

import numpy as np
from scipy.special import ndtri, stdtrit

from ctid_cli.arrays import Array


def normal_quantile(level: float = 0.95) -> float:
    """Half the width of a two-sided interval of that probability [standard errors]."""
    return float(ndtri(0.5 + level / 2))


def student_quantile(degrees_of_freedom: float, level: float = 0.95) -> float:
    """The same where the standard error itself is known only as well as these degrees of freedom tell."""
    return float(stdtrit(degrees_of_freedom, 0.5 + level / 2))


def robust_deviation(x: Array) -> float:
    """Standard deviation from the median size of values about zero, which outliers hardly change."""
    return 1.4826 * float(np.median(np.abs(x)))
