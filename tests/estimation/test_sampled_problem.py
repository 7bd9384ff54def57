"""Problem on samples: moments, least-squares start, and the numerator for a given denominator."""

import numpy as np
import pytest

from ctid_cli.estimation.iteration import with_best
from ctid_cli.estimation.sampled_problem import SampledProblem, at_known_delay, least_squares_start, reflect_unstable
from ctid_cli.filtering.bank import standard_rows
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.inference.sensitivities import Structure
from tests.estimators.records import CASE_1, CASE_2, SVF_CUTOFF, make_record, theta_of


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_start_is_the_least_squares_solution(model, regular):
    # p^n/F y = phi' theta, solved from the filtered signals by an orthogonal decomposition.
    n, m = model.order, model.numerator.size - 1
    cutoff = SVF_CUTOFF[model]
    data = filter_data(make_record(model, snr_db=15, regular=regular, n=2500), 9.0)
    f = np.poly(np.full(n, -cutoff))
    rows = standard_rows(data, f, np.zeros(1), 8.0, "chain")
    filtered = rows[:, 2 * n + 1 : 3 * n + 1][:, ::-1]  # p^(n-1)/F y ... 1/F y
    highest = data.y_used - filtered @ f[1:]
    phi = np.column_stack((-filtered, rows[:, m::-1]))
    size = np.linalg.norm(phi, axis=0)
    expected = np.linalg.lstsq(phi / size, highest, rcond=None)[0] / size
    expected[:n] = reflect_unstable(np.append(1.0, expected[:n]))[1:]
    found = least_squares_start(data, Structure(n, m), 8.0, cutoff)
    np.testing.assert_allclose(found, np.append(expected, 8.0), rtol=1e-6)


def test_numerator_is_the_best_for_its_denominator():
    # Linear least squares of y on p^k/A u with a fixed denominator.
    data = filter_data(make_record(CASE_2, snr_db=15, n=3000), 9.0)
    theta = np.append(theta_of(CASE_2) * 1.05, 8.0)
    rows = standard_rows(data, np.append(1.0, theta[:4]), np.zeros(1), 8.0)
    expected = np.linalg.lstsq(rows[:, 1::-1], data.y_used, rcond=None)[0]
    refitted = with_best(at_known_delay(data, Structure(4, 1)), theta, 4, 6)
    np.testing.assert_allclose(refitted[4:6], expected, rtol=1e-9)
    assert np.array_equal(refitted[[0, 1, 2, 3, 6]], theta[[0, 1, 2, 3, 6]])


def test_nothing_is_computed_outside_the_bounds_or_for_non_finite_parameters():
    problem = SampledProblem(filter_data(make_record(n=500), 2.0), 2, 0, True, 1.0, 2.0)
    theta = theta_of(CASE_1)
    assert np.isfinite(problem.equations(np.append(theta, 1.5)).squared_error)
    for bad in (
        np.append(theta, 2.5),
        np.append(theta, 0.5),
        np.append(theta, np.nan),
        np.append(theta * np.nan, 1.5),
        np.append(theta * np.inf, 1.5),
    ):
        assert problem.equations(bad).squared_error == np.inf


def test_gradient_of_the_cost_is_that_of_central_differences():
    # d/dtheta of half the squared output error = -sum psi eps, for the coefficients and a delay off the clock.
    data = filter_data(make_record(snr_db=5, n=1000), 12.0)
    problem = SampledProblem(data, 2, 0, True, 0.0, 12.0)
    theta = np.append(theta_of(CASE_1) * [1.1, 0.9, 1.05], 8.1234)
    gradient = -problem.equations(theta).instrument_error
    for k, value in enumerate(theta):
        step = np.zeros(4)
        step[k] = 1e-6 * value
        plus, minus = (problem.equations(theta + sign * step).squared_error for sign in (1, -1))
        assert gradient[k] == pytest.approx((plus - minus) / (4 * step[k]), rel=1e-5)
