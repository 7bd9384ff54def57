"""Autoregressive noise models against the Yule-Walker equations and known autocovariances."""

import numpy as np
import pytest
from scipy.linalg import matmul_toeplitz, solve_toeplitz, toeplitz
from scipy.signal import lfilter

from ctid_cli.inference.noise_model import NoiseModel, fit_noise_model


def ar2(count, seed=0):
    return lfilter([1.0], [1.0, -1.5, 0.7], np.random.default_rng(seed).standard_normal(count + 500))[500:]


def test_solves_the_yule_walker_equations():
    v = ar2(400)
    model = fit_noise_model([v])
    r = np.array([v[k:] @ v[: v.size - k] for k in range(model.order + 1)]) / v.size
    assert model.order >= 2
    np.testing.assert_allclose(model.first_autocovariances, r, rtol=1e-12)
    np.testing.assert_allclose(model.coefficients[1:], -solve_toeplitz(r[:-1], r[1:]), rtol=1e-9)
    assert model.innovation_variance == pytest.approx(model.coefficients @ r, rel=1e-9)


def test_finds_order_coefficients_and_variance():
    model = fit_noise_model([ar2(100_000)], max_order=2)
    np.testing.assert_allclose(model.coefficients, [1.0, -1.5, 0.7], atol=0.01)
    assert model.innovation_variance == pytest.approx(1.0, abs=0.02)


def test_autocovariance_is_that_of_the_impulse_response():
    # R(k) = sigma^2 sum_j h(j) h(j + k)
    c = np.array([1.0, -1.5, 0.7])
    h = lfilter([1.0], c, np.append(1.0, np.zeros(400)))
    expected = np.array([h[: h.size - k] @ h[k:] for k in range(60)])
    model = NoiseModel(c, expected[:3], 1.0)
    np.testing.assert_allclose(model.autocovariance(60), expected, atol=1e-9)
    np.testing.assert_array_equal(model.autocovariance(2), expected[:2])


@pytest.mark.parametrize("count", [3, 37, 5000])
def test_covariance_of_products_is_that_of_the_toeplitz_matrix(count):
    model = fit_noise_model([ar2(300)])
    columns = np.random.default_rng(1).standard_normal((count, 2))
    expected = columns.T @ matmul_toeplitz(model.autocovariance(count), columns)
    np.testing.assert_allclose(model.covariance_of(columns), expected, rtol=1e-9)


def test_products_of_slow_noise_end_long_after_the_columns():
    root = 0.99999
    model = NoiseModel(np.array([1.0, -root]), np.array([1.0, root]) / (1.0 - root**2), 1.0)
    expected = toeplitz(root ** np.arange(50)).sum() / (1.0 - root**2)
    assert model.covariance_of(np.ones((50, 1)))[0, 0] == pytest.approx(expected, rel=1e-9)


def test_white_noise_has_order_zero_and_no_later_autocovariance():
    v = np.array([1.0, -1.0, -1.0, 1.0, 1.0, -1.0, -1.0, 1.0])
    model = fit_noise_model([v], max_order=1)  # products at lag one: -1 1 -1 1 -1 1 -1, r(1)/r(0) = -1/8
    assert model.order == 0
    np.testing.assert_array_equal(model.autocovariance(3), [1.0, 0.0, 0.0])


def test_no_product_reaches_from_one_experiment_into_the_next():
    blocks = [np.array([1.0, 2.0, 3.0]), np.array([4.0, -1.0])]
    # r(0) = (1+4+9+16+1)/5, r(1) = (2+6-4)/5
    model = fit_noise_model(blocks, max_order=1)
    assert model.first_autocovariances[0] == pytest.approx(31 / 5)
    many = fit_noise_model(blocks * 50, max_order=1)
    assert many.first_autocovariances == pytest.approx([31 / 5, 4 / 5])
