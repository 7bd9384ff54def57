"""Gradient, finite time and sliding window against plain numpy versions, exactness, and invariance to scaling."""

import numpy as np
import pytest

from ctid_cli.frequency.delay_regression import theta_of
from ctid_cli.frequency.drem import DremFiniteTime, DremGradient, DremWindow
from ctid_cli.frequency.drem_kernels import slide
from ctid_cli.frequency.flags import Flag
from tests.frequency.signals import INTERVAL, OMEGA, frequencies_of, regression_rows, tones

H, D = 0.4, 0.3
LAG, SPACING = 40, 30
COUNT = 2500


def mixed_regressions(y, n, first_row, lag=LAG, spacing=SPACING):
    """Return Psi (N, n) and Delta (N,) from numpy's determinants; NaN for missing rows."""
    psi, phi = regression_rows(y, n, lag)
    right, delta = np.full((y.size, n), np.nan), np.full(y.size, np.nan)
    for k in range(2 * n * lag + (first_row + n - 1) * spacing, y.size):
        places = k - (first_row + np.arange(n)) * spacing
        matrix = phi[places]
        delta[k] = np.linalg.det(matrix)
        for i in range(n):
            replaced = matrix.copy()
            replaced[:, i] = psi[places]
            right[k, i] = np.linalg.det(replaced)
    return right, delta


def noisy(n, count=COUNT, noise=0.01):
    return tones(n, count).sum(axis=1) + noise * np.random.default_rng(n).standard_normal(count)


def decoded(theta, h=H):
    return np.array([frequencies_of(row, h)[0] for row in theta])


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("first_row", [0, 1])
def test_gradient_and_finite_time_are_the_published_recursions(n, first_row):
    # theta' = gamma Delta (Psi - Delta theta) solved over each interval, W' = -gamma Delta^2 W, and the finite-time
    # estimate (theta - theta(0) W)/(1 - W), directly from numpy's determinants.
    y = noisy(n)
    epsilon, gamma = 0.3, np.array([3.0, 1.0, 2.0])[:n]
    initial = tuple(1.2 * OMEGA[n])
    right, delta = mixed_regressions(y, n, first_row)
    theta, W = np.array([theta_of(initial, H)] * (y.size + 1)), np.ones((y.size + 1, n))
    for k in range(y.size):
        theta[k + 1], W[k + 1] = theta[k], W[k]
        if np.isfinite(delta[k]):
            x = gamma * (epsilon * delta[k]) ** 2 * INTERVAL
            theta[k + 1] = right[k] / delta[k] + (theta[k] - right[k] / delta[k]) * np.exp(-x)
            W[k + 1] = W[k] * np.exp(-x)
    options = {
        "tones": n,
        "h": H,
        "d": D,
        "epsilon": epsilon,
        "gamma": tuple(gamma),
        "first_row": first_row,
        "initial_frequencies": initial,
    }
    gradient = DremGradient(**options).track(y, INTERVAL).frequencies
    np.testing.assert_allclose(gradient, decoded(theta[1:]), atol=1e-8)
    finite = DremFiniteTime(**options).track(y, INTERVAL).frequencies
    begun = W[1:].max(axis=1) < 0.99
    assert begun.sum() > 1000
    literal = (theta[1:] - theta[0] * W[1:]) / np.where(W[1:] < 1, 1 - W[1:], np.nan)
    np.testing.assert_allclose(finite[begun], decoded(literal[begun]), atol=1e-7)
    # The initial frequencies are shown until the first mixed row.
    assert np.array_equal(np.unique(finite[: np.flatnonzero(np.isfinite(delta))[0]], axis=0), finite[:1])
    np.testing.assert_allclose(finite[0], initial, rtol=1e-9)


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("memory", [0.5, 3.0, 100.0])
def test_window_is_least_squares_on_the_mixed_regressions_of_the_window(n, memory):
    y = noisy(n)
    right, delta = np.nan_to_num(mixed_regressions(y, n, 1)[0]), np.nan_to_num(mixed_regressions(y, n, 1)[1])
    length = round(memory / INTERVAL)
    track = DremWindow(tones=n, h=H, d=D, memory=memory).track(y, INTERVAL)
    first = 2 * n * LAG + n * SPACING
    assert np.isnan(track.frequencies[:first]).all()
    for k in (first, first + 20, first + 150, 1234, COUNT - 1):
        part = slice(max(0, k + 1 - length), k + 1)
        theta = (delta[part] @ right[part]) / (delta[part] @ delta[part])
        np.testing.assert_allclose(track.frequencies[k], frequencies_of(theta, H)[0], atol=1e-8)


