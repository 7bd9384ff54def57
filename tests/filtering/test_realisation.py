"""Building blocks of the filters: roots, chains of sections and matrix exponentials."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from ctid_cli.filtering.realisation import (
    chain,
    exponential_minus_identity,
    polynomial_roots,
)

POLES = [
    [-2.0],
    [-1.0, -4.0],
    [-1 + 2j, -1 - 2j],
    [-0.001, -0.1, -1.0, -50.0, -1000.0],
    [-0.1 + 20j, -0.1 - 20j, -1 + 2j, -1 - 2j],
    [-3.0, -1 + 1j, -1 - 1j, -0.2, 0.5],
    [-1.0, 0.0],
]


@pytest.mark.parametrize("poles", POLES)
def test_roots_of_a_product_are_its_factors(poles):
    expected = sorted(poles, key=lambda p: (-abs(p), -np.imag(p)))
    roots = polynomial_roots(np.poly(poles).real)
    roots = roots[np.lexsort((-roots.imag, -np.abs(roots).round(9)))]
    np.testing.assert_allclose(roots, expected, rtol=1e-10, atol=1e-15)
    # Exact conjugates, so that imaginary parts cancel in a sum.
    for k in range(len(roots)):
        if roots[k].imag > 0:
            assert roots[k + 1] == roots[k].conjugate()


@pytest.mark.parametrize("poles", [*POLES[:-1], [-1.0, -1.0, -1.0], [-1 + 2j, -1 - 2j, -1 + 2j, -1 - 2j]])
def test_chain_has_the_transfer_functions_of_its_rows(poles):
    # Row k of the map over the states: s^k/A(s) at points off the poles.
    roots = np.array(sorted(poles, key=lambda p: -abs(p)), complex)  # pairs stay adjacent
    dynamics, gain, powers = chain(roots)
    for s in (0.3j, 2.0 + 1j, 7j):
        response = powers @ np.linalg.solve(s * np.eye(roots.size) - dynamics, gain)
        expected = s ** np.arange(roots.size) / np.prod(s - roots)
        np.testing.assert_allclose(response, expected, rtol=1e-10)


@given(st.integers(1, 8), st.floats(-6, 2), st.integers(0, 2**31))
def test_exponential_equals_that_of_scipy(size, exponent, seed):
    matrix = np.random.default_rng(seed).standard_normal((size, size)) * 10**exponent
    matrix -= 3 * np.abs(matrix).max() * np.eye(size)  # decaying, as the matrices of filters are
    expected = expm(matrix) - np.eye(size)
    np.testing.assert_allclose(
        exponential_minus_identity(matrix), expected, rtol=0, atol=1e-12 * max(1e-3, np.abs(expected).max())
    )


def test_small_exponents_keep_their_digits():
    # exp(x) - 1 together with a fast mode, where the difference of rounded numbers has no correct digits.
    result = exponential_minus_identity(np.diag([-1e6, -1e-9]))
    assert result[1, 1] == pytest.approx(np.expm1(-1e-9), rel=1e-13)
    assert result[0, 0] == -1.0
