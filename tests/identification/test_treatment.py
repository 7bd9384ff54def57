"""Choice of the range of the delay and of the treatment of a record."""

from dataclasses import replace

import numpy as np
import pytest

from ctid_cli import HeldSignal, Record, TransferFunction, identify, simulate
from ctid_cli.estimation.common import Fixed
from ctid_cli.identification.choice import Given
from ctid_cli.identification.choose import choose, gains_of_treatments
from ctid_cli.inference.input_response import greatest_delay
from ctid_cli.inference.signal_features import begins_quietly

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

FIRST = TransferFunction([2.0], [1.0, 1.0], 0.3)


def binary(count=300, held=10, seed=0):
    return np.repeat(np.random.default_rng(seed).choice([-1.0, 1.0], count // held + 1), held)[:count]


def record_of(model=FIRST, u=None, *, drift=0.0, offset=0.0, noise=0.05, past=0, seed=0):
    u = binary() if u is None else u
    t = 0.1 * np.arange(u.size)
    y = simulate(model, HeldSignal(t, u), t) + noise * np.random.default_rng(seed).standard_normal(u.size)
    y += offset + drift * t / t[-1]
    return Record.from_arrays(t[past:] - t[past], u[past:], y[past:], "zoh")


def step(count=300, at=30):
    return (np.arange(count) >= at).astype(float)


def gain_of(found):
    return next(item for item in found.derived if item.name == "static_gain")


@pytest.mark.parametrize("integrators", [0, None])
def test_a_drift_under_a_typed_structure_is_estimated(integrators):
    record = record_of(drift=3.0)
    found = identify(record, Given(poles=1, zeros=0, integrators=integrators))
    assert found.options.offset == "drift"
    assert gain_of(found).low < 2.0 < gain_of(found).high
    assert choose(record_of(), Given(poles=1, zeros=0)).options.offset == "none"


def test_a_drift_after_a_quiet_beginning_is_estimated():
    record = record_of(u=step(at=100), drift=1.5, offset=5.0)
    options = choose(record, Given(poles=1, zeros=0)).options
    assert begins_quietly(record_of(u=step(at=100), offset=5.0))
    assert not begins_quietly(record)
    assert options.offset == "drift"


def test_a_drift_does_not_replace_a_slow_pole():
    slow = TransferFunction(
        np.polyadd(1.5 * np.array([0.1, 1.0]), [2.0 / 0.5, 2.0]) / 1.0, np.polymul([0.1, 1.0], [2.0, 1.0])
    )
    record = record_of(slow, u=step(), noise=0.01)
    assert choose(record, Given(poles=1, zeros=0)).options.offset != "drift"


def test_a_step_test_begins_at_rest_and_its_gain_has_the_right_sign():
    deviation = record_of(TransferFunction([-3.0], [1.0, 1.5, 1.0]), u=step(), offset=10.0)
    record = Record.from_arrays(deviation.t, 20.0 + step(), deviation.y, "zoh")
    found = identify(record, Given(poles=2, zeros=0, delay_bounds=(0.0, 0.0)))
    options = found.options
    assert (options.initial_state, options.input_before, options.offset) == ("rest", "first", "estimate")
    assert gain_of(found).estimate == pytest.approx(-3.0, rel=0.05)


def test_an_estimated_state_has_an_offset():
    tried = choose(record_of(past=37), Given(poles=1, zeros=0)).ranking.candidates
    assert {each.options.offset for each in tried if each.options.initial_state == "estimate"} >= {"estimate"}
    assert all(each.options.offset != "none" for each in tried if each.options.initial_state == "estimate")


def test_a_long_delay_after_a_step_is_within_the_range():
    record = record_of(TransferFunction([2.0], [1.0, 1.0], 12.0), u=step(200, 20))
    assert 12.0 < greatest_delay([record]) < 0.9 * 18.0
    found = identify(record, Given(poles=1, zeros=0))
    assert found.fit.model.delay == pytest.approx(12.0, abs=0.1)


def test_known_parameters_act_while_the_treatment_is_chosen():
    given = Given(poles=1, zeros=0, fixed=(Fixed("a1", 1.0),))
    choice = choose(record_of(offset=3.0), given)
    assert all(each.options.fixed == given.fixed for each in choice.ranking.candidates)
    assert all(each.fit.parameters["a1"] == 1.0 for each in choice.ranking.candidates)
    assert choice.options.offset == "estimate"


@pytest.mark.parametrize(("behind", "expected"), [(9.0, {"static_gain": (2.0, -2.0)}), (11.0, {})])
def test_a_gain_whose_sign_differs_between_treatments_is_not_determined(behind, expected):
    ranking = choose(record_of(), Given(poles=1, zeros=0)).ranking
    best = ranking.best
    model = TransferFunction([2.0], [1.0, 1.0])
    other = replace(
        best,
        options=replace(best.options, offset="estimate"),
        fit=replace(best.fit, model=TransferFunction([-2.0], [1.0, 1.0])),
        criterion=best.criterion + behind,
    )
    pair = replace(ranking, candidates=(replace(best, fit=replace(best.fit, model=model)), other))
    assert gains_of_treatments(pair) == expected


def test_a_level_that_the_output_contradicts_is_not_taken():
    # Whitened by the noise model of slow residuals, a wrong level before the record has nearly the same innovations.
    u = binary()
    early = record_of(u=u, noise=0.0)
    record = Record.from_arrays(early.t[:-1], u[:-1], early.y[1:], "zoh")
    options = choose(
        record, Given(poles=2, zeros=0, delay_bounds=(0.0, 0.0), initial_state="rest", offset="none")
    ).options
    costs = [replace(options, input_before=level).fit(record).cost for level in ("first", None)]
    chosen = costs[0] if options.input_before == "first" else costs[1]
    assert chosen < 4.0 * min(costs)


def test_a_record_that_moves_before_its_step_has_a_state():
    u = np.where(np.arange(400) < 140, 0.0, 1.0)
    u[:60] = -1.0
    record = record_of(TransferFunction([1.0], [1.0, 0.8]), u=u, noise=0.01, past=70)
    found = identify(record)
    assert found.options.initial_state == "estimate"
    assert found.options.integrators == 0
    assert gain_of(found).low < 1.25 < gain_of(found).high