def test_sliding_sums_hold_the_window_and_nothing_else():
    rng = np.random.default_rng(0)
    values = rng.standard_normal((100, 2)) * 10.0 ** rng.uniform(-8, 8, (100, 1))
    sums = np.empty(values.shape)
    slide(values, np.zeros((7, 2)), np.zeros(2), np.zeros(1, np.int64), sums)
    for k in range(100):
        part = values[max(0, k - 6) : k + 1]
        # The rounding is at most that of the sum itself, although much larger numbers have been added and removed.
        np.testing.assert_allclose(sums[k], part.sum(axis=0), rtol=0, atol=1e-15 * np.abs(part).sum(axis=0).max())


@pytest.mark.parametrize("n", range(1, 6))
@pytest.mark.parametrize("first_row", [0, 1])
def test_finite_time_is_exact_from_its_first_row_on(n, first_row):
    y = tones(n, 3000).sum(axis=1)
    first = 2 * n * LAG + (first_row + n - 1) * SPACING
    for options in (
        DremFiniteTime(tones=n, h=H, d=D, epsilon=0.3, first_row=first_row),
        DremWindow(tones=n, h=H, d=D, memory=5.0, first_row=first_row),
    ):
        track = options.track(y, INTERVAL)
        error = np.abs(track.frequencies - OMEGA[n]).max(axis=1)
        assert error[first + 1 :].max() < (1e-9 if n < 5 else 1e-4)
        assert error[-1] < 1e-8
        assert not track.valid[:first].any()
        # Valid once n h/4 of rows have agreed, and from then on.
        assert track.valid[first + n * LAG // 4 :].all()
        assert np.array_equal(np.flatnonzero(track.valid), np.arange(first - 1 + n * LAG // 4, y.size))


def test_gains_of_any_size_are_stable():
    # The explicit step would diverge beyond gamma Delta^2 Ts = 2.
    for gamma in (1e-12, 1e6, 1e12):
        y = tones(2, 3000).sum(axis=1)
        track = DremFiniteTime(tones=2, h=H, d=D, gamma=gamma).track(y, INTERVAL)
        np.testing.assert_allclose(track.frequencies[-1], OMEGA[2], atol=1e-9)
        track = DremGradient(tones=2, h=H, d=D, gamma=gamma).track(y, INTERVAL)
        assert np.isfinite(track.frequencies).all()


def test_zero_filled_delays_enter_the_estimate():
    y = tones(2, 3000).sum(axis=1)
    gated = DremFiniteTime(tones=2, h=H, d=D).track(y, INTERVAL)
    filled = DremFiniteTime(tones=2, h=H, d=D, gated=False).track(y, INTERVAL)
    padded = DremFiniteTime(tones=2, h=H, d=D).track(np.concatenate((np.zeros(300), y)), INTERVAL)
    # Zero-filled delays equal a signal that was always zero before, from the first complete row on.
    np.testing.assert_allclose(filled.frequencies[:], padded.frequencies[300:], atol=1e-9)
    error = np.abs(filled.frequencies - OMEGA[2]).max(axis=1)
    assert error[2 * 2 * LAG + 2 * SPACING] > 1e-3
    assert np.abs(gated.frequencies[2 * 2 * LAG + 2 * SPACING] - OMEGA[2]).max() < 1e-9


def test_rounded_delays_cost_nothing():
    # h = 0.1 s is not a multiple of 3 ms: 0.099 s is used, in the arc cosine too.
    t = 0.003 * np.arange(1000)
    y = np.sin(2 * t) + np.cos(3 * t)
    options = DremFiniteTime(tones=2, h=0.1, d=0.13, epsilon=100.0, gamma=0.005)
    note = "h = 0.1 s is no whole number of sampling intervals of 0.003 s; 0.099 s is used."
    assert list(options.warnings(0.003, 3.0)) == [("h", note)]
    assert list(options.warnings(0.01, 3.0)) == []
    np.testing.assert_allclose(options.track(y, 0.003).frequencies[-1], [2.0, 3.0], atol=1e-9)


def test_a_missing_sample_is_a_gap_until_it_leaves_the_delays():
    y = tones(2, 1500).sum(axis=1)
    y[900] = np.nan
    track = DremFiniteTime(tones=2, h=H, d=D).track(y, INTERVAL)
    gaps = np.flatnonzero(track.flags & Flag.GAP)
    lags = np.add.outer(np.arange(5) * LAG, np.array([1, 2]) * SPACING)
    assert np.array_equal(gaps, np.unique(900 + lags))
    assert not track.valid[gaps].any()
    assert np.abs(track.frequencies[300:] - OMEGA[2]).max() < 1e-9


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(({"tones": n}, f"tones must be an integer from 1 to 8, not {n}") for n in (0, 9, 2.0, True)),
        ({"gamma": (1.0, 2.0, 3.0)}, r"gamma must hold one number for each of the 2 tones, not \(1.0, 2.0, 3.0\)"),
        ({"initial_frequencies": (1.0,)}, "initial_frequencies must hold one number for each of the 2 tones"),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        DremFiniteTime(**{"tones": 2, "h": H, "d": D, **options})
