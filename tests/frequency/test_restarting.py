"""Recommended tracker: least squares against numpy and scipy, alarms, restarts, mixed data, memory."""

import numpy as np
import pytest
from scipy import linalg

from ctid_cli.frequency.delay_regression import delay_table
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares, noise_covariance
from tests.frequency.signals import INTERVAL, OMEGA, frequencies_of, regression_rows, tones

H, LAG = 0.4, 40


def tracker(n=2, h=H, **options):
    return RestartingLeastSquares(tones=n, h=h, **options)


def rows_of(y, n):
    psi, phi = regression_rows(y, n, LAG)
    rows = np.column_stack([phi, psi])
    return rows[np.isfinite(psi)]


def noisy(n, count=1500, noise=0.02):
    return tones(n, count).sum(axis=1) + noise * np.random.default_rng(n).standard_normal(count)


def alarms(track):
    changed = (track.flags & Flag.CHANGED) > 0
    return np.flatnonzero(changed[1:] & ~changed[:-1]) + 1


@pytest.mark.parametrize("n", range(1, 6))
def test_estimate_is_least_squares_over_all_rows(n):
    y = noisy(n)[: 1500 - (1500 - 2 * n * LAG) % 10]  # the estimate is refreshed every ten rows
    track, rows = tracker(n).track(y, INTERVAL), rows_of(y, n)
    theta = np.linalg.lstsq(rows[:, :n], rows[:, n], rcond=None)[0]
    np.testing.assert_allclose(track.frequencies[-1], frequencies_of(theta, H)[0], atol=1e-7)


