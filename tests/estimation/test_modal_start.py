"""Starts for sums of submodels, from the record alone."""

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.estimation import modal_start
from ctid_cli.estimation.common import Start
from ctid_cli.estimation.modal_start import automatic_start
from ctid_cli.estimators.additive_srivc import AdditiveSrivc
from ctid_cli.models.additive import AdditiveModel, Submodel, Term
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from tests.estimators.additive_records import (
    FOUR_MODES,
    MODE,
    TWO_MODES,
    assert_parameters,
    beam_record,
    coloured_record,
    loop_record,
    open_record,
)

MODE_1 = Submodel([3.0], [0.25, 0.25, 1.0])
MODE_2 = Submodel([1.0], [0.025, 0.01, 1.0])


def assert_in_basin(record, system, **options):
    """The estimate from the automatic start is that from the truth."""
    start = automatic_start(record, system.terms, system.delay)
    frequencies, expected = (
        [submodel.natural_frequency for submodel in model.submodels] for model in (start.model, system)
    )
    np.testing.assert_allclose(frequencies, expected, rtol=0.2)
    prepared = AdditiveSrivc(terms=system.terms, delay=system.delay, **options).prepare(record)
    one, other = prepared.fit(Start(model=start.model)), prepared.fit(Start(model=system))
    assert one.status.succeeded
    np.testing.assert_allclose(one.additive.theta, other.additive.theta, rtol=1e-3)
    return start


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_four_modes_in_coloured_noise(seed):
    assert_in_basin(coloured_record(seed), FOUR_MODES)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_two_modes_in_closed_loop(seed):
    assert_in_basin(loop_record(TWO_MODES, 500, 0.1, seed), TWO_MODES, instruments="closed_loop")


def test_beam_from_rest():
    record, system, _ = beam_record(0, noise=1e-3)
    start = assert_in_basin(record, system)
    assert "free response" not in start.method


def test_beam_that_still_rings():
    record, system, _ = beam_record(1, periods=3)
    start = automatic_start(record, system.terms, system.delay)
    assert start.method.endswith("a free response was fitted along with the numerators.")
    # Damping shows little in two seconds of modes that ring for half a minute.
    np.testing.assert_allclose(start.model.theta[1::3], system.theta[1::3], rtol=1e-3)
    np.testing.assert_allclose(start.model.theta[2::3], system.theta[2::3], rtol=0.05)


def test_noise_free_record_gives_the_system():
    record = open_record(FOUR_MODES, 1500, 0.0, 1)
    np.testing.assert_allclose(automatic_start(record, FOUR_MODES.terms).model.theta, FOUR_MODES.theta, rtol=1e-3)


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
    start = automatic_start(open_record(system, 2000, 0.0, 2, interval=0.02), system.terms)
    assert start.model.terms == system.terms
    assert start.model.is_marginally_stable
    np.testing.assert_allclose(start.model.theta, system.theta, rtol=0.05, atol=1e-3)


@pytest.mark.parametrize("way", ["spectral_lines", "_transfer_function_poles"])
def test_either_way_would_do(way, monkeypatch):
    record = open_record(TWO_MODES, 1500, 0.1, 3)
    both = automatic_start(record, TWO_MODES.terms)
    place = modal_start.pole_relocation if way == "spectral_lines" else modal_start
    monkeypatch.setattr(place, way, lambda *_, **__: None)
    alone = automatic_start(record, TWO_MODES.terms)
    np.testing.assert_allclose(alone.model.theta, both.model.theta, rtol=0.05)
    assert ("transfer function" in alone.method) == (way == "spectral_lines")


def test_irregular_clock():
    rng = np.random.default_rng(4)
    t = np.concatenate(([0.0], np.cumsum(rng.uniform(0.01, 0.09, 1499))))
    record = open_record(TWO_MODES, 1500, 0.1, 5, times=t)
    np.testing.assert_allclose(automatic_start(record, TWO_MODES.terms).model.theta, TWO_MODES.theta, rtol=0.1)


