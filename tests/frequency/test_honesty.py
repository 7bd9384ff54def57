"""Signals without the requested tones: no estimator marks a wrong number as valid."""

import numpy as np
import pytest

from ctid_cli.frequency.drem import DremFiniteTime, DremGradient, DremWindow
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares
from tests.frequency.signals import CLEAN, INTERVAL, NO_TWO_TONES, NOISE, T

TRUTH = np.array([2.0, 3.0])
ONLINE = [
    DremGradient(tones=2, h=0.7, d=0.4, epsilon=0.3),
    DremFiniteTime(tones=2, h=0.7, d=0.4, epsilon=0.3),
    DremFiniteTime(tones=2, h=0.7, d=0.4, epsilon=0.3, prefilter=1.0, first_row=0),
    DremWindow(tones=2, h=0.7, d=0.4, memory=4.0),
    RestartingLeastSquares(tones=2, h=0.7),
    RestartingLeastSquares(tones=2, h=0.7, prefilter=1.0),
    RestartingLeastSquares(tones=2, h=0.7, solution="total_least_squares"),
]


@pytest.mark.parametrize("name", NO_TWO_TONES)
@pytest.mark.parametrize("options", ONLINE, ids=lambda options: options.kind)
def test_no_estimate_is_valid_where_there_are_no_two_tones(options, name):
    track = options.track(NO_TWO_TONES[name], INTERVAL)
    assert not track.valid.any()


@pytest.mark.parametrize("noise", [0.0, 1e-6, 1e-3, 0.05, 0.3])
@pytest.mark.parametrize("options", ONLINE, ids=lambda options: options.kind)
def test_valid_estimates_are_right(options, noise):
    y = CLEAN + noise * NOISE
    track = options.track(y, INTERVAL)
    error = np.abs(track.frequencies - TRUTH)
    valid = track.valid
    assert (error[valid] < 0.1).all()  # valid means: within a tenth of the distance
    if noise <= 1e-3:
        assert valid[-500:].all()
        assert error[-500:].max() < 1e-2


@pytest.mark.parametrize("options", ONLINE, ids=lambda options: options.kind)
def test_flags_say_what_is_wrong(options):
    def flags(name):
        return Flag(int(options.track(NO_TWO_TONES[name], INTERVAL).flags[-1]))

    assert flags("zero") & Flag.UNDETERMINED
    assert flags("noise") & Flag.UNCERTAIN
    assert flags("a large bias") & (Flag.UNCERTAIN | Flag.COMPLEX_ROOTS | Flag.OUT_OF_BOUNDS)
    assert flags("an alias") & Flag.INCONSISTENT


@pytest.mark.parametrize("jump", [True, False])
@pytest.mark.parametrize("options", ONLINE, ids=lambda options: options.kind)
def test_no_estimate_from_before_a_step_stays_valid(options, jump):
    true = np.where(T[:, None] < 30.0, [1.8, 3.2], [2.0, 3.0])
    phase = true * T[:, None] if jump else np.vstack([np.zeros(2), np.cumsum(true[:-1], axis=0)]) * INTERVAL
    track = options.track(np.sin(phase).sum(axis=1), INTERVAL)
    error = np.abs(track.frequencies - true).max(axis=1)
    assert track.valid[2990:3000].all()
    assert (track.valid & (error > 0.1)).sum() <= 5  # until the residual reveals it


def test_rows_of_two_signals_bear_nothing_out():
    # A slow estimate keeps the old frequencies, and checked rows from both sides of the step match them for a while.
    true = np.where(T[:, None] < 30.0, [1.8, 3.2], [2.0, 3.0])
    y = np.sin(true[:, 0] * T) + np.cos(true[:, 1] * T)
    track = DremFiniteTime(tones=2, h=0.7, d=0.4, epsilon=0.1, power="literal").track(y, INTERVAL)
    assert track.valid[2900:3000].all()
    assert not track.valid[3005:].any()


@pytest.mark.parametrize("options", [{}, {"gated": False}, {"power": "literal"}])
def test_an_estimate_that_converges_stays_valid(options):
    # Its residuals fall below the resolution of second moments.
    tuning = {"h": 0.1, "d": 0.13, "epsilon": 100.0, "gamma": 0.005, "initial_frequencies": (2.0, 5.0)}
    track = DremGradient(tones=2, **tuning, **options).track(CLEAN, INTERVAL)
    assert track.valid[-500:].all()
    assert track.valid[np.argmax(track.valid) :].all()
    assert np.abs(track.frequencies[track.valid] - TRUTH).max() < 1e-3


@pytest.mark.parametrize("scale", [1e-25, 1e25])
@pytest.mark.parametrize("options", ONLINE, ids=lambda options: options.kind)
def test_extreme_amplitudes_give_no_wrong_number(options, scale):
    with np.errstate(all="raise"):
        track = options.track(scale * CLEAN, INTERVAL)
    if track.valid.any():
        assert np.abs(track.frequencies[track.valid] - TRUTH).max() < 0.1


STREAM = 0.004 * np.arange(4000)
ENDS = STREAM >= 10.0
SINE = np.sin(75.0 * STREAM + 0.4)
#: Events of a tone of 75 rad/s at 10 s; a gap ends there.
EVENTS = {
    "a small spike": SINE + (np.arange(STREAM.size) == 2500),
    "a spike": SINE + 10.0 * (np.arange(STREAM.size) == 2500),
    "a huge spike": SINE + 1e6 * (np.arange(STREAM.size) == 2500),
    "a gap": np.where((STREAM > 9.8) & ~ENDS, np.nan, SINE),
    "10 degrees": np.sin(75.0 * STREAM + 0.4 + 0.17 * ENDS),
    "90 degrees": np.sin(75.0 * STREAM + 0.4 + 1.57 * ENDS),
    "another frequency": np.sin(75.0 * STREAM + 0.4 + 3.0 * ENDS * (STREAM - 10.0)),
    "twice the amplitude": SINE + ENDS * SINE,
    "another tone": SINE + 0.3 * ENDS * np.sin(94.0 * STREAM),
    "a weak tone": SINE + 0.1 * ENDS * np.sin(94.0 * STREAM),
    "a tone far away": SINE + 0.5 * ENDS * np.sin(190.0 * STREAM),
}
DELAYS = {"h": 0.024, "prefilter": 0.048}


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("event", EVENTS)
@pytest.mark.parametrize(
    "options",
    [RestartingLeastSquares(tones=1, memory=0.4, **DELAYS), DremWindow(tones=1, d=0.008, memory=0.4, **DELAYS)],
    ids=lambda options: options.kind,
)
def test_in_a_stream_an_event_makes_valid_estimates_wrong_for_a_stated_time_only(options, event, seed):
    # All samples in the memory, the delays and the prefilter are then from after the event.
    until = options.memory + options.prefilter + 2 * options.h
    y = EVENTS[event] + 0.007 * np.random.default_rng(seed).standard_normal(STREAM.size)
    track = options.track(y, 0.004)
    true = np.where(ENDS & ("frequency" in event), 78.0, 75.0)
    error = np.abs(track.frequencies[:, 0] - true)
    assert not (track.valid & (error > 0.1 * true)).any()
    assert not (track.valid & (error > 0.05 * true))[STREAM > 10.0 + until].any()
    assert track.valid[-500:].mean() > 0.9
    assert track.valid[1000:2400].all()
