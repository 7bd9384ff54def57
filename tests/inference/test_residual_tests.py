"""Residual tests against sums by hand, their nominal level, and models with known errors."""

import numpy as np
import pytest
from scipy.linalg import matmul_toeplitz
from scipy.signal import lfilter
from scipy.stats import binom, chi2

from ctid_cli.inference.noise_model import ROWS, NoiseModel
from ctid_cli.inference.residual_tests import (
    Concatenated,
    Projected,
    constant,
    dependence,
    input_dependence,
    orthonormal,
    regression_residuals,
    residual_tests,
)
from ctid_cli.signals.record import Record
from tests.inference.autoregression import autocovariance


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


def test_band_of_the_cross_correlation_is_ljungs():
    # An AR(1) residual and an AR(1) input: the sum of the products of autocorrelations is (1 + ab) / (1 - ab).
    rng = np.random.default_rng(1)
    e = lfilter([1], [1, -0.9], rng.standard_normal(200_000))
    u = lfilter([1], [1, -0.5], rng.standard_normal(200_000))
    # It includes all lags, not only the tested ones.
    band = residual_tests(e, u, lags=1).cross_correlation_band
    assert band == pytest.approx(1.959964 * np.sqrt(1.45 / 0.55 / 200_000), rel=0.02)
    white = rng.standard_normal(200_000)
    assert residual_tests(white, u, lags=1).cross_correlation_band == pytest.approx(
        1.959964 / np.sqrt(200_000), rel=0.02
    )


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
    # binomial: 0.05 +- 3 * 0.0126; slightly fewer, because the colour is estimated from the same residuals
    assert 0.01 < rejected[1] / 300 < 0.088
    if coloured:
        assert rejected[0] == 300
        assert "coloured" in tests.sentence
    else:
        assert 0.012 < rejected[0] / 300 < 0.088


def test_signals_without_variation_are_not_tested():
    rng = np.random.default_rng(8)
    constant = residual_tests(rng.standard_normal(100), np.full(100, 0.1))
    assert np.isnan(constant.cross_p_value)
    assert constant.uncorrelated
    assert "does not vary enough" in constant.sentence
    zero = residual_tests(np.zeros(100), rng.standard_normal(100))
    assert zero.white
    assert "exactly zero" in zero.sentence


RNG = np.random.default_rng(5)


def least_squares_rest(columns, beside):
    beside = beside / np.linalg.norm(beside, axis=0)
    return columns - beside @ np.linalg.lstsq(beside, columns, rcond=None)[0]


@pytest.mark.parametrize("count", [40, ROWS, 2 * ROWS + 17])
def test_the_rest_is_that_of_least_squares(count):
    # Nearly collinear columns of very different sizes, one of them repeated.
    slow = np.cumsum(RNG.standard_normal(count))
    beside = np.column_stack((slow, 1e6 * slow + RNG.standard_normal(count), slow))
    columns = RNG.standard_normal((count, 3))
    parts = Concatenated((constant(count), beside))
    expected = least_squares_rest(columns, parts[:])
    # Rounding rotates a subspace by eps times the condition number, here of the three different columns.
    sizes = np.linalg.svd(parts[:] / np.linalg.norm(parts[:], axis=0), compute_uv=False)
    slack = np.finfo(float).eps * sizes[0] / sizes[2] * np.linalg.norm(columns, axis=0).max()
    assert slack < 1e-5
    np.testing.assert_allclose(Projected.of(columns, parts)[:], expected, rtol=0, atol=slack)
    np.testing.assert_allclose(regression_residuals(columns[:, 1], parts), expected[:, 1], rtol=0, atol=slack)
    assert orthonormal(parts).shape == (4, 3)


def test_dependence_is_the_chi_square_form_of_dense_matrices():
    count, noise = 2 * ROWS + 5, NoiseModel(np.array([1.0, -0.6]), np.array([1.0, 0.6]) / 0.64, 1.0)
    e, columns, beside = (RNG.standard_normal((count, width)) for width in (1, 4, 2))
    rest = least_squares_rest(columns, beside)
    covariance = rest.T @ matmul_toeplitz(autocovariance(noise, count), rest) * count / (count - 2)
    products = columns.T @ least_squares_rest(e, beside)
    found = dependence(e[:, 0], columns, noise, beside)
    assert found.statistic == pytest.approx((products.T @ np.linalg.solve(covariance, products)).item(), rel=1e-9)
    assert found.p_value == pytest.approx(chi2.sf(found.statistic, 4), rel=1e-9)


N = 600


def input_tests(rng, *, colour=0.0, pole=0.0, feedback=0.0):
    """Return the tests of the errors of a first-order model with known parameters."""
    e = lfilter([1.0], [1.0, -colour], rng.standard_normal(N))
    r = np.repeat(rng.choice([-3.0, 3.0], N // 4), 4)
    u = r - feedback * e
    x = lfilter([0.0, 0.3], [1.0, -0.7], u)
    e = e + pole * lfilter([0.0, 0.1], [1.0, -0.9], x)
    record = Record.from_arrays(np.arange(N), u, x + e)
    return input_dependence(e, x, x[:, None], record.t, record, 0.0)


@pytest.mark.parametrize("colour", [0.0, 0.8])
def test_false_alarms_have_the_nominal_level(colour):
    rng = np.random.default_rng(7)
    found = [input_tests(rng, colour=colour) for _ in range(150)]
    # Both levels are approximate: at most twice the nominal one, with a confidence of 99.9 %.
    most = binom.ppf(0.999, len(found), 0.1)
    assert sum(one.pole_p_value < 0.05 for one in found) <= most
    assert sum(one.feedback_p_value < 0.05 for one in found) <= most


def test_missing_dynamics_and_feedback_are_distinguished():
    rng = np.random.default_rng(8)
    poor, looped = input_tests(rng, pole=1.0), input_tests(rng, feedback=0.3)
    assert poor.pole_p_value < 1e-6 < 1e-2 < poor.feedback_p_value
    assert poor.pole_share > 0.1
    assert looped.feedback_p_value < 1e-6 < 1e-2 < looped.pole_p_value


def test_a_short_record_is_not_tested():
    record = Record.from_arrays(np.arange(50), np.ones(50), np.ones(50))
    assert input_dependence(np.ones(50), np.ones(50), np.ones((50, 1)), record.t, record, 0.0) is None
