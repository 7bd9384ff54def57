"""Paired comparison of two estimators on the same data sets: differences and their significance."""

from collections.abc import Callable, Sequence
from functools import cache
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, IntArray
from ctid_cli.inference.monte_carlo import QUANTILE

#: Resamples of a bootstrap, its seed, and the number drawn at a time.
DRAWS, SEED, BLOCK = 4000, 20190130, 200
NORMAL = NormalDist()


class Difference(NamedTuple):
    """First estimator minus second, with the 95 % interval and the p-value of no difference."""

    value: float
    low: float
    high: float
    p_value: float


def mcnemar(first: int, second: int) -> float:
    """Return the mid-p value of McNemar's test, from the numbers of data sets with only one success.

    M. W. Fagerland, S. Lydersen and P. Laake, BMC Medical Research Methodology 13 (2013) 91: it keeps its level for any
    number of data sets, while the exact test is conservative.
    """
    from scipy.special import bdtr

    n, least = first + second, min(first, second)
    if not n:
        return 1.0
    # The smaller count is binomial with probability 1/2; the observed one counts half on either side.
    below = float(bdtr(least - 1, n, 0.5)) if least else 0.0
    return min(1.0, below + float(bdtr(least, n, 0.5)))


def tango_interval(first: int, second: int, n: int) -> tuple[float, float]:
    r"""Return the score interval for the difference of two percentages on the same n data sets, as a fraction.

    T. Tango, Statistics in Medicine 17 (1998) 891-908. It contains the differences d with

    .. math:: |b - c - n d| \leq z \sqrt{n (2 q + d (1 - d))},

    where q is the likeliest probability of a success of the second alone, given d.
    """
    from scipy.optimize import brentq

    def distance(d: float, z: float) -> float:
        B = (2 * n - first + second) * d - first - second
        C = -second * d * (1 - d)
        q = (np.sqrt(max(B * B - 8 * n * C, 0.0)) - B) / (4 * n)
        return float(first - second - n * d - z * np.sqrt(max(n * (2 * q + d * (1 - d)), 0.0)))

    ends = []
    for z, outermost in ((QUANTILE, -1.0), (-QUANTILE, 1.0)):
        # Next to the estimate, where the statistic is 0 / 0 without discordant pairs.
        inner = (1 - 1e-9) * (first - second) / n + 1e-9 * outermost
        # The interval may end at -1 or 1.
        crosses = distance(outermost, z) * distance(inner, z) < 0
        ends.append(float(brentq(distance, outermost, inner, args=(z,))) if crosses else outermost)
    return ends[0], ends[1]


def percent_difference(first: int, second: int, n: int) -> Difference:
    """Return the difference of two percentages on n data sets, from the numbers with only one success [%]."""
    low, high = tango_interval(first, second, n)
    return Difference(100 * (first - second) / n, 100 * low, 100 * high, mcnemar(first, second))


def hit_difference(first: Array, second: Array) -> Difference:
    """Return the difference of two percentages, from 1 for each data set with a success and 0 for others [%]."""
    return percent_difference(int((first > second).sum()), int((first < second).sum()), first.size)


def bootstrap_difference(statistic: Callable[[Array], Array], first: Array, second: Array) -> Difference:
    """Return the difference of a statistic of two estimators, by resampling common data sets, shapes (n,).

    The interval is bias-corrected and accelerated (B. Efron, Journal of the American Statistical Association 82 (1987)
    171-185); the p-value is the level of the interval that ends at zero. ``statistic`` acts along the last axis.
    """
    rng, n = np.random.default_rng(SEED), first.size

    def difference(picked: IntArray) -> Array:
        return statistic(first.take(picked)) - statistic(second.take(picked))

    value = float(difference(np.arange(n)))
    drawn = np.concatenate([difference(rng.integers(n, size=(BLOCK, n))) for _ in range(DRAWS // BLOCK)])
    left_out = _left_out(n)[:, None]
    parts = (left_out[k : k + BLOCK] for k in range(0, len(left_out), BLOCK))
    without = np.concatenate([difference(np.arange(n - 1) + (np.arange(n - 1) >= part)) for part in parts])
    spread = without.mean() - without
    scale = float(np.sum(spread**2)) ** 1.5
    acceleration = float(np.sum(spread**3)) / (6 * scale) if scale else 0.0
    shift = NORMAL.inv_cdf(_share(drawn, value))
    ends = []
    for z in (-QUANTILE, QUANTILE):
        reach = shift + (shift + z) / (1 - acceleration * (shift + z))
        ends.append(float(np.quantile(drawn, NORMAL.cdf(reach))))
    # Solved for the level at which the end is zero.
    beyond = NORMAL.inv_cdf(_share(drawn, 0.0)) - shift
    z = beyond / (1 + acceleration * beyond) - shift
    # p-values below one over the number of resamples cannot be resolved.
    p_value = 1.0 if not drawn.any() else max(2 * NORMAL.cdf(-abs(z)), 2 / (DRAWS + 1))
    return Difference(value, ends[0], ends[1], p_value)


def rms_difference(first: Array, second: Array) -> Difference:
    """Return the difference of two root mean square errors on the same data sets, by the bootstrap, shapes (n,)."""
    return bootstrap_difference(lambda squares: np.asarray(np.sqrt(squares.mean(axis=-1))), first**2, second**2)


def median_difference(first: Array, second: Array) -> Difference:
    """Return the difference of two medians on the same data sets, by the bootstrap, shapes (n,)."""
    return bootstrap_difference(lambda values: np.asarray(np.median(values, axis=-1)), first, second)


def _left_out(n: int) -> IntArray:
    """Return the data sets for the jackknife, at most a thousand, because acceleration is a small correction."""
    return np.unique(np.linspace(0, n - 1, min(n, 1000)).astype(int))


def _share(drawn: Array, limit: float) -> float:
    """Return the share of resamples below a limit, ties half, strictly between 0 and 1."""
    below = float(np.sum(drawn < limit) + 0.5 * np.sum(drawn == limit))
    return (below + 0.5) / (drawn.size + 1)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values with Holm's correction for several tests.

    With ``p_(1) <= ... <= p_(m)``, the adjusted p-value of ``p_(i)`` is the largest ``(m + 1 - j) p_(j)``, j <= i,
    and at most 1.
    """
    order = np.argsort(p_values, kind="stable")
    adjusted = np.empty(len(order))
    scaled = np.arange(len(order), 0, -1) * np.asarray(p_values, dtype=float)[order]
    adjusted[order] = np.minimum(np.maximum.accumulate(scaled), 1.0) if len(order) else 0.0
    return adjusted.tolist()


@cache
def fisher(converged: int, n: int, reference_converged: int, reference_n: int) -> float:
    """Return the two-sided p-value of Fisher's exact test that two percentages are equal [-]."""
    from scipy.stats import fisher_exact

    reference = [reference_converged, reference_n - reference_converged]
    return float(fisher_exact([reference, [converged, n - converged]]).pvalue)
