"""Stability of polynomials, the least-squares start and the numerator of a given denominator."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ctid_cli.estimation.stability import is_hurwitz, reflect_unstable
from ctid_cli.filtering.bank import standard_rows
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.inference.sensitivities import Structure
from tests.estimation.adapters import CoefficientProblem, DelayProblem, least_squares_start, refit_numerator
from tests.estimators.records import CASE_1, CASE_2, make_record, theta_of


@st.composite
def polynomials(draw):
    """Monic polynomials of degree 1 to 8 with their roots, none of them near the imaginary axis."""
    roots = []
    for _ in range(draw(st.integers(1, 4))):
        real = draw(st.floats(0.05, 5)) * draw(st.sampled_from([-1, -1, -1, 1]))
        imag = draw(st.floats(0.1, 5))
        roots += [real + 1j * imag, real - 1j * imag] if draw(st.booleans()) else [complex(real)]
    return np.array(roots), np.poly(roots).real


@given(polynomials(), st.floats(-6, 6))
def test_hurwitz_criterion_says_what_the_roots_say(polynomial, decades):
    # Whatever the unit of time.
    roots, a = polynomial
    scaled = a * 10.0 ** (decades * np.arange(a.size))
    assert is_hurwitz(scaled) == bool((roots.real < 0).all())


@pytest.mark.parametrize("a", [[1.0, 0.0], [1.0, 0.0, 4.0], [1.0, 1.0, 1.0, 1.0], [1.0, 2.0, 0.0], [1.0, np.nan]])
def test_roots_on_the_axis_are_not_stable(a):
    assert not is_hurwitz(np.array(a))


@given(polynomials())
def test_unstable_roots_are_mirrored_and_the_others_kept(polynomial):
    roots, a = polynomial
    gaps = np.abs(roots[:, None] - roots) + 10 * np.eye(roots.size)
    assume(gaps.min() > 0.05)  # close roots are known from the coefficients to few digits
    mirrored = reflect_unstable(a)
    expected = np.poly(-np.abs(roots.real) + 1j * roots.imag).real
    np.testing.assert_allclose(mirrored, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    assert is_hurwitz(mirrored)
    if is_hurwitz(a):
        assert np.array_equal(mirrored, a)


@pytest.mark.parametrize("a", [[1.0, 0.0, 4.0], [1.0, 0.0], [1.0, 0.0, 0.0]])
def test_roots_on_the_axis_are_moved_off_it(a):
    moved = reflect_unstable(np.array(a))
    assert is_hurwitz(moved) or not np.any(a[1:])  # a polynomial s^n has no scale to move by
    np.testing.assert_allclose(moved, a, atol=1e-4)


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_start_is_the_least_squares_solution(model, regular):
    # p^n/F y = phi' theta, solved from the filtered signals themselves by an orthogonal decomposition.
    n, m = model.order, model.numerator.size - 1
    cutoff = {2: 1.0, 4: 25.0}[n]
    data = filter_data(make_record(model, snr_db=15, regular=regular, n=2500), 9.0)
    f = np.poly(np.full(n, -cutoff))
    rows = standard_rows(data, f, np.zeros(1), 8.0, "chain")
    filtered = rows[:, 2 * n + 1 : 3 * n + 1][:, ::-1]  # p^(n-1)/F y ... 1/F y
    highest = data.y_used - filtered @ f[1:]
    phi = np.column_stack((-filtered, rows[:, m::-1]))
    size = np.linalg.norm(phi, axis=0)
    expected = np.linalg.lstsq(phi / size, highest, rcond=None)[0] / size
    expected[:n] = reflect_unstable(np.append(1.0, expected[:n]))[1:]
    np.testing.assert_allclose(least_squares_start(data, Structure(n, m), 8.0, cutoff), expected, rtol=1e-6)


def test_numerator_is_the_best_for_its_denominator():
    # Linear least squares of y on p^k/A u; the denominator stays.
    data = filter_data(make_record(CASE_2, snr_db=15, n=3000), 9.0)
    theta = theta_of(CASE_2) * 1.05
    rows = standard_rows(data, np.append(1.0, theta[:4]), np.zeros(1), 8.0)
    expected = np.linalg.lstsq(rows[:, 1::-1], data.y_used, rcond=None)[0]
    refitted = refit_numerator(data, Structure(4, 1), theta, 8.0)
    np.testing.assert_allclose(refitted[4:], expected, rtol=1e-9)
    assert np.array_equal(refitted[:4], theta[:4])


def test_nothing_is_computed_outside_the_bounds_or_for_non_finite_parameters():
    data = filter_data(make_record(n=500), 2.0)
    delay_problem = DelayProblem(data, Structure(2, 0), (1.0, 2.0))
    theta = theta_of(CASE_1)
    assert delay_problem.equations(np.append(theta, 1.5)) is not None
    assert delay_problem.equations(np.append(theta, 2.5)) is None
    assert delay_problem.equations(np.append(theta, 0.5)) is None
    assert delay_problem.equations(np.append(theta, np.nan)) is None
    problem = CoefficientProblem(data, Structure(2, 0), 1.0)
    assert problem.equations(theta * np.nan) is None
    assert problem.equations(theta * np.inf) is None


def test_gradient_of_the_cost_is_that_of_central_differences():
    # d/dtheta of half the squared output error = -sum psi eps, for the coefficients and a delay off the clock.
    data = filter_data(make_record(snr_db=5, n=1000), 12.0)
    problem = DelayProblem(data, Structure(2, 0), (0.0, 12.0))
    theta = np.append(theta_of(CASE_1) * [1.1, 0.9, 1.05], 8.1234)
    gradient = -problem.equations(theta).instrument_error
    for k, value in enumerate(theta):
        step = np.zeros(4)
        step[k] = 1e-6 * value
        plus, minus = (problem.equations(theta + sign * step).squared_error for sign in (1, -1))
        assert gradient[k] == pytest.approx((plus - minus) / (4 * step[k]), rel=1e-5)
