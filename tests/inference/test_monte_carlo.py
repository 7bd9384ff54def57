"""Monte Carlo errors and intervals: by hand, against the bootstrap, and by their coverage."""

import math

import numpy as np
import pytest

from ctid_cli.inference import monte_carlo
from ctid_cli.inference.monte_carlo import MEASURES, Measured, Sample, quantile, wilson_interval


def test_wilson_interval_solves_its_defining_equation() -> None:
    for k, n in [(3, 7), (20, 20), (0, 5), (50, 100)]:
        for limit in wilson_interval(k, n):
            if 0 < limit < 1:
                assert abs(k / n - limit) / math.sqrt(limit * (1 - limit) / n) == pytest.approx(1.959963984540054)
        low, high = wilson_interval(k, n)
        assert 0 <= low < high <= 1


def test_wilson_interval_at_the_edges() -> None:
    assert wilson_interval(20, 20)[1] == 1.0
    assert wilson_interval(0, 20)[0] == 0.0
    assert all(math.isnan(limit) for limit in wilson_interval(0, 0))
    with pytest.raises(ValueError, match="got 3 of 2"):
        wilson_interval(3, 2)


ERRORS = np.array([1.0, -2.0, 3.0, 6.0, 0.5])


def test_bias_deviation_and_mean_square_are_those_of_the_table_of_morris():
    n, mean, scatter = 5, ERRORS.mean(), np.std(ERRORS, ddof=1)
    squares = ERRORS**2
    assert monte_carlo.bias(Sample(ERRORS, ERRORS))[:2] == pytest.approx((mean, scatter / np.sqrt(n)))
    assert monte_carlo.mean_square(Sample(ERRORS, ERRORS)).error == pytest.approx(np.std(squares, ddof=1) / np.sqrt(n))
    assert monte_carlo.deviation(Sample(ERRORS, ERRORS)).value == pytest.approx(scatter)
    # For normal errors, the error of a standard deviation has a formula, with which the jackknife agrees.
    normal = np.random.default_rng(1).standard_normal(20_000)
    found = monte_carlo.deviation(Sample(normal, normal))
    assert found.error == pytest.approx(found.value / np.sqrt(2 * 19_999), rel=0.03)


def test_too_few_values_have_no_measures():
    nothing = Sample(np.empty(0), np.empty(0))
    for measure in MEASURES.values():
        assert measure.compute(nothing if measure.source == "errors" else np.empty(0, dtype=bool)) == Measured()
    one = Sample(np.array([2.0]), np.array([1.0]))
    assert monte_carlo.bias(one) == (2.0, None, None, None)
    assert monte_carlo.coverage(Sample(ERRORS, np.full(5, np.nan))) == Measured()
    assert monte_carlo.deviation(one) == monte_carlo.error_ratio(one) == Measured()
    # If one of two values is left out, no scatter remains.
    assert monte_carlo.deviation(Sample(np.array([1.0, 3.0]), np.ones(2))) == (pytest.approx(2**0.5), None, None, None)
    exact = Sample(np.zeros(9), np.zeros(9), 1.0)
    assert monte_carlo.root_mean_square(exact) == (0.0, 0.0, 0.0, 0.0)
    assert monte_carlo.efficiency(exact).value is None


# W. J. Conover, Practical Nonparametric Statistics, 3.2: ranks of the 95 % interval of a median.
@pytest.mark.parametrize(("n", "ranks"), [(6, (1, 6)), (10, (2, 9)), (20, (6, 15)), (50, (18, 33))])
def test_a_median_lies_between_order_statistics(n, ranks):
    values = np.random.default_rng(n).permutation(np.arange(1.0, n + 1))
    found = quantile(values)
    assert (found.low, found.high) == ranks
    assert found.value == (n + 1) / 2
    assert found.error == pytest.approx((ranks[1] - ranks[0]) / 3.92, rel=1e-4)


def test_a_median_counts_what_never_ends():
    assert quantile(np.arange(5.0))[2:] == (None, None)
    assert quantile(np.array([1.0, 2.0, 3.0, *[math.inf] * 2])).value == 3.0
    assert quantile(np.array([1.0, *[math.inf] * 5])) == (None, None, 1.0, None)


POSITIVE = ("deviation", "mse", "rmse", "standard_error", "error_ratio", "efficiency")


def test_an_interval_that_says_nothing_has_no_ends():
    rng = np.random.default_rng(6)
    errors, widths = rng.standard_normal(60), rng.uniform(0.8, 1.2, 60)
    far = np.where(np.arange(60) == 17, 1e4, 1.0)
    for name in POSITIVE:
        found = MEASURES[name].compute(Sample(errors, widths, 1.0))
        assert 0.5 * found.value < found.low < found.high < 2.0 * found.value
        found = MEASURES[name].compute(Sample(far * errors, widths * (far if name == "standard_error" else 1.0), 1.0))
        assert found.value > 0.0
        assert found[2:] == (None, None)
    # Two data sets do not determine a mean square.
    assert monte_carlo.mean_square(Sample(np.array([0.1, 2.0]), np.ones(2)))[2:] == (None, None)


def test_intervals_hold_the_truth_in_95_percent():
    # 2,000 studies of 200 normal errors; two standard deviations of the coverage are 1 %.
    rng = np.random.default_rng(4)
    truth = {"bias": 0.5, "mse": 1.25, "rmse": np.sqrt(1.25), "deviation": 1.0, "median_bias": 0.5}
    truth |= {"robust_deviation": 1.0, "coverage": 92.09, "efficiency": 80.0, "error_ratio": 1.0}
    counts = dict.fromkeys(truth, 0)
    for errors in 0.5 + rng.standard_normal((2000, 200)):
        sample = Sample(errors, np.ones(200), 1.0)
        for name, value in truth.items():
            found = MEASURES[name].compute(sample)
            counts[name] += found.low <= value <= found.high
    assert {name: count for name, count in counts.items() if not 0.93 <= count / 2000 <= 0.97} == {}
