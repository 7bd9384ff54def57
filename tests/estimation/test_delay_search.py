"""The search over the delay on costs whose minima are known, and its step against differences of the profile cost."""

import math
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.estimation.delay_search import Limits, Minimum, bound_in_the_way, descend
from ctid_cli.estimation.iteration import ENDS, INADMISSIBLE, Equations
from ctid_cli.filtering.bank import standard_rows
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.inference.fit import Status
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.models.transfer_function import TransferFunction
from tests.estimation.adapters import CoefficientProblem, DelayProblem, delay_step, iterate
from tests.estimators.records import CASE_1, CASE_2, make_record, theta_of

START = np.array([[3.0, 4.0]])
BOUNDS = (0.0, 10.0)
#: A hundred-thousandth of the range.
SMALLEST = 1e-4


class Artificial:
    """A cost given by a formula and its step; writes down where it was asked for what."""

    def __init__(self, cost, step):
        self.cost, self.formula = cost, step
        self.asked, self.starts = [], []

    def minimise(self, delay, starts, own):
        self.asked.append(delay)
        self.starts.append((starts.tolist(), own))
        value = self.cost(delay)
        return Minimum(np.array([value, delay]), value, self.formula(delay))


def quadratic(at, floor=1.0):
    """Cost (d - at)^2 + floor with Newton's step, which is exact."""
    return Artificial(lambda d: (d - at) ** 2 + floor, lambda d: at - d)


def waves(at=5.0, frequency=4.0):
    """A parabola with waves on it: stationary points where 0.2 (d - at) + w sin(w (d - at)) = 0."""

    def cost(d):
        return 2.0 + 0.1 * (d - at) ** 2 - math.cos(frequency * (d - at))

    def step(d):
        slope = 0.2 * (d - at) + frequency * math.sin(frequency * (d - at))
        return -slope / (0.2 + frequency**2)

    return Artificial(cost, step)


def search(
    cost, delay, starts=START, bounds=BOUNDS, *, max_iterations=50, tolerance=1e-9, largest_step=math.inf, reflect=False
):
    found = descend(cost, delay, starts, Limits(*bounds, max_iterations, tolerance, SMALLEST, largest_step, reflect))
    end = SimpleNamespace(minimum=found.minimum, status=ENDS[found.end], iterations=found.iterations)
    return end, [Minimum(row[:-1], row[-1]) for row in found.path]


def test_newton_step_on_a_parabola_needs_one_step():
    cost = quadratic(3.0)
    found, seen = search(cost, 7.0)
    assert (found.minimum.delay, found.status, found.iterations) == (3.0, Status.CONVERGED, 1)
    assert cost.asked == [7.0, 3.0]
    assert [minimum.delay for minimum in seen] == [7.0, 3.0]
    assert (seen[-1].delay, seen[-1].squared_error) == (3.0, 1.0)
    assert found.minimum.squared_error == 1.0


def test_coefficients_are_handed_on():
    cost = quadratic(3.0)
    search(cost, 7.0, largest_step=2.0)
    # Each trial starts from the coefficients of the last accepted delay.
    assert cost.starts == [([[3.0, 4.0]], False), ([[17.0, 7.0]], False), ([[5.0, 5.0]], False)]
    # Without any the cost starts from its own.
    cost = quadratic(3.0)
    search(cost, 7.0, START[:0])
    assert cost.starts[0] == ([], True)


@pytest.mark.parametrize(("start", "at"), [(0.0, 7.25), (9.5, 1.0)])
def test_steps_are_no_longer_than_the_largest(start, at):
    cost = quadratic(at)
    found, seen = search(cost, start, largest_step=1.5)
    steps = np.diff([minimum.delay for minimum in seen])
    whole = int(abs(at - start) / 1.5)
    np.testing.assert_allclose(steps[:whole], math.copysign(1.5, at - start), rtol=1e-12)
    assert steps.size == whole + 1 == found.iterations
    assert found.minimum.delay == pytest.approx(at, abs=1e-12)
    assert len(cost.asked) == whole + 2  # no trial in vain


