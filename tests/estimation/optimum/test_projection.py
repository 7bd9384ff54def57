"""Variable projection against dense matrices, and its derivatives against differences."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from ctid_cli.estimation.optimum import chain, projection
from ctid_cli.estimation.optimum.arrangement import with_one_denominator
from ctid_cli.estimation.optimum.box import Box, point_of
from ctid_cli.estimation.optimum.chain import Chain, Modal, chain_dynamics, forms_of, numerators, poles_of
from ctid_cli.estimation.optimum.projection import Problem, project, slopes
from ctid_cli.estimation.optimum.triangle import Columns, Delay, rows_of, triangle_of
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.models.additive import Term
from tests.estimation.optimum.dense import columns_of, left_over, squared_error
from tests.estimation.optimum.systems import MODEL, record_of

#: A point near the model of the records.
SPEED, DAMPING = np.array([4.0, 2.2, 0.4]), np.array([-1.0, 0.3, -1.0])
POLES = np.array([-4.0, 2.2 * complex(-0.3, np.sqrt(0.91)), 2.2 * complex(-0.3, -np.sqrt(0.91)), -0.4])
DENOMINATOR = np.poly(POLES).real
CASES = [
    {},
    {"hold": "foh"},
    {"regular": False},
    {"regular": False, "hold": "foh"},
]
TREATMENTS = [
    {},
    {"offset": True},
    {"free_response": True},
    {"free_response": True, "offset": True},
    {"periodic": True},
    {"periodic": True, "offset": True},
]


def problem_of(record, zeros, free_response=False, offset=False, periodic=False):
    period = float(record.t[-1] - record.t[0] + 0.5) if periodic else 0.0
    return Problem((filter_data(record),), zeros, free_response, (0,) * offset, (period,))


@pytest.mark.parametrize("treatment", TREATMENTS, ids=str)
@pytest.mark.parametrize("case", CASES, ids=str)
@pytest.mark.parametrize(("zeros", "delay"), [(0, 0.0), (2, 0.37), (3, 1.0), (4, 0.0)])
def test_projection_is_that_of_dense_matrices(case, treatment, zeros, delay):
    record = record_of(MODEL, np.random.default_rng(1), noise=0.1, offset=0.3, **case)
    problem = problem_of(record, zeros, **treatment)
    found = project(problem, SPEED, DAMPING, Delay(delay, -1)).squared_error
    dense = squared_error(
        record, DENOMINATOR, zeros, delay, problem.free_response, bool(problem.trend), problem.periods[0]
    )
    np.testing.assert_allclose(found, dense, rtol=1e-8)


@pytest.mark.parametrize("treatment", TREATMENTS, ids=str)
@pytest.mark.parametrize("case", CASES, ids=str)
def test_gradient_is_that_of_differences(case, treatment):
    record = record_of(MODEL, np.random.default_rng(2), noise=0.1, offset=0.3, **case)
    problem, delay = problem_of(record, 2, **treatment), Delay(0.37, -1)

    def value(step):
        speed, damping = SPEED.copy(), DAMPING.copy()
        speed *= np.exp([step[0], step[1], step[3]])
        damping[1] *= np.exp(step[2])
        return project(problem, speed, damping, Delay(0.37 + step[4], -1)).squared_error

    found = slopes(problem, SPEED, DAMPING, delay, project(problem, SPEED, DAMPING, delay), (0,))
    steps = 1e-5 * np.eye(5)
    differences = [(value(step) - value(-step)) / 4e-5 for step in steps]
    np.testing.assert_allclose(found.gradient, differences, rtol=0, atol=1e-7 * np.abs(found.gradient).max())
    assert found.squared_error == pytest.approx(value(np.zeros(5)), rel=1e-10)


def test_curvature_is_that_of_the_gradient_where_residuals_vanish():
    # Kaufman's J'J is the Hessian without residuals.
    record = record_of(MODEL, np.random.default_rng(3))
    problem = problem_of(record, 1)
    point = point_of(MODEL.poles, MODEL.delay, Box(0.01, 20.0))
    delay = Delay(MODEL.delay, -1)

    def gradient(step):
        speed, damping = point.shifted(step)
        here = project(problem, speed, damping, delay)
        return slopes(problem, speed, damping, delay, here).gradient

    curvature = slopes(problem, point.speed, point.damping, delay, project(problem, point.speed, point.damping, delay))
    differences = np.array([(gradient(step) - gradient(-step)) / 2e-4 for step in 1e-4 * np.eye(3)])
    np.testing.assert_allclose(curvature.curvature, differences, rtol=0, atol=1e-6 * curvature.curvature.max())


@pytest.mark.parametrize("cell", [3, 4])
def test_a_sample_belongs_to_the_cells_on_both_sides(cell):
    # The squared error is continuous there; its slope is one-sided.
    record = record_of(MODEL, np.random.default_rng(4), noise=0.1)
    problem = problem_of(record, 3)
    at, side = Delay(2.0, cell), 1.0 if cell == 4 else -1.0
    here = project(problem, SPEED, DAMPING, at)
    assert here.squared_error == pytest.approx(project(problem, SPEED, DAMPING, Delay(2.0, -1)).squared_error)
    beyond = [project(problem, SPEED, DAMPING, Delay(2.0 + side * step, -1)).squared_error for step in (1e-5, 2e-5)]
    slope = side * (4 * beyond[0] - beyond[1] - 3 * here.squared_error) / 4e-5
    assert slopes(problem, SPEED, DAMPING, at, here, (0,)).gradient[-1] == pytest.approx(slope, rel=1e-5)


@pytest.mark.parametrize(("free_response", "offset"), [(False, False), (True, False), (False, True), (True, True)])
def test_records_share_the_numerator_and_have_their_own_state_and_offset(free_response, offset):
    rng = np.random.default_rng(7)
    records = [record_of(MODEL, rng, noise=0.1, offset=k, samples=100 + 40 * k, regular=k != 1) for k in range(3)]
    problem = Problem(tuple(filter_data(record) for record in records), 2, free_response, (0,) * offset, (0.0,) * 3)
    delay = Delay(0.37, -1)
    found = project(problem, SPEED, DAMPING, delay)
    parts = [columns_of(record, DENOMINATOR, 2, 0.37, free_response, offset) for record in records]
    phi = np.hstack((np.vstack([shared for shared, _ in parts]), block_diag(*[own for _, own in parts])))
    left = left_over(phi, np.concatenate([record.y for record in records]))
    assert found.squared_error == pytest.approx(left @ left, rel=1e-8)
    found_slopes = slopes(problem, SPEED, DAMPING, delay, found, (0,))
    ends = [project(problem, SPEED, DAMPING, Delay(0.37 + step, -1)).squared_error for step in (-1e-5, 1e-5)]
    assert found_slopes.gradient[-1] == pytest.approx((ends[1] - ends[0]) / 4e-5, rel=1e-6)


@pytest.mark.parametrize("length", [100.0, 1e-6])
def test_states_and_slopes_have_the_transfer_functions_that_they_claim(length):
    # All responses overlap in a very short record.
    form, rows = forms_of([(SPEED, DAMPING)], [slice(None)], length)[0], numerators(SPEED, DAMPING)
    assert isinstance(form, Modal if length > 1.0 else Chain)
    output, direct = np.array([0.3, -0.2, 0.5, 1.0]), np.array([0.7])
    for s in (0.3j, 1.0 + 2.0j, 5.0j):
        states = np.array([np.polyval(row, s) for row in rows]) / np.polyval(DENOMINATOR, s)
        x = output @ states + direct
        if isinstance(form, Modal):
            single = 1.0 / (s - form.poles)
            z, w = (np.linalg.solve(form.whole, signal) for signal in (single, single**2))
        else:
            z = np.linalg.solve(s * np.eye(4) - form.dynamics, form.gain)
            w = z * x
        np.testing.assert_allclose(form.states @ z, states)
        # d ln A: p/(s + p), and (2 zeta w s + 2 w^2, 2 zeta w s)/(s^2 + 2 zeta w s + w^2).
        middle = s * s + 1.32 * s + 4.84
        logarithmic = np.array([4 / (s + 4), (1.32 * s + 9.68) / middle, 1.32 * s / middle, 0.4 / (s + 0.4)])
        np.testing.assert_allclose(np.concatenate((z, w)) @ form.slopes(output, direct), -logarithmic * x)
        of_z, of_u = form.rate(output)
        np.testing.assert_allclose(of_z @ z + of_u, s * (output @ states))


def test_poles_of_a_section_meet_and_part():
    np.testing.assert_allclose(
        poles_of(np.array([2.0, 1.0]), np.array([1.25, 0.6])), [-4, -1, -0.6 + 0.8j, -0.6 - 0.8j]
    )
    assert poles_of(np.array([2.0]), np.array([1.0])) == [-2, -2]
    F, _ = chain_dynamics(np.array([2.0, 1.0]), np.array([1.25, 0.6]))
    np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(F)), [-4, -1, -0.6 - 0.8j, -0.6 + 0.8j])


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("damping", [1.0, 0.3])
def test_a_long_record_is_filtered_piece_by_piece(monkeypatch, regular, damping):
    data = filter_data(record_of(MODEL, np.random.default_rng(3), samples=400, regular=regular))
    form = forms_of([(np.array([2.0]), np.array([damping]))], [slice(None)], 100.0)[0]
    columns = Columns.of(with_one_denominator(2, 0, 0, (0,)), False, True, (0,))
    (whole,) = rows_of([form], columns, Delay(0.8, -1), data, 0.0)
    monkeypatch.setattr(chain, "PIECE", 37)
    found = np.hstack(list(rows_of([form], columns, Delay(0.8, -1), data, 0.0)))
    np.testing.assert_allclose(found, whole, atol=1e-12)
    triangle = triangle_of([form], columns, Delay(0.8, -1), data, 0.0)
    np.testing.assert_allclose(triangle.T @ triangle, whole @ whole.T, rtol=1e-10, atol=1e-12)


def test_two_submodels_of_one_input_are_fractions_of_two_inputs_that_are_the_same():
    record = record_of(MODEL, np.random.default_rng(11), noise=0.1)
    speed, damping, delay = np.array([3.0, 1.5, 0.5, 0.2]), np.array([0.4, -1.0, -1.0, -1.0]), Delay(0.37, -1)
    one = problem_of(record, 0, True, True)._replace(terms=(Term(2, 1), Term(3, 0, 1)))
    data = filter_data(record)
    two = one._replace(records=(data._replace(further=(data,)),), inputs=(0, 1))
    here, there = project(one, speed, damping, delay), project(two, speed, damping, (delay, delay))
    assert there.squared_error == pytest.approx(here.squared_error, rel=1e-10)
    single = slopes(one, speed, damping, delay, here, (0,))
    each = slopes(two, speed, damping, (delay, delay), there, (0, 1))
    np.testing.assert_allclose(each.gradient[:-2], single.gradient[:-1], rtol=1e-6)
    assert each.gradient[-2:].sum() == pytest.approx(single.gradient[-1], rel=1e-6)


def test_a_response_that_overflows_explains_nothing(monkeypatch):
    record = record_of(MODEL, np.random.default_rng(1), noise=0.1)
    problem = problem_of(record, 2)
    whole = projection._columns

    def overflowing(*of):
        phi, y = whole(*of)
        return np.full_like(phi, np.nan), y

    monkeypatch.setattr(projection, "_columns", overflowing)
    found = project(problem, SPEED, DAMPING, Delay(0.0, -1)).squared_error
    np.testing.assert_allclose(found, float(record.y @ record.y), rtol=1e-9)
