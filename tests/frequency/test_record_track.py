"""Rows of a track by an online estimator: instants, amplitudes, how many there are, and which are confirmed."""

import numpy as np
import pytest

from ctid_cli.frequency import estimator_rows
from ctid_cli.frequency.automatic import choose_settings
from ctid_cli.frequency.estimator_rows import confirmed, online_rows, track_record
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.record_track import RecordTrack

INTERVAL = 0.002
T = INTERVAL * np.arange(10_000)


def test_the_instant_of_an_online_estimate_is_that_of_its_newest_sample():
    y = np.sin(20.0 * T)
    change = 5000
    y[change:] = np.sin(26.0 * (T[change:] - T[change]))
    settings = choose_settings(y, INTERVAL, 1, method="restarting_least_squares")
    track = online_rows(y, INTERVAL, settings, every=settings.interval)
    before = track.valid[:, 0] & (track.t < T[change])
    assert np.abs(track.omega[before, 0] - 20.0).max() < 0.01
    first = np.flatnonzero(np.abs(track.omega[:, 0] - 20.0) > 0.02)[0]
    assert T[change] <= track.t[first] < T[change] + 1.5
    # One sample of the record more or less at the end is the only difference that a later end makes.
    shorter = online_rows(y[:8000], INTERVAL, settings, every=settings.interval)
    count = shorter.t.size
    assert shorter.t == pytest.approx(track.t[:count])
    assert shorter.t[-1] <= T[7999] + 1e-12
    # The prefilter may sum in another order.
    assert shorter.omega == pytest.approx(track.omega[:count], abs=1e-6, nan_ok=True)


def test_amplitudes_are_those_before_the_filter():
    rng = np.random.default_rng(0)
    y = 3.0 * np.sin(20.0 * T) + np.sin(27.0 * T) + 0.5 * np.sin(40.0 * T) + 0.01 * rng.standard_normal(T.size)
    settings = choose_settings(y, INTERVAL, 2, method="drem_finite_time")
    assert settings.decimation.weights.size > 1
    track = online_rows(y, INTERVAL, settings)
    assert np.median(track.amplitudes[track.valid.all(axis=1)], axis=0) == pytest.approx([3.0, 1.0], rel=0.01)


def test_rows_are_as_many_as_asked_for():
    y = np.sin(20.0 * T)
    settings = choose_settings(y, INTERVAL, 1, method="drem_window")
    track = track_record(y, INTERVAL, settings, every=0.5)
    assert track.every == pytest.approx(0.5, abs=settings.interval)
    assert np.diff(track.t) == pytest.approx(track.every)
    assert 300 <= track_record(y, INTERVAL, settings).t.size <= 1000


def test_pieces_change_nothing(monkeypatch):
    y = np.sin(20.0 * T) + 0.01 * np.random.default_rng(1).standard_normal(T.size)
    settings = choose_settings(y, INTERVAL, 1, method="restarting_least_squares")
    calls = []
    whole = online_rows(y, INTERVAL, settings)
    monkeypatch.setattr(estimator_rows, "PIECE", 97)
    pieces = online_rows(y, INTERVAL, settings, on_progress=lambda done, total: calls.append((done, total)))
    assert pieces.t.tolist() == whole.t.tolist()
    assert pieces.omega == pytest.approx(whole.omega, abs=1e-8, nan_ok=True)
    assert calls[-1][0] == calls[-1][1]
    assert len(calls) > 3


def rows_of(omega, every=0.1, **known):
    omega = np.asarray(omega, float)
    flags = known.pop("flags", np.zeros(omega.shape, np.uint16))
    return RecordTrack.of(every * np.arange(len(omega)), omega, flags, every, **known)


def test_a_row_is_confirmed_by_the_reading_nearest_to_it_and_by_no_other():
    readings = rows_of([[10.0, 20.0, np.nan]] * 4, error=np.full((4, 3), 0.01))
    track = confirmed(rows_of([[10.1, 20.0], [10.2, 10.0], [15.0, 20.0], [np.nan, 20.0]]), readings, memory=2.0)
    unconfirmed = int(Flag.UNCONFIRMED)
    # One bin of the memory is pi rad/s; a tone that is not there at all has the flags of its method only.
    assert track.flags.tolist() == [[0, 0], [unconfirmed, 0], [unconfirmed, 0], [0, 0]]
    assert np.isnan(track.error[[1, 2, 3], 0]).all()
    assert np.isfinite(track.error[:, 1]).all()


def test_flags_of_a_reading_and_of_a_method_are_kept_but_for_doubts_that_are_settled():
    readings = rows_of(
        [[10.0]] * 2, error=np.full((2, 1), 0.01), flags=np.full((2, 1), int(Flag.UNRESOLVED), np.uint16)
    )
    own = np.full((2, 1), int(Flag.UNCERTAIN | Flag.CHANGED), np.uint16)
    track = confirmed(rows_of([[10.0], [30.0]], flags=own), readings, memory=1.0)
    assert track.flags[0, 0] == int(Flag.UNRESOLVED | Flag.CHANGED)
    assert track.flags[1, 0] == int(Flag.UNCERTAIN | Flag.CHANGED | Flag.UNCONFIRMED)


def test_the_error_is_that_of_the_reading_and_the_usual_distance_from_it():
    rng = np.random.default_rng(0)
    readings = rows_of(np.full((4000, 1), 10.0), error=np.full((4000, 1), 0.03))
    found = 10.0 + 0.04 * rng.standard_normal((4000, 1))
    found[2000] += 0.4
    track = confirmed(rows_of(found), readings, memory=10.0)
    assert np.median(track.error) == pytest.approx(0.05, rel=0.03)
    assert track.error[2000, 0] > 0.2


ALONE = np.sin(75.0 * T)
AFTER = T >= 10.0
EVENTS = {
    "nothing": (ALONE, 0.95),
    "a tenth of another tone": (ALONE + 0.1 * np.sin(94.0 * T), 0.8),
    "a tone that enters": (ALONE + 0.3 * AFTER * np.sin(94.0 * T), 0.6),
    "a spike": (ALONE + 1e6 * (np.arange(T.size) == 5000), 0.95),
    "a gap": (np.where((T > 10.0) & (T < 10.3), np.nan, ALONE), 0.9),
    "a step of the phase": (np.sin(75.0 * T + 0.2 * AFTER), 0.85),
    "a step of the frequency": (np.sin(75.0 * T + 2.0 * AFTER * (T - 10.0)), 0.85),
    "a step of the amplitude": ((1.0 + AFTER) * ALONE, 0.85),
    "a decay": (np.exp(-0.3 * T) * ALONE, 0.3),
}


@pytest.mark.parametrize("method", ["restarting_least_squares", "drem_window"])
@pytest.mark.parametrize("event", EVENTS)
def test_valid_rows_are_right_whatever_happens(method, event):
    y, share = EVENTS[event]
    y = y + 0.007 * np.random.default_rng(2).standard_normal(T.size)
    track = track_record(y, INTERVAL, choose_settings(y, INTERVAL, 1, method=method)).of_accuracy(None)
    true = np.where((track.t >= 10.0) & ("frequency" in event), 77.0, 75.0)[:, None]
    off = np.abs(track.omega - true)
    wrong = track.valid & (off > 3.3 * track.error) & (off > 1e-3 * true)
    assert not wrong.any()
    assert track.valid.mean() > share
