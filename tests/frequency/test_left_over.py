"""Lines that the tones of a track leave over."""

from dataclasses import replace

import numpy as np
import pytest

from ctid_cli.frequency.left_over import left_over, with_lines_left
from ctid_cli.frequency.record_tones import follow_tones
from ctid_cli.frequency.record_track import MissingLine, RecordTrack

INTERVAL = 0.002
T = INTERVAL * np.arange(10_000)
NOISE = 0.01 * np.random.default_rng(0).standard_normal(T.size)


def tracked(y, tones):
    return with_lines_left(replace(follow_tones(y, INTERVAL, tones)[0], missing=()), y, INTERVAL)


def test_a_second_tone_that_nobody_asked_for_is_named():
    y = np.sin(2 * np.pi * 60.0 * T) + 0.1 * np.sin(2 * np.pi * 85.0 * T) + NOISE
    (line,) = tracked(y, 1).missing
    assert line.omega / (2 * np.pi) == pytest.approx(85.0, abs=0.05)
    assert line.amplitude == pytest.approx(0.1, rel=0.05)
    assert tracked(y, 2).missing == ()


def test_a_tone_that_moves_leaves_no_line_beside_itself():
    y = np.sin(2 * np.pi * (60.0 * T + 0.2 * T**2)) + NOISE
    assert tracked(y, 1).missing == ()


def test_a_method_that_names_lines_itself_is_believed():
    lines = (MissingLine(300.0, 1.0, 0.1),)
    track = RecordTrack.of(T[:3], np.full((3, 1), 100.0), np.zeros(3, np.uint16), INTERVAL, missing=lines)
    assert with_lines_left(track, NOISE, INTERVAL) is track


def test_where_nothing_is_known_nothing_is_named():
    track = RecordTrack.of(T[:3], np.full((3, 1), 100.0), np.zeros(3, np.uint16), INTERVAL)
    assert with_lines_left(track, NOISE, INTERVAL).missing == ()


def test_a_spike_is_not_what_the_tones_leave():
    y = np.sin(2 * np.pi * 60.0 * T) + NOISE
    track, _ = follow_tones(y, INTERVAL, 1)
    y[4000] = 1e6
    left = left_over(y, INTERVAL, track)
    assert left.unknown[4000]
    assert np.abs(left.residual[~left.unknown]).max() < 0.1
