"""The iteration: against the textbook formula, at its fixed points, and how it ends."""

import numpy as np
import pytest

from ctid_cli.estimation.iteration import PATIENCE, RELAXATIONS, Equations, relative_change
from ctid_cli.filtering.bank import standard_rows
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.inference.fit import Status
from ctid_cli.inference.sensitivities import Structure
from tests.estimation.adapters import CoefficientProblem, DelayProblem, iterate
from tests.estimators.records import CASE_1, CASE_2, make_record, theta_of

DEGREES = {CASE_1: Structure(2, 0), CASE_2: Structure(4, 1)}


def problem_of(model, regular=True, snr_db=15, hold_output="foh", n=3000):
    data = filter_data(make_record(model, snr_db=snr_db, regular=regular, n=n), 9.0, hold_output)
    return CoefficientProblem(data, DEGREES[model], model.delay)


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("hold_output", ["zoh", "foh"])
@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_plain_step_is_the_textbook_formula(model, hold_output, regular):
    # theta+ = [Psi' Phi]^-1 Psi' y_f with y_f = p^n/A y, formed from the filtered signals and solved by numpy.
    problem = problem_of(model, regular, hold_output=hold_output)
    n, m = model.order, model.numerator.size - 1
    theta = theta_of(model) * (1 + 0.02 * np.cos(np.arange(n + m + 1)))
    a, b = np.append(1.0, theta[:n]), theta[n:]
    rows = standard_rows(problem.data, a, b, model.delay, "chain")
    p_x, p_y = rows[:, n + 1 : 2 * n + 1][:, ::-1], rows[:, 2 * n + 1 : 3 * n + 1][:, ::-1]
    p_u = rows[:, m::-1]
    psi, phi = np.column_stack((-p_x, p_u)), np.column_stack((-p_y, p_u))
    y_f = problem.data.y_used - p_y @ a[1:]
    scale = np.linalg.norm(psi, axis=0)
    expected = np.linalg.solve((psi / scale).T @ (phi / scale), (psi / scale).T @ y_f) / scale
    result = iterate(problem, theta, max_iterations=1, tolerance=1e-12, variant="plain")
    np.testing.assert_allclose(result.theta, expected, rtol=1e-8)
    assert (result.status, result.iterations) == (Status.MAX_ITERATIONS, 1)


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("variant", ["plain", "guarded"])
@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_gradient_vanishes_at_convergence(model, variant, regular):
    # On noisy data: sum psi eps = 0, so the estimate minimises the output error, whatever the hold of y.
    thetas = []
    for hold_output in ("foh", "zoh"):
        problem = problem_of(model, regular, hold_output=hold_output)
        result = iterate(problem, theta_of(model), max_iterations=100, tolerance=1e-11, variant=variant)
        assert result.status is Status.CONVERGED
        equations = problem.equations(result.theta)
        lengths = np.sqrt(np.diag(equations.hessian) * equations.squared_error)
        assert np.abs(equations.instrument_error / lengths).max() < 1e-8
        thetas.append(result.theta)
    np.testing.assert_allclose(thetas[0], thetas[1], rtol=1e-7)


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_gradient_vanishes_for_coefficients_and_delay_together(model, regular):
    data = filter_data(make_record(model, snr_db=15, regular=regular, n=3000), 12.0)
    problem = DelayProblem(data, DEGREES[model], (0.0, 12.0))
    theta = np.append(theta_of(model), model.delay)
    result = iterate(problem, theta, max_iterations=100, tolerance=1e-11, variant="guarded")
    assert result.status is Status.CONVERGED
    equations = result.equations
    lengths = np.sqrt(np.diag(equations.hessian) * equations.squared_error)
    assert np.abs(equations.instrument_error / lengths).max() < 1e-8
    # A minimum and no saddle: every small step costs.
    for k in range(theta.size):
        for sign in (1, -1):
            moved = result.theta.copy()
            moved[k] += sign * 1e-3 * abs(moved[k])
            assert problem.equations(moved).squared_error > equations.squared_error


