"""Settings from the record alone: good enough that the tones are found, and refusals in words."""

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.frequency.automatic import choose_settings
from ctid_cli.frequency.estimator_rows import track_record
from ctid_cli.kinds import ONLINE, classes


def plucked(rate=8000.0, seconds=1.5, hum=0.003, noise=0.0005, seed=0):
    """A string that decays: inharmonic partials, two loud high ones for a moment, hum, noise and a constant."""
    t = np.arange(int(rate * seconds)) / rate
    rng = np.random.default_rng(seed)
    y = 0.002 + hum * np.sin(2 * np.pi * 100.0 * t) + noise * rng.standard_normal(t.size)
    for frequency, amplitude, decay in (*PARTIALS, (1320.7, 0.02, 6.0), (1467.9, 0.02, 6.0)):
        y += amplitude * np.exp(-decay * t) * np.sin(2 * np.pi * frequency * t + frequency)
    return y


PARTIALS = ((146.3, 0.15, 0.4), (292.9, 0.03, 0.4), (439.9, 0.03, 1.1), (587.4, 0.015, 1.3))


def medians(y, interval, tones, **options):
    settings = choose_settings(y, interval, tones, **options)
    track = track_record(y, interval, settings)
    return settings, track, np.median(track.omega[track.valid.all(axis=1)], axis=0) / (2 * np.pi)


def test_the_online_estimators_are_those_that_take_one_sample_after_the_other():
    assert {kind for kind, each in classes("frequency_estimator").items() if each.online} == set(ONLINE)


@pytest.mark.parametrize(("omega", "angle"), [((2.0,), 2.03), ((2.0, 2.1), 2.1), ((1.0, 2.0, 3.0), 2.4)])
def test_the_delay_makes_noise_matter_least(omega, angle):
    t = 0.02 * np.arange(20_000)
    y = sum(np.sin(w * t + w) for w in omega)
    estimator = choose_settings(y, 0.02, len(omega), method="restarting_least_squares").estimator
    assert max(omega) * estimator.h == pytest.approx(angle, abs=0.15)
    assert max(omega) * 1.1 * estimator.h <= np.pi + 1e-9


def test_partials_of_a_decaying_string():
    settings, track, found = medians(plucked(), 1 / 8000.0, 4, method="restarting_least_squares")
    assert found == pytest.approx([146.3, 292.9, 439.9, 587.4], abs=0.3)
    assert track.valid.mean() > 0.7
    assert np.abs(settings.expected[4:] / (2 * np.pi) - 100.0).min() < 0.5
    text = " ".join(settings.reasons)
    for part in ("high-pass", "not shown", "memory"):
        assert part in text


@pytest.mark.parametrize("method", ONLINE)
def test_every_method_finds_two_tones_far_from_one_radian_per_second(method):
    t = 2e-6 * np.arange(30_000)
    rng = np.random.default_rng(2)
    y = np.sin(4000.0 * t) + 0.8 * np.sin(6500.0 * t + 1.0) + 0.01 * rng.standard_normal(t.size)
    settings = choose_settings(y, 2e-6, 2, method=method)
    track = track_record(y, 2e-6, settings)
    assert settings.estimator.kind == method
    assert track.omega[-1] == pytest.approx([4000.0, 6500.0], rel=0.02)
    assert track.amplitudes[-1] == pytest.approx([1.0, 0.8], rel=0.05)
    assert track.valid[-1].all()


def test_units_of_time_only_scale():
    y = plucked(seconds=0.6)
    one, other = (choose_settings(y, interval, 4, method="drem_window") for interval in (1 / 8000.0, 1.0))
    assert other.expected * 8000.0 == pytest.approx(one.expected, rel=1e-9)
    assert (other.window, other.decimation.factor) == (one.window, one.decimation.factor)
    assert other.decimation.weights == pytest.approx(one.decimation.weights, abs=1e-12)


def test_delay_of_the_regression_follows_the_highest_tone():
    t = 0.001 * np.arange(20_000)
    settings = choose_settings(np.sin(30.0 * t) + np.sin(50.0 * t), 0.001, 2, method="restarting_least_squares")
    assert 1.8 < settings.estimator.h * 50.0 < 2.6
    assert settings.estimator.prefilter == pytest.approx(2.0 * settings.estimator.h)


def test_noise_makes_windows_longer():
    t = 0.01 * np.arange(6000)
    noise = np.random.default_rng(3).standard_normal(t.size)
    clean, noisy = (
        choose_settings(np.sin(20.0 * t) + level * noise, 0.01, 1, method="drem_window") for level in (0.01, 2.0)
    )
    assert noisy.window_seconds > 1.5 * clean.window_seconds


def test_doubts_are_told():
    def warnings(y, tones):
        return choose_settings(y, 0.01, tones, method="drem_window").warnings

    t = 0.01 * np.arange(3000)
    assert "Nyquist" in warnings(np.sin(305.0 * t), 1)[0]
    noise = 0.01 * np.random.default_rng(5).standard_normal(t.size)
    assert "Only 1 of 2" in warnings(np.sin(30.0 * t) + noise, 2)[0]
    assert warnings(np.sin(30.0 * t) + noise, 1) == ()


@pytest.mark.parametrize(
    ("y", "message"),
    [
        (np.zeros(100), r"constant \(0\)"),
        (np.full(100, 3.3), "constant"),
        (np.sin(np.arange(5.0)), "too few"),
        (np.full(100, np.nan), "too few"),
        (np.random.default_rng(6).standard_normal(500), "no tone stands out"),
    ],
)
def test_refusals(y, message):
    with pytest.raises(DataError, match=message):
        choose_settings(y, 0.01, 1, method="drem_window")


def test_options_out_of_range():
    y = np.sin(0.3 * np.arange(300))
    for options in (
        {"tones": 0},
        {"tones": 9},
        {"method": "fft"},
        {"method": "esprit"},
        {"window": -1.0},
        {"window": 1e6},
    ):
        with pytest.raises(ValueError, match=next(iter(options))):
            choose_settings(y, 0.01, **{"tones": 1, "method": "drem_window", **options})
