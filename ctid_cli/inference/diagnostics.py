"""How well a simulated output follows a measured one."""

import numpy as np
from numpy.typing import ArrayLike


def fit_percent(y: ArrayLike, x: ArrayLike) -> float:
    """Fit of a simulated output: ``100 (1 - ||y - x|| / ||y - mean y||)``.

    Parameters
    ----------
    y : array_like, shape (N,)
        Measured output; NaN marks a missing sample and is left out.
    x : array_like, shape (N,)
        Simulated output.

    Returns
    -------
    float
        Fit [%]: 100 is perfect, 0 no better than the mean; NaN where the measured output is constant.

    Examples
    --------
    >>> fit_percent([0.0, 1.0, 2.0], [0.0, 1.0, 2.0])
    100.0
    """
    return percent_from_r_squared(r_squared(y, x))


def percent_from_r_squared(r2: float) -> float:
    """Fit that belongs to a coefficient of determination: ``100 (1 - sqrt(1 - R^2))``."""
    return 100.0 * (1.0 - float(np.sqrt(max(1.0 - r2, 0.0))))


def r_squared(y: ArrayLike, x: ArrayLike) -> float:
    """Coefficient of determination of a simulated output: ``1 - ||y - x||^2 / ||y - mean y||^2``."""
    measured = np.asarray(y, dtype=float)
    error = measured - np.asarray(x, dtype=float)
    valid = np.isfinite(measured)
    spread = float(np.sum((measured[valid] - measured[valid].mean()) ** 2)) if valid.any() else 0.0
    return 1.0 - float(np.sum(error[valid] ** 2)) / spread if spread > 0 else float("nan")
