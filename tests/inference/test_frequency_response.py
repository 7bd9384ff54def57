"""Nonparametric frequency responses against the exact response of known systems."""

import numpy as np
import pytest

from ctid_cli import DataError, HeldSignal, Record, TransferFunction, simulate
from ctid_cli.inference.frequency_response import estimate_frequency_response
from ctid_cli.inference.spectral_methods import find_period
from ctid_cli.signals.held import hold_factor

INTERVAL, PERIOD = 0.1, 256
MODEL = TransferFunction([2.0, 1.0], [1.0, 1.0, 3.0], delay=0.37)
ODD = np.arange(1, 100, 2)
T200 = INTERVAL * np.arange(200)


def multisine(seed: int, harmonics: np.ndarray = ODD) -> np.ndarray:
    phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, harmonics.size)
    return np.cos(2 * np.pi * np.outer(np.arange(PERIOD), harmonics) / PERIOD + phases).sum(axis=1)


def periodic_record(once, periods, settling=40, noise=0.0, square=0.0, cube=0.0, seed=0, model=MODEL):
    u = np.tile(once, periods + settling)
    t = INTERVAL * np.arange(u.size)
    x = simulate(model, HeldSignal(t, u), t)
    y = x + square * x**2 + cube * x**3 + noise * np.random.default_rng(seed).standard_normal(u.size)
    kept = slice(settling * PERIOD, None)
    return Record(t[kept], y[kept], HeldSignal(t[kept], u[kept]))


def sampled_response(model, w, hold="zoh"):
    """Return the response of the samples: spectrum of the response to one held sample, over that of the hold."""
    t = INTERVAL * np.arange(3000)
    pulse = np.zeros(t.size)
    pulse[1] = 1.0
    answer = simulate(model, HeldSignal(t, pulse, hold), t)[1:]
    return np.exp(-1j * np.outer(w, t[:-1])) @ answer / hold_factor(hold, w, INTERVAL)


def exact(model, w):
    s = 1j * w
    return np.polyval(model.numerator, s) / np.polyval(model.denominator, s) * np.exp(-s * model.delay)


def random_record(seed, n=2000, noise=0.3, model=MODEL, warm_up=300):
    rng = np.random.default_rng(seed)
    t = INTERVAL * np.arange(n + warm_up)
    u = rng.standard_normal(t.size)
    x = simulate(model, HeldSignal(t, u), t)
    y = x + noise * x.std() * rng.standard_normal(t.size)
    return Record(t[warm_up:], y[warm_up:], HeldSignal(t[warm_up:], u[warm_up:]))


def test_periods_without_noise_are_exact():
    found = estimate_frequency_response(periodic_record(multisine(0), 4))
    assert found.method == "periodic"
    assert found.frequencies == pytest.approx(2 * np.pi / (PERIOD * INTERVAL) * ODD, rel=1e-12)
    true = sampled_response(MODEL, found.frequencies)
    assert np.abs(found.response - true).max() < 1e-10 * np.abs(true).max()
    # The image errors of a hold are within their bound.
    assert (np.abs(true - exact(MODEL, found.frequencies)) <= 1.1 * found.bias).all()


def test_a_start_that_has_not_settled_is_taken_out():
    once = np.random.default_rng(0).standard_normal(PERIOD)
    found = estimate_frequency_response(periodic_record(once, 3, settling=0))
    true = sampled_response(MODEL, found.frequencies)
    assert np.abs(found.response - true).max() < 0.01 * np.abs(true).max()


def test_distortions_show_on_lines_without_input():
    linear = estimate_frequency_response(periodic_record(multisine(0), 4, noise=0.1))
    even = estimate_frequency_response(periodic_record(multisine(0), 4, noise=0.1, square=0.02))
    assert "even: no more than noise" in linear.notes[1]
    assert "even: -" in even.notes[1]
    assert even.distortion is None  # even distortions of an odd input do not touch its lines
    gaps = np.setdiff1d(ODD, ODD[3::4])
    linear = estimate_frequency_response(periodic_record(multisine(0, gaps), 4, noise=0.01))
    cubic = estimate_frequency_response(periodic_record(multisine(0, gaps), 4, noise=0.01, cube=1e-3))
    assert np.median(cubic.distortion) > 100 * np.median(linear.distortion)


