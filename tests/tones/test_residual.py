"""Residual of a record after subtraction of its tones."""

from types import SimpleNamespace

import numpy as np
import pytest

from ctid_cli.tones.condition import find_spikes
from ctid_cli.tones.constants import SPIKE_AROUND, SPIKE_TIMES, SPIKE_WIDTH
from ctid_cli.tones.residual import left_over, without_spikes
from ctid_cli.tones.track import Track
from ctid_cli.tones.track import track as follow

INTERVAL = 0.002
T = INTERVAL * np.arange(10_000)
NOISE = 0.01 * np.random.default_rng(0).standard_normal(T.size)


def test_a_spike_is_not_what_the_tones_leave():
    y = np.sin(2 * np.pi * 60.0 * T) + NOISE
    track = follow(SimpleNamespace(samples=y, interval=INTERVAL), 1)
    y[4000] = 1e6
    left = left_over(y, INTERVAL, track)
    assert left.unknown[4000]
    assert np.abs(left.residual[~left.unknown]).max() < 0.1


def found_one_by_one(samples):
    size = np.abs(samples - np.median(samples))
    spikes = np.zeros(size.size, bool)
    for k in range(size.size):
        before = size[max(0, k - SPIKE_WIDTH - SPIKE_AROUND) : max(0, k - SPIKE_WIDTH)]
        after = size[k + SPIKE_WIDTH + 1 :][:SPIKE_AROUND]
        around = max(before.max(initial=0.0), after.max(initial=0.0))
        spikes[k] = 0.0 < SPIKE_TIMES * around < size[k]
    return spikes


@pytest.mark.parametrize("turn", [0.003, 0.1, 1.0, 3.0])
@pytest.mark.parametrize("place", [0, 1, 5, 700, 1495, 1499])
def test_spikes_are_found_at_every_place(turn, place):
    y = np.sin(turn * np.arange(1500))
    assert not find_spikes(y).any()
    y[place] += 20.0
    found = find_spikes(y)
    assert found.tolist() == found_one_by_one(y).tolist()
    assert found[place]
    assert np.isnan(without_spikes(y)).tolist() == found.tolist()


def test_noise_steps_and_pulses_are_no_spikes():
    rng = np.random.default_rng(0)
    assert not find_spikes(rng.standard_normal(20_000)).any()
    y = np.sin(0.3 * np.arange(2000))
    y[1000:] *= 50.0
    assert not find_spikes(y).any()
    y = 0.01 * rng.standard_normal(4000)
    y[::70] += 1.0  # a train of pulses
    assert not find_spikes(y).any()
    assert not find_spikes(np.full(100, np.nan)).any()
    assert not find_spikes(np.full(100, 3.0)).any()


def test_what_is_left_is_the_line_that_is_missing():
    y = 2.0 * np.sin(2 * np.pi * 12.0 * T) + 0.1 * np.sin(2 * np.pi * 19.0 * T) + NOISE
    rows = 0.1 + 0.05 * np.arange(396)
    shape = (rows.size, 1)
    parts = {"error": np.full(shape, 0.01), "amplitudes": np.full(shape, 2.0), "window": np.full(shape, 0.2)}
    phase = (2 * np.pi * 12.0 * rows)[:, None]
    omega = np.full(shape, 2 * np.pi * 12.0)
    left = left_over(y, INTERVAL, Track.of(rows, omega, np.zeros(rows.size, np.uint16), 0.05, phase=phase, **parts))
    assert left.hertz[np.argmax(left.residual_spectrum)] == pytest.approx(19.0, abs=0.2)
    assert left.residual_spectrum.max() == pytest.approx(0.1, rel=0.02)
    assert left.signal_spectrum.max() == pytest.approx(2.0, rel=0.02)
    assert left.root_mean_squares[1] == pytest.approx(np.hypot(0.1 / np.sqrt(2), 0.01), rel=0.03)
    assert left.unknown.mean() < 0.05
