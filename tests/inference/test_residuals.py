"""Residual tests against sums by hand, their nominal level, and models that are wrong in known ways."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from ctid_cli.inference.residual_tests import residual_tests


def test_whiteness_by_hand():
    e = np.array([1.0, -1.0, 2.0, 0.0, 1.0])
    # sum e^2 = 7; lag 1: -1 - 2 + 0 + 0 = -3; lag 2: 2 + 0 + 2 = 4
    tests = residual_tests(e, np.array([1.0, -1.0, -1.0, 1.0, -1.0]), lags=2)
    np.testing.assert_allclose(tests.autocorrelation, [-3 / 7, 4 / 7], rtol=1e-14)
    q = 5 * 7 * ((3 / 7) ** 2 / 4 + (4 / 7) ** 2 / 3)
    assert tests.whiteness_statistic == pytest.approx(q, rel=1e-14)
    assert tests.whiteness_degrees_of_freedom == 2
    assert tests.whiteness_p_value == pytest.approx(np.exp(-q / 2), rel=1e-12)  # chi-square with two degrees
    assert tests.autocorrelation_band == pytest.approx(1.959964 / np.sqrt(5), rel=1e-6)


def test_cross_correlation_by_hand():
    e = np.array([1.0, -1.0, 2.0, -2.0])
    u = np.array([4.0, 2.0, 2.0, 4.0])  # centred: 1 -1 -1 1; sums of squares 10 and 4
    tests = residual_tests(e, u, lags=1)
    # k = -1: e(t) u(t+1): -1 + 1 + 2; k = 0: 1 + 1 - 2 - 2; k = 1: e(t) u(t-1): -1 - 2 + 2
    np.testing.assert_allclose(tests.cross_correlation, np.array([2.0, -2.0, -1.0]) / np.sqrt(40), rtol=1e-14)


def test_band_of_the_cross_correlation_is_ljungs():
    # An AR(1) residual and an AR(1) input: sum of the products of autocorrelations is (1 + ab) / (1 - ab).
    rng = np.random.default_rng(1)
    e = lfilter([1], [1, -0.9], rng.standard_normal(200_000))
    u = lfilter([1], [1, -0.5], rng.standard_normal(200_000))
    # It sums over all lags, however few are tested.
    band = residual_tests(e, u, lags=1).cross_correlation_band
    assert band == pytest.approx(1.959964 * np.sqrt(1.45 / 0.55 / 200_000), rel=0.02)
    white = rng.standard_normal(200_000)
    assert residual_tests(white, u, lags=1).cross_correlation_band == pytest.approx(
        1.959964 / np.sqrt(200_000), rel=0.02
    )


def test_statistic_of_white_residuals_and_white_input_is_the_sum_of_squares():
    rng = np.random.default_rng(2)
    tests = residual_tests(rng.standard_normal(50_000), rng.choice([-1.0, 1.0], 50_000), lags=10)
    assert tests.cross_degrees_of_freedom == 21
    assert tests.cross_statistic == pytest.approx(50_000 * np.sum(tests.cross_correlation**2), rel=0.03)
    assert tests.cross_p_value == pytest.approx(chi2.sf(tests.cross_statistic, 21), rel=1e-12)


@pytest.mark.parametrize("numerator", [[1.0], [1.0, 0.8]])
def test_a_sound_model_fails_at_the_stated_rate(numerator):
    # Residuals of an estimated first-order system; response of 60 samples, longer than the lags.
    rng = np.random.default_rng(3)
    coloured = len(numerator) > 1
    u = np.repeat(rng.choice([-1.0, 1.0], 100), 10)
    x = lfilter([0.05], [1, -0.95], u)
    psi = np.column_stack([lfilter([0.05], [1, -0.95], x), x])
    rejected = np.zeros(2)
    for _ in range(300):
        v = lfilter(numerator, [1.0, -0.7] if coloured else [1.0], rng.standard_normal(1200))[200:]
        residuals = v - psi @ np.linalg.lstsq(psi, v, rcond=None)[0]
        tests = residual_tests(residuals, u, sensitivities=psi)
        rejected += not tests.white, not tests.uncorrelated
    # binomial: 0.05 +- 3 * 0.0126; a little fewer, as the colour is estimated from the same residuals
    assert 0.01 < rejected[1] / 300 < 0.088
    if coloured:
        assert rejected[0] == 300
        assert "coloured" in tests.sentence
    else:
        assert 0.012 < rejected[0] / 300 < 0.088


def test_the_statistic_does_not_see_what_estimation_removes():
    rng = np.random.default_rng(4)
    u = rng.standard_normal(400)
    e = rng.standard_normal(400)
    psi = lfilter([1.0, 0.5], [1.0, -0.6], u)[:, None]
    e -= psi[:, 0] * (psi[:, 0] @ e) / (psi[:, 0] @ psi[:, 0])
    here = residual_tests(e, u, sensitivities=psi)
    # the colour of the residuals is estimated anew, hence not to the last digit
    moved = residual_tests(e - 0.01 * psi[:, 0], u, sensitivities=psi)
    assert moved.cross_statistic == pytest.approx(here.cross_statistic, rel=1e-3)
    assert residual_tests(e - 0.2 * psi[:, 0], u).cross_statistic > here.cross_statistic + 5


def test_missing_dynamics_and_feedback_are_told_apart():
    rng = np.random.default_rng(5)
    u, e = rng.standard_normal(1000), rng.standard_normal(1000)
    late = residual_tests(e + 0.3 * np.roll(u, 4), u)
    assert not late.uncorrelated
    assert np.argmax(np.abs(late.cross_correlation)) == late.lags + 4
    assert "misses a part of the response" in late.sentence
    early = residual_tests(e + 0.3 * np.roll(u, -4), u)
    assert not early.uncorrelated
    assert "feedback" in early.sentence


def test_an_offset_is_not_white_but_no_dependence_on_the_input():
    rng = np.random.default_rng(6)
    tests = residual_tests(rng.standard_normal(1000) + 0.5, 3.0 + rng.standard_normal(1000))
    assert not tests.white
    assert tests.uncorrelated


def test_scaling_changes_nothing():
    rng = np.random.default_rng(7)
    e, u = rng.standard_normal(300), rng.standard_normal(300)
    one, other = residual_tests(e, u), residual_tests(1e6 * e, 1e-6 * u + 1e-3)
    assert other.whiteness_statistic == pytest.approx(one.whiteness_statistic, rel=1e-9)
    assert other.cross_statistic == pytest.approx(one.cross_statistic, rel=1e-6)


def test_nothing_to_test_is_said():
    rng = np.random.default_rng(8)
    constant = residual_tests(rng.standard_normal(100), np.full(100, 0.1))
    assert np.isnan(constant.cross_p_value)
    assert constant.uncorrelated
    assert "does not vary enough" in constant.sentence
    zero = residual_tests(np.zeros(100), rng.standard_normal(100))
    assert zero.white
    assert "exactly zero" in zero.sentence


def test_every_estimated_lag_takes_a_degree_of_freedom():
    rng = np.random.default_rng(9)
    u = rng.standard_normal(500)
    u -= u.mean()
    e = rng.standard_normal(500)
    delayed = np.append(np.zeros(3), u[:-3])
    assert residual_tests(e, u).cross_degrees_of_freedom == 51
    assert residual_tests(e, u, sensitivities=np.column_stack((u, delayed))).cross_degrees_of_freedom == 49


def test_default_lags():
    assert residual_tests(np.ones(40), np.ones(40)).lags == 10
    assert residual_tests(np.ones(400), np.ones(400)).lags == 25