def test_missing_samples_delay_and_linear_hold():
    system = AdditiveModel(TWO_MODES.submodels, 0.13)
    record = open_record(system, 1500, 0.1, 6, hold="foh")
    y = np.array(record.y)
    y[200:230] = np.nan
    y[::50] = np.nan
    start = automatic_start(Record(record.t, y, record.input), system.terms, 0.13)
    assert start.model.delay == 0.13
    np.testing.assert_allclose(start.model.theta, system.theta, rtol=0.1)


def test_record_that_does_not_start_at_rest():
    whole = open_record(TWO_MODES, 2000, 0.1, 7)
    late = Record(whole.t[500:], whole.y[500:], HeldSignal(whole.t[500:], whole.input.values[500:]))
    start = automatic_start(late, TWO_MODES.terms)
    assert "does not start at rest" in start.method
    assert "does not start at rest" not in automatic_start(whole, TWO_MODES.terms).method
    np.testing.assert_allclose(start.model.theta, TWO_MODES.theta, rtol=0.1)


def test_terms_keep_their_order_and_equal_ones_rise_in_frequency():
    system = AdditiveModel([Submodel([2.0], [0.02, 1.0]), MODE_2, MODE_1])
    start = automatic_start(open_record(system, 2000, 0.05, 8, interval=0.02), system.terms)
    assert start.model.terms == (Term(1, 0), MODE, MODE)
    expected = AdditiveModel([Submodel([2.0], [0.02, 1.0]), MODE_1, MODE_2])
    np.testing.assert_allclose(start.model.theta, expected.theta, rtol=0.1)
    turned = automatic_start(open_record(system, 2000, 0.05, 8, interval=0.02), system.terms[::-1])
    np.testing.assert_allclose(turned.model.sorted().theta, start.model.sorted().theta, rtol=1e-6)


def test_units_do_not_matter():
    record = open_record(TWO_MODES, 800, 0.1, 9)
    base = automatic_start(record, TWO_MODES.terms).model.theta.reshape(2, 3)
    t, u = 1e-3 * record.t, HeldSignal(1e-3 * record.t, 50.0 * record.input.values)
    scaled = automatic_start(Record(t, 1e-4 * record.y, u), TWO_MODES.terms).model.theta.reshape(2, 3)
    np.testing.assert_allclose(scaled, base * [1e-3, 1e-6, 1e-4 / 50.0], rtol=1e-5)


def test_estimator_starts_by_itself():
    record = open_record(TWO_MODES, 1500, 0.1, 10)
    fit = AdditiveSrivc(terms=TWO_MODES.terms).fit(record)
    np.testing.assert_array_equal(fit.start.theta, automatic_start(record, TWO_MODES.terms).model.theta)
    assert_parameters(fit, TWO_MODES, 0.1)


def test_gain_alone_is_plain_least_squares():
    record = open_record(AdditiveModel([Submodel([0.7], [1.0])]), 50, 0.1, 11)
    u = record.input.values
    gain = automatic_start(record, [Term(0, 0)]).model.theta
    np.testing.assert_allclose(gain, u @ record.y / (u @ u), rtol=1e-10)


def test_errors_are_sentences(monkeypatch):
    record = open_record(TWO_MODES, 200, 0.1, 12)
    seven = Record(record.t[:7], record.y[:7], record.input, name="bench")
    with pytest.raises(DataError, match="bench: no start was found: 7 samples"):
        automatic_start(seven, TWO_MODES.terms)
    monkeypatch.setattr(modal_start.pole_relocation, "spectral_lines", lambda *_, **__: None)
    monkeypatch.setattr(modal_start, "_transfer_function_poles", lambda *_, **__: None)
    with pytest.raises(DataError, match="no modes of the structure asked for"):
        automatic_start(record, TWO_MODES.terms)


@pytest.mark.parametrize("initial_state", ["rest", "estimated"])
def test_when_the_clock_began_does_not_matter(initial_state):
    record = coloured_record(1)
    later = Record(record.t + 1e4, record.y, HeldSignal(record.input.t + 1e4, record.input.values))
    options = AdditiveSrivc(terms=FOUR_MODES.terms, initial_state=initial_state)
    fits = []
    for one in (record, later):
        start = automatic_start(one, FOUR_MODES.terms, 0.0)
        fits.append(options.prepare(one).fit(Start(model=start.model)).additive.theta)
    np.testing.assert_allclose(fits[1], fits[0], rtol=1e-7)
