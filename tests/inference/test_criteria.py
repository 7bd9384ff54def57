"""Criteria against numbers computed by hand."""

import numpy as np
import pytest

from ctid_cli.inference.criteria import (
    cross_validated_errors,
    information_criteria,
    r_squared,
    r_t_squared,
    young_information_criterion,
)


def test_information_criteria_by_hand():
    # V = e^2 / 10 of 20 samples, p = 3: N ln V = 20 (2 - ln 10) = -6.0517018598809
    criteria = information_criteria(2.0 * np.exp(2.0), 20, 3)
    assert criteria.aic == pytest.approx(-6.0517018598809 + 6, rel=1e-9)
    assert criteria.aicc == pytest.approx(criteria.aic + 2 * 4 * 5 / 15, rel=1e-12)
    assert criteria.bic == pytest.approx(-6.0517018598809 + 3 * 2.995732273554, rel=1e-9)
    assert criteria.fpe == pytest.approx(0.7389056098931 * 23 / 17, rel=1e-9)
    assert (criteria.count, criteria.parameters) == (20, 3)


def test_criteria_of_a_perfect_fit_and_of_too_few_samples():
    perfect = information_criteria(0.0, 20, 3)
    assert perfect.aic == perfect.bic == -np.inf
    assert perfect.fpe == 0.0
    few = information_criteria(1.0, 5, 3)
    assert np.isnan(few.aicc)
    assert few.fpe == pytest.approx(0.2 * 8 / 2)
    assert np.isnan(information_criteria(1.0, 3, 3).fpe)


def test_r_t_squared_by_hand():
    y = np.array([0.0, 2.0, 4.0, 6.0])  # variance 5
    e = np.array([1.0, 3.0, 1.0, 3.0])  # mean 2, variance 1
    assert r_t_squared(e, y) == pytest.approx(0.8)
    assert r_squared(y, y - e) == pytest.approx(0.0)  # sees the constant error: 20 of 20
    assert np.isnan(r_t_squared(e, np.ones(4)))


def test_young_information_criterion_by_hand():
    y, e = np.array([0.0, 2.0, 4.0, 6.0]), np.array([1.0, 3.0, 1.0, 3.0])
    covariance = np.array([[0.01, 0.5], [0.5, 0.16]])
    # NEVN = (0.01/4 + 0.16/16) / 2 = 0.00625
    expected = np.log(0.2) + np.log(0.00625)
    assert young_information_criterion(e, y, np.array([2.0, -4.0]), covariance) == pytest.approx(expected, rel=1e-12)
    assert young_information_criterion(e, y, np.array([2.0, 0.0]), covariance) == np.inf
    assert np.isnan(young_information_criterion(e, y, np.array([2.0, 1.0]), np.full((2, 2), np.nan)))
    assert np.isnan(young_information_criterion(e, np.ones(4), np.array([2.0, -4.0]), covariance))


def test_cross_validation_of_linear_least_squares_is_that_of_fits_without_each_block():
    rng = np.random.default_rng(1)
    psi, y = rng.standard_normal((50, 3)), rng.standard_normal(50)
    e = y - psi @ np.linalg.lstsq(psi, y, rcond=None)[0]
    (left,) = cross_validated_errors([e], [psi])
    rest = np.arange(50) >= 5
    without = np.linalg.lstsq(psi[rest], y[rest], rcond=None)[0]
    np.testing.assert_allclose(left[:5], y[:5] - psi[:5] @ without)
