"""Search over the delay on costs with known minima, and its step against differences of the profile cost."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.estimation.delay_search import (
    LEAST_CURVATURE,
    Limits,
    Minimum,
    SampledCost,
    bound_in_the_way,
    delay_step,
    descend,
)
from ctid_cli.estimation.iteration import Equations, Steps
from ctid_cli.estimation.sampled_problem import at_known_delay
from ctid_cli.filtering.bank import standard_rows
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.fit import Status
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from tests.estimators.records import CASE_1, CASE_2, make_record, theta_of

START = np.array([[3.0, 4.0]])
BOUNDS = (0.0, 10.0)
#: A hundred-thousandth of the range.
SMALLEST = 1e-4


class Artificial:
    """A cost given by a formula and its step; it records its calls."""

    def __init__(self, cost, step):
        self.cost, self.formula = cost, step
        self.asked, self.starts = [], []

    def minimise(self, delay, starts, own):
        self.asked.append(delay)
        self.starts.append((starts.tolist(), own))
        value = self.cost(delay)
        return Minimum(np.array([value, delay]), value, self.formula(delay))


def quadratic(at, floor=1.0):
    """Return the cost (d - at)^2 + floor with Newton's step, which is exact."""
    return Artificial(lambda d: (d - at) ** 2 + floor, lambda d: at - d)


def search(cost, delay, starts=START, *, max_iterations=50, tolerance=1e-9, largest_step=math.inf, reflect=False):
    limits = Limits(*BOUNDS, max_iterations, tolerance, SMALLEST, largest_step, reflect)
    return descend(cost, delay, starts, limits)


#: A double step ends at the same cost on the other side of the minimum, which is no decrease.
OVERSHOOTING = Artificial(lambda d: (d - 3.0) ** 2 + 1.0, lambda d: 2.0 * (3.0 - d))
CLIFF = Artificial(lambda d: math.inf if d > 4.0 else (d - 3.0) ** 2 + 1.0, lambda d: 8.0 if d < 1.0 else 3.0 - d)
#: The slope at 9 s and at 0 s points away from the valley.
UP_AT_9 = Artificial(lambda d: (d - 5.0) ** 2, lambda d: 4.0 if d == 9.0 else 5.0 - d)
DOWN_AT_0 = Artificial(lambda d: (d - 5.0) ** 2, lambda d: -4.0 if d == 0.0 else 5.0 - d)
FAR_AT_1 = Artificial(lambda d: (d - 4.0) ** 2, lambda d: -15.0 if d == 1.0 else 4.0 - d)
BLIND_FROM_2 = Artificial(lambda d: (d - 9.0) ** 2, lambda d: 1.0 if d < 2 else math.nan)
NEAR = 3.0 + 0.9 * SMALLEST
MIRROR, FEW = {"reflect": True}, {"max_iterations": 3, "largest_step": 1.0}
#: Cost, start, options; the first evaluated delays, and place and status of the end.
SEARCHES = {
    "exact on a parabola": (quadratic(3.0), 7.0, {}, [7, 3], (3, Status.CONVERGED, 1)),
    "a cost of zero is the end": (quadratic(3.0, floor=0.0), 7.0, {}, [7, 3], (3, Status.CONVERGED, 1)),
    "no lower cost: halved": (OVERSHOOTING, 5.0, {}, [5, 1, 3], (3, Status.CONVERGED, 1)),
    "nothing can be computed: halved": (CLIFF, 0.5, {}, [0.5, 8.5, 4.5, 2.5, 3], (3, Status.CONVERGED, 2)),
    # At the bound the step becomes zero without a further evaluation.
    "beyond the upper bound: halved": (quadratic(17.0), 9.0, {}, [9, 10], (10, Status.CONVERGED, 1)),
    "beyond the lower bound: halved": (quadratic(-7.0), 1.0, {}, [1, 0], (0, Status.CONVERGED, 1)),
    "beyond the upper bound: mirrored": (UP_AT_9, 9.0, MIRROR, [9, 7, 5], (5, Status.CONVERGED, 2)),
    "beyond the lower bound: mirrored": (DOWN_AT_0, 0.0, MIRROR, [0, 4, 5], (5, Status.CONVERGED, 2)),
    # Reflections at 17 and 13 s are not better, the one at 11 s is the start.
    "mirrored in vain: halved": (quadratic(17.0), 9.0, MIRROR, [9, 3, 7, 9, 10], (10, Status.CONVERGED, 1)),
    "mirrored beyond the other bound: halved": (FAR_AT_1, 1.0, MIRROR, [1, 6.5, 4], (4, Status.CONVERGED, 2)),
    "within the smallest step": (quadratic(3.0), NEAR, {}, [NEAR], (NEAR, Status.CONVERGED, 0)),
    "a delay that is not determined": (BLIND_FROM_2, 0.0, {}, [0, 1, 2], (2, Status.SINGULAR, 2)),
    "too few iterations": (quadratic(9.0), 0.0, FEW, [0, 1, 2, 3], (3, Status.MAX_ITERATIONS, 3)),
}


