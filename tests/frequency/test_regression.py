"""Delay regression and mixing: closed forms against operator products, determinants against numpy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import polynomial

from ctid_cli.frequency.delay_regression import delay_table
from ctid_cli.frequency.drem import mix
from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares


def mixed(matrix):
    """Return Psi and Delta of one stacked regression."""
    [row] = mix([line[None, :] for line in matrix])
    return row[:-1], row[-1]


@pytest.mark.parametrize("n", range(1, 9))
def test_table_holds_the_products_of_delay_operators(n):
    # psi = -(1 + Z^2)^n, phi_k = (2 Z)^k (1 + Z^2)^(n - k), multiplied out by numpy.
    table = delay_table(n)
    for k in range(n + 1):
        product = polynomial.polymul(polynomial.polypow([0.0, 2.0], k), polynomial.polypow([1.0, 0.0, 1.0], n - k))
        expected = np.zeros(2 * n + 1)
        expected[: product.size] = product
        np.testing.assert_array_equal(table[k - 1] if k else -table[n], expected)


@pytest.mark.parametrize(("length", "difference"), [(0.0, 0.0), (1.0, 0.0), (0.0, 0.7), (1.0, 0.7), (0.013, 0.01)])
def test_prefilter_is_a_hann_window_and_a_difference(length, difference):
    weights = RestartingLeastSquares(tones=1, h=0.4, prefilter=length, difference=difference).weights(0.01)
    order, shift = round(length / 0.01), round(difference / 0.01)
    assert weights.size == order + shift + 1
    window = np.hanning(order + 3)[1:-1]
    expected = np.convolve(window / window.sum(), [1.0, *[0.0] * (shift - 1), -1.0] if shift else [1.0])
    np.testing.assert_allclose(weights, expected, atol=1e-15)


@given(st.integers(1, 8), st.integers(0, 2**31))
def test_mixing_is_cramers_rule(n, seed):
    matrix = np.random.default_rng(seed).standard_normal((n, n + 1))
    right, delta = mixed(matrix)
    scale = np.prod(np.linalg.norm(matrix, axis=1))
    assert delta == pytest.approx(np.linalg.det(matrix[:, :n]), rel=1e-9, abs=1e-12 * scale)
    np.testing.assert_allclose(matrix[:, :n] @ right, delta * matrix[:, n], atol=1e-11 * scale)


def test_mixing_of_a_singular_matrix_is_finite():
    # Two equal rows of regressors with different right-hand sides: theta does not exist, but the numbers are finite.
    right, delta = mixed(np.array([[1.0, 2.0, 3.0], [1.0, 2.0, 5.0]]))
    assert delta == 0.0
    np.testing.assert_array_equal(right, [-4.0, 2.0])
