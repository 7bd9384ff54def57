"""Projections in blocks of rows against dense least squares."""

import numpy as np
import pytest
from scipy.linalg import matmul_toeplitz
from scipy.stats import chi2

from ctid_cli.inference.noise_model import ROWS, NoiseModel
from ctid_cli.inference.residual_tests import Rest, SideBySide, constant, dependence, orthonormal, rest_of

RNG = np.random.default_rng(5)


def least_squares_rest(columns, beside):
    beside = beside / np.linalg.norm(beside, axis=0)
    return columns - beside @ np.linalg.lstsq(beside, columns, rcond=None)[0]


@pytest.mark.parametrize("count", [40, ROWS, 2 * ROWS + 17])
def test_the_rest_is_that_of_least_squares(count):
    # Nearly collinear columns of very different sizes, one twice.
    slow = np.cumsum(RNG.standard_normal(count))
    beside = np.column_stack((slow, 1e6 * slow + RNG.standard_normal(count), slow))
    columns = RNG.standard_normal((count, 3))
    parts = SideBySide((constant(count), beside))
    expected = least_squares_rest(columns, parts[:])
    # Rounding turns a span by eps times the condition number, here of the three columns that differ.
    sizes = np.linalg.svd(parts[:] / np.linalg.norm(parts[:], axis=0), compute_uv=False)
    slack = np.finfo(float).eps * sizes[0] / sizes[2] * np.linalg.norm(columns, axis=0).max()
    assert slack < 1e-5
    np.testing.assert_allclose(Rest.of(columns, parts)[:], expected, rtol=0, atol=slack)
    np.testing.assert_allclose(rest_of(columns[:, 1], parts), expected[:, 1], rtol=0, atol=slack)
    assert orthonormal(parts).shape == (4, 3)


def test_a_column_of_zeros_has_no_weight():
    for _ in range(50):
        weights = orthonormal(np.insert(RNG.standard_normal((40, 5)), 2, 0.0, axis=1))
        assert weights.shape == (6, 5)
        assert np.abs(weights[2]).max() < 1e-12


def test_dependence_is_the_chi_square_form_of_dense_matrices():
    count, noise = 2 * ROWS + 5, NoiseModel(np.array([1.0, -0.6]), np.array([1.0, 0.6]) / 0.64, 1.0)
    e, columns, beside = (RNG.standard_normal((count, width)) for width in (1, 4, 2))
    rest = least_squares_rest(columns, beside)
    covariance = rest.T @ matmul_toeplitz(noise.autocovariance(count), rest) * count / (count - 2)
    products = columns.T @ least_squares_rest(e, beside)
    found = dependence(e[:, 0], columns, noise, beside)
    assert found.statistic == pytest.approx((products.T @ np.linalg.solve(covariance, products)).item(), rel=1e-9)
    assert found.p_value == pytest.approx(chi2.sf(found.statistic, 4), rel=1e-9)
