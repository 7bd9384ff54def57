"""Models with known coefficients: projection by dense matrices, feasible points, and verified minima."""

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.estimation.optimum.box import Box, point_of
from ctid_cli.estimation.optimum.known import KnownCoefficients, null_space
from ctid_cli.estimation.optimum.projection import Problem, project, slopes
from ctid_cli.estimation.optimum.search import Descent, Ending
from ctid_cli.estimation.optimum.triangle import Delay
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.models.transfer_function import TransferFunction
from tests.estimation.optimum.dense import columns_of, left_over
from tests.estimation.optimum.systems import MODEL, best, random_model, record_of

SPEED, DAMPING = np.array([2.2, 0.3]), np.array([0.4, -1.0])
DENOMINATOR = np.convolve([1.0, 2 * 0.4 * 2.2, 2.2**2], [1.0, 0.3])
BOX = Box(1e-3, 50.0)


def numerator_of(size, known):
    """Return the coefficients with NaN for free ones."""
    values = np.full(size, np.nan)
    values[list(known)] = list(known.values())
    return values


@pytest.mark.parametrize("treatment", [(False, False), (True, True)])
@pytest.mark.parametrize(
    ("zeros", "known"),
    [(1, {0: 1.5}), (2, {0: 0.0, 2: 4.0}), (2, {0: 1.0, 1: 2.0, 2: 3.0}), (3, {0: 0.2}), (3, {1: 1.0, 3: 2.0})],
)
def test_projection_with_known_numerators_is_that_of_dense_matrices(zeros, known, treatment):
    free_response, offset = treatment
    record = record_of(MODEL, np.random.default_rng(1), noise=0.1, offset=0.3)
    problem = Problem(
        (filter_data(record),), zeros, free_response, (0,) * offset, (0.0,), numerator_of(zeros + 1, known)
    )
    delay = Delay(0.0 if zeros == 3 else 0.37, -1)
    shared, own = columns_of(record, DENOMINATOR, zeros, delay.seconds, free_response, offset)
    given = sum(value * shared[:, k] for k, value in known.items())
    left = np.hstack((np.delete(shared, list(known), axis=1), own))
    residual = left_over(left, record.y - given) if left.size else record.y - given
    found = project(problem, SPEED, DAMPING, delay)
    assert found.squared_error == pytest.approx(residual @ residual, rel=1e-8)

    def value(step):
        moved = project(problem, SPEED * np.exp(step[[0, 2]]), DAMPING * np.exp([step[1], 0.0]), delay)
        return moved.squared_error

    gradient = slopes(problem, SPEED, DAMPING, delay, found).gradient
    differences = [(value(step) - value(-step)) / 4e-5 for step in 1e-5 * np.eye(3)]
    np.testing.assert_allclose(gradient, differences, rtol=0, atol=1e-6 * np.abs(gradient).max())


@pytest.mark.parametrize("seed", range(6))
def test_points_move_to_where_the_denominator_has_its_values(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 7))
    truth, start = (random_model(rng, n, 0) for _ in range(2))
    values = dict.fromkeys(rng.choice(n, int(rng.integers(1, n)), replace=False).tolist(), 0.0)
    known = KnownCoefficients.of(n, 0, {place: truth.denominator[1 + place] for place in values})
    point = known.met(point_of(start.poles, 0.0, BOX), BOX)
    np.testing.assert_allclose(point.denominator[1:][known.places], known.denominator[known.places], rtol=1e-10)
    assert (np.abs(point.poles) >= BOX.slowest * (1 - 1e-9)).all()
    # Directions of the null space preserve the values to first order.
    direction = null_space(known.slopes(point, n))[:, -1]
    speed, damping = point.shifted(1e-6 * direction)
    moved = type(point)(speed, damping, point.edge, point.delays).denominator[1:][known.places]
    np.testing.assert_allclose(moved, known.denominator[known.places], rtol=1e-9)


def test_known_coefficients_that_hold_poles_at_a_bound():
    """At the solution the bounds have multipliers of the right sign: no admissible model nearby is better."""
    rng = np.random.default_rng(3)
    record = record_of(TransferFunction([1.0], [1.0, 1.0, 0.0625]), rng, samples=300, noise=0.05)
    data = filter_data(record)
    known = KnownCoefficients.of(2, 0, {0: 0.05})
    found = best([data], 2, 0, known=known, free_response=True)
    assert found.ending in (Ending.AT_BOUND, Ending.CONVERGED)
    assert found.denominator[1] == 0.05
    trials = [[1.0, 0.05, a2] for a2 in np.geomspace(1e-4, 30.0, 200)]
    problem = Problem((data,), 0, True, (), (0.0,))
    for trial in trials:
        poles = np.roots(trial)
        if np.abs(poles).min() >= found.box.slowest and np.abs(poles).max() <= found.box.fastest:
            point = point_of(poles.astype(complex), 0.0, found.box)
            if np.allclose(point.denominator, trial):
                other = project(problem, point.speed, point.damping, point.delay)
                assert found.squared_error <= other.squared_error * (1 + 1e-9)


def test_a_known_denominator_needs_no_box():
    record = record_of(TransferFunction([2.0], [1.0, 1e-4]), np.random.default_rng(5), noise=0.01)
    known = KnownCoefficients.of(1, 0, {0: 1e-4})
    found = best([filter_data(record)], 1, 0, known=known, free_response=True)
    assert found.denominator.tolist() == [1.0, 1e-4]
    assert found.numerator == pytest.approx([2.0], rel=0.05)
    assert found.ending is Ending.CONVERGED


def test_values_that_no_admissible_model_has_are_refused():
    record = record_of(TransferFunction([2.0], [1.0, 1.0, 1.0]), np.random.default_rng(6), noise=0.1)
    known = KnownCoefficients.of(2, 0, {0: 1e5})
    with pytest.raises(DataError, match="no model with the fixed a1 = 100000"):
        best([filter_data(record)], 2, 0, known=known)


def test_the_end_of_a_search_is_stationary_along_the_constraint():
    rng = np.random.default_rng(7)
    model = random_model(rng, 4, 1, 0.6)
    data = filter_data(record_of(model, rng, noise=0.2))
    values = {1: 1.2 * model.denominator[2], 4: 0.8 * model.numerator[0]}
    known = KnownCoefficients.of(4, 1, values)
    found = best([data], 4, 1, delays=(0.0, 3.0), known=known)
    assert found.ending is Ending.CONVERGED
    assert (found.denominator[2], found.numerator[0]) == (values[1], values[4])
    box = found.box
    descent = Descent(Problem((data,), 1, False, (), (0.0,)), box, known)
    here = descent.local(point_of(found.model.poles, found.delay, box))
    basis = null_space(known.slopes(here.point, 5))
    along = basis.T @ here.gradient
    curvature = basis.T @ descent.hessian(here) @ basis
    assert along @ np.linalg.solve(curvature, along) <= 1e-8 * found.squared_error
    assert np.linalg.eigvalsh(curvature)[0] > 0
