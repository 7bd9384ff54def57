"""What records determine: equivalents of repeating inputs, other minima, and intervals at bounds."""

import numpy as np
import pytest

from ctid_cli import (
    DelayProfile,
    FrequencyData,
    FrequencyDomain,
    HeldSignal,
    Record,
    TransferFunction,
    identify,
    simulate,
)
from ctid_cli.estimation.common import Bound
from ctid_cli.identification.choice import Given

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

HALF = 2.0


def cut(u_of, model, n=240, noise=0.02, seed=0, interval=0.1, lead=400):
    """Return the last samples of a long record with an input as a function of the sample."""
    k = np.arange(n + lead)
    t, u = interval * k, u_of(k)
    y = simulate(model, HeldSignal(t, u), t) + noise * np.random.default_rng(seed).standard_normal(k.size)
    return Record.from_arrays(t[:n], u[lead:], y[lead:], "zoh")


def square(k):
    return np.where(k // 20 % 2 == 0, 1.0, -1.0)


def first_order(gain, constant, delay=0.0):
    return TransferFunction([gain / constant], [1.0, 1.0 / constant], delay)


def by_name(found):
    return {item.name: item for item in (*found.estimates, *found.derived)}


def holds(item, value):
    return any(low - 1e-9 <= value <= high + 1e-9 for low, high in item.intervals or [(item.low, item.high)])


@pytest.mark.parametrize("options", [Given(poles=1, zeros=0), DelayProfile(1, 0, (0.0, 5.0), "estimate", "estimate")])
@pytest.mark.parametrize("intervals", [0.0, 0.4, 0.9, 1.3, 1.9])
def test_half_a_period_leaves_the_sign_open_and_the_least_delay_is_shown(intervals, options):
    found = identify(cut(square, first_order(2.0, 0.5, intervals * HALF)), options)
    least, sign = intervals % 1 * HALF, 1 if intervals < 1 else -1
    assert found.fit.model.delay == pytest.approx(least, abs=0.02)
    assert holds(by_name(found)["static_gain"], 2.0 * sign)
    (other,) = found.fit.equivalents
    assert (other.delay, other.sign) == (pytest.approx(found.fit.model.delay + HALF), -1)
    assert found.marks()[0] == (
        f"Or gain {-found.fit.model.dc_gain:.5g} with delay {other.delay:.5g} s: the input repeats."
    )


def test_a_given_input_before_the_record_determines_the_delay():
    t = 0.1 * np.arange(240)
    model = first_order(2.0, 0.5, 2.4)
    y = simulate(model, HeldSignal(t, square(np.arange(240))), t) + 0.02 * np.random.default_rng(1).standard_normal(240)
    record = Record.from_arrays(t, square(np.arange(240)), y, "zoh")
    fit = DelayProfile(1, 0, (0.0, 5.0), input_before=0.0).fit(record)
    assert fit.equivalents == ()
    assert (fit.model.delay, fit.model.dc_gain) == pytest.approx((2.4, 2.0), abs=0.02)


def test_a_whole_period_of_a_periodic_state_is_searched_whole():
    u = np.resize(np.random.default_rng(5).choice([-1.0, 1.0], 60), 640)
    found = identify(
        cut(lambda k: u[k], first_order(2.0, 0.5, 5.3), n=60), Given(poles=1, zeros=0, initial_state="periodic")
    )
    assert found.fit.model.delay == pytest.approx(5.3, abs=0.03)
    assert [each.sign for each in found.fit.equivalents] == [1]


def test_intervals_beside_a_delay_at_its_bound_contain_those_of_other_delays():
    record = cut(lambda k: np.sin(2 * np.pi * k / 120), first_order(2.0, 4.0, 1.5), noise=0.1, n=360)
    found = identify(record, DelayProfile(1, 0, (0.0, 5.0), "estimate", "estimate"))
    items = by_name(found)
    for name, value in (("static_gain", 2.0), ("time_constant_1", 4.0), ("delay", 1.5)):
        assert items[name].is_undetermined or holds(items[name], value)


def test_a_pole_at_the_slow_bound_leaves_gain_and_time_constant_undetermined():
    rng, t = np.random.default_rng(3), np.arange(200.0)
    u = np.repeat(rng.choice([-1.0, 1.0], 40), 5)
    y = simulate(first_order(300.0, 5000.0), HeldSignal(t, u), t) + 0.05 * rng.standard_normal(200)
    found = identify(Record.from_arrays(t, u, y, "zoh"), DelayProfile(1, 0, (0.0, 0.0), "estimate", "estimate"))
    items = by_name(found)
    assert found.fit.held_poles
    assert items["static_gain"].is_undetermined
    assert items["a1"].is_undetermined or items["a1"].status == "at bound"
    # The product of both, the slope of the response, is determined.
    assert items["b0"].status == "free"
    assert holds(items["b0"], 0.06)
    assert any("bound of the admissible models" in mark for mark in found.marks())


def test_intervals_at_a_given_bound_contain_models_inside_it():
    rng, t = np.random.default_rng(4), 0.1 * np.arange(200)
    u = np.repeat(rng.choice([-1.0, 1.0], 20), 10)
    y = simulate(first_order(2.0, 0.5), HeldSignal(t, u), t) + 0.3 * rng.standard_normal(200)
    record = Record.from_arrays(t, u, y, "zoh")
    free = DelayProfile(1, 0, (0.0, 0.0)).fit(record)
    low = free.parameters["a1"] + 0.05 * free.standard_errors["a1"]
    fit = DelayProfile(1, 0, (0.0, 0.0), bounds=(Bound("a1", low, 4 * low),)).fit(record)
    conditional = np.sqrt(np.diag(fit.covariance))[fit.parameter_names.index("b0")]
    assert fit.bounds_met
    assert fit.standard_errors["b0"] > 1.2 * conditional
    assert fit.intervals["b0"][0][1] >= free.parameters["b0"] + 1.5 * free.standard_errors["b0"]


@pytest.mark.parametrize(
    ("multiples", "shift", "sign"), [(np.arange(1, 25), 2 * np.pi, 1), (np.arange(1, 48, 2), np.pi, -1)]
)
def test_delays_that_the_lines_of_a_response_cannot_tell_apart(multiples, shift, sign):
    w = 1.0 * multiples
    rng = np.random.default_rng(0)
    noise = 0.01 * (rng.standard_normal(w.size) + 1j * rng.standard_normal(w.size))
    fit = FrequencyDomain(1, 0, (0.0, 2.2 * shift)).fit(
        FrequencyData(w, 2.0 / (0.5j * w + 1) * np.exp(-0.3j * w) + noise)
    )
    (other,) = fit.equivalents
    assert (fit.model.delay, fit.model.dc_gain) == pytest.approx((0.3, 2.0), abs=0.05)
    assert (other.delay - fit.model.delay, other.sign) == pytest.approx((shift, sign))
