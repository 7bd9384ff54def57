"""Test for a response of outputs to inputs: rates of false and of missed detections."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference import response_test as module
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

FIRST_ORDER = TransferFunction([0.1], [1.0, 0.1], 5.0)
#: Denominators of autoregressive noise: white, of first order, resonant, and a near random walk.
COLOURS = ([1.0], [1.0, -0.5], [1.0, -0.8], [1.0, -0.95], np.real(np.poly(0.9 * np.exp([0.4j, -0.4j]))), [1.0, -0.998])


def noise(rng, n, colour=(1.0,)):
    e = lfilter([1.0], colour, rng.standard_normal(n + 2000))[2000:]
    return e / e.std()


def inputs(rng, n):
    """Yield a fast and a slow random binary input, steps, a sine and filtered noise."""
    k = np.arange(n)
    yield np.repeat(rng.choice([-1.0, 1.0], n // 2 + 1), 2)[:n]
    yield np.repeat(rng.choice([-1.0, 1.0], n // 10 + 1), 10)[:n]
    yield 1.0 * (k >= n // 10) - 1.5 * (k >= n // 2)
    yield np.sin(0.1 * k)
    yield lfilter([1.0], [1.0, -0.9], rng.standard_normal(n))


def record_of(u, y, t=None):
    return Record.from_arrays(np.arange(float(len(u))) if t is None else t, u, y)


def outcome(*records, delays=(0.0, 10.0), **options):
    return module.response_test(records, [record.valid for record in records], delays, **options)


def record_with_response(rng, n=400, share=0.36, colour=(1.0,), model=FIRST_ORDER):
    """Return a record in which the model explains a fraction of the output variance."""
    u = next(inputs(rng, n))
    x = simulate(model, HeldSignal(np.arange(float(n)), u), np.arange(float(n)))
    return record_of(u, np.sqrt(share) * x / x.std() + np.sqrt(1 - share) * noise(rng, n, colour))


def test_false_detections_in_noise_have_the_nominal_level():
    rng = np.random.default_rng(41)
    found = [
        outcome(record_of(u, noise(rng, 120, colour))).seen
        for _ in range(2)
        for colour in COLOURS
        for u in inputs(rng, 120)
    ]
    # A test of level 5 % stays below this number in 999 of 1,000 such samples.
    assert sum(found) <= binom.ppf(0.999, len(found), 0.05)
    # A test without any false alarm would have another level.
    assert sum(found) >= 1


@pytest.mark.parametrize("colour", [COLOURS[0], COLOURS[2]])
def test_a_response_with_a_fit_of_20_percent_is_detected(colour):
    rng = np.random.default_rng(42)
    found = [outcome(record_with_response(rng, 500, colour=colour)).seen for _ in range(12)]
    # With a power of 95 %, at most two are missed in 98 of 100 such samples.
    assert sum(found) >= 10


@pytest.mark.parametrize("initial_state", ["rest", "estimate"])
def test_the_share_is_that_of_least_squares(initial_state):
    rng = np.random.default_rng(43)
    record = record_with_response(rng, 100)
    t, y, best = record.t, record.y - record.y.mean(), 0.0
    for pole in module._poles(1.0, 99.0):
        denominator = np.real(np.poly([pole, pole.conjugate()] if np.imag(pole) else [pole]))
        beside = [np.ones(100)]
        if initial_state == "estimate" and pole:
            beside += [np.exp(pole * t).real] + [np.exp(pole * t).imag] * bool(np.imag(pole))
        left = y - np.column_stack(beside) @ np.linalg.lstsq(np.column_stack(beside), y, rcond=None)[0]
        columns = np.column_stack([*beside, simulate(TransferFunction([1.0], denominator, 4.0), record.input, t)])
        rest = y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]
        best = max(best, 1 - float(rest @ rest) / float(left @ left))
    found = outcome(record, delays=(4.0, 4.0), initial_state=initial_state)
    assert found.explained == pytest.approx(best, rel=1e-6)


def test_a_fast_response_in_a_long_record_is_detected():
    rng = np.random.default_rng(47)
    u = rng.choice([-1.0, 1.0], 9000)
    assert outcome(record_of(u, np.append(0.0, u[:-1]) + noise(rng, 9000))).seen
    assert not outcome(record_of(u, noise(rng, 9000))).seen


@pytest.mark.parametrize("model", [([1.0], [1.0, 0.0]), ([1.0], [1.0, 0.005, 0.25]), ([-0.1, 0.01], [1.0, 0.2, 0.01])])
def test_a_response_without_noise_is_detected(model):
    """Integrating and lightly damped systems, and one with a zero in the right half plane."""
    rng = np.random.default_rng(48)
    t = np.arange(300.0)
    for u in inputs(rng, 300):
        assert outcome(record_of(u, simulate(TransferFunction(*model), HeldSignal(t, u), t))).seen


def test_free_responses_and_steady_states():
    rng = np.random.default_rng(49)
    t = np.arange(100.0)
    # Most of the response to a pulse at the end occurs at the beginning of the next period.
    u = 1.0 * (t >= 92)
    twice = simulate(FIRST_ORDER, HeldSignal(np.arange(200.0), np.append(u, u)), np.arange(200.0))
    steady = record_of(u, twice[100:] + 0.01 * noise(rng, 100))
    assert outcome(steady).explained < 0.5
    assert outcome(steady, initial_state="periodic").explained > 0.95
    # A free response is not a response to the input, however large.
    falling = record_of(next(inputs(rng, 100)), 50.0 * np.exp(-t / 12.0) + noise(rng, 100))
    assert not outcome(falling, initial_state="estimate").seen


def test_what_cannot_be_tested_is_not_denied():
    rng = np.random.default_rng(51)
    held = record_of(np.ones(100), noise(rng, 100))
    # From rest, a constant input is a step.
    assert np.isfinite(outcome(held).p_value)
    still = Record(held.t, held.y, HeldSignal(held.t - 1e6, np.zeros(100)))
    for found in (outcome(still), outcome(record_with_response(rng, 7))):
        assert np.isnan(found.p_value)
        assert found.seen
    assert outcome(record_of(next(inputs(rng, 100)), np.full(100, 3.0))).p_value == 1.0
