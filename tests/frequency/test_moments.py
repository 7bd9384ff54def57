"""Least squares from second moments, and the second delay."""

from math import gcd

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.frequency.delay_kernels import add_row, least_squares, squared_residual
from ctid_cli.frequency.delay_regression import second_lag


def moments_of(rows):
    gram = np.zeros((rows.shape[1], rows.shape[1]))
    for row in rows:
        add_row(row, gram)
    return gram


@given(st.integers(1, 8), st.integers(0, 2**31))
def test_least_squares_from_moments_is_that_of_numpy(n, seed):
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((40, n + 1)) * 10.0 ** rng.uniform(-3, 3, n + 1)
    gram = moments_of(rows)
    theta = np.empty(n)
    assert least_squares(gram, 0.0, theta)
    expected = np.linalg.lstsq(rows[:, :n], rows[:, n], rcond=None)[0]
    size = np.linalg.norm(rows[:, n]) / np.linalg.norm(rows[:, :n], axis=0)
    np.testing.assert_allclose(theta / size, expected / size, atol=1e-9)
    residual = rows[:, n] - rows[:, :n] @ theta
    assert squared_residual(gram, theta) == pytest.approx(residual @ residual, rel=1e-9)


@given(st.integers(2, 3000))
def test_second_delay_is_shorter_and_shares_no_divisor(lag):
    second = second_lag(lag)
    assert 0 < second < lag
    assert gcd(second, lag) == 1
    assert abs(second - 0.618 * lag) <= max(4.0, 0.01 * lag)