@pytest.mark.parametrize("start", [5.3, 4.35, 5.6])
def test_ends_in_the_minimum_of_its_valley(start):
    found, seen = search(waves(), start, tolerance=1e-14)
    assert found.status is Status.CONVERGED
    assert found.minimum.delay == pytest.approx(5.0, abs=SMALLEST)
    costs = [minimum.squared_error for minimum in seen]
    assert all(after < before for before, after in pairwise(costs))


@pytest.mark.parametrize(("start", "turns"), [(6.4, 1), (3.7, -1), (8.4, 2)])
def test_ends_in_a_local_minimum_where_it_starts_in_one(start, turns):
    # It does not look over the next hill. The minimum lies near whole turns of the waves, a little towards the middle.
    found, _ = search(waves(), start, tolerance=1e-14)
    assert found.status is Status.CONVERGED
    d = found.minimum.delay - 5.0
    assert abs(0.2 * d + 4.0 * math.sin(4.0 * d)) < 16.2 * SMALLEST  # the curvature there times the smallest step
    assert abs(d - turns * math.pi / 2) < 0.1
    assert found.minimum.squared_error > 1.2


def test_step_that_does_not_lower_the_cost_is_halved():
    # A step of twice the distance lands as high on the other side, which is no fall; half of it is exact.
    cost = Artificial(lambda d: (d - 3.0) ** 2 + 1.0, lambda d: 2.0 * (3.0 - d))
    found, _ = search(cost, 5.0)
    assert cost.asked == [5.0, 1.0, 3.0]
    assert (found.minimum.delay, found.iterations) == (3.0, 1)


def test_step_where_nothing_can_be_computed_is_halved():
    cost = Artificial(lambda d: math.inf if d > 4.0 else (d - 3.9) ** 2 + 1.0, lambda d: 8.0 if d < 1.0 else 3.9 - d)
    found, _ = search(cost, 0.5)
    assert cost.asked[:3] == [0.5, 8.5, 4.5]
    assert cost.asked[3] == 2.5
    assert found.minimum.delay == pytest.approx(3.9)


@pytest.mark.parametrize(("start", "at", "bound"), [(9.0, 17.0, 10.0), (1.0, -7.0, 0.0)])
def test_step_beyond_a_bound_is_halved_until_it_stays_inside(start, at, bound):
    # The cost is never asked for beyond a bound; at the bound the step shrinks to nothing without another question.
    cost = quadratic(at)
    found, _ = search(cost, start)
    assert cost.asked == [start, bound]
    assert (found.minimum.delay, found.status, found.iterations) == (bound, Status.CONVERGED, 1)


@pytest.mark.parametrize(("start", "bound"), [(0.0, 0.0), (10.0, 10.0), (1.0, 0.0), (9.0, 10.0)])
def test_step_beyond_a_bound_is_mirrored_where_that_is_wanted(start, bound):
    # The slope points outwards there, away from the valley: no fraction of the step helps, its mirror image does.
    outwards = 4.0 if bound else -4.0
    cost = Artificial(lambda d: (d - 5.0) ** 2, lambda d: outwards if d == start else 5.0 - d)
    found, _ = search(cost, start, reflect=True)
    assert cost.asked == [start, 2 * bound - (start + outwards), 5.0]
    assert (found.minimum.delay, found.iterations) == (5.0, 2)
    found, _ = search(cost, start)
    assert abs(found.minimum.delay - bound) <= 1.0


def test_mirrored_steps_are_halved_too():
    # Beyond the bound lies the minimum: mirror images of 17 and 13 s are no better, the one of 11 s is the start.
    cost = quadratic(17.0)
    found, _ = search(cost, 9.0, reflect=True)
    assert cost.asked[:5] == [9.0, 3.0, 7.0, 9.0, 10.0]
    assert (found.minimum.delay, found.status, found.iterations) == (10.0, Status.CONVERGED, 1)
    # A mirror image beyond the other bound is halved into the range.
    cost = Artificial(lambda d: (d - 4.0) ** 2, lambda d: -15.0 if d == 1.0 else 4.0 - d)
    found, _ = search(cost, 1.0, reflect=True)
    assert all(0.0 <= delay <= 10.0 for delay in cost.asked)