@pytest.mark.parametrize(("cost", "start", "options", "asked", "outcome"), SEARCHES.values(), ids=SEARCHES.keys())
def test_search_asks_for_the_delays_of_its_steps(cost, start, options, asked, outcome):
    found = search(cost, start, **options)
    assert cost.asked[: len(asked)] == pytest.approx(asked, abs=1e-12)
    assert (found.minimum.delay, found.end, found.iterations) == outcome
    assert found.path[:, -1].tolist() == [cost.cost(delay) for delay in found.path[:, 1]]


@given(st.floats(0, 10), st.floats(-30, 40), st.floats(0.1, 3), st.floats(0.05, 10), st.booleans())
def test_never_leaves_the_bounds_nor_rises(start, at, gain, largest_step, reflect):
    # For any place of the minimum and any step gain.
    cost = Artificial(lambda d: (d - at) ** 2 + 1.0, lambda d: gain * (at - d))
    found = search(cost, start, max_iterations=500, tolerance=1e-12, largest_step=largest_step, reflect=reflect)
    assert all(0.0 <= delay <= 10.0 for delay in cost.asked)
    assert (np.diff(found.path[:, -1]) < 0.0).all()
    assert found.path[[0, -1], 1].tolist() == [start, found.minimum.delay]
    assert len(found.path) == found.iterations + 1
    nearest = min(max(at, 0.0), 10.0)
    assert abs(found.minimum.delay - nearest) <= max(abs(start - nearest), SMALLEST)


def test_nothing_at_the_start_is_no_search():
    cost = Artificial(lambda d: math.inf, lambda d: 1.0)
    found = search(cost, 5.0)
    assert (found.end, found.path.shape, cost.asked) == (None, (0, 3), [5.0])


@pytest.mark.parametrize(("tolerance", "costs"), [(0.7, 2), (0.5, 3), (0.05, 5)])
def test_search_ends_when_the_cost_falls_by_less_than_the_tolerance(tolerance, costs):
    # Half the distance at each step: the cost is 20, 8, 5, 4.25, 4.0625, 4.015625 and falls by 0.6, 0.375, 0.15, ...
    cost = Artificial(lambda d: (d - 2.0) ** 2 + 4.0, lambda d: 0.5 * (2.0 - d))
    found = search(cost, 6.0, tolerance=tolerance)
    assert found.path[:, -1].tolist() == [20.0, 8.0, 5.0, 4.25, 4.0625, 4.015625][:costs]
    assert (found.end, found.iterations) == (Status.CONVERGED, costs - 1)


# The delay step of the separable problem -------------------------------------------------------------


@pytest.mark.parametrize(("model", "delay", "snr_db"), [(CASE_1, 8.0129, 5), (CASE_2, 7.9321, 15)])
def test_delay_step_follows_the_slope_of_the_profile_cost(model, delay, snr_db):
    # step = -P'/(2 H): P' by central differences of the cost minimised over the coefficients, H from the rows by an
    # orthogonal projection. The true delay lies between two changes of the input, where the cost is smooth.
    truth = TransferFunction(model.numerator, model.denominator, 8.0123)
    data = filter_data(make_record(truth, snr_db=snr_db, n=3000), 9.0)
    n, m = model.order, model.numerator.size - 1
    problem = at_known_delay(data, Structure(n, m))

    cost = SampledCost(problem, Steps(200, 1e-13, "guarded"), ())

    def minimum(delay):
        return cost.minimise(delay, np.append(theta_of(model), delay)[None], False)

    h = 1e-4
    plus, here, minus = (minimum(delay + side) for side in (h, 0.0, -h))
    a, b, _ = problem.split(here.theta)
    rows = standard_rows(data, a, b, delay, "chain")
    psi = np.column_stack((rows[:, n + 1 : 2 * n + 1], rows[:, : m + 1]))
    basis, _ = np.linalg.qr(psi / np.linalg.norm(psi, axis=0))
    slope = rows[:, -1]
    curvature = np.sum((slope - basis @ (basis.T @ slope)) ** 2)
    expected = -(plus.squared_error - minus.squared_error) / (4 * h * curvature)
    assert here.step == pytest.approx(expected, rel=1e-4, abs=1e-7)


