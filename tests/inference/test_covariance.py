"""Covariances for white and coloured noise, against exact ones and by coverage; messages on ill-conditioned ones."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import block_diag, toeplitz
from scipy.signal import lfilter
from scipy.stats import binom

from ctid_cli.inference.covariance import (
    Rounding,
    _of_rounding,
    condition_number,
    describe_conditioning,
    robust_dispersion,
    white_noise_dispersion,
)
from ctid_cli.inference.loop_noise import SensitivityFunction
from ctid_cli.inference.noise_model import NoiseModel, fit_residual_noise
from ctid_cli.inference.uncertainty import estimate_uncertainty
from tests.inference.autoregression import autocovariance


def sensitivities(seed, scales):
    return np.random.default_rng(seed).standard_normal((40, len(scales))) * np.array(scales)


@given(st.integers(0, 2**31), st.lists(st.floats(-8, 8), min_size=1, max_size=5))
def test_covariance_is_that_of_linear_least_squares(seed, exponents):
    # s^2 (Psi' Psi)^-1 by an orthogonal decomposition, for parameters of any units.
    psi = sensitivities(seed, 10.0 ** np.array(exponents))
    p = len(exponents)
    covariance = white_noise_dispersion(psi.T @ psi, 7.0, 40).covariance
    r_inverse = np.linalg.inv(np.linalg.qr(psi / np.linalg.norm(psi, axis=0))[1])
    scale = 1 / np.linalg.norm(psi, axis=0)
    expected = r_inverse @ r_inverse.T * np.outer(scale, scale) * 7.0 / (40 - p)
    deviations = np.sqrt(np.diag(expected))
    assert np.abs((covariance - expected) / np.outer(deviations, deviations)).max() < 1e-10
    assert np.array_equal(covariance, covariance.T)


@pytest.mark.parametrize(
    "hessian",
    [np.ones((2, 2)), np.diag([1.0, 0.0]), np.diag([1.0, np.nan]), np.array([[1.0, 1 - 1e-16], [1 - 1e-16, 1.0]])],
)
def test_singular_matrices_have_no_covariance(hessian):
    assert np.isnan(white_noise_dispersion(hessian, 1.0, 40).covariance).all()
    assert condition_number(hessian) > 1e14


def test_no_degrees_of_freedom_no_covariance():
    assert np.isnan(white_noise_dispersion(np.eye(3), 1.0, 3).covariance).all()
    assert white_noise_dispersion(np.eye(3), 1.0, 4).covariance[0, 0] == 1.0


def regressors(count, seed=0, pole=0.95):
    """Return the sensitivities of a first-order system with a delay to its pole, gain and delay."""
    u = np.repeat(np.random.default_rng(seed).choice([-1.0, 1.0], count // 10 + 1), 10)[:count]
    x = lfilter([1 - pole], [1, -pole], u)
    return np.column_stack([lfilter([1 - pole], [1, -pole], x), x, np.append(0, np.diff(x)) / (1 - pole)])


def noise(rng, count, numerator=(1.0, 0.8), denominator=(1.0, -1.5, 0.7)):
    return lfilter(numerator, denominator, rng.standard_normal(count + 300))[300:]


def largest_relative_error(covariance, expected):
    deviations = np.sqrt(np.diag(expected))
    return np.abs((covariance - expected) / np.outer(deviations, deviations)).max()


def covariance_of(psi, residuals):
    return robust_dispersion(psi, residuals).covariance


def test_is_the_double_sum_over_all_pairs_of_samples():
    psi, v = regressors(200), noise(np.random.default_rng(1), 200)
    R = toeplitz(autocovariance(fit_residual_noise([psi], [v]), 200))
    M = np.linalg.inv(psi.T @ psi)
    assert largest_relative_error(covariance_of([psi], [v]), M @ psi.T @ R @ psi @ M) < 1e-9


def test_in_a_loop_noise_passes_the_sensitivity_function():
    # S has a zero at 1, from an integrating controller; the zero of the unstable plant at 1.25 is reflected to .8.
    loop = SensitivityFunction.of(np.array([1.0, 1.25, 0.3]), np.array([0.9 + 0.2j, 0.9 - 0.2j, 0.0]))
    psi, v = regressors(200), noise(np.random.default_rng(1), 200)
    S = toeplitz(lfilter(np.poly([1.0, 0.8, 0.3]), np.poly(loop.poles), np.eye(200)[0]), np.zeros(200))
    found = robust_dispersion([psi], [S @ v], loop)
    covariance, model = found.covariance, found.noise
    R, M = toeplitz(autocovariance(model, 200)), np.linalg.inv(psi.T @ psi)
    # By the autoregression of v, with the sensitivities of its open loop.
    own = fit_residual_noise([np.linalg.solve(S, psi)], [v])
    np.testing.assert_allclose(model.coefficients, own.coefficients, atol=1e-6)
    assert largest_relative_error(covariance, M @ psi.T @ S @ R @ S.T @ psi @ M) < 1e-6


def test_white_residuals_give_the_white_formula():
    psi = regressors(200)
    v = np.random.default_rng(4).standard_normal(200)
    v -= psi @ np.linalg.lstsq(psi, v)[0]
    assert fit_residual_noise([psi], [v]).order == 0  # then it is exact, N - p included
    expected = white_noise_dispersion(psi.T @ psi, v @ v, 200).covariance
    assert largest_relative_error(covariance_of([psi], [v]), expected) < 1e-12


def test_experiments_are_independent_of_each_other():
    psi = [regressors(150, 1), regressors(90, 2)]
    v = [noise(np.random.default_rng(1), 150), noise(np.random.default_rng(2), 90)]
    r = autocovariance(fit_residual_noise(psi, v), 150)
    stacked = np.vstack(psi)
    M = np.linalg.inv(stacked.T @ stacked)
    sigma = stacked.T @ block_diag(toeplitz(r), toeplitz(r[:90])) @ stacked
    expected = M @ sigma @ M
    assert largest_relative_error(covariance_of(psi, v), expected) < 1e-9


def test_undefined_where_the_data_say_nothing():
    v = np.random.default_rng(0).standard_normal(50)
    assert np.isnan(covariance_of([np.ones((50, 2))], [v])).all()
    assert np.isnan(covariance_of([np.eye(50)[:, :2] * 0], [v])).all()
    assert np.isnan(covariance_of([np.eye(2)], [v[:2]])).all()


def test_rounding_adds_the_covariance_of_a_random_position_of_the_levels():
    """Without noise the sum over harmonics is Bernoulli's polynomial, here up to the first 50 of them."""
    rng = np.random.default_rng(1)
    rows, x, step = rng.standard_normal((80, 2)), rng.standard_normal(80), 0.4
    z = np.abs(np.subtract.outer(x, x)) / step % 1.0
    expected = rows.T @ (0.5 * step**2 * (z**2 - z + 1.0 / 6.0)) @ rows
    without_noise = NoiseModel(np.ones(1), np.zeros(1), 0.0)
    found = _of_rounding(rows, Rounding(step, x), without_noise)
    np.testing.assert_allclose(found, expected, rtol=0.03, atol=0.03 * np.trace(expected))
    # Noise of the size of a step makes the error independent.
    noisy = NoiseModel(np.ones(1), np.full(1, step**2), step**2)
    assert not _of_rounding(rows, Rounding(step, x), noisy).any()