def test_guarded_iteration_never_raises_the_cost():
    # From starts so far away that full steps do raise it, by more than it is in the end.
    problem = problem_of(CASE_2, snr_db=5)
    rng = np.random.default_rng(0)
    rises = []
    for _ in range(20):
        theta = theta_of(CASE_2) * np.exp(rng.standard_normal(6))
        costs = {"plain": [], "guarded": []}
        for variant, seen in costs.items():

            def remember(_, equations, seen=seen):
                seen.append(equations.squared_error)

            iterate(problem, theta, max_iterations=30, tolerance=1e-9, variant=variant, on_step=remember)
        assert len(costs["guarded"]) > 3
        assert np.diff(costs["guarded"]).max() <= 1e-12 * costs["guarded"][0]
        rises.append(np.diff(costs["plain"]).max() / costs["plain"][-1])
    assert max(rises) > 1.0


def test_unstable_starts_are_reflected():
    problem = problem_of(CASE_1)
    result = iterate(problem, np.array([-2.8, 4.0, 8.0]), max_iterations=50, tolerance=1e-9, variant="guarded")
    assert result.status is Status.CONVERGED
    np.testing.assert_allclose(result.theta, theta_of(CASE_1), rtol=0.1)


def test_step_of_convergence_is_free_of_units():
    # The change of the output that a step makes, as a fraction of the output: here 1 % more gain.
    problem = problem_of(CASE_1)
    theta = theta_of(CASE_1)
    assert relative_change(problem.equations(theta), np.array([0.0, 0.0, 0.01 * theta[2]])) == pytest.approx(0.01)


class Fixed:
    """A problem with the same equations everywhere, or none."""

    def __init__(self, equations):
        self.sequence = iter(equations)

    def equations(self, theta):
        return next(self.sequence, None)

    def admissible(self, theta):
        return theta


def equations(hessian=1.0, error=1.0, cost=1.0):
    return Equations(np.array([[hessian]]), np.array([error]), np.array([[abs(hessian)]]), cost, 1.0)


@pytest.mark.parametrize(
    ("sequence", "variant", "status"),
    [
        ([equations(), equations(error=0.0)], "plain", Status.CONVERGED),
        ([equations(), equations(error=0.0, cost=0.0)], "guarded", Status.CONVERGED),
        ([equations(hessian=0.0)], "plain", Status.SINGULAR),
        ([equations(hessian=0.0)], "guarded", Status.SINGULAR),
        ([equations(hessian=0.0)], "relaxed", Status.SINGULAR),
        ([equations(), equations(error=0.0)], "relaxed", Status.CONVERGED),
        ([equations()], "relaxed", Status.DIVERGED),
        ([equations()], "plain", Status.DIVERGED),
        ([equations()] + [equations(cost=2.0)] * 100, "guarded", Status.STALLED),
        ([equations(error=1e-9)] + [equations(cost=2.0)] * 50, "guarded", Status.CONVERGED),
        ([equations()] * 100, "plain", Status.MAX_ITERATIONS),
    ],
)
def test_every_end_has_its_status(sequence, variant, status):
    # A vanishing error means convergence; no equations at the trial means a step into the void; a cost that does
    # not fall stalls, unless the step was below rounding anyway.
    followed = sequence + [equations(error=0.0, cost=0.0)] * (status is Status.CONVERGED)
    result = iterate(Fixed(followed), np.zeros(1), max_iterations=10, tolerance=1e-8, variant=variant)
    assert result.status is status


class Mirrored(Fixed):
    """Parameters below zero are moved to the other side."""

    def admissible(self, theta):
        return np.abs(theta)


@pytest.mark.parametrize("variant", ["plain", "relaxed", "guarded"])
@pytest.mark.parametrize(("error", "status"), [(-1e-9, Status.REFLECTED), (1e-9, Status.CONVERGED)])
def test_a_last_step_that_was_mirrored_is_no_convergence(error, status, variant):
    sequence = [equations(error=error), equations(error=0.0, cost=0.0)]
    result = iterate(Mirrored(sequence), np.zeros(1), max_iterations=10, tolerance=1e-8, variant=variant)
    assert result.status is status


def test_start_that_is_not_admissible_gives_nothing():
    assert iterate(Fixed([]), np.zeros(1), max_iterations=10, tolerance=1e-8, variant="guarded") is None