def test_cheapest_of_several_starts_is_kept():
    # In any order, the result is that of the best start, bit for bit; starts that are not finite are ignored.
    problem = at_known_delay(filter_data(make_record(CASE_2, snr_db=15, n=2500), 9.0), Structure(4, 1))
    cost = SampledCost(problem, Steps(10, 1e-2, "guarded", 3), (25.0,))
    slow = np.concatenate((np.poly(np.full(4, -0.1))[1:], [1.0, 1.0]))
    near = theta_of(CASE_2)
    starts = np.array([slow, near * 1.02, slow * [-1, 1, -1, 1, 1, 1], near * [1, 1, 1.4, 1, 1, 1], near * np.nan])
    starts = np.column_stack((starts, np.full(5, 8.0)))
    alone = [cost.minimise(8.0, start[None], False) for start in starts]
    costs = [minimum.squared_error for minimum in alone]
    assert costs[4] == np.inf
    assert max(costs[:4]) > 2 * min(costs)
    for order in ([0, 1, 2, 3], [3, 4, 2, 1, 0], [1, 0], [4, 2, 3]):
        found = cost.minimise(8.0, starts[order], False)
        best = alone[min(order, key=costs.__getitem__)]
        assert (found.theta.tolist(), *found[1:]) == (best.theta.tolist(), *best[1:])
    own = cost.minimise(8.0, starts[:0], True)
    assert cost.minimise(8.0, starts[:1], True).squared_error == min(own.squared_error, costs[0])


def test_delay_that_the_data_do_not_determine_has_no_step():
    # The steady response to one tone has an amplitude and a phase: a pole and a gain match them at any delay.
    t = 0.05 * np.arange(3000)
    held = HeldSignal(t, np.sin(1.3 * t))
    y = simulate(TransferFunction([2.0], [1.0, 2.0], 1.0), held, t)
    problem = at_known_delay(filter_data(Record(t, y, held), 20.0), Structure(1, 0))
    found = SampledCost(problem, Steps(100, 1e-9, "guarded"), ()).minimise(1.2, np.array([[2.0, 2.0, 1.2]]), False)
    assert np.isfinite(found.squared_error)
    assert np.isnan(found.step)


def moments_of(psi, delay_sensitivity, error):
    """Return second moments from signals: coefficient sensitivities psi, then that of the delay."""
    full = np.column_stack((psi, delay_sensitivity))
    hessian = full.T @ full
    return Equations(hessian, full.T @ error, hessian, float(error @ error), 1.0)


@given(st.integers(0, 2**31), st.integers(1, 6), st.floats(-8, 8), st.floats(-8, 8))
def test_delay_step_is_least_squares_on_what_the_coefficients_leave(seed, p, coefficient_decades, delay_decades):
    # For an error orthogonal to the coefficient sensitivities, in any units.
    rng = np.random.default_rng(seed)
    psi, slope, error = rng.standard_normal((40, p)), rng.standard_normal(40), rng.standard_normal(40)
    error -= psi @ np.linalg.lstsq(psi, error, rcond=None)[0]
    expected = np.linalg.lstsq(np.column_stack((psi, slope)), error, rcond=None)[0][-1]
    units = 10.0 ** (coefficient_decades * np.cos(np.arange(p)))
    step = delay_step(moments_of(psi * units, slope * 10.0**delay_decades, error), LEAST_CURVATURE)
    assert step * 10.0**delay_decades == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_delay_that_the_coefficients_can_imitate_has_no_step():
    rng = np.random.default_rng(0)
    psi, error = rng.standard_normal((40, 3)), rng.standard_normal(40)
    imitated = psi @ np.array([1.0, -2.0, 0.5])
    for columns, slope in ((psi, imitated), (psi, np.zeros(40)), (psi * 0, imitated)):
        assert np.isnan(delay_step(moments_of(columns, slope, error), LEAST_CURVATURE))
    # A small independent part: 1e-5 of the signal, 1e-10 of the curvature.
    own = rng.standard_normal(40)
    own -= psi @ np.linalg.lstsq(psi, own, rcond=None)[0]
    nearly = imitated + 1e-5 * own * np.linalg.norm(imitated) / np.linalg.norm(own)
    steps = [delay_step(moments_of(psi, nearly, error), least) for least in (LEAST_CURVATURE, 1e-11, 1e-9)]
    assert np.isnan(steps).tolist() == [False, False, True]


def one_delay(step, determined=1.0):
    """Return equations of one coefficient and the delay, with a given step and curvature fraction of the delay."""
    overlap = np.sqrt(1.0 - determined)
    hessian = np.array([[1.0, overlap], [overlap, 1.0]])
    return Equations(hessian, np.array([0.0, step * determined]), hessian, 1.0, 1.0)


@pytest.mark.parametrize(
    ("delay", "step", "bound"),
    [
        (5.0, 1.0, None),
        (5.0, -1.0, None),
        (5.0, 4.0, None),
        (5.0, -3.0, None),
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


def test_step_of_a_delay_that_is_hardly_determined_means_nothing():
    assert bound_in_the_way(one_delay(100.0, determined=1e-6), 5.0, (2.0, 9.0)) == 9.0
    assert bound_in_the_way(one_delay(100.0, determined=1e-9), 5.0, (2.0, 9.0)) is None
    assert delay_step(one_delay(100.0, determined=1e-9), LEAST_CURVATURE) == pytest.approx(100.0, rel=1e-5)
    assert bound_in_the_way(one_delay(100.0, determined=0.0), 5.0, (2.0, 9.0)) is None