def test_intervals_cover_in_noise_of_changing_variance():
    """Deviation proportional to a regressor: 300 runs, 95 % -+ 4; those for a constant variance cover less."""
    rng = np.random.default_rng(4)
    psi = np.column_stack((regressors(300)[:, 0], np.ones(300)))
    covered = np.zeros((2, 2))
    for _ in range(300):
        v = psi[:, 0] * rng.standard_normal(300)
        error = np.linalg.lstsq(psi, v)[0]
        for k, kind in enumerate(("auto", "white")):
            law = estimate_uncertainty([psi], [v - psi @ error], kind)
            covered[k] += np.abs(error) < law.quantiles() * law.errors(np.eye(2))
    low, high = binom.ppf([5e-4, 1 - 5e-4], 300, 0.95)
    assert ((low <= covered[0]) & (covered[0] <= high)).all()
    assert covered[1, 0] < low


NAMES = ("a1", "b0", "delay")


def covariance(errors, pairs=()):
    correlation = np.eye(len(errors))
    for i, j, value in pairs:
        correlation[i, j] = correlation[j, i] = value
    return correlation * np.outer(errors, errors)


FIVE = ("a1", "a2", "b0", "b1", "delay")
# Correlations between pairs are 0.6 to 0.8, but the third parameter is nearly the sum of the others.
TOGETHER = np.random.default_rng(1).standard_normal((1000, 3))
TOGETHER[:, 2] = TOGETHER[:, 0] + TOGETHER[:, 1] + 0.01 * TOGETHER[:, 2]
UNDEFINED = np.full((3, 3), np.nan)
DIRECTION = np.array([[4.0, 0.0, 0.0], [0.0, 1.0, 2.0], [0.0, 2.0, 4.0]])


@pytest.mark.parametrize(
    ("C", "names", "hessian", "words"),
    [
        (covariance([0.1, 0.1, 0.1], [(0, 1, 0.998)]), NAMES, None, ()),
        (
            covariance([0.1, 0.1, 0.1], [(1, 2, -0.9995)]),
            *(NAMES, None),
            (
                "These data can hardly distinguish b0 and delay (correlation -0.99950)",
                "hardly shows when the response begins",
            ),
        ),
        # Pairs that share a parameter are in one sentence.
        (
            covariance([0.1] * 5, [(0, 1, 0.9997), (1, 2, 0.9997), (0, 2, 0.9996)]),
            *(FIVE, None),
            (
                f"These data can hardly distinguish {FIVE[0]}, {FIVE[1]} and {FIVE[2]} (correlations above "
                "0.999): only combinations",
            ),
        ),
        (
            np.cov(TOGETHER.T),
            *(("a1", "a2", "b0"), None),
            ("These data can hardly distinguish a1, a2 and b0 (multiple correlations",),
        ),
        (
            UNDEFINED,
            *(NAMES, DIRECTION),
            ("do not determine b0 and delay separately (singular equations); no standard errors can be given",),
        ),
        (UNDEFINED, NAMES, None, ("do not determine the parameters separately",)),
        (UNDEFINED, NAMES, np.diag([1.0, 1.0, 0.0]), ("delay has no detectable effect in these data",)),
        (
            covariance([0.1, 0.1, 0.1], [(1, 2, 1 - 1e-9)]),
            *(NAMES, None),
            ("b0 and delay separately (condition number 2.0e+09); their standard errors are not reliable",),
        ),
    ],
)
def test_descriptions_of_conditioning(C, names, hessian, words):
    if hessian is None:
        hessian = np.linalg.inv(C) if np.isfinite(C).all() else UNDEFINED
    found = describe_conditioning(C, names, hessian)
    assert len(found) == bool(words)
    assert all(word in sentence for sentence in found for word in words)
