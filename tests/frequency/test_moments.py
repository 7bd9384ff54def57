"""Least squares from second moments, and the check at a second delay."""

from math import gcd

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.frequency.delay_kernels import add_row, flag_inconsistent, least_squares, squared_residual
from ctid_cli.frequency.delay_regression import second_lag
from ctid_cli.frequency.flags import Flag
from tests.frequency.signals import regression_rows, tones


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


def test_singular_moments_are_no_solution():
    rng = np.random.default_rng(0)
    x, theta = rng.standard_normal(100), np.empty(2)
    for other in (3 * x, 0 * x, np.nan * x):
        assert not least_squares(moments_of(np.column_stack([x, other, x])), 0.0, theta)
    assert least_squares(moments_of(np.column_stack([x, x + 1e-6 * rng.standard_normal(100), x])), 0.0, theta)


# Consistency -------------------------------------------------------------------------------------------


@given(st.integers(2, 3000))
def test_second_delay_is_shorter_and_shares_no_divisor(lag):
    second = second_lag(lag)
    assert 0 < second < lag
    assert gcd(second, lag) == 1
    assert abs(second - 0.618 * lag) <= max(4.0, 0.01 * lag)


def second_moments(y, n, lag):
    psi, phi = regression_rows(y, n, lag)
    rows = np.column_stack([phi, psi])
    return moments_of(rows[np.isfinite(psi)])


@pytest.mark.parametrize(("n", "noise"), [(1, 0.0), (2, 0.0), (3, 0.0), (1, 1e-3), (2, 1e-3), (3, 1e-3), (1, 0.05)])
def test_every_alias_is_told_from_the_frequency_itself(n, noise):
    interval, lag = 0.01, 50
    second = second_lag(lag)
    h = lag * interval
    omega = np.array([1.0, 2.0, 3.0])[:n]
    clean = tones(n, 4000, interval, omega).sum(axis=1)
    gram = second_moments(clean + noise * np.random.default_rng(n).standard_normal(4000), n, second)
    assert flag_inconsistent(gram, omega, second * interval, 1e-8) == 0
    for k in range(1, 8):
        for alias in (2 * np.pi * k / h - omega[-1], 2 * np.pi * k / h + omega[-1]):
            assert np.cos(alias * h) == pytest.approx(np.cos(omega[-1] * h), abs=1e-9)
            aliased = omega.copy()
            aliased[-1] = alias
            # In noise, the two must clearly differ at the second delay.
            if (
                abs(np.cos(alias * second * interval) - np.cos(omega[-1] * second * interval))
                > (0.1 if noise else 0.0) + 10 * noise
            ):
                assert flag_inconsistent(gram, aliased, second * interval, 1e-8) == Flag.INCONSISTENT
