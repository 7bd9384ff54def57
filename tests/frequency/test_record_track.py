"""Rows of a track: their instants, their amplitudes, how many there are."""

import numpy as np
import pytest

from ctid_cli.frequency import estimator_rows
from ctid_cli.frequency.automatic import choose_settings
from ctid_cli.frequency.estimator_rows import track_record

INTERVAL = 0.002
T = INTERVAL * np.arange(10_000)


@pytest.mark.parametrize("method", ["esprit", "nonlinear_least_squares"])
def test_the_instant_of_a_window_is_its_middle(method):
    # The frequency rises linearly, so the middle of a symmetrical window has the mean frequency.
    y = np.sin(20.0 * T + 0.25 * T**2)
    track = track_record(y, INTERVAL, choose_settings(y, INTERVAL, 1, method=method))
    assert track.valid.mean() > 0.9
    assert track.omega[track.valid[:, 0], 0] == pytest.approx(20.0 + 0.5 * track.t[track.valid[:, 0]], abs=0.05)
    assert T[0] < track.t[0] < track.t[-1] < T[-1]


def test_the_instant_of_an_online_estimate_is_that_of_its_newest_sample():
    y = np.sin(20.0 * T)
    change = 5000
    y[change:] = np.sin(26.0 * (T[change:] - T[change]))
    settings = choose_settings(y, INTERVAL, 1, method="restarting_least_squares")
    track = track_record(y, INTERVAL, settings, every=settings.interval)
    before = track.valid[:, 0] & (track.t < T[change])
    assert np.abs(track.omega[before, 0] - 20.0).max() < 0.01
    first = np.flatnonzero(np.abs(track.omega[:, 0] - 20.0) > 0.02)[0]
    assert T[change] <= track.t[first] < T[change] + 1.5
    # One sample of the record more or less at the end is the only difference that a later end makes.
    shorter = track_record(y[:8000], INTERVAL, settings, every=settings.interval)
    count = shorter.t.size
    assert shorter.t == pytest.approx(track.t[:count])
    assert shorter.t[-1] <= T[7999] + 1e-12
    # The prefilter may sum in another order.
    assert shorter.omega == pytest.approx(track.omega[:count], abs=1e-6, nan_ok=True)


def test_amplitudes_are_those_before_the_filter():
    rng = np.random.default_rng(0)
    y = 3.0 * np.sin(20.0 * T) + np.sin(27.0 * T) + 0.5 * np.sin(40.0 * T) + 0.01 * rng.standard_normal(T.size)
    for method in ("esprit", "drem_finite_time"):
        settings = choose_settings(y, INTERVAL, 2, method=method)
        assert settings.decimation.weights.size > 1
        track = track_record(y, INTERVAL, settings)
        assert np.median(track.amplitudes[track.valid.all(axis=1)], axis=0) == pytest.approx([3.0, 1.0], rel=0.01)


def test_rows_are_as_many_as_asked_for():
    y = np.sin(20.0 * T)
    settings = choose_settings(y, INTERVAL, 1)
    track = track_record(y, INTERVAL, settings, every=0.5)
    assert track.every == pytest.approx(0.5, abs=settings.interval)
    assert np.diff(track.t) == pytest.approx(track.every)
    online = choose_settings(y, INTERVAL, 1, method="drem_window")
    assert 300 <= track_record(y, INTERVAL, online).t.size <= 1000


def test_pieces_change_nothing(monkeypatch):
    y = np.sin(20.0 * T) + 0.01 * np.random.default_rng(1).standard_normal(T.size)
    settings = choose_settings(y, INTERVAL, 1, method="restarting_least_squares")
    calls = []
    whole = track_record(y, INTERVAL, settings)
    monkeypatch.setattr(estimator_rows, "PIECE", 97)
    pieces = track_record(y, INTERVAL, settings, on_progress=lambda done, total: calls.append((done, total)))
    assert pieces.t.tolist() == whole.t.tolist()
    assert pieces.omega == pytest.approx(whole.omega, abs=1e-8, nan_ok=True)
    assert calls[-1][0] == calls[-1][1]
    assert len(calls) > 3
