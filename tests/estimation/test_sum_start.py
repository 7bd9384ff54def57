"""Starts for sums of submodels, computed from the record only."""

import numpy as np
import pytest

from ctid_cli.estimation.common import Start
from ctid_cli.estimators.additive_srivc import AdditiveSrivc
from ctid_cli.models.additive import AdditiveModel, Submodel, Term
from ctid_cli.signals.record import Record
from tests.estimators.additive_records import (
    FOUR_MODES,
    MODE,
    TWO_MODES,
    beam_record,
    coloured_record,
    loop_record,
    open_record,
)

MODE_1 = Submodel([3.0], [0.25, 0.25, 1.0])
MODE_2 = Submodel([1.0], [0.025, 0.01, 1.0])


def start_of(record, system, **options):
    """Return the start for a sum with the structure and delay of a system."""
    return AdditiveSrivc(terms=system.terms, delay=system.delay, **options).prepare(record).laid_out.start


def assert_in_basin(record, system, **options):
    """Assert that the estimate from the automatic start is that from the true system."""
    prepared = AdditiveSrivc(terms=system.terms, delay=system.delay, **options).prepare(record)
    one, other = prepared.fit(), prepared.fit(Start(model=system))
    assert one.status.succeeded
    np.testing.assert_allclose(one.additive.theta, other.additive.theta, rtol=1e-3)


@pytest.mark.parametrize("seed", [0, 1])
def test_four_modes_in_coloured_noise(seed):
    assert_in_basin(coloured_record(seed), FOUR_MODES)


@pytest.mark.parametrize("seed", [0, 1])
def test_two_modes_in_closed_loop(seed):
    assert_in_basin(loop_record(TWO_MODES, 500, 0.1, seed), TWO_MODES, instruments="closed_loop")


@pytest.mark.slow
def test_beam_that_still_rings():
    record, system, _ = beam_record(1, periods=3)
    assert_in_basin(record, system, initial_state="estimated")


def test_noise_free_record_gives_the_system():
    record = open_record(FOUR_MODES, 1500, 0.0, 1)
    np.testing.assert_allclose(start_of(record, FOUR_MODES).theta, FOUR_MODES.theta, rtol=1e-3)


@pytest.mark.parametrize(
    "others",
    [
        [Submodel([2.0], [1.0, 1.0])],
        [Submodel([0.5], [1.0], 2)],
        [Submodel([1.0], [0.4, 1.0], 1)],
        [Submodel([0.7], [1.0])],
        [Submodel([2.0], [0.5, 1.5, 1.0])],
        [Submodel([0.1, 0.3, 1.0], [0.25, 0.25, 1.0])],
        [Submodel([1.0], np.polymul([0.4, 1.0], [0.25, 0.25, 1.0]))],
    ],
    ids=["real pole", "integrators", "integrator and pole", "gain", "two real poles", "feed-through", "third order"],
)
@pytest.mark.parametrize("mode_first", [True, False])
def test_every_structure(others, mode_first):
    system = AdditiveModel([MODE_2, *others] if mode_first else [*others, MODE_2])
    if len(set(system.terms)) == 1:
        system = system.sorted()
    start = start_of(open_record(system, 2000, 0.0, 2, interval=0.02), system)
    assert start.terms == system.terms
    assert start.is_marginally_stable
    np.testing.assert_allclose(start.theta, system.theta, rtol=0.05, atol=1e-3)


def test_irregular_clock():
    rng = np.random.default_rng(4)
    t = np.concatenate(([0.0], np.cumsum(rng.uniform(0.01, 0.09, 1499))))
    record = open_record(TWO_MODES, 1500, 0.1, 5, times=t)
    np.testing.assert_allclose(start_of(record, TWO_MODES).theta, TWO_MODES.theta, rtol=0.1)


def test_missing_samples_delay_and_linear_hold():
    system = AdditiveModel(TWO_MODES.submodels, 0.13)
    record = open_record(system, 1500, 0.1, 6, hold="foh")
    y = np.array(record.y)
    y[200:230] = np.nan
    y[::50] = np.nan
    start = start_of(Record(record.t, y, record.input), system)
    assert start.delay == 0.13
    np.testing.assert_allclose(start.theta, system.theta, rtol=0.1)


def test_terms_keep_their_order_and_equal_ones_rise_in_frequency():
    system = AdditiveModel([Submodel([2.0], [0.02, 1.0]), MODE_2, MODE_1])
    start = start_of(open_record(system, 2000, 0.05, 8, interval=0.02), system)
    assert start.terms == (Term(1, 0), MODE, MODE)
    expected = AdditiveModel([Submodel([2.0], [0.02, 1.0]), MODE_1, MODE_2])
    np.testing.assert_allclose(start.theta, expected.theta, rtol=0.1)
    backwards = AdditiveModel(system.submodels[::-1])
    turned = start_of(open_record(system, 2000, 0.05, 8, interval=0.02), backwards)
    np.testing.assert_allclose(turned.sorted().theta, start.sorted().theta, rtol=1e-6)


def test_gain_alone_is_plain_least_squares():
    system = AdditiveModel([Submodel([0.7], [1.0])])
    record = open_record(system, 50, 0.1, 11)
    u = record.input.values
    gain = AdditiveSrivc(terms=system.terms).fit(record).additive.theta
    np.testing.assert_allclose(gain, u @ record.y / (u @ u), rtol=1e-10)
