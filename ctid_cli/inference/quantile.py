"""The quantile of the normal distribution on which intervals of estimates rest."""

from scipy.special import ndtri


def normal_quantile(level: float = 0.95) -> float:
    """Half the width of a two-sided interval of that probability [standard errors]."""
    return float(ndtri(0.5 + level / 2))
