"""Peaks of the median spectrum: every tone that is there most of the time, and nothing else."""

import numpy as np
import pytest

from ctid_cli.frequency.spectrum import find_peaks, median_spectrum

T = 0.01 * np.arange(4000)


def test_tones_are_found_with_their_amplitudes():
    peaks = find_peaks(2.0 * np.sin(20.0 * T) + np.sin(35.0 * T + 1.0) + 0.1 * np.sin(90.0 * T), 0.01, 3)
    assert peaks.omega == pytest.approx([20.0, 35.0, 90.0], rel=1e-3)
    assert peaks.amplitudes == pytest.approx([2.0, 1.0, 0.1], rel=0.02)


def test_side_lobes_and_noise_are_no_peaks():
    clean = np.sin(20.3 * T)
    assert find_peaks(clean, 0.01, 1).omega.size == 1
    # A whole number of periods: the side lobes have exact zeros between them.
    assert find_peaks(np.sin(2 * np.pi * 3.0 * T) + np.sin(2 * np.pi * 9.0 * T), 0.01, 2).omega.size == 2
    noise = np.random.default_rng(1).standard_normal(T.size)
    assert find_peaks(noise, 0.01, 1).omega.size == 0
    assert find_peaks(clean + 0.3 * noise, 0.01, 1).omega == pytest.approx([20.3], rel=1e-3)


def test_what_lasts_counts_more_than_what_is_loud():
    burst = np.where(T < 4.0, 8.0 * np.sin(60.0 * T), 0.0)
    peaks = find_peaks(np.sin(20.0 * T) + burst, 0.01, 1)
    assert peaks.omega[0] == pytest.approx(20.0, rel=1e-3)


def test_long_segments_tell_close_tones_apart_and_short_ones_stand_a_sweep():
    close = find_peaks(np.sin(20.0 * T) + np.sin(20.7 * T) + 0.2 * np.sin(60.0 * T), 0.01, 2)
    assert np.sort(close.omega[:2]) == pytest.approx([20.0, 20.7], rel=5e-3)
    sweep = find_peaks(np.sin(20.0 * T + 0.5 * T**2), 0.01, 1)
    assert sweep.segment < 0.25 * close.segment
    assert 20.0 < sweep.omega[0] < 60.0


def test_gaps_are_bridged_and_segments_full_of_them_left_out():
    y = np.sin(20.0 * T)
    y[::40] = np.nan
    assert find_peaks(y, 0.01, 1).omega[0] == pytest.approx(20.0, rel=1e-3)
    missing = np.zeros(T.size, bool)
    missing[: T.size // 2] = True
    assert median_spectrum(np.ones(T.size), missing, 0.1, T.size) is None


def test_units_of_time_and_signal_only_scale():
    y = np.sin(20.0 * T) + 0.5 * np.sin(33.0 * T)
    one, other = find_peaks(y, 0.01, 2), find_peaks(1e3 * y, 1e-5, 2)
    assert other.omega == pytest.approx(1e3 * one.omega, rel=1e-12)
    assert other.amplitudes == pytest.approx(1e3 * one.amplitudes, rel=1e-9)
    assert other.resolution == pytest.approx(1e3 * one.resolution)
