"""Filters and gaps in front of an estimator."""

import numpy as np
import pytest

from ctid_cli.frequency import decimation
from ctid_cli.frequency.decimation import Decimation, bridge_gaps, low_pass, without_low

INTERVAL = 0.01
T = INTERVAL * np.arange(3000)


def response(weights, omega):
    return np.abs(np.exp(-1j * np.outer(omega * INTERVAL, np.arange(weights.size))) @ weights)


def test_low_pass_keeps_and_stops():
    weights = low_pass(40.0, 80.0, 60.0, INTERVAL)
    assert np.abs(response(weights, np.linspace(0.0, 40.0, 50)) - 1.0).max() < 2e-3
    assert response(weights, np.linspace(80.0, 314.0, 200)).max() < 2e-3
    assert weights == pytest.approx(weights[::-1])


def test_high_pass_removes_a_drift_and_keeps_the_tones():
    weights = without_low(low_pass(40.0, 80.0, 60.0, INTERVAL), 4.0, 8.0, 40.0, INTERVAL)
    assert response(weights, np.linspace(0.0, 4.0, 50)).max() < 2e-2
    assert np.abs(response(weights, np.linspace(8.0, 40.0, 50)) - 1.0).max() < 2e-2
    assert weights.size % 2 == 1


def test_output_is_the_tone_at_the_middle_of_the_filter():
    step = Decimation(low_pass(40.0, 80.0, 60.0, INTERVAL), 5)
    out = step.apply(np.sin(30.0 * T))
    middle = INTERVAL * (0.5 * (step.weights.size - 1) + 5.0 * np.arange(out.size))
    gain = step.gain(np.array([30.0]), INTERVAL)
    assert out == pytest.approx(gain * np.sin(30.0 * middle), abs=1e-12)
    assert out.size == -(-(T.size - step.weights.size + 1) // 5)


def test_short_gaps_are_bridged_and_long_ones_stay():
    y = T.copy()
    y[[100, 101, 200, 201, 202, 0]] = np.nan
    out = bridge_gaps(y, 2)
    assert out[98:104] == pytest.approx(T[98:104])
    assert np.flatnonzero(np.isnan(out)).tolist() == [0, 200, 201, 202]
    assert np.isnan(y[100])
    wide = Decimation(np.ones(3) / 3.0, 1, 2).apply(y)
    assert np.flatnonzero(np.isnan(wide)).tolist() == [0, 198, 199, 200, 201, 202]


def test_pieces_join_to_the_whole(monkeypatch):
    monkeypatch.setattr(decimation, "PIECE", 64)
    step = Decimation(low_pass(40.0, 80.0, 60.0, INTERVAL), 7)
    y = np.random.default_rng(0).standard_normal(20 * step.weights.size) + 3.0
    assert step.apply(y, 3.0) == pytest.approx(np.convolve(y - 3.0, step.weights, "valid")[::7], abs=1e-12)
    assert step.apply(y[: step.weights.size - 1]).size == 0


def test_without_a_filter_only_samples_are_kept():
    assert Decimation(np.ones(1), 7).apply(T).tolist() == T[::7].tolist()