class Scalar:
    """One parameter whose full step is a function of it; no equations where it is too large."""

    def __init__(self, step, largest=np.inf):
        self.step = step
        self.largest = largest

    def equations(self, theta):
        if abs(theta[0]) > self.largest:
            return None
        # The regressor is twice the instrument: the step is not that of Gauss and Newton.
        return Equations(np.array([[2.0]]), np.array([2.0 * self.step(theta[0])]), np.eye(1), 1.0 + theta[0] ** 2, 1.0)

    def admissible(self, theta):
        return theta


def path(problem, begin, variant, **options):
    """All parameters on the way, and how it ended."""
    seen = []
    options = {"max_iterations": 200, "tolerance": 1e-9, **options}
    result = iterate(
        problem, np.array([begin]), variant=variant, on_step=lambda theta, _: seen.append(theta[0]), **options
    )
    return np.array(seen), result


def test_relaxed_steps_end_a_cycle_that_full_steps_never_leave():
    # theta becomes -theta for ever.
    cycle = Scalar(lambda theta: -2.0 * theta)
    seen, result = path(cycle, 1.0, "plain")
    assert result.status is Status.MAX_ITERATIONS
    assert set(seen) == {-1.0, 1.0}
    seen, result = path(cycle, 1.0, "relaxed")
    assert result.status is Status.CONVERGED
    assert result.iterations < 40
    ratios = seen[1:] / seen[:-1]
    np.testing.assert_allclose(ratios[:PATIENCE], -1.0)
    np.testing.assert_allclose(ratios[PATIENCE:], -0.4)
    assert abs(result.theta[0]) < 1e-9


def test_half_steps_where_seven_tenths_do_not_settle_either():
    # theta becomes -2 theta, then -1.1 theta, then -theta/2.
    seen, result = path(Scalar(lambda theta: -3.0 * theta), 1.0, "relaxed")
    assert result.status is Status.CONVERGED
    expected = np.repeat(1.0 - 3.0 * np.array(RELAXATIONS), PATIENCE)
    np.testing.assert_allclose(seen[1 : 3 * PATIENCE + 1] / seen[: 3 * PATIENCE], expected)


def test_cycle_that_is_entered_from_within_is_left_by_the_first_relaxation():
    # From close to the solution, which full steps leave: how short they were there does not matter later.
    seen, result = path(Scalar(lambda theta: -2.7 * np.tanh(theta)), 0.01, "relaxed", max_iterations=500)
    assert result.status is Status.CONVERGED
    assert np.abs(seen).max() > 0.5
    assert seen[-1] / seen[-2] == pytest.approx(1.0 - 0.7 * 2.7, rel=1e-6)


@pytest.mark.parametrize("factor", [-0.9, -0.3, 0.5, 0.95])
def test_relaxed_steps_that_become_shorter_are_full_ones(factor):
    # However slowly: every one is shorter than all before.
    seen, result = path(Scalar(lambda theta: (factor - 1.0) * theta), 1.0, "relaxed", max_iterations=1000)
    assert result.status is Status.CONVERGED
    np.testing.assert_allclose(seen, factor ** np.arange(seen.size), rtol=1e-9)
    plain, _ = path(Scalar(lambda theta: (factor - 1.0) * theta), 1.0, "plain", max_iterations=1000)
    assert plain.tolist() == seen.tolist()


def test_relaxed_steps_into_the_void_are_halved_and_the_cost_may_rise():
    # 1 -> 1 + 4 lies outside, 1 + 2 too, 1 + 1 does not: there the cost is higher, which guarded steps do not take.
    problem = Scalar(lambda theta: 4.0 if theta == 1.0 else 0.0, largest=2.5)
    seen, result = path(problem, 1.0, "relaxed")
    assert result.status is Status.CONVERGED
    assert seen[1] == 2.0
    _, result = path(problem, 1.0, "plain")
    assert result.status is Status.DIVERGED
    seen, _ = path(problem, 1.0, "guarded")
    assert seen.tolist() == [1.0]


def test_relaxed_iteration_that_finds_nothing_admissible_ends():
    _, result = path(Scalar(lambda theta: 1e9, largest=2.5), 1.0, "relaxed")
    assert result.status is Status.DIVERGED
    assert result.theta.tolist() == [1.0]
    # Full steps that are too long are no convergence because a small fraction of them is taken.
    _, result = path(Scalar(lambda theta: 4.0 - theta, largest=2.5), 1.0, "relaxed", tolerance=1e-3)
    assert result.status is not Status.CONVERGED
