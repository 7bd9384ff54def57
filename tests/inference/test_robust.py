"""The sandwich against exact covariances, limiting cases and Monte Carlo coverage."""

import numpy as np
import pytest
from scipy.linalg import block_diag, toeplitz
from scipy.signal import lfilter

from ctid_cli.inference.covariance import robust_covariance, white_noise_covariance
from ctid_cli.inference.noise_model import fit_residual_noise


def regressors(count, seed=0, pole=0.95):
    """Sensitivities of a first-order system with a delay to its pole, gain and delay."""
    u = np.repeat(np.random.default_rng(seed).choice([-1.0, 1.0], count // 10 + 1), 10)[:count]
    x = lfilter([1 - pole], [1, -pole], u)
    return np.column_stack([lfilter([1 - pole], [1, -pole], x), x, np.append(0, np.diff(x)) / (1 - pole)])


def noise(rng, count, numerator=(1.0, 0.8), denominator=(1.0, -1.5, 0.7)):
    return lfilter(numerator, denominator, rng.standard_normal(count + 300))[300:]


def largest_relative_error(covariance, expected):
    deviations = np.sqrt(np.diag(expected))
    return np.abs((covariance - expected) / np.outer(deviations, deviations)).max()


def covariance_of(psi, residuals, regular=True):
    return robust_covariance(psi, residuals, regular=regular)[0]


def test_is_the_double_sum_over_all_pairs_of_samples():
    psi, v = regressors(200), noise(np.random.default_rng(1), 200)
    R = toeplitz(fit_residual_noise([psi], [v]).autocovariance(200))
    M = np.linalg.inv(psi.T @ psi)
    assert largest_relative_error(covariance_of([psi], [v]), M @ psi.T @ R @ psi @ M) < 1e-9


def test_approaches_the_exact_covariance_of_known_noise():
    count = 20_000
    psi = regressors(count)
    h = lfilter([1.0, 0.8], [1.0, -1.5, 0.7], np.append(1.0, np.zeros(300)))
    R = np.zeros(count)
    R[:301] = [h[: h.size - k] @ h[k:] for k in range(301)]
    M = np.linalg.inv(psi.T @ psi)
    sigma = R[0] * psi.T @ psi
    for lag in range(1, 301):
        product = psi[lag:].T @ psi[:-lag]
        sigma += R[lag] * (product + product.T)
    v = noise(np.random.default_rng(2), count)
    assert largest_relative_error(covariance_of([psi], [v], True), M @ sigma @ M) < 0.1
    assert largest_relative_error(covariance_of([psi], [v], False), M @ sigma @ M) < 0.35
    assert largest_relative_error(white_noise_covariance(psi.T @ psi, v @ v, count), M @ sigma @ M) > 0.5


def test_white_residuals_give_the_white_formula():
    psi = regressors(200)
    v = np.random.default_rng(4).standard_normal(200)
    v -= psi @ np.linalg.lstsq(psi, v)[0]
    assert fit_residual_noise([psi], [v]).order == 0  # then it is exact, N - p included
    expected = white_noise_covariance(psi.T @ psi, v @ v, 200)
    assert largest_relative_error(covariance_of([psi], [v], True), expected) < 1e-12
    psi, v = regressors(20_000), np.random.default_rng(5).standard_normal(20_000)
    expected = white_noise_covariance(psi.T @ psi, v @ v, 20_000)
    assert largest_relative_error(covariance_of([psi], [v], False), expected) < 0.1


@pytest.mark.parametrize(("regular", "lowest", "highest"), [(True, 0.93, 0.97), (False, 0.92, 0.985)])
def test_intervals_cover_under_coloured_noise(regular, lowest, highest):
    rng = np.random.default_rng(6)
    psi = regressors(1000)
    solve = np.linalg.pinv(psi)
    robust, white = np.zeros(3), np.zeros(3)
    for _ in range(400):
        v = noise(rng, 1000)
        error = solve @ v
        residuals = v - psi @ error
        robust += np.abs(error) < 1.96 * np.sqrt(np.diag(covariance_of([psi], [residuals], regular)))
        covariance = white_noise_covariance(psi.T @ psi, residuals @ residuals, 1000)
        white += np.abs(error) < 1.96 * np.sqrt(np.diag(covariance))
    # of 400 runs: two binomial standard deviations are 0.022
    assert (robust / 400 > lowest - 0.022).all()
    assert (robust / 400 < highest + 0.022).all()
    assert (white / 400 < 0.85).all()


@pytest.mark.parametrize("regular", [True, False])
def test_covariance_follows_the_units(regular):
    psi, v = regressors(500), noise(np.random.default_rng(8), 500)
    units = np.array([1e-6, 1.0, 1e6])
    rescaled = covariance_of([1e3 * psi * units], [1e3 * v], regular)
    expected = covariance_of([psi], [v], regular) / np.outer(units, units)
    assert largest_relative_error(rescaled, expected) < 1e-9


def test_experiments_are_independent_of_each_other():
    psi = [regressors(150, 1), regressors(90, 2)]
    v = [noise(np.random.default_rng(1), 150), noise(np.random.default_rng(2), 90)]
    r = fit_residual_noise(psi, v).autocovariance(150)
    stacked = np.vstack(psi)
    M = np.linalg.inv(stacked.T @ stacked)
    sigma = stacked.T @ block_diag(toeplitz(r), toeplitz(r[:90])) @ stacked
    expected = M @ sigma @ M
    assert largest_relative_error(covariance_of(psi, v, True), expected) < 1e-9


@pytest.mark.parametrize("regular", [True, False])
def test_twice_the_experiments_halve_the_variance(regular):
    psi, v = regressors(20_000), noise(np.random.default_rng(7), 20_000)
    single = covariance_of([psi], [v], regular)
    double = covariance_of([psi, psi], [v, -v], regular)
    assert largest_relative_error(2 * double, single) < 0.05


def test_missing_samples_of_a_regular_clock():
    count = 20_000
    rng = np.random.default_rng(9)
    psi, v = regressors(count), noise(rng, count)
    v[rng.random(count) < 0.3] = np.nan
    v[5000:6000] = np.nan
    use = np.isfinite(v)
    h = lfilter([1.0, 0.8], [1.0, -1.5, 0.7], np.append(1.0, np.zeros(300)))
    sigma = np.zeros((3, 3))
    kept = np.where(use[:, None], psi, 0.0)
    for lag in range(301):
        product = h[: h.size - lag] @ h[lag:] * kept[lag:].T @ kept[: count - lag]
        sigma += product if lag == 0 else product + product.T
    M = np.linalg.inv(kept.T @ kept)
    covariance = covariance_of([psi[use]], [v[use]], True)
    assert largest_relative_error(covariance, M @ sigma @ M) < 0.1


@pytest.mark.parametrize("regular", [True, False])
def test_undefined_where_the_data_say_nothing(regular):
    v = np.random.default_rng(0).standard_normal(50)
    assert np.isnan(covariance_of([np.ones((50, 2))], [v], regular)).all()
    assert np.isnan(covariance_of([np.eye(50)[:, :2] * 0], [v], regular)).all()
    assert np.isnan(covariance_of([np.eye(2)], [v[:2]], regular)).all()
