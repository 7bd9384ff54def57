"""Paired differences on the same data sets: published examples, defining equations, and coverage."""

import itertools
from math import comb

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import minimize_scalar

from ctid_cli.inference.paired import bootstrap_difference, fisher, holm, mcnemar, tango_interval


def root_of_mean(squares):
    return np.sqrt(squares.mean(axis=-1))


@pytest.mark.parametrize(("b", "c"), [(0, 3), (2, 9), (5, 6), (0, 1)])
def test_mid_p_halves_what_was_observed(b, c):
    exact = stats.binomtest(min(b, c), b + c).pvalue
    observed = stats.binom.pmf(min(b, c), b + c, 0.5)
    assert mcnemar(b, c) == pytest.approx(min(1.0, exact - observed))


def score(d, b, c, n):
    """Return Tango's statistic, with the likelihood of the discordant pairs maximised by brute force."""
    low, high = max(0.0, -d), (1 - d) / 2

    def cost(q):
        with np.errstate(divide="ignore", invalid="ignore"):
            terms = [(b, q + d), (c, q), (n - b - c, 1 - 2 * q - d)]
            return -sum(k * np.log(p) for k, p in terms if k)

    q = minimize_scalar(cost, bounds=(low, high), method="bounded", options={"xatol": 1e-12}).x
    return (b - c - n * d) / np.sqrt(n * (2 * q + d * (1 - d)))


@pytest.mark.parametrize(("b", "c", "n"), [(1, 7, 21), (86, 150, 1600), (16, 3, 40), (5, 5, 20), (12, 2, 14)])
def test_tango_solves_its_defining_equation(b, c, n):
    low, high = tango_interval(b, c, n)
    assert score(low, b, c, n) == pytest.approx(1.96, abs=2e-3)
    assert score(high, b, c, n) == pytest.approx(-1.96, abs=2e-3)


def test_the_bootstrap_is_that_of_scipy():
    rng = np.random.default_rng(1)
    common = rng.standard_normal(60)
    one, other = ((0.8 * common + 0.6 * rng.standard_normal(60)) * size for size in (1.3, 1.0))
    found = bootstrap_difference(root_of_mean, one**2, other**2)

    def statistic(a, b, axis=-1):
        return np.sqrt((a**2).mean(axis)) - np.sqrt((b**2).mean(axis))

    theirs = stats.bootstrap((one, other), statistic, paired=True, n_resamples=20_000, rng=np.random.default_rng(2))
    interval = theirs.confidence_interval
    width = interval.high - interval.low
    assert found.value == pytest.approx(statistic(one, other))
    assert (found.low, found.high) == pytest.approx((interval.low, interval.high), abs=0.04 * width)
    # The p-value is that of the interval with one end at zero.
    assert (found.p_value < 0.05) == (found.low > 0 or found.high < 0)
    assert bootstrap_difference(root_of_mean, one**2, other**2) == found
    assert bootstrap_difference(root_of_mean, one**2, one**2)[:3] == (0.0, 0.0, 0.0)
    assert bootstrap_difference(root_of_mean, one**2, one**2).p_value == 1.0


def hypergeometric_p(k1, n1, k2, n2):
    """Return the two-sided p-value by definition: the sum over all tables no more likely than the observed one."""
    likely = [comb(n1, k) * comb(n2, k1 + k2 - k) for k in range(max(0, k1 + k2 - n2), min(n1, k1 + k2) + 1)]
    found = comb(n1, k1) * comb(n2, k2)
    return sum(value for value in likely if value <= found) / sum(likely)


@pytest.mark.parametrize(("fresh", "committed"), [((20, 20), (80, 100)), ((3, 7), (99, 100)), ((0, 5), (100, 100))])
def test_the_p_value_is_that_of_fisher(fresh, committed):
    assert fisher(*fresh, *committed) == pytest.approx(hypergeometric_p(*fresh, *committed))


def test_holm_is_the_closure_of_bonferroni():
    p = [0.001, 0.2, 0.004, 0.012, 0.012, 0.9]
    for k, adjusted in enumerate(holm(p)):
        subsets = (s for size in range(1, 7) for s in itertools.combinations(range(6), size) if k in s)
        assert adjusted == pytest.approx(max(min(1.0, len(s) * min(p[j] for j in s)) for s in subsets))
    assert list(holm([])) == []