@given(st.floats(0, 10), st.floats(-30, 40), st.floats(0.1, 3), st.floats(0.05, 10), st.booleans())
def test_never_leaves_the_bounds_nor_rises(start, at, gain, largest_step, reflect):
    # Wherever the minimum lies, and whatever the steps are worth.
    cost = Artificial(lambda d: (d - at) ** 2 + 1.0, lambda d: gain * (at - d))
    found, seen = search(cost, start, max_iterations=500, tolerance=1e-12, largest_step=largest_step, reflect=reflect)
    assert all(0.0 <= delay <= 10.0 for delay in cost.asked)
    costs = [minimum.squared_error for minimum in seen]
    assert all(after < before for before, after in pairwise(costs))
    assert (seen[0].delay, seen[-1].delay) == (start, found.minimum.delay)
    assert len(seen) == found.iterations + 1
    nearest = min(max(at, 0.0), 10.0)
    assert abs(found.minimum.delay - nearest) <= max(abs(start - nearest), SMALLEST)


def test_search_ends_at_its_smallest_step():
    # No trial closer than 1e-5 of the range of the delay, and the best point reached so far is kept.
    cost = Artificial(lambda d: 1.0 + abs(d - 5.0), lambda d: 5.0)
    found, _ = search(cost, 5.0)
    assert (found.minimum.delay, found.status, found.iterations) == (5.0, Status.CONVERGED, 0)
    tried = np.array(cost.asked[1:]) - 5.0
    np.testing.assert_allclose(tried, 5.0 * 0.5 ** np.arange(tried.size))
    assert SMALLEST < tried[-1] <= 2 * SMALLEST
    # A start closer to the minimum than that stays where it is, unasked.
    cost = quadratic(3.0)
    found, _ = search(cost, 3.0 + 0.9 * SMALLEST)
    assert (cost.asked, found.status, found.iterations) == ([3.0 + 0.9 * SMALLEST], Status.CONVERGED, 0)


@pytest.mark.parametrize("after", [0, 1, 2])
def test_delay_that_is_not_determined_is_singular(after):
    # No step: the search ends with what it has.
    cost = Artificial(lambda d: (d - 9.0) ** 2, lambda d: 1.0 if d < after else math.nan)
    found, _ = search(cost, 0.0)
    assert (found.minimum.delay, found.status, found.iterations) == (after, Status.SINGULAR, after)


def test_nothing_at_the_start_is_no_search():
    cost = Artificial(lambda d: math.inf, lambda d: 1.0)
    found = descend(cost, 5.0, START, Limits(*BOUNDS, 50, 1e-9, SMALLEST, math.inf, False))
    assert (found.end, found.path.shape, cost.asked) == (INADMISSIBLE, (0, 3), [5.0])


def test_search_stops_after_max_iterations():
    cost = quadratic(9.0)
    found, _ = search(cost, 0.0, max_iterations=3, largest_step=1.0)
    assert (found.minimum.delay, found.status, found.iterations) == (3.0, Status.MAX_ITERATIONS, 3)
    assert cost.asked == [0.0, 1.0, 2.0, 3.0]


@pytest.mark.parametrize(("tolerance", "costs"), [(0.7, 2), (0.5, 3), (0.2, 4), (0.1, 5), (0.05, 5), (0.04, 6)])
def test_search_ends_when_the_cost_falls_by_less_than_the_tolerance(tolerance, costs):
    # Half the distance at each step: the cost is 20, 8, 5, 4.25, 4.0625, 4.015625 and falls by 0.6, 0.375, 0.15, ...
    cost = Artificial(lambda d: (d - 2.0) ** 2 + 4.0, lambda d: 0.5 * (2.0 - d))
    found, seen = search(cost, 6.0, tolerance=tolerance)
    assert [minimum.squared_error for minimum in seen] == [20.0, 8.0, 5.0, 4.25, 4.0625, 4.015625][:costs]
    assert (found.status, found.iterations) == (Status.CONVERGED, costs - 1)


def test_perfect_fit_ends_the_search():
    # A cost of zero cannot fall; the relative fall to it is whole.
    cost = quadratic(3.0, floor=0.0)
    found, _ = search(cost, 7.0)
    assert (found.minimum.squared_error, found.status, found.iterations) == (0.0, Status.CONVERGED, 1)
    stubborn = Artificial(lambda d: 0.0, lambda d: 1.0)
    found, _ = search(stubborn, 7.0)
    assert (found.minimum.delay, found.status, found.iterations) == (7.0, Status.CONVERGED, 0)


