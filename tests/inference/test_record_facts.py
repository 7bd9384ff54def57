"""Facts about a record: each planted fault is found, none on a clean record, and estimates are near the true values."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from ctid_cli import HeldSignal, Record, TransferFunction, simulate
from ctid_cli.inference.input_response import analyse_response, regular_grid
from ctid_cli.inference.record_facts import excitation_order, record_facts, sampled_input
from ctid_cli.inference.record_tests import LEVEL
from ctid_cli.inference.signal_features import input_moves

FIRST_ORDER = TransferFunction([1], [1, 1], delay=1.3)


def clean(seed=0, n=1000, hold=20, colour=0.9, noise=0.1, irregular=False):
    """Return a record of a first-order system with a random binary input, from rest, in AR(1) noise."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.02, 0.18, n)) if irregular else 0.1 * np.arange(n)
    u = np.repeat(rng.choice([-1.0, 1.0], n // hold + 1), hold)[:n]
    v = lfilter([np.sqrt(1 - colour**2)], [1, -colour], rng.standard_normal(n + 200))[200:]
    return Record.from_arrays(t, u, simulate(FIRST_ORDER, HeldSignal(t, u), t) + noise * v)


def faulty(fault):
    record = clean()
    t, u, y = record.t, record.input.values, record.y
    match fault:
        case "offset":
            return replace(record, y=y + 0.3)
        case "drift":
            return replace(record, y=y + 0.01 * t)
        case "start":
            return replace(record, y=y + np.exp(-t))
        case "outliers":
            return replace(record, y=y + 0.6 * (np.arange(y.size) == 500))
        case "saturation":
            return replace(record, y=np.minimum(y, np.quantile(y, 0.98)))
        case "feedback":
            z, w, x, level = np.zeros(y.size), u.copy(), 0.0, y - simulate(FIRST_ORDER, record.input, t)
            for k in range(y.size):
                z[k] = x + level[k]
                w[k] -= 0.5 * z[k]
                x = 0.905 * x + 0.095 * w[k]
            return Record.from_arrays(t, w, z)
    raise AssertionError(fault)


def stated(facts):
    """Return the stated faults."""
    parts = facts.parts
    found = {name for name in ("offset", "drift", "start") if getattr(parts, name).detected}
    others = {"outliers": parts.outliers, "feedback": parts.feedback_p_value <= LEVEL, "saturation": facts.saturated}
    return found | {name for name, value in others.items() if value}


@pytest.mark.parametrize("fault", ["offset", "drift", "start", "outliers", "saturation", "feedback"])
def test_a_fault_is_stated_and_no_other(fault):
    assert stated(record_facts(faulty(fault))) == {fault}


def test_zero_is_no_rest_of_an_input_that_is_far_from_it():
    record = faulty("start")
    far = HeldSignal(record.input.t, record.input.values + 10.0)
    parts = record_facts(Record(record.t, record.y + 10.0, far)).parts
    assert parts.start.detected
    assert parts.input_at_rest == far.values[0]


@pytest.mark.parametrize("irregular", [False, True])
@pytest.mark.parametrize("colour", [0.0, 0.95])
def test_a_clean_record_has_no_faults_and_its_numbers_hold_the_truth(colour, irregular):
    facts = record_facts(clean(1, colour=colour, irregular=irregular))
    assert stated(facts) == set()
    parts = facts.parts
    assert parts.delay.low <= 1.3 <= parts.delay.high
    assert parts.response_time.low - 0.1 <= 2.3 <= parts.response_time.high + 0.1
    assert parts.signal_to_noise.low - 1 <= 18.2 <= parts.signal_to_noise.high + 1


def test_units_do_not_matter():
    record, scale = clean(), 1e-6
    facts = record_facts(record)
    scaled = record_facts(Record.from_arrays(record.t * scale, record.input.values, record.y / scale))
    assert scaled.parts.signal_to_noise == pytest.approx(facts.parts.signal_to_noise, rel=1e-4)
    assert scaled.parts.delay.high == pytest.approx(facts.parts.delay.high * scale)
    assert stated(scaled) == set()


def test_no_response_is_no_estimate():
    record = clean()
    noise = lfilter([1], [1, -0.9], np.random.default_rng(6).standard_normal(record.n_samples))
    facts = record_facts(replace(record, y=noise))
    assert facts.answer_p_value > 0.05
    assert np.isnan(facts.parts.signal_to_noise.value)


def test_a_system_that_integrates_has_no_response_time():
    record = clean(colour=0.0)
    y = simulate(TransferFunction([1], [1, 0], delay=0.5), record.input, record.t)
    facts = record_facts(replace(record, y=y + 0.1 * np.random.default_rng(1).standard_normal(y.size)))
    assert np.isnan(facts.parts.response_time.value)
    assert facts.parts.delay.low <= 0.5 <= facts.parts.delay.high
    assert stated(facts) == set()


@pytest.mark.parametrize("n", [1, 2, 3, 9, 49, 50, 60])
def test_short_records_and_missing_samples(n):
    record = clean(hold=1)
    y = np.where(np.arange(n) % 7 == 3, np.nan, record.y[:n])
    facts = record_facts(Record.from_arrays(record.t[:n], record.input.values[:n], y))
    assert (facts.parts.offset is None) == (np.isfinite(y).sum() < 50)


@pytest.mark.parametrize("tones", [1, 2, 4])
def test_excitation_counts_two_for_every_tone(tones):
    t = 0.1 * np.arange(4000)
    u = sum(np.sin(w * t + w) for w in (0.5, 1.3, 2.9, 4.7)[:tones])
    record = Record.from_arrays(t, u, simulate(FIRST_ORDER, HeldSignal(t, u, "foh"), t))
    moves = input_moves(record)
    assert excitation_order(*sampled_input(record), moves, analyse_response(record, moves)) == 2 * tones


@pytest.mark.slow
def test_gaps_and_periods():
    t = 0.1 * np.arange(600)
    u = np.tile(np.random.default_rng(8).choice([-1.0, 1.0], 100), 6)
    keep = np.r_[0:300, 400:600]
    x = simulate(FIRST_ORDER, HeldSignal(t, u), t)
    assert record_facts(Record.from_arrays(t, u, x)).input_period == pytest.approx(10.0)
    levels = np.repeat(np.random.default_rng(11).uniform(0.5, 1.5, 15), 40)
    assert math.isnan(record_facts(Record.from_arrays(t, levels, np.sin(t))).input_period)
    (gap,) = record_facts(Record.from_arrays(t[keep], u[keep], x[keep])).gaps
    assert (gap.start, gap.length) == (pytest.approx(29.9), pytest.approx(10.1))


def test_the_signals_on_the_grid_have_neither_mean_nor_slope():
    record = clean(n=300)
    grid = regular_grid(replace(record, y=record.y + 3.0 + 0.2 * record.t))
    lines = np.column_stack((np.ones(300), np.linspace(-1.0, 1.0, 300)))
    np.testing.assert_allclose(lines.T @ np.column_stack((grid.u, grid.y)), 0.0, atol=1e-9)
