"""Estimates of one window, of which some tones are wanted."""

import numpy as np
import pytest

from ctid_cli.frequency.esprit import Esprit
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.tracking import FrequencyEstimate
from ctid_cli.frequency.windows import belonging, estimate_window, sinusoids_of, wanted_tones

T = 0.05 * np.arange(300)
Y = np.sin(2.0 * T) + 0.5 * np.sin(3.1 * T + 1.0) + 0.2 * np.sin(7.0 * T)


def test_wanted_tones_are_kept_whatever_their_order():
    found = estimate_window(Esprit(tones=3), Y, 0.05, np.array([7.1, 2.1, 3.0]), 2)
    assert found.omega == pytest.approx([2.0, 7.0], abs=1e-9)
    assert found.everything == pytest.approx([2.0, 3.1, 7.0], abs=1e-9)
    assert found.flags == 0
    amplitudes, phases = sinusoids_of(Y, 0.05, found.omega, found.everything, 10.0)
    assert amplitudes == pytest.approx([1.0, 0.2], abs=1e-6)
    assert np.sin(phases) == pytest.approx(np.sin([20.0, 70.0]), abs=1e-6)


def test_a_tone_that_nobody_wants_spoils_nothing():
    uncertain = FrequencyEstimate(
        np.array([1.0, 2.0, 3.0]),
        Flag.UNCERTAIN | Flag.OUT_OF_BOUNDS | Flag.INCONSISTENT,
        np.array([np.inf, 0.01, 0.01]),
    )
    expected = np.array([2.1, 3.1, 1.1])
    assert wanted_tones(uncertain, expected, 2).flags == Flag.INCONSISTENT
    assert Flag.UNCERTAIN in wanted_tones(uncertain, np.array([2.1, 1.1, 3.1]), 2).flags
    assert wanted_tones(uncertain, expected, 3).flags == uncertain.flags


def test_tones_that_are_not_in_the_window_are_left_out():
    y = np.sin(2.0 * T) + np.sin(3.1 * T)
    found = estimate_window(Esprit(tones=4), y, 0.05, np.array([2.0, 3.1, 5.0, 6.0]), 2)
    assert found.omega == pytest.approx([2.0, 3.1], abs=1e-8)
    assert Flag.UNDETERMINED not in found.flags


def test_nothing_to_estimate():
    y = np.where(T == T[40], np.nan, Y)
    assert estimate_window(Esprit(tones=3), y, 0.05, np.array([2.01, 3.08, 6.97]), 3).flags == Flag.GAP
    found = estimate_window(Esprit(tones=2), np.sin(T[:6]), 0.05, np.array([1.0, 2.0]), 2)
    assert found.flags == Flag.UNDETERMINED
    assert np.isnan(found.omega).all()
    assert np.isnan(sinusoids_of(Y, 0.05, found.omega, found.everything, 0.0)).all()


def test_belonging_prefers_the_nearest_in_ratio():
    assert belonging(np.array([50.0, 100.0, 210.0]), np.array([200.0, 52.0, 101.0]), 3).tolist() == [2, 0, 1]


def test_a_disturbing_tone_that_is_not_found_does_not_push_the_others_along():
    expected = np.array([146.44, 293.7, 440.34, 109.65, 163.91, 733.56, 99.45])
    found = np.array([99.52, 109.79, 146.45, 293.72, 440.36, 733.86])
    assert belonging(found, expected, 3).tolist() == [2, 3, 4]
    assert belonging(found[2:], expected, 3).tolist() == [0, 1, 2]
    # one stray estimate, not three that are all a little off
    assert belonging(found, expected[:6], 3).tolist() == [2, 3, 4]


def test_a_wanted_tone_is_always_there():
    assert belonging(np.array([1.0, 5.0]), np.array([1.0, 2.0, 5.0, 5.1]), 2).tolist() == [0, 1]