@pytest.mark.parametrize("periods", [1, 3])
def test_intervals_of_short_records_cover(periods):
    # A resonance with damping .1, 8 to 16 periods of it in the record, 15 dB. Lines share windows: at most 7 of 9 in
    # the band of the gain are independent, and at least 400 of 30 records. 90 % is then 3.3 standard deviations below
    # 95 %.
    hits = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        w = rng.uniform(1.0, 2.0)
        model = TransferFunction([w**2], [1.0, 0.2 * w, w**2])
        t = INTERVAL * np.arange(500)
        u = np.resize(rng.choice([-1.0, 1.0], 500 // periods), 500)
        x = simulate(model, HeldSignal(t, u), t)
        record = Record(t, x + 0.18 * x.std() * rng.standard_normal(t.size), HeldSignal(t, u))
        found = estimate_frequency_response(record)
        assert found.method == ("periodic" if periods > 1 else "local-polynomial")
        true = sampled_response(model, found.frequencies)
        band = found.has_interval & (np.abs(true) > 0.1 * np.abs(true).max())
        hits.extend((np.abs(found.response - true) <= found.radius())[band])
    assert np.mean(hits) > 0.9


def test_no_interval_on_a_peak_between_the_lines():
    model = TransferFunction([1.0], [1.0, 0.06, 1.0])
    found = estimate_frequency_response(random_record(0, n=500, noise=0.1, model=model))
    top = np.argmin(np.abs(found.frequencies - 1.0))
    low, high = found.gain_band()
    assert np.isnan([low[top], high[top], found.radius()[top], found.phase_band()[top]]).all()
    assert any("narrow peak" in note for note in found.notes)
    assert found.has_interval.mean() > 0.9


def test_the_phase_is_followed_where_it_is_known():
    # Above 2 rad/s the response is below the noise.
    model = TransferFunction([1.0], np.polymul([1.0, 1.0], [0.7, 1.0]), delay=3.0)
    found = estimate_frequency_response(random_record(0, n=800, noise=0.5, model=model))
    phase, half = found.phase(), found.phase_band()
    known = np.isfinite(phase)
    assert (np.isfinite(half) == known).all()
    assert (half[known] < np.pi / 2).all()
    first = np.flatnonzero(~known)[0]
    true = np.unwrap(np.angle(exact(model, found.frequencies[:first])))
    assert first >= 8
    assert np.abs(phase[:first] - true).max() < 0.6
    assert known[found.frequencies > 10.0].mean() < 0.1
    assert np.abs(phase[known]).max() < 5 * np.pi
    assert any("No phase at" in note for note in found.notes)


def test_any_clock_covers():
    shares = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        t = np.cumsum(INTERVAL * rng.uniform(0.5, 1.5, 1500))
        breaks = np.arange(0.0, t[-1], 0.35)
        signal = HeldSignal(breaks, rng.choice([-1.0, 1.0], breaks.size))
        y = simulate(MODEL, signal, t)
        record = Record(t, y + 0.2 * y.std() * rng.standard_normal(t.size), signal)
        found = estimate_frequency_response(record)
        inside = found.frequencies < 0.5 * np.pi / INTERVAL
        shares.append(np.mean((np.abs(found.response - exact(MODEL, found.frequencies)) <= found.radius())[inside]))
        assert any("the clock is irregular" in note for note in found.notes)
    assert 0.88 < np.mean(shares) < 0.985


def test_welch_averages():
    record = random_record(0, n=20_000, noise=0.1)
    found = estimate_frequency_response(record, method="welch", segment=1000)
    true = sampled_response(MODEL, found.frequencies)
    low = found.frequencies < 5
    assert np.median((np.abs(found.response - true) / np.abs(true))[low]) < 0.05
    assert found.coherence[found.frequencies < 3].min() > 0.95
    assert not found.has_interval.any()
    assert any("no intervals" in note for note in found.notes)


def test_the_period_of_an_input():
    rng = np.random.default_rng(0)
    assert find_period(np.tile(rng.standard_normal(37), 5)[:-9]) == 37
    assert find_period(np.sin(2 * np.pi * np.arange(400) / 100)) == 100
    assert find_period(rng.standard_normal(500)) is None
    assert find_period(np.linspace(0.0, 1.0, 500)) is None


def flat_or_short(n, u=None):
    t = INTERVAL * np.arange(n)
    return Record.from_arrays(t, np.sin(30 * t) if u is None else np.full(n, u), t)


@pytest.mark.parametrize(
    ("record", "options", "words"),
    [
        (random_record(0), {"method": "welch", "segment": 1900}, "segments of 1900 samples are too long"),
        (random_record(0), {"method": "periodic"}, "the input is not periodic"),
        (random_record(0), {"period": 1500}, "less than two periods of 1500"),
        (random_record(0), {"half_width": 2}, "half_width"),
        (flat_or_short(200, 1.0), {}, "the input is constant"),
        (flat_or_short(10), {}, "at least"),
        ([random_record(0), random_record(1)], {}, "do not all have the same period"),
        (Record.from_arrays(T200**1.01, np.sin(T200**2), np.cos(T200)), {"method": "welch"}, "the clock is irregular"),
    ],
)
def test_records_and_options_that_give_no_frequency_response(record, options, words):
    with pytest.raises((DataError, ValueError), match=words):
        estimate_frequency_response(record, **options)
