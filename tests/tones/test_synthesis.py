"""Signal described by the rows of a track."""

import numpy as np
import pytest

from ctid_cli.frequency.flags import Flag
from ctid_cli.tones.residual import synthesised
from ctid_cli.tones.track import Track

T = 0.001 * np.arange(3950)
ROWS = 0.1 + 0.05 * np.arange(76)


def sweep(t):
    """Return phase, frequency and rate of a tone of rising frequency, and its falling amplitude."""
    return 100.0 * t + 2.0 * t**2, 100.0 + 4.0 * t, np.full(t.size, 4.0), np.exp(-0.3 * t)


def track_of(rows=ROWS, **changed):
    phase, omega, rate, amplitude = (part[:, None] for part in sweep(rows))
    known = {"phase": phase, "rate": rate, "amplitudes": amplitude, "growth": np.full((rows.size, 1), -0.3)}
    known |= {"window": np.full((rows.size, 1), 0.2)} | changed
    return Track.of(rows, omega, np.zeros(rows.size, np.uint16), 0.05, **known)


def test_rows_that_are_true_give_the_signal_back():
    phase, _, _, amplitude = sweep(T)
    assert synthesised(track_of(), T) == pytest.approx(amplitude * np.sin(phase), abs=1e-9)


def test_a_row_that_is_not_known_makes_a_gap_around_it_and_one_without_the_tone_none():
    amplitudes = sweep(ROWS)[3][:, None].copy()
    amplitudes[10] = np.nan
    unknown = np.isnan(synthesised(track_of(amplitudes=amplitudes), T))
    assert unknown[551:650].all()
    assert not unknown[:550].any()
    assert not unknown[651:].any()
    track = track_of()
    absent = Track.of(ROWS, np.full((76, 1), np.nan), np.full(76, int(Flag.ABSENT), np.uint16), 0.05)
    assert (synthesised(absent, T)[100:3850] == 0.0).all()
    assert not np.isnan(synthesised(track, T)).any()


def test_far_from_the_rows_nothing_is_known():
    far = synthesised(track_of(ROWS[:20]), T)
    assert np.isfinite(far[: 1051 + 98]).all()
    assert np.isnan(far[1051 + 102 :]).all()
