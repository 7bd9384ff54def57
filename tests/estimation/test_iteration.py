"""The iteration: against the textbook formula, at its fixed points, and its terminations."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ctid_cli.estimation.iteration import (
    PATIENCE,
    RELAXATIONS,
    SLOW_STEPS,
    Equations,
    Steps,
    inadmissible,
    iterate,
    solve_scaled,
)
from ctid_cli.estimation.sampled_problem import at_known_delay
from ctid_cli.filtering.bank import standard_rows
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.inference.fit import Status
from ctid_cli.inference.sensitivities import Structure
from tests.estimators.records import CASE_1, CASE_2, make_record, theta_of

DEGREES = {CASE_1: Structure(2, 0), CASE_2: Structure(4, 1)}


def problem_of(model, regular=True, hold_output="foh", snr_db=15):
    """Return a problem with a fixed delay, and the true parameters."""
    data = filter_data(make_record(model, snr_db=snr_db, regular=regular, n=3000), 12.0, hold_output)
    return at_known_delay(data, DEGREES[model]), np.append(theta_of(model), model.delay)


def relative_gradient(equations, free):
    """Return the cosines between the sensitivities and the output error."""
    lengths = np.sqrt(np.diag(equations.hessian)[:free] * equations.squared_error)
    return np.abs(equations.instrument_error[:free] / lengths).max()


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("hold_output", ["zoh", "foh"])
@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_plain_step_is_the_textbook_formula(model, hold_output, regular):
    # theta+ = [Psi' Phi]^-1 Psi' y_f with y_f = p^n/A y, formed from the filtered signals and solved by numpy.
    problem, truth = problem_of(model, regular, hold_output)
    n, m = model.order, model.numerator.size - 1
    theta = truth * np.append(1 + 0.02 * np.cos(np.arange(n + m + 1)), 1.0)
    a, b, delay = problem.split(theta)
    rows = standard_rows(problem.data, a, b, delay, "chain")
    p_x, p_y = rows[:, n + 1 : 2 * n + 1][:, ::-1], rows[:, 2 * n + 1 : 3 * n + 1][:, ::-1]
    p_u = rows[:, m::-1]
    psi, phi = np.column_stack((-p_x, p_u)), np.column_stack((-p_y, p_u))
    y_f = problem.data.y_used - p_y @ a[1:]
    scale = np.linalg.norm(psi, axis=0)
    expected = np.linalg.solve((psi / scale).T @ (phi / scale), (psi / scale).T @ y_f) / scale
    result = iterate(problem, theta, Steps(1, 1e-12, "plain"))
    np.testing.assert_allclose(result.theta, np.append(expected, delay), rtol=1e-8)
    assert (result.status, result.iterations) == (Status.MAX_ITERATIONS, 1)
    assert np.array_equal(result.path[:, :-1], [theta, result.theta])


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_gradient_vanishes_at_convergence(model, regular):
    # On noisy data, sum psi eps = 0: the estimate minimises the output error for any rule and hold of y.
    found = []
    for rule, hold_output in (("plain", "foh"), ("guarded", "zoh")):
        problem, truth = problem_of(model, regular, hold_output)
        result = iterate(problem, truth, Steps(100, 1e-11, rule))
        assert result.status is Status.CONVERGED
        assert relative_gradient(result.equations, problem.free) < 1e-8
        found.append(result.theta)
    np.testing.assert_allclose(found[1], found[0], rtol=1e-7)


def test_guarded_iteration_never_raises_the_cost():
    # Distant starts, from which full steps increase the cost above its final value.
    problem, truth = problem_of(CASE_2, snr_db=5)
    rng = np.random.default_rng(0)
    rises = []
    for _ in range(20):
        theta = truth * np.append(np.exp(rng.standard_normal(6)), 1.0)
        plain, guarded = (iterate(problem, theta, Steps(30, 1e-9, rule)).path[:, -1] for rule in ("plain", "guarded"))
        assert guarded.size > 3
        assert np.diff(guarded).max() <= 1e-12 * guarded[0]
        rises.append(np.diff(plain).max() / plain[-1])
    assert max(rises) > 1.0


# One parameter ------------------------------------------------------------------------------------------------


class Sequence:
    """A problem with a fixed sequence of equations at any parameters, then none."""

    free = 1

    def __init__(self, equations):
        self.sequence = iter(equations)

    def equations(self, theta):
        return next(self.sequence, inadmissible(1))

    def admissible(self, theta):
        return theta


def equations(hessian=1.0, error=1.0, cost=1.0):
    return Equations(np.array([[hessian]]), np.array([error]), np.array([[abs(hessian)]]), cost, 1.0)


@pytest.mark.parametrize(
    ("sequence", "rule", "status"),
    [
        ([equations(), equations(error=0.0)], "plain", Status.CONVERGED),
        ([equations(), equations(error=0.0, cost=0.0)], "guarded", Status.CONVERGED),
        ([equations(), equations(error=0.0)], "relaxed", Status.CONVERGED),
        ([equations(hessian=0.0)], "plain", Status.SINGULAR),
        ([equations(hessian=0.0)], "guarded", Status.SINGULAR),
        ([equations()], "relaxed", Status.DIVERGED),
        ([equations()], "plain", Status.DIVERGED),
        ([equations()] + [equations(cost=2.0)] * 100, "guarded", Status.STALLED),
        ([equations(error=1e-9)] + [equations(cost=2.0)] * 50, "guarded", Status.CONVERGED),
        ([equations()] * 100, "plain", Status.MAX_ITERATIONS),
    ],
)
def test_every_end_has_its_status(sequence, rule, status):
    # A zero error means convergence; no equations at the trial point means an invalid step; a cost that does not
    # decrease means a stall, unless the step is below rounding.
    followed = sequence + [equations(error=0.0, cost=0.0)] * (status is Status.CONVERGED)
    assert iterate(Sequence(followed), np.zeros(1), Steps(10, 1e-8, rule)).status is status


def test_start_that_is_not_admissible_gives_nothing():
    assert iterate(Sequence([]), np.zeros(1), Steps(10, 1e-8, "guarded")) is None


class Mirrored(Sequence):
    """Negative parameters are reflected."""

    def admissible(self, theta):
        return np.abs(theta)


@pytest.mark.parametrize("rule", ["plain", "relaxed", "guarded"])
@pytest.mark.parametrize(("error", "status"), [(-1e-9, Status.REFLECTED), (1e-9, Status.CONVERGED)])
def test_a_last_step_that_was_mirrored_is_no_convergence(error, status, rule):
    sequence = [equations(error=error), equations(error=0.0, cost=0.0)]
    assert iterate(Mirrored(sequence), np.zeros(1), Steps(10, 1e-8, rule)).status is status


def test_steps_that_give_less_than_they_promise_end_the_iteration():
    # Each step is halved eight times before the cost decreases, by a thousandth of the prediction for the full one.
    sequence = [equations()]
    for k in range(SLOW_STEPS + 5):
        sequence += [equations(cost=2.0)] * 8 + [equations(cost=1.0 - 1e-3 * (k + 1))]
    result = iterate(Sequence(sequence), np.zeros(1), Steps(100, 1e-8, "guarded"))
    assert (result.status, result.iterations) == (Status.STALLED, SLOW_STEPS)


class Scalar:
    """One parameter with a given full step as a function of it; no equations if it is too large."""

    free = 1

    def __init__(self, step, largest=np.inf):
        self.step, self.largest = step, largest
        self.asked = []

    def equations(self, theta):
        self.asked.append(theta[0])
        if abs(theta[0]) > self.largest:
            return inadmissible(1)
        # The regressor is twice the instrument: the step is not the Gauss-Newton step.
        return Equations(np.array([[2.0]]), np.array([2.0 * self.step(theta[0])]), np.eye(1), 1.0 + theta[0] ** 2, 1.0)

    def admissible(self, theta):
        return theta


def path(problem, begin, rule, max_iterations=200, tolerance=1e-9):
    """Return all parameters of the iterations, and the result."""
    result = iterate(problem, np.array([begin]), Steps(max_iterations, tolerance, rule))
    return result.path[:, 0], result


def test_steps_that_overshoot_are_halved_and_failed_directions_not_tried_again():
    # Instrumental steps lead away from the minimum at 0, however short; Gauss-Newton steps, 3 from 2, overshoot it to
    # a lower cost, but not lower by a tenth of the prediction from its slope; half of the step is taken.
    class Misled(Scalar):
        def equations(self, theta):
            return super().equations(theta)._replace(instrument_regressor=np.array([[-1.0]]))

    problem = Misled(lambda theta: -0.95 * theta)
    seen, _ = path(problem, 2.0, "guarded", max_iterations=3)
    away = [2.0 + 3.8 * 0.5**k for k in range(12)]
    np.testing.assert_allclose(problem.asked[:15], [2.0, *away, 2.0 - 3.8, 2.0 - 1.9], rtol=1e-12)
    np.testing.assert_allclose(seen[1:4], [0.1, 0.005, 0.00025], rtol=1e-9)
    assert max(np.abs(problem.asked[15:])) < 0.1


@pytest.mark.parametrize("factor", [-2.0, -3.0])
def test_relaxed_steps_end_a_cycle_that_full_steps_never_leave(factor):
    # theta alternates to -theta, or -2 theta, without end; with relaxation to -0.4 theta, or -theta/2.
    problem = Scalar(lambda theta: factor * theta)
    assert path(problem, 1.0, "plain")[1].status is not Status.CONVERGED
    seen, result = path(problem, 1.0, "relaxed")
    assert result.status is Status.CONVERGED
    fractions = np.repeat(RELAXATIONS if factor == -3.0 else RELAXATIONS[:2], PATIENCE)
    ratios = seen[1 : fractions.size + 1] / seen[: fractions.size]
    np.testing.assert_allclose(ratios, 1.0 + factor * fractions)


def test_relaxed_steps_into_the_void_are_halved_and_the_cost_may_rise():
    # 1 -> 1 + 4 and 1 + 2 are outside, 1 + 1 is not, but has a higher cost and is refused by guarded steps.
    def four_once(theta):
        return 4.0 if theta == 1.0 else 0.0

    seen, result = path(Scalar(four_once, largest=2.5), 1.0, "relaxed")
    assert result.status is Status.CONVERGED
    assert seen[1] == 2.0
    assert path(Scalar(four_once, largest=2.5), 1.0, "plain")[1].status is Status.DIVERGED
    assert path(Scalar(four_once, largest=2.5), 1.0, "guarded")[0].tolist() == [1.0]


# Scaled equations ---------------------------------------------------------------------------------------------


@given(st.integers(0, 2**31), st.integers(1, 8), st.integers(1, 8))
def test_leading_equations_are_solved_in_any_units(seed, size, count):
    rng = np.random.default_rng(seed)
    count = min(count, size)
    matrix, right = rng.uniform(-3, 3, (size, size)), rng.uniform(-3, 3, size)
    condition = np.linalg.cond(matrix[:count, :count])
    assume(condition < 1e8)
    rows, columns = 10.0 ** rng.uniform(-120, 120, (2, size))
    found, solution = solve_scaled(matrix * np.outer(rows, columns), right * rows, rows**2, columns**2, count)
    assert found
    expected = np.linalg.solve(matrix[:count, :count], right[:count])
    largest = np.abs(expected).max() + np.abs(right).max()
    np.testing.assert_allclose(solution[:count] * columns[:count], expected, rtol=0, atol=1e-13 * condition * largest)
    assert not solution[count:].any()


@pytest.mark.parametrize(
    ("matrix", "right", "scale"),
    [
        ([[1.0, 2.0], [2.0, 4.0]], 1.0, 1.0),
        (np.zeros((2, 2)), 1.0, 1.0),
        (np.full((2, 2), np.nan), 1.0, 1.0),
        (np.eye(2), np.nan, 1.0),
        (np.eye(2), np.inf, 1.0),
        (np.eye(2), 1.0, 0.0),
        (np.eye(2), 1.0, -1.0),
        (np.eye(2), 1.0, np.inf),
        (np.eye(2), 1.0, np.nan),
    ],
)
def test_equations_without_a_solution_are_noticed(matrix, right, scale):
    ones, scales = np.ones(2), np.array([1.0, scale])
    for rows, columns in ((scales, ones), (ones, scales)):
        assert not solve_scaled(np.array(matrix), np.array([1.0, right]), rows, columns, 2)[0]