@pytest.mark.parametrize("prefilter", [0.0, 0.3, 1.0])
def test_total_least_squares_is_the_smallest_generalised_eigenvector(prefilter):
    n, y = 2, noisy(2, 1500, 0.2)
    options = tracker(n, prefilter=prefilter, solution="total_least_squares")
    track, weights = options.track(y, INTERVAL), options.weights(INTERVAL)
    filtered = np.convolve(y, weights, mode="valid")
    rows = rows_of(filtered, n)
    rows = rows[: rows.shape[0] // 10 * 10]
    C = noise_covariance(delay_table(n), weights, LAG)
    v = linalg.eigh(rows.T @ rows, C)[1][:, 0]
    np.testing.assert_allclose(track.frequencies[-1], frequencies_of(-v[:n] / v[n], H)[0], atol=1e-8)


@pytest.mark.parametrize("length", [0.0, 0.3, 1.0])
def test_noise_covariance_is_that_of_the_rows_of_filtered_noise(length):
    weights = tracker(prefilter=length).weights(INTERVAL)
    noise = np.convolve(np.random.default_rng(0).standard_normal(400_000), weights, mode="valid")
    rows = rows_of(noise / np.linalg.norm(weights), 2)
    C = noise_covariance(delay_table(2), weights, LAG)
    np.testing.assert_allclose(rows.T @ rows / len(rows), C, atol=0.05 * C.max())
    if not length:
        np.testing.assert_array_equal(C, delay_table(2) @ delay_table(2).T)


@pytest.mark.parametrize("n", range(1, 6))
@pytest.mark.parametrize("prefilter", [0.0, 0.5])
def test_exact_in_finite_time_and_honest_before(n, prefilter):
    track = tracker(n, prefilter=prefilter).track(tones(n, 3000).sum(axis=1), INTERVAL)
    first = 2 * n * LAG + round(prefilter / INTERVAL)
    assert np.isnan(track.frequencies[:first]).all()
    error = np.abs(track.frequencies - OMEGA[n]).max(axis=1)
    assert error[first + (10 if n < 3 else 200) :].max() < (1e-8 if n < 5 else 1e-4)
    assert not track.valid[: first + n * LAG // 4 - 1].any()
    assert track.valid[first + n * LAG :].mean() > 0.99
    assert error[track.valid].max() < (1e-8 if n < 5 else 1e-4)


def test_a_step_raises_one_alarm_and_is_exact_again_after_the_flush():
    y = np.concatenate((tones(2, 1500).sum(axis=1), 2.0 * tones(2, 1500, omega=[1.3, 2.5]).sum(axis=1)))
    for prefilter in (0.0, 0.5):
        flush = 2 * 2 * LAG + round(prefilter / INTERVAL) + 1
        track = tracker(prefilter=prefilter).track(y, INTERVAL)
        (alarm,) = alarms(track)
        assert 1500 <= alarm <= 1510
        assert np.flatnonzero(track.flags & Flag.CHANGED)[-1] == alarm + flush
        assert (track.frequencies[alarm : alarm + flush] == track.frequencies[alarm]).all()  # held
        # The ring buffer has no samples from before the change when the first row is used.
        assert np.abs(track.frequencies[alarm + flush + 20 :] - [1.3, 2.5]).max() < 1e-8
        assert track.valid[-500:].all()
        assert not track.valid[alarm : alarm + flush + 2 * LAG // 4].any()


def test_noise_raises_no_alarm_but_a_step_does():
    rng = np.random.default_rng(0)
    y = tones(2, 20_000).sum(axis=1) + 0.1 * rng.standard_normal(20_000)
    for prefilter in (0.0, 0.6):
        assert not alarms(tracker(h=1.0, prefilter=prefilter).track(y, INTERVAL)).size
    y[10_000:] = tones(2, 10_000, omega=[1.3, 2.5]).sum(axis=1) + 0.1 * rng.standard_normal(10_000)
    track = tracker(h=1.0, prefilter=0.6).track(y, INTERVAL)
    (alarm,) = alarms(track)
    assert 10_000 < alarm < 10_300
    np.testing.assert_allclose(track.frequencies[[9990, -1]], [OMEGA[2], [1.3, 2.5]], atol=5e-3)


def test_a_second_change_during_the_flush_is_found_by_comparing_halves():
    # 1.0 -> 1.6 -> 1.3 rad/s, half a second apart: the restart uses rows that mix the last two.
    t = INTERVAL * np.arange(4000)
    rate = np.select([t < 15.0, t < 15.5], [1.0, 1.6], 1.3)
    y = np.sin(np.concatenate(([0.0], np.cumsum(rate[:-1]) * INTERVAL))) + np.sin(2.2 * t)
    track = tracker().track(y, INTERVAL)
    assert alarms(track).size == 1
    final = [1.3, 2.2]
    error = np.abs(track.frequencies - final).max(axis=1)
    # Twice the first comparison, 1.43 h, after the restart.
    restart = alarms(track)[0] + 4 * LAG + 2
    settled = restart + 2 * 57
    assert error[settled - 10] > 1e-3
    assert error[settled + 10 :].max() < 1e-9
    mixed = slice(restart, settled - 1)
    assert not track.valid[mixed][error[mixed] > 0.02].any()


@pytest.mark.parametrize("memory", [2.0, 3.5])
def test_older_rows_are_forgotten_exponentially(memory):
    y = noisy(2, 1560)
    track = tracker(memory=memory).track(y, INTERVAL)
    assert not alarms(track).size
    rows = rows_of(y, 2)
    most = round(memory / INTERVAL)
    # All rows have equal weights until the memory is full; every further row reduces the weights of the others.
    weights = (1.0 - 1.0 / most) ** np.clip(np.arange(len(rows))[::-1], 0, len(rows) - most)
    root = np.sqrt(weights)[:, None]
    theta = np.linalg.lstsq(root * rows[:, :2], root[:, 0] * rows[:, 2], rcond=None)[0]
    np.testing.assert_allclose(track.frequencies[-1], frequencies_of(theta, H)[0], atol=1e-9)
    without = np.linalg.lstsq(rows[:, :2], rows[:, 2], rcond=None)[0]
    assert np.abs(track.frequencies[-1] - frequencies_of(without, H)[0]).max() > 1e-3


def test_a_difference_removes_a_bias():
    y = tones(2, 2000).sum(axis=1)
    assert not tracker().track(y + 0.5, INTERVAL).valid.any()
    track = tracker(difference=1.0).track(y + 0.5, INTERVAL)
    assert track.valid[-1000:].all()
    np.testing.assert_allclose(track.frequencies[-1], OMEGA[2], atol=1e-9)


def test_gaps_are_waited_for_and_passed():
    y = tones(2, 2000).sum(axis=1)
    y[1000:1010] = np.nan
    y[1100] = np.inf
    track = tracker(prefilter=0.2).track(y, INTERVAL)
    gaps = (track.flags & Flag.GAP) > 0
    assert not track.valid[gaps].any()
    assert np.flatnonzero(gaps)[0] == 1000
    assert np.flatnonzero(gaps)[-1] == 1100 + 20 + 4 * LAG
    assert track.valid[1100 + 20 + 4 * LAG + 1 :].all()
    assert np.abs(track.frequencies[300:] - OMEGA[2]).max() < 1e-7
    # Without samples there are no estimates.
    silent = tracker().track(np.full(500, np.nan), INTERVAL)
    assert (silent.flags == Flag.STARTING).all()
    assert np.isnan(silent.frequencies).all()