# The delay step of the separable problem -------------------------------------------------------------

SHORT = {CASE_1: 2000, CASE_2: 3000}


def coefficient_minimum(data, structure, delay, theta):
    found = iterate(
        CoefficientProblem(data, structure, delay), theta, max_iterations=200, tolerance=1e-13, variant="guarded"
    )
    return found.theta, found.equations.squared_error


def off_the_clock(model, delay):
    """The same system with another delay: between two changes of the input the cost is smooth."""
    return TransferFunction(model.numerator, model.denominator, delay)


@pytest.mark.parametrize("snr_db", [None, 15, 5])
@pytest.mark.parametrize("delay", [8.0129, 7.9321])
@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_delay_step_follows_the_slope_of_the_profile_cost(model, delay, snr_db):
    # step = -P'/(2 H): P' by central differences of the cost minimised over the coefficients, H from the rows by an
    # orthogonal projection.
    record = make_record(off_the_clock(model, 8.0123), snr_db=snr_db, n=SHORT[model])
    data, structure = filter_data(record, 9.0), Structure(model.order, model.numerator.size - 1)
    theta, _ = coefficient_minimum(data, structure, delay, theta_of(model))
    h = 1e-4
    plus, minus = (coefficient_minimum(data, structure, delay + side, theta)[1] for side in (h, -h))
    n, m = structure.poles, structure.zeros
    rows = standard_rows(data, np.append(1.0, theta[:n]), theta[n:], delay, "chain")
    psi = np.column_stack((rows[:, n + 1 : 2 * n + 1], rows[:, : m + 1]))
    basis, _ = np.linalg.qr(psi / np.linalg.norm(psi, axis=0))
    slope = rows[:, -1]
    curvature = np.sum((slope - basis @ (basis.T @ slope)) ** 2)
    step = delay_step(DelayProblem(data, structure, (0.0, 9.0)).equations(np.append(theta, delay)))
    assert step == pytest.approx(-(plus - minus) / (4 * h * curvature), rel=1e-4, abs=1e-7)


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_delay_step_without_noise_is_newtons(model, regular):
    # Where the residual vanishes at the minimum, the step is the distance to it up to second order, from both sides,
    # and -P'/P'' of the profile cost.
    truth = off_the_clock(model, 8.0123)
    record = make_record(truth, regular=regular, n=SHORT[model])
    data, structure = filter_data(record, 9.0), Structure(model.order, model.numerator.size - 1)
    joint = DelayProblem(data, structure, (0.0, 9.0))
    steps = []
    for error in (1e-4, -1e-4):
        theta, _ = coefficient_minimum(data, structure, truth.delay + error, theta_of(model))
        steps.append(delay_step(joint.equations(np.append(theta, truth.delay + error))))
        assert steps[-1] == pytest.approx(-error, rel=2e-2)
    costs = [coefficient_minimum(data, structure, 8.0123 + e, theta_of(model))[1] for e in (2e-4, 1e-4, 0.0)]
    newton = -(costs[0] - costs[2]) / 2 / (costs[0] - 2 * costs[1] + costs[2]) * 1e-4
    assert newton == pytest.approx(-1e-4, rel=2e-2)
    assert steps[0] == pytest.approx(newton, rel=2e-2)


def moments_of(psi, delay_sensitivity, error):
    """Second moments from signals: psi to the coefficients, then the delay."""
    full = np.column_stack((psi, delay_sensitivity))
    hessian = full.T @ full
    return Equations(hessian, full.T @ error, hessian, float(error @ error), 1.0)


