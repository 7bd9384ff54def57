"""Least squares from second moments, its worst case, and the check at a second delay."""

from math import gcd

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.frequency.delay_options import second_lag
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.frequency_kernels import (
    accumulate_row,
    check_consistency,
    factorise,
    least_squares,
    moment_uncertainty,
    squared_residual,
)
from tests.frequency.signals import regression_rows, tones


def moments_of(rows, keep=1.0):
    gram = np.zeros((rows.shape[1], rows.shape[1]))
    for row in rows:
        accumulate_row(row, gram, keep)
    return gram


def fit(gram):
    n = gram.shape[0] - 1
    factor, scales, theta = np.empty((n, n)), np.empty(n), np.empty(n)
    assert factorise(gram, 0.0, factor, scales)
    least_squares(gram, factor, scales, theta)
    return theta, factor, scales


@given(st.integers(1, 8), st.integers(0, 2**31), st.sampled_from([1.0, 0.9]))
def test_least_squares_from_moments_is_that_of_numpy(n, seed, keep):
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((40, n + 1)) * 10.0 ** rng.uniform(-3, 3, n + 1)
    gram = moments_of(rows, keep)
    theta = fit(gram)[0]
    weighted = rows * keep ** (0.5 * np.arange(39, -1, -1))[:, None]
    expected = np.linalg.lstsq(weighted[:, :n], weighted[:, n], rcond=None)[0]
    size = np.linalg.norm(weighted[:, n]) / np.linalg.norm(weighted[:, :n], axis=0)
    np.testing.assert_allclose(theta / size, expected / size, atol=1e-9)
    residual = weighted[:, n] - weighted[:, :n] @ theta
    assert squared_residual(gram, theta) == pytest.approx(residual @ residual, rel=1e-9)


def test_singular_moments_are_no_solution():
    rng = np.random.default_rng(0)
    x = rng.standard_normal(100)
    factor, scales = np.empty((2, 2)), np.empty(2)
    assert not factorise(moments_of(np.column_stack([x, 3 * x, x])), 0.0, factor, scales)
    assert not factorise(moments_of(np.column_stack([x, 0 * x, x])), 0.0, factor, scales)
    assert not factorise(moments_of(np.column_stack([x, np.nan * x, x])), 0.0, factor, scales)
    assert factorise(moments_of(np.column_stack([x, x + 1e-6 * rng.standard_normal(100), x])), 0.0, factor, scales)


def test_uncertainty_is_reached_in_the_worst_direction_and_never_exceeded():
    # Residuals e move g'theta by g' G^-1 Phi' e: most for e along Phi G^-1 g.
    rng = np.random.default_rng(1)
    phi, theta, g = rng.standard_normal((200, 3)), np.array([0.5, -1.0, 2.0]), np.array([[0.3, -0.2, 1.0]] * 3)
    inverse = np.linalg.inv(phi.T @ phi)
    worst = phi @ inverse @ g[0]
    for residual in (worst, *rng.standard_normal((20, 200))):
        e = residual / np.linalg.norm(residual)
        gram = moments_of(np.column_stack([phi, phi @ theta + e]))
        found, factor, scales = fit(gram)
        uncertainty, rounding = np.empty(3), np.empty(3)
        moment_uncertainty(gram, factor, scales, 1.0, found, g, uncertainty, rounding)  # e'e = 1
        assert (rounding < 1e-12).all()
        moved = abs(g[0] @ (found - theta))
        assert moved <= uncertainty[0] * (1 + 1e-9)
        if residual is worst:
            assert moved == pytest.approx(uncertainty[0], rel=1e-9)


def test_uncertainty_counts_rounding_where_moments_are_nearly_singular():
    x = np.random.default_rng(2).standard_normal(1000)
    y = np.random.default_rng(3).standard_normal(1000)
    uncertainties = []
    for closeness in (1.0, 1e-2, 1e-4, 1e-6):
        gram = moments_of(np.column_stack([x, x + closeness * y, 2 * x + closeness * y]))
        theta, factor, scales = fit(gram)
        misfit, rounding = np.empty(2), np.empty(2)
        moment_uncertainty(gram, factor, scales, 0.0, theta, np.eye(2), misfit, rounding)
        assert np.abs(theta - 1.0).max() <= rounding.max()
        uncertainties.append(rounding.max())
        # A misfit of nothing is one that rounding hides.
        assert 1e-8 < misfit.max() * closeness < 1e-6
    # Proportional to the condition number of the moments.
    assert uncertainties[0] < 1e-13
    np.testing.assert_allclose(np.diff(np.log10(uncertainties))[1:], 4.0, atol=0.3)


# Consistency -------------------------------------------------------------------------------------------


@given(st.integers(2, 3000))
def test_second_delay_is_shorter_and_shares_no_divisor(lag):
    second = second_lag(lag)
    assert 0 < second < lag
    assert gcd(second, lag) == 1
    assert abs(second - 0.618 * lag) <= max(4.0, 0.01 * lag)


def test_at_the_shortest_delay_nothing_can_alias():
    assert second_lag(1) == 0


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
    assert check_consistency(gram, omega, second * interval, 1e-8) == 0
    for k in range(1, 8):
        for alias in (2 * np.pi * k / h - omega[-1], 2 * np.pi * k / h + omega[-1]):
            assert np.cos(alias * h) == pytest.approx(np.cos(omega[-1] * h), abs=1e-9)
            aliased = omega.copy()
            aliased[-1] = alias
            # In noise, the two must really differ at the second delay.
            if (
                abs(np.cos(alias * second * interval) - np.cos(omega[-1] * second * interval))
                > (0.1 if noise else 0.0) + 10 * noise
            ):
                assert check_consistency(gram, aliased, second * interval, 1e-8) == Flag.INCONSISTENT


def test_negligible_residuals_are_none():
    # Frequencies wrong by 1e-5 leave less than 1e-8 of the regressand's square, and least squares nothing.
    omega, second = np.array([1.0, 2.0]), second_lag(50)
    gram = second_moments(tones(2, 4000, 0.01, omega).sum(axis=1), 2, second)
    assert check_consistency(gram, omega * (1 + 1e-5), second * 0.01, 1e-8) == 0
    assert check_consistency(gram, omega * (1 + 1e-5), second * 0.01, 1e-14) == Flag.INCONSISTENT


def test_consistency_needs_a_second_delay_and_data():
    omega = np.array([1.0, 2.0])
    assert check_consistency(np.eye(3), omega, 0.0, 1e-8) == 0
    assert check_consistency(np.zeros((3, 3)), omega, 0.1, 1e-8) == 0
