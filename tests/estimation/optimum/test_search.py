"""Local searches against a general optimiser in the same box, and their reported statuses."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from ctid_cli.estimation.optimum.box import LIMITS, box_of, point_of
from ctid_cli.estimation.optimum.chain import polynomial
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.estimation.optimum.search import Descent, Ending
from ctid_cli.estimation.optimum.triangle import Delay
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.record import Record
from tests.estimation.optimum.dense import residual
from tests.estimation.optimum.systems import MODEL, random_model, random_poles, record_of


def descent_of(record, zeros, delays=(0.0, 0.0), *, free_response=False, offset=False):
    data = filter_data(record)
    problem = Problem((data,), zeros, free_response, (0,) * offset, (0.0,))
    return Descent(problem, box_of(problem, delays))


def settled(descent, poles, delay=0.0):
    return descent.settle(descent.descend(point_of(np.asarray(poles, dtype=complex), delay, descent.box)))


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_a_general_optimiser_in_the_same_box_finds_the_same_minimum(seed, regular):
    rng = np.random.default_rng(seed)
    record = record_of(random_model(rng, 3, 1), rng, noise=0.2, regular=regular)
    descent = descent_of(record, 1, offset=True)
    box, start = descent.box, [np.log(0.3), np.log(0.9), np.log(0.5)]
    found = settled(descent, [-0.3, 0.9 * complex(-0.5, np.sqrt(0.75)), 0.9 * complex(-0.5, -np.sqrt(0.75))])
    other = least_squares(
        lambda x: residual(record, polynomial(np.exp(x[:2]), np.array([-1.0, np.exp(x[2])])), 1, offset=True),
        start,
        bounds=(np.log([box.slowest] * 2 + [box.least_damping]), np.log([box.fastest] * 2 + [100.0])),
        xtol=1e-12,
        ftol=1e-14,
        gtol=1e-12,
    )
    assert found.ending.optimal
    assert found.squared_error == pytest.approx(2 * other.cost, rel=1e-8)


@pytest.mark.parametrize("seed", [2, 6, 7])
def test_a_minimum_in_a_kink_is_pinned_to_its_sample(seed):
    # Relative degree 1, input and output on one clock: the slope of the cost jumps at a sample, here upwards.
    rng = np.random.default_rng(seed)
    record = record_of(TransferFunction([1.0], [1.0, 0.8], 2.0), rng, noise=1.0, samples=60)
    descent = descent_of(record, 0, (0.0, 4.0))
    found = settled(descent, [-0.6], 1.7)
    assert found.ending is Ending.CONVERGED
    assert found.pinned
    assert found.point.delay.seconds == 2.0
    before, after = (descent.local(found.point.with_delays([Delay(2.0, cell)])).gradient[-1] for cell in (3, 4))
    assert before < 0 < after


def test_a_pole_beyond_the_set_stops_at_its_border():
    rng = np.random.default_rng(8)
    t = 0.5 * np.arange(300)
    slow = Record.from_arrays(t, np.ones(300), 1e-4 * t**2 + 1e-3 * rng.standard_normal(300))
    found = settled(descent_of(slow, 0), [-0.1])
    assert found.ending is Ending.AT_BOUND
    np.testing.assert_allclose(found.point.poles, [-LIMITS["slowest"].rest / t[-1]])


def test_what_a_record_says_nothing_about_is_a_ridge():
    rng = np.random.default_rng(9)
    t = 0.5 * np.arange(100)
    found = settled(descent_of(Record.from_arrays(t, 0.0 * t, rng.standard_normal(100)), 0), [-0.5, -5.0])
    assert found.ending is Ending.RIDGE
    assert found.ending.optimal


def test_wherever_it_starts_a_search_does_not_rise():
    rng = np.random.default_rng(10)
    record = record_of(MODEL, rng, noise=0.5)
    descent = descent_of(record, 1, (0.0, 3.0))
    for _ in range(10):
        start = point_of(random_poles(rng, 3, 0.01, 15.0), float(rng.uniform(0, 3)), descent.box)
        ends = descent.descend(start)
        assert ends.squared_error <= descent.value(start).squared_error
        assert ends.squared_error == pytest.approx(descent.value(ends.point).squared_error, rel=1e-9)