@given(st.integers(0, 2**31), st.integers(1, 6), st.floats(-8, 8), st.floats(-8, 8))
def test_delay_step_is_least_squares_on_what_the_coefficients_leave(seed, p, coefficient_decades, delay_decades):
    # For an error that the coefficients cannot lower any more, in whatever units.
    rng = np.random.default_rng(seed)
    psi, slope, error = rng.standard_normal((40, p)), rng.standard_normal(40), rng.standard_normal(40)
    error -= psi @ np.linalg.lstsq(psi, error, rcond=None)[0]
    expected = np.linalg.lstsq(np.column_stack((psi, slope)), error, rcond=None)[0][-1]
    units = 10.0 ** (coefficient_decades * np.cos(np.arange(p)))
    step = delay_step(moments_of(psi * units, slope * 10.0**delay_decades, error))
    assert step * 10.0**delay_decades == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_delay_that_the_coefficients_can_imitate_has_no_step():
    rng = np.random.default_rng(0)
    psi, error = rng.standard_normal((40, 3)), rng.standard_normal(40)
    imitated = psi @ np.array([1.0, -2.0, 0.5])
    assert delay_step(moments_of(psi, imitated, error)) is None
    assert delay_step(moments_of(psi, np.zeros(40), error)) is None
    assert delay_step(moments_of(psi[:, [0, 0, 1]] * 0, imitated, error)) is None
    # A little of its own: 1e-5 of the signal, 1e-10 of the curvature.
    own = rng.standard_normal(40)
    own -= psi @ np.linalg.lstsq(psi, own, rcond=None)[0]
    nearly = imitated + 1e-5 * own * np.linalg.norm(imitated) / np.linalg.norm(own)
    equations = moments_of(psi, nearly, error)
    assert delay_step(equations) is not None
    assert delay_step(equations, least_curvature=1e-9) is None
    assert delay_step(equations, least_curvature=1e-11) is not None


def one_delay(step, determined=1.0):
    """Equations of one coefficient and the delay, whose step is given; a fraction of the curvature is the delay's."""
    overlap = np.sqrt(1.0 - determined)
    hessian = np.array([[1.0, overlap], [overlap, 1.0]])
    return Equations(hessian, np.array([0.0, step * determined]), hessian, 1.0, 1.0)


@pytest.mark.parametrize(
    ("delay", "step", "bound"),
    [
        (5.0, 1.0, None),
        (5.0, -1.0, None),
        (5.0, 3.999, None),
        (5.0, -2.999, None),
        (5.0, 4.1, 9.0),
        (5.0, -3.1, 2.0),
        (9.0, 1e-9, 9.0),
        (9.0, 0.0, None),
        (9.0, -1e-9, None),
        (2.0, -1e-9, 2.0),
        (2.0, 1e-9, None),
        (9.0, -8.0, 2.0),  # the other one
    ],
)
def test_bound_in_the_way_is_the_one_that_the_step_would_pass(delay, step, bound):
    assert bound_in_the_way(one_delay(step), delay, (2.0, 9.0)) == bound
    assert bound_in_the_way(one_delay(step, determined=1e-3), delay, (2.0, 9.0)) == bound


def test_step_onto_a_bound_is_not_beyond_it():
    assert bound_in_the_way(one_delay(4.0), 5.0, (2.0, 9.0)) is None
    assert bound_in_the_way(one_delay(-3.0), 5.0, (2.0, 9.0)) is None


def test_step_of_a_delay_that_is_hardly_determined_means_nothing():
    assert bound_in_the_way(one_delay(100.0, determined=1e-6), 5.0, (2.0, 9.0)) == 9.0
    assert bound_in_the_way(one_delay(100.0, determined=1e-9), 5.0, (2.0, 9.0)) is None
    assert delay_step(one_delay(100.0, determined=1e-9)) == pytest.approx(100.0, rel=1e-5)
    assert bound_in_the_way(one_delay(100.0, determined=0.0), 5.0, (2.0, 9.0)) is None


@pytest.mark.parametrize(
    ("bounds", "expected"), [((0, 7.9), 7.9), ((8.1, 12), 8.1), ((0, 12), None), ((7.9, 8.1), None)]
)
def test_bound_in_the_way_of_a_record(bounds, expected):
    # The true delay is 8 s; the estimate is sought where the bounds allow.
    data = filter_data(make_record(snr_db=15), 12.0)
    delay = min(max(8.0, bounds[0]), bounds[1])
    theta, _ = coefficient_minimum(data, Structure(2, 0), delay, theta_of(CASE_1))
    equations = DelayProblem(data, Structure(2, 0), bounds).equations(np.append(theta, delay))
    assert bound_in_the_way(equations, delay, bounds) == expected
