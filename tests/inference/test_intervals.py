"""Profile intervals of the delay against the t interval, closed forms and known shapes."""

import numpy as np
import pytest
from scipy.stats import f, t

from ctid_cli.inference.intervals import CostOfDelay, student_quantile


def profile_likelihood_interval(squared_error_at, estimate, smallest, count, parameters, bounds, level=0.95, **more):
    quantile = student_quantile(count - parameters, level)
    return CostOfDelay(squared_error_at, estimate, smallest, count, parameters, bounds, **more).interval(quantile)


def quadratic_is_doubtful(squared_error_at, estimate, error, *common, **more):
    return CostOfDelay(squared_error_at, estimate, *common, **more).quadratic_is_doubtful(error)


def parabola(estimate=2.0, curvature=50.0, smallest=8.0):
    return lambda delay: smallest + curvature * (delay - estimate) ** 2


@pytest.mark.parametrize("curvature", [1.0, 50.0, 1e6])
@pytest.mark.parametrize("level", [0.5, 0.95])
def test_a_parabola_gives_the_t_interval(curvature, level):
    # s^2 = 8 / 16; se^2 = s^2 / curvature
    interval = profile_likelihood_interval(parabola(2.0, curvature), 2.0, 8.0, 20, 4, (-3.0, 10.0), level)
    reach = t.ppf(0.5 + level / 2, 16) * np.sqrt(0.5 / curvature)
    assert interval.low == pytest.approx(2.0 - reach, abs=3e-6 * reach)
    assert interval.high == pytest.approx(2.0 + reach, abs=3e-6 * reach)
    assert not interval.open_low
    assert not interval.open_high


def test_an_asymmetric_profile_in_closed_form():
    # S = 1 + (ln tau)^2
    allowed = f.ppf(0.95, 1, 97) / 97
    interval = profile_likelihood_interval(lambda d: 1 + np.log(d) ** 2, 1.0, 1.0, 100, 3, (0.1, 10.0))
    assert interval.low == pytest.approx(np.exp(-np.sqrt(allowed)), rel=1e-5)
    assert interval.high == pytest.approx(np.exp(np.sqrt(allowed)), rel=1e-5)


def test_inflation_widens_by_its_root():
    plain = profile_likelihood_interval(parabola(), 2.0, 8.0, 20, 4, (-3.0, 10.0))
    wide = profile_likelihood_interval(parabola(), 2.0, 8.0, 20, 4, (-3.0, 10.0), inflation=4.0)
    assert wide.high - 2.0 == pytest.approx(2 * (plain.high - 2.0), rel=1e-5)


def test_ends_at_the_bounds_are_open():
    interval = profile_likelihood_interval(parabola(), 2.0, 8.0, 20, 4, (1.9, 10.0))
    assert (interval.low, interval.open_low, interval.open_high) == (1.9, True, False)
    flat = profile_likelihood_interval(lambda d: 8.0, 2.0, 8.0, 20, 4, (0.0, 10.0))
    assert (flat.low, flat.high, flat.open_low, flat.open_high) == (0.0, 10.0, True, True)
    at_bound = profile_likelihood_interval(lambda d: 8.0 + d, 0.0, 8.0, 20, 4, (0.0, 30.0))
    assert (at_bound.low, at_bound.open_low) == (0.0, True)
    assert at_bound.high == pytest.approx(8 * f.ppf(0.95, 1, 16) / 16, rel=1e-5)


def test_a_failed_fit_ends_the_interval_and_a_second_basin_is_not_entered():
    def broken(delay):
        return 8.0 if delay < 3.0 else float("nan")

    assert profile_likelihood_interval(broken, 2.0, 8.0, 20, 4, (0.0, 10.0)).high == pytest.approx(3.0, abs=1e-4)

    def basins(delay):
        return 8.0 + 50 * min((delay - 2) ** 2, (delay - 7) ** 2)

    assert profile_likelihood_interval(basins, 2.0, 8.0, 20, 4, (0.0, 10.0)).high < 2.5


def test_when_the_quadratic_interval_is_doubtful():
    error = np.sqrt(0.5 / 50.0)
    common = (8.0, 20, 4)
    bounds = (0.0, 10.0)
    assert not quadratic_is_doubtful(parabola(), 2.0, error, *common, bounds)
    # interval 9 % and 11 % too short
    assert not quadratic_is_doubtful(parabola(curvature=50 / 1.09**2), 2.0, error, *common, bounds)
    assert quadratic_is_doubtful(parabola(curvature=50 / 1.12**2), 2.0, error, *common, bounds)
    assert quadratic_is_doubtful(parabola(curvature=50 * 1.11**2), 2.0, error, *common, bounds)
    # right on one side only
    assert quadratic_is_doubtful(lambda d: 8.0 + 50 * (d - 2) ** 2 * (1 if d < 2 else 2), 2.0, error, *common, bounds)
    assert quadratic_is_doubtful(parabola(), 2.0, error, *common, (1.9, 10.0))
    assert quadratic_is_doubtful(parabola(), 2.0, float("nan"), *common, bounds)
    assert quadratic_is_doubtful(parabola(), 2.0, 2 * error, *common, bounds)
    assert not quadratic_is_doubtful(parabola(), 2.0, 2 * error, *common, bounds, inflation=4.0)
