"""The compiled iteration against the Python one, step by step and from start to end, and the parts it is made of."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ctid_cli.estimation.iteration import solve_scaled
from ctid_cli.estimation.stability import is_hurwitz, with_stable_denominator
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.fit import Status
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from tests.estimation.adapters import CoefficientProblem, DelayProblem, best_coefficients, delay_step, refit_numerator
from tests.estimation.reference_iteration import guarded, solved, stable
from tests.estimators.records import CASE_1, CASE_2, make_record, theta_of

SEARCH = {"max_iterations": 10, "tolerance": 1e-2, "halvings": 3}
FULL = {"max_iterations": 100, "tolerance": 1e-9, "halvings": 12}
LONGEST = 3.0
RIGHT, NEAR, ANY = (0.0, 0.0371), (0.0, 0.0371, 0.3), (0.0, 0.0371, 0.3, 1.7182, 3.0)


def in_python(data, structure, delay, starts, gauss_newton=False, **effort):
    """What `best_coefficients` promises, from the reference."""
    problem = CoefficientProblem(data, structure, delay)
    results = []
    for start in starts:
        refitted = refit_numerator(data, structure, stable(start, structure.poles), delay)
        result = guarded(problem, refitted, gauss_newton=gauss_newton, **effort)
        results += [] if result is None else [result]
    return min(results, key=lambda result: result.equations.squared_error, default=None)


def distance(theta, squared_error, expected, data):
    """How far the outputs of two sets of coefficients and their costs are apart, as a fraction of the output's.

    Far from the true delay the data hardly determine some combinations of coefficients, which are left to rounding.
    """
    change = theta - expected.theta
    power = max(expected.equations.output_power, float(data.y_used @ data.y_used))
    squared = max(change @ expected.equations.hessian @ change, 0.0)
    return max(np.sqrt(squared / power), abs(squared_error - expected.equations.squared_error) / power)


def dynamics(rng, n, m):
    """A stable system with poles and zeros within 0.4 to 4 rad/s and a gain of one."""
    poles = []
    while len(poles) < n:
        w = np.exp(rng.uniform(-1, 1.4))
        if n - len(poles) >= 2 and rng.random() < 0.6:
            damping = rng.uniform(0.15, 0.9)
            poles += [w * complex(-damping, sign * np.sqrt(1 - damping**2)) for sign in (1, -1)]
        else:
            poles.append(-w)
    a = np.poly(poles).real
    b = np.poly(-np.exp(rng.uniform(-1, 1.4, m)) * rng.choice([-1, 1], m)) if m else np.ones(1)
    return TransferFunction(b * a[-1] / b[-1], a, float(rng.choice([0.0, 1.0, 1.2345])))


@st.composite
def problems(draw, highest=5, errors=ANY):
    """A record, its degrees, a delay in error by as much as allowed, and starts near the true coefficients or far."""
    n = draw(st.integers(1, highest))
    structure = Structure(n, draw(st.integers(0, n - 1)))
    rng = np.random.default_rng(draw(st.integers(0, 2**31)))
    count = 250
    regular = draw(st.booleans())
    t = 0.1 * np.arange(count) if regular else np.cumsum(rng.uniform(0.03, 0.17, count))
    # The input changes on the clock of the output or on one of its own.
    breaks = t if draw(st.booleans()) else np.arange(t[0], t[-1], 0.5)
    held = HeldSignal(breaks, rng.standard_normal(breaks.size), draw(st.sampled_from(["zoh", "foh"])))
    truth = dynamics(rng, n, structure.zeros)
    x = simulate(truth, held, t)
    y = x + draw(st.sampled_from([0.0, 0.1])) * x.std() * rng.standard_normal(count)
    data = filter_data(Record(t, y, held), LONGEST, draw(st.sampled_from(["foh", "zoh"])))
    delay = min(truth.delay + draw(st.sampled_from(errors)), LONGEST)
    spread = draw(st.sampled_from([0.02, 0.5]))
    starts = theta_of(truth) * np.exp(spread * rng.standard_normal((draw(st.integers(1, 3)), n + structure.zeros + 1)))
    if draw(st.booleans()):
        starts[0, :n] *= rng.choice([-1, 1], n)  # mostly unstable
    return data, structure, delay, starts


def assert_same_iterations(problem, gauss_newton, **effort):
    data, structure, delay, starts = problem
    expected = in_python(data, structure, delay, starts, gauss_newton, **effort)
    # Where a pole runs to infinity it is a matter of rounding which of two steps lowers the cost enough. Such starts
    # betray themselves: the last digits decide where the Python iteration goes.
    for digits in (1e-12, -1e-12):
        moved = starts * (1 + digits * np.cos(np.arange(starts.size).reshape(starts.shape)))
        other = in_python(data, structure, delay, moved, gauss_newton, **effort)
        assume(distance(other.theta, other.equations.squared_error, expected, data) < 1e-10)
    theta, squared_error, _ = best_coefficients(data, structure, delay, starts, gauss_newton=gauss_newton, **effort)
    assert distance(theta, squared_error, expected, data) < 1e-9


@settings(max_examples=100)
@given(problems(), st.booleans())
def test_one_step_is_that_of_the_python_iteration(problem, gauss_newton):
    # From any start, at any delay: numerator, step, halvings, fall-back direction and reflection.
    assert_same_iterations(problem, gauss_newton, **{**SEARCH, "max_iterations": 1})


@settings(max_examples=100)
@given(problems(highest=3, errors=NEAR), st.booleans())
def test_search_is_that_of_the_python_iteration(problem, gauss_newton):
    assert_same_iterations(problem, gauss_newton, **SEARCH)


@settings(max_examples=30)
@given(problems(highest=4, errors=RIGHT), st.booleans())
def test_converged_coefficients_are_those_of_the_python_iteration(problem, gauss_newton):
    assert_same_iterations(problem, gauss_newton, **FULL)


@pytest.mark.parametrize("delay", [8.0, 7.9321, 7.6])
@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_benchmark_coefficients_are_those_of_the_python_iteration(model, regular, delay):
    # To 1e-9 in every coefficient.
    data = filter_data(make_record(model, snr_db=15, regular=regular, n=2500), 9.0)
    structure = Structure(model.order, model.numerator.size - 1)
    start = theta_of(model) * (1 + 0.1 * np.cos(np.arange(structure.size)))
    for effort in (SEARCH, FULL):
        expected = in_python(data, structure, delay, [start], **effort)
        theta, squared_error, _ = best_coefficients(data, structure, delay, start, **effort)
        np.testing.assert_allclose(theta, expected.theta, rtol=1e-9)
        assert squared_error == pytest.approx(expected.equations.squared_error, rel=1e-9)


@pytest.mark.parametrize("seed", [31, 49])
def test_steps_that_give_less_than_they_promise_end_it(seed):
    # A delay that is too long by a time constant: both stop after as many such steps, and far from where they would go.
    # Of other records the steps are so short (1e-7 of the output) that rounding decides which still lowers the cost.
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(250)
    held = HeldSignal(t, rng.standard_normal(t.size))
    x = simulate(TransferFunction([1.0], [1.0, 1.0], 1.0), held, t)
    data = filter_data(Record(t, x + 0.1 * rng.standard_normal(t.size), held), LONGEST)
    problem = (data, Structure(1, 0), 2.0, np.ones((1, 2)))
    expected = in_python(*problem, **FULL)
    assert expected.status is Status.STALLED
    theta, squared_error, _ = best_coefficients(*problem, **FULL)
    assert distance(theta, squared_error, expected, data) < 1e-11
    patient = in_python(*problem, **FULL, slow_steps=1000)
    assert patient.iterations > expected.iterations
    assert distance(theta, squared_error, patient, data) > 1e-3


def test_cheapest_of_several_starts_is_kept():
    # Whatever the order: the result is that of the best start alone, bit for bit.
    data = filter_data(make_record(CASE_2, snr_db=15, n=2500), 9.0)
    structure, truth = Structure(4, 1), theta_of(CASE_2)
    slow = np.concatenate((np.poly(np.full(4, -0.1))[1:], [1.0, 1.0]))
    starts = np.array([slow, truth * 1.02, slow * [-1, 1, -1, 1, 1, 1], truth * [1, 1, 1.4, 1, 1, 1]])
    alone = [best_coefficients(data, structure, 8.0, start, **SEARCH) for start in starts]
    costs = [squared_error for _, squared_error, _ in alone]
    assert max(costs) > 2 * min(costs)
    before = starts.copy()
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [1, 0], [2, 3]):
        theta, squared_error, step = best_coefficients(data, structure, 8.0, starts[order], **SEARCH)
        best = alone[min(order, key=costs.__getitem__)]
        assert (theta.tolist(), squared_error, step) == (best[0].tolist(), *best[1:])
    assert np.array_equal(starts, before)


def test_only_the_denominators_of_the_starts_matter():
    data = filter_data(make_record(snr_db=15, n=1500), 9.0)
    found = [
        best_coefficients(data, Structure(2, 0), 8.0, np.array([2.0, 3.0, b]), **SEARCH) for b in (1.0, -5.0, 1e6, 0.0)
    ]
    for theta, squared_error, step in found[1:]:
        assert (theta.tolist(), squared_error, step) == (found[0][0].tolist(), *found[0][1:])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("poles", [1, 2])
def test_start_that_is_not_finite_leads_nowhere(poles, bad):
    data = filter_data(make_record(snr_db=15, n=1000), 9.0)
    structure = Structure(poles, 0)
    start = np.full(poles + 1, bad)
    assert best_coefficients(data, structure, 8.0, start, **SEARCH) is None
    good = np.concatenate((np.poly(np.full(poles, -1.0))[1:], [1.0]))
    one, two = (best_coefficients(data, structure, 8.0, starts, **SEARCH) for starts in (good, np.array([start, good])))
    assert (one[0].tolist(), *one[1:]) == (two[0].tolist(), *two[1:])


@pytest.mark.parametrize("delay", [8.0, 7.9321, 7.6])
@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_delay_step_at_convergence_is_that_of_the_separable_problem(model, regular, delay):
    # Where the gradient in the coefficients vanishes, projecting them out of it changes nothing.
    data = filter_data(make_record(model, snr_db=15, regular=regular, n=2500), 9.0)
    structure = Structure(model.order, model.numerator.size - 1)
    theta, _, step = best_coefficients(
        data, structure, delay, theta_of(model), max_iterations=200, tolerance=1e-13, halvings=30
    )
    joint = DelayProblem(data, structure, (0.0, 9.0)).equations(np.append(theta, delay))
    assert step == pytest.approx(delay_step(joint), rel=1e-9)


def test_delay_that_the_data_do_not_determine_has_no_step():
    # The steady response to one tone has an amplitude and a phase: a pole and a gain explain them at any delay.
    t = 0.05 * np.arange(3000)
    held = HeldSignal(t, np.sin(1.3 * t))
    y = simulate(TransferFunction([2.0], [1.0, 2.0], 1.0), held, t)
    data = filter_data(Record(t, y, held), 20.0)
    _, _, step = best_coefficients(data, Structure(1, 0), 1.2, np.array([2.0, 2.0]), **FULL)
    assert step is None


def entries(shape, low=-3.0, high=3.0):
    return arrays(np.float64, shape, elements=st.floats(low, high, width=32))


@st.composite
def systems(draw):
    """Equations whose rows and columns have very different units."""
    p = draw(st.integers(1, 8))
    matrix, right = draw(entries((p, p))) + 2 * np.diag(draw(entries(p)) + 4), draw(entries(p))
    row_units, column_units = 10.0 ** draw(entries(p, -120, 120)), 10.0 ** draw(entries(p, -120, 120))
    return matrix, right, row_units, column_units


@given(systems())
def test_solve_scaled_is_numpy_on_the_scaled_equations(system):
    matrix, right, row_units, column_units = system
    condition = np.linalg.cond(matrix)
    assume(condition < 1e8)
    mixed = matrix * np.outer(row_units, column_units)
    before = mixed.copy()
    found, out = solve_scaled(mixed, right * row_units, row_units**2, column_units**2, right.size)
    assert found
    expected = np.linalg.solve(matrix, right)
    size = np.abs(expected).max() + np.abs(right).max()
    np.testing.assert_allclose(out * column_units, expected, rtol=0, atol=1e-13 * condition * size)
    assert np.array_equal(mixed, before)
    also = solved(mixed, right * row_units, row_units**2, column_units**2)
    np.testing.assert_allclose(out * column_units, also * column_units, rtol=0, atol=1e-13 * condition * size)


@given(systems(), st.integers(1, 8))
def test_leading_equations_are_solved_by_themselves(system, count):
    matrix, right, _, _ = system
    count = min(count, right.size)
    assume(np.linalg.cond(matrix[:count, :count]) < 1e8)
    ones = np.ones(right.size)
    _, whole = solve_scaled(matrix[:count, :count].copy(), right[:count].copy(), ones, ones, count)
    _, part = solve_scaled(matrix, right, ones, ones, count)
    assert np.array_equal(part, np.append(whole, np.zeros(right.size - count)))


@given(st.integers(1, 6), st.integers(0, 5), st.sampled_from([np.nan, np.inf, 0.0, -1.0]))
def test_scales_that_are_not_positive_are_refused(p, place, bad):
    ones, wrong = np.ones(p), np.ones(p)
    wrong[place % p] = bad
    assert solve_scaled(np.eye(p), ones, ones, ones, p)[0]
    assert not solve_scaled(np.eye(p), ones, wrong, ones, p)[0]
    assert not solve_scaled(np.eye(p), ones, ones, wrong, p)[0]


@pytest.mark.parametrize(
    "matrix", [np.ones((2, 2)), np.zeros((3, 3)), np.diag([1.0, 0.0, 2.0]), np.array([[1.0, 2], [2, 4]]), [[0.0]]]
)
def test_singular_equations_have_no_solution(matrix):
    matrix = np.array(matrix, dtype=float)
    ones = np.ones(matrix.shape[0])
    assert not solve_scaled(matrix, ones, ones, ones, ones.size)[0]


@given(systems(), st.integers(0, 63))
def test_numbers_that_are_none_are_noticed(system, place):
    matrix, right, _, _ = system
    ones = np.ones(right.size)
    for number in (np.nan, np.inf):
        wrong = right.copy()
        wrong[place % right.size] = number
        assert not solve_scaled(matrix, wrong, ones, ones, right.size)[0]
    matrix.flat[place % matrix.size] = np.nan
    assert not solve_scaled(matrix, right, ones, ones, right.size)[0]


def test_zero_pivots_are_no_obstacle():
    # Partial pivoting: the leading entry vanishes at every stage.
    matrix = np.array([[0.0, 0, 1], [0, 2, 0], [4, 0, 0]])
    found, out = solve_scaled(matrix, np.array([1.0, 2, 3]), np.ones(3), np.ones(3), 3)
    assert found
    assert out.tolist() == [0.75, 1.0, 1.0]


@st.composite
def denominators(draw):
    """Roots off the axis and apart from one another, and the polynomial in any unit of time."""
    roots = []
    for _ in range(draw(st.integers(1, 3))):
        real = draw(st.floats(0.05, 5)) * draw(st.sampled_from([-1, 1]))
        imag = draw(st.floats(0.1, 5))
        roots += [complex(real, imag), complex(real, -imag)] if draw(st.booleans()) else [complex(real)]
    roots = np.array(roots)
    gaps = np.abs(roots[:, None] - roots) + 10 * np.eye(roots.size)
    assume(gaps.min() > 0.05)
    return np.poly(roots).real * 10.0 ** (draw(st.floats(-6, 6)) * np.arange(roots.size + 1))


@given(denominators(), st.lists(st.floats(-9, 9), max_size=3))
def test_reflection_is_that_of_numpy(a, numerator):
    theta = np.concatenate((a[1:], numerator))
    expected = stable(theta, a.size - 1)
    found = with_stable_denominator(theta, a.size - 1)
    assert is_hurwitz(np.append(1.0, found[: a.size - 1]))
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    if is_hurwitz(a):
        assert np.array_equal(found, theta)
    assert np.array_equal(found[a.size - 1 :], numerator)


@pytest.mark.parametrize("a", [[0.0], [0.0, 4.0], [1.0, 1.0, 1.0], [2.0, 0.0], [0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
def test_roots_on_the_axis_are_moved_off_it(a):
    theta = np.array([*a, 7.0])
    moved = with_stable_denominator(theta, len(a))
    np.testing.assert_allclose(moved, stable(theta, len(a)), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(moved, [*a, 7.0], atol=1e-4)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [0, 2, 3])
def test_parameters_that_are_not_finite_are_left_alone(place, bad):
    theta = np.array([-1.0, 2.0, -3.0, 4.0])
    theta[place] = bad
    kept = theta.copy()
    assert np.array_equal(with_stable_denominator(theta, 3), kept, equal_nan=True)
    assert np.array_equal(theta, kept, equal_nan=True)
