"""Covariances and condition numbers from the Gauss-Newton matrix."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.inference.covariance import condition_number, white_noise_covariance


def sensitivities(seed, scales):
    return np.random.default_rng(seed).standard_normal((40, len(scales))) * np.array(scales)


@given(st.integers(0, 2**31), st.lists(st.floats(-8, 8), min_size=1, max_size=5))
def test_covariance_is_that_of_linear_least_squares(seed, exponents):
    # s^2 (Psi' Psi)^-1 by an orthogonal decomposition, for parameters of any units.
    psi = sensitivities(seed, 10.0 ** np.array(exponents))
    p = len(exponents)
    covariance = white_noise_covariance(psi.T @ psi, 7.0, 40)
    r_inverse = np.linalg.inv(np.linalg.qr(psi / np.linalg.norm(psi, axis=0))[1])
    scale = 1 / np.linalg.norm(psi, axis=0)
    expected = r_inverse @ r_inverse.T * np.outer(scale, scale) * 7.0 / (40 - p)
    deviations = np.sqrt(np.diag(expected))
    assert np.abs((covariance - expected) / np.outer(deviations, deviations)).max() < 1e-10
    assert np.array_equal(covariance, covariance.T)


@given(st.integers(0, 2**31), st.floats(-8, 8))
def test_condition_number_is_free_of_units(seed, exponent):
    psi = sensitivities(seed, [1.0, 1.0, 1.0])
    rescaled = psi * [1.0, 10.0**exponent, 1.0]
    unit = psi / np.linalg.norm(psi, axis=0)
    expected = np.linalg.cond(unit) ** 2
    assert condition_number(psi.T @ psi) == pytest.approx(expected, rel=1e-9)
    assert condition_number(rescaled.T @ rescaled) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    "hessian",
    [np.ones((2, 2)), np.diag([1.0, 0.0]), np.diag([1.0, np.nan]), np.array([[1.0, 1 - 1e-16], [1 - 1e-16, 1.0]])],
)
def test_singular_matrices_have_no_covariance(hessian):
    assert np.isnan(white_noise_covariance(hessian, 1.0, 40)).all()
    assert condition_number(hessian) > 1e14


def test_no_degrees_of_freedom_no_covariance():
    assert np.isnan(white_noise_covariance(np.eye(3), 1.0, 3)).all()
    assert white_noise_covariance(np.eye(3), 1.0, 4)[0, 0] == 1.0
