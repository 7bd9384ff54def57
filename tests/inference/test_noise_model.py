"""Autoregressive noise models against the Yule-Walker equations, dense matrices and known autocovariances."""

import numpy as np
import pytest
from scipy.linalg import matmul_toeplitz, solve_toeplitz, toeplitz
from scipy.optimize import approx_fprime
from scipy.signal import lfilter
from scipy.stats import binom

from ctid_cli.inference.noise_model import (
    NoiseModel,
    _products,
    fit_noise_model,
    fit_residual_noise,
    levinson,
    restricted_likelihood,
)
from ctid_cli.inference.uncertainty import estimate_uncertainty
from tests.inference.autoregression import autocovariance


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
    np.testing.assert_allclose(levinson(model.partial)[0], model.coefficients, rtol=1e-9)


@pytest.mark.parametrize("count", [3, 37, 5000])
def test_covariance_of_products_is_that_of_the_toeplitz_matrix(count):
    model = fit_noise_model([ar2(300)])
    columns = np.random.default_rng(1).standard_normal((count, 2))
    expected = columns.T @ matmul_toeplitz(autocovariance(model, count), columns)
    np.testing.assert_allclose(model.covariance_of(columns), expected, rtol=1e-9)


def test_no_product_reaches_from_one_experiment_into_the_next():
    blocks = [np.array([1.0, 2.0, 3.0]), np.array([4.0, -1.0])]
    # r(0) = (1+4+9+16+1)/5, r(1) = (2+6-4)/5
    model = fit_noise_model(blocks, max_order=1)
    assert model.first_autocovariances[0] == pytest.approx(31 / 5)
    many = fit_noise_model(blocks * 50, max_order=1)
    assert many.first_autocovariances == pytest.approx([31 / 5, 4 / 5])


def slow_rows(count, rng, columns=3):
    """Return sensitivities to slow inputs, and to an offset."""
    return np.column_stack([lfilter([0.1], [1, -0.9], rng.standard_normal((columns, count))).T, np.ones(count)])


def left_of(psi, v):
    return v - psi @ np.linalg.lstsq(psi, v)[0]


def noise(rng, denominator, count):
    return lfilter([1.0], denominator, rng.standard_normal(count + 2000))[2000:]


def model_of(partial, variance=1.0):
    c, _, covariances = levinson(partial)
    return NoiseModel(c, variance * covariances, variance)


def test_criterion_and_gradient_are_those_of_dense_matrices():
    rng = np.random.default_rng(0)
    blocks = [np.column_stack((slow_rows(n, rng), rng.standard_normal(n))) for n in (60, 6)]
    products = _products(blocks, 3)
    partial = np.array([-0.8, 0.3, 0.1])

    def dense(partial):
        shape = model_of(partial)
        log_determinant, gram = 0.0, np.zeros((5, 5))
        for block in blocks:
            V = toeplitz(autocovariance(shape, len(block)))
            log_determinant += np.linalg.slogdet(V)[1]
            gram += block.T @ np.linalg.solve(V, block)
        squared = gram[4, 4] - gram[4, :4] @ np.linalg.solve(gram[:4, :4], gram[:4, 4])
        return 62 * np.log(squared / 62) + log_determinant + np.linalg.slogdet(gram[:4, :4])[1], squared / 62

    found = restricted_likelihood(products, 66, 2, partial)
    assert (found.criterion, found.variance) == pytest.approx(dense(partial), rel=1e-10)
    slope = approx_fprime(partial, lambda x: dense(x)[0], 1e-6)
    np.testing.assert_allclose(found.gradient, slope, rtol=1e-4)


def test_the_autocovariances_of_a_model_are_those_of_its_impulse_response():
    model = model_of(np.array([-0.8, 0.3, 0.1]), 2.0)
    h = lfilter([1.0], model.coefficients, np.append(1.0, np.zeros(400)))
    expected = [2.0 * h[: h.size - k] @ h[k:] for k in range(4)]
    np.testing.assert_allclose(model.first_autocovariances, expected, rtol=1e-9)
    # The mean of many samples has the variance R(0) / effective count.
    assert model.effective_count(1000) == pytest.approx(1000 * expected[0] / (2.0 * h.sum() ** 2), rel=1e-9)


def test_the_order_may_be_long_as_a_season():
    rng = np.random.default_rng(1)
    psi = slow_rows(3000, rng)
    season = np.zeros(13)
    season[[0, 12]] = 1.0, -0.8
    model = fit_residual_noise([psi], [left_of(psi, noise(rng, season, 3000))])
    assert model.order >= 12
    assert model.coefficients[12] == pytest.approx(-0.8, abs=0.05)


@pytest.mark.parametrize(("pole", "count"), [(0.7, 60), (0.95, 600)])
def test_intervals_of_short_records_of_coloured_noise_cover(pole, count):
    """AR(1) noise, records that are worth about 10 and 15 independent samples: of 300 runs 95 % -+ 4 are inside."""
    rng = np.random.default_rng(2)
    psi = slow_rows(count, rng)
    covered = np.zeros(4)
    for _ in range(300):
        v = noise(rng, [1.0, -pole], count)
        error = np.linalg.lstsq(psi, v)[0]
        law = estimate_uncertainty([psi], [v - psi @ error], "auto")
        covered += np.abs(error) < law.quantiles() * np.sqrt(np.diag(law.covariance))
    low, high = binom.ppf([5e-4, 1 - 5e-4], 300, 0.95)
    assert ((low <= covered) & (covered <= high)).all()
