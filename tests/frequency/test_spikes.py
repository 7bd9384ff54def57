"""Spikes: found where they are, never in tones or noise, and without a trace in the rows of a track."""

import numpy as np
import pytest

from ctid_cli.frequency.automatic import choose_settings
from ctid_cli.frequency.estimator_rows import track_record
from ctid_cli.frequency.spikes import AROUND, TIMES, WIDTH, find_spikes, without_spikes


def found_one_by_one(samples):
    size = np.abs(samples - np.median(samples))
    spikes = np.zeros(size.size, bool)
    for k in range(size.size):
        before = size[max(0, k - WIDTH - AROUND) : max(0, k - WIDTH)]
        after = size[k + WIDTH + 1 :][:AROUND]
        around = max(before.max(initial=0.0), after.max(initial=0.0))
        spikes[k] = 0.0 < TIMES * around < size[k]
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
    y[::70] += 1.0  # pulses are what such a signal is made of
    assert not find_spikes(y).any()
    assert not find_spikes(np.full(100, np.nan)).any()
    assert not find_spikes(np.full(100, 3.0)).any()


@pytest.mark.parametrize("method", ["drem_window", "restarting_least_squares"])
@pytest.mark.parametrize("size", [10.0, 1e6])
def test_one_spike_moves_no_row_of_a_track(method, size):
    t = 0.002 * np.arange(3000)
    y = np.sin(75.0 * t) + 0.01 * np.random.default_rng(1).standard_normal(t.size)
    y[1500] += size
    settings = choose_settings(y, 0.002, 1, method=method)
    assert "Spikes" in " ".join(settings.reasons)
    track = track_record(y, 0.002, settings)
    settled = track.valid[:, 0] & (track.t > 0.5)
    assert settled.mean() > 0.8
    assert np.abs(track.omega[settled, 0] - 75.0).max() < 0.1
