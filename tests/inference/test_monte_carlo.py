"""Monte Carlo errors and intervals: by hand, against the bootstrap, and how often they hold the truth."""

import math

import numpy as np
import pytest

from ctid_cli.inference import monte_carlo
from ctid_cli.inference.monte_carlo import MEASURES, Measured, Sample, quantile, share, wilson_interval
from ctid_cli.inference.quantile import student_quantile

# R. G. Newcombe, Statistics in Medicine 17 (1998) 857-872, Table I, method 3.
NEWCOMBE = [
    (81, 263, 0.2553, 0.3662),
    (15, 148, 0.0624, 0.1605),
    (0, 20, 0.0, 0.1611),
    (1, 29, 0.0061, 0.1718),
]


@pytest.mark.parametrize(("k", "n", "low", "high"), NEWCOMBE)
def test_wilson_interval_against_published_values(k: int, n: int, low: float, high: float) -> None:
    assert wilson_interval(k, n) == pytest.approx((low, high), abs=5e-5)


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
WIDTHS = np.array([2.0, 1.0, np.nan, 2.5, 1.5])


def by_hand(statistic, *columns):
    """The jackknife, one data set left out after the other."""
    n = len(columns[0])
    without = [statistic(*(np.delete(column, k) for column in columns)) for k in range(n)]
    return statistic(*columns), np.sqrt((n - 1) * np.var(without))


@pytest.mark.parametrize(
    ("name", "statistic"),
    [
        ("bias", lambda e: e.mean()),
        ("mse", lambda e: (e**2).mean()),
        ("rmse", lambda e: np.sqrt((e**2).mean())),
        ("efficiency", lambda e: 200.0 / (e**2).mean()),
    ],
)
def test_errors_are_those_of_the_jackknife(name, statistic):
    found = MEASURES[name].compute(Sample(ERRORS, WIDTHS, 2.0))
    assert found[:2] == pytest.approx(by_hand(statistic, ERRORS))


def test_bias_deviation_and_mean_square_are_those_of_the_table_of_morris():
    n, mean, scatter = 5, ERRORS.mean(), np.std(ERRORS, ddof=1)
    squares = ERRORS**2
    bias = monte_carlo.bias(Sample(ERRORS, WIDTHS))
    assert bias[:2] == pytest.approx((mean, scatter / np.sqrt(n)))
    assert bias.high - bias.low == pytest.approx(2 * student_quantile(4) * bias.error)
    assert monte_carlo.mean_square(Sample(ERRORS, WIDTHS)).error == pytest.approx(np.std(squares, ddof=1) / np.sqrt(n))
    assert monte_carlo.deviation(Sample(ERRORS, WIDTHS)).value == pytest.approx(scatter)
    # Their error of a standard deviation is that of normal errors, and the jackknife finds it there.
    normal = np.random.default_rng(1).standard_normal(20_000)
    found = monte_carlo.deviation(Sample(normal, normal))
    assert found.error == pytest.approx(found.value / np.sqrt(2 * 19_999), rel=0.03)


def test_standard_errors_of_the_model():
    sample = Sample(ERRORS, WIDTHS)
    known = WIDTHS[[0, 1, 3, 4]]
    mean = np.sqrt((known**2).mean())
    assert monte_carlo.standard_error(sample)[:2] == pytest.approx(by_hand(lambda w: np.sqrt((w**2).mean()), known))
    assert monte_carlo.error_ratio(sample).value == pytest.approx(mean / np.std(ERRORS, ddof=1))
    # 1 of 2 and 0.5 of 1.5 lie within 1.96 errors, 2 of 1 and 6 of 2.5 do not, and 3 has no interval.
    assert monte_carlo.covered(sample).tolist() == [True, False, False, False, True]
    assert monte_carlo.coverage(sample) == share(np.array([True, False, False, False, True]))
    assert monte_carlo.coverage(Sample(ERRORS, np.full(5, np.nan))) == Measured()
    wider = sample._replace(quantiles=np.array([1.0, 1.0, 1.0, 1e9, 1e9]) * 1.96)
    assert monte_carlo.covered(wider).tolist()[-2:] == [True, True]


def test_nothing_is_said_of_nothing():
    nothing = Sample(np.empty(0), np.empty(0))
    for measure in MEASURES.values():
        assert measure.compute(nothing if measure.source == "errors" else np.empty(0, dtype=bool)) == Measured()
    one = Sample(np.array([2.0]), np.array([1.0]))
    assert monte_carlo.bias(one) == (2.0, None, None, None)
    assert monte_carlo.deviation(one) == monte_carlo.error_ratio(one) == Measured()
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


@pytest.mark.parametrize("name", ["mse", "rmse", "deviation", "standard_error", "error_ratio", "efficiency"])
def test_errors_agree_with_the_bootstrap(name):
    rng = np.random.default_rng(3)
    errors, widths, n = rng.standard_t(9, 300) + 0.4, rng.uniform(0.8, 1.4, 300), 300
    compute = MEASURES[name].compute
    drawn = [compute(Sample(errors[k], widths[k], 0.7)).value for k in rng.integers(n, size=(1000, n))]
    assert compute(Sample(errors, widths, 0.7)).error == pytest.approx(np.std(drawn), rel=0.1)


def test_intervals_hold_the_truth_in_95_percent():
    # 2,000 studies of 200 normal errors; two standard deviations of the coverage are 1 %.
    rng = np.random.default_rng(4)
    truth = {"bias": 0.5, "mse": 1.25, "rmse": np.sqrt(1.25), "deviation": 1.0, "median_bias": 0.5}
    truth |= {"robust_deviation": 1.0, "coverage": 92.09}
    counts = dict.fromkeys(truth, 0)
    for errors in 0.5 + rng.standard_normal((2000, 200)):
        sample = Sample(errors, np.ones(200))
        for name, value in truth.items():
            found = MEASURES[name].compute(sample)
            counts[name] += found.low <= value <= found.high
    assert {name: count for name, count in counts.items() if not 0.93 <= count / 2000 <= 0.97} == {}
