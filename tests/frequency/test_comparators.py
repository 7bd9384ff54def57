"""The derived comparators: their filters and observers against scipy and plain formulas, and their convergence."""

import numpy as np
import pytest
from scipy import signal

from ctid_cli.frequency.adaptive_observer import AdaptiveObserver
from ctid_cli.frequency.filter_regression import FilterRegression, derivative_rows
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.frequency_kernels import observer_slope, place_poles
from tests.frequency.signals import INTERVAL, OMEGA, tones


def settled(track, omega, band):
    """Samples after the last error outside a band."""
    return track.t.size - 1 - np.flatnonzero(np.abs(track.omega - omega).max(axis=1) > band)[-1]


# Filter regression -------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 3])
def test_rows_are_derivatives_of_the_filtered_signal(n):
    # At s = j w: w_j = (l/(s + l))^j y, and row k is (-1)^(k + 1) s^(2 (n - k)) w_2n, the last s^(2 n) w_2n.
    pole, s = 3.0, 1.7j
    chain = (pole / (s + pole)) ** np.arange(2 * n + 1)
    rows = derivative_rows(n, pole) @ chain
    for k in range(1, n + 1):
        assert rows[k - 1] == pytest.approx((-1) ** (k + 1) * s ** (2 * (n - k)) * chain[-1], rel=1e-12)
    assert rows[n] == pytest.approx(s ** (2 * n) * chain[-1], rel=1e-12)


@pytest.mark.parametrize("n", [1, 2])
def test_chain_is_that_of_scipy_for_a_linearly_held_signal(n):
    y = tones(n, 600).sum(axis=1)
    tracker = FilterRegression(tones=n, pole=3.0).start(INTERVAL)
    tracker.run(y)
    for order in range(1, 2 * n + 1):
        system = signal.lti([3.0**order], np.poly(np.full(order, -3.0)))
        # The first sample is where the chain is at rest.
        _, expected, _ = signal.lsim(system, y, INTERVAL * np.arange(y.size))
        assert tracker.state()["chain"][order] == pytest.approx(expected[-1], rel=1e-9)


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("algorithm", ["least_squares", "gradient"])
def test_filter_converges_to_the_frequencies(n, algorithm):
    options = FilterRegression(
        tones=n,
        pole=3.0,
        algorithm=algorithm,
        gains=tuple(20.0 * 4.0 ** np.arange(n)) if algorithm == "gradient" else None,
        initial_frequencies=tuple(OMEGA[n] * 1.1),
    )
    errors = []
    for finer in (1, 2):
        interval = INTERVAL / finer
        track = options.start(interval).run(tones(n, 12_000 * finer, interval).sum(axis=1))
        errors.append(np.abs(track.omega[-1] - OMEGA[n]).max())
        if algorithm == "least_squares":
            assert track.valid[-3000 * finer :].all()
    # Lines between the samples are all that is wrong with it: an error of second order, or one that falls faster.
    assert errors[0] < (1e-3 if algorithm == "least_squares" else 0.05)
    assert 3.0 < errors[0] / errors[1] < 9.0


def test_filter_gradient_is_implicit_and_normalised():
    # a += Ts K phi e/(1 + Ts phi' K phi) with phi = z, regressand z'' = -w^2 z; z and z'' from scipy's filters.
    pole, gain = 3.0, 5.0
    y = tones(1, 400).sum(axis=1)
    t = INTERVAL * np.arange(y.size)
    once = signal.lsim(signal.lti([pole], [1.0, pole]), y, t)[1]
    z = signal.lsim(signal.lti([pole**2], [1.0, 2 * pole, pole**2]), y, t)[1]
    second = pole**2 * (y - 2 * once + z)
    square = 1.5**2
    for k in range(1, y.size):
        error = -second[k] - z[k] * square
        square += INTERVAL * gain * z[k] * error / (1 + INTERVAL * gain * z[k] ** 2)
    options = FilterRegression(tones=1, pole=pole, algorithm="gradient", gains=(gain,), initial_frequencies=(1.5,))
    tracker = options.start(INTERVAL)
    tracker.run(y)
    assert abs(tracker.state()["estimate"][0, 0]) == pytest.approx(square, rel=1e-9)


def test_filter_fills_again_after_a_gap():
    y = tones(2, 6000).sum(axis=1)
    y[3000:3010] = np.nan
    options = FilterRegression(tones=2, pole=3.0)
    track = options.start(INTERVAL).run(y)
    gaps = np.flatnonzero(track.flags & Flag.GAP)
    refill = round(2 * 4 / (3.0 * INTERVAL))
    assert np.array_equal(gaps, np.arange(3000, 3010 + refill + 1))
    assert np.isfinite(track.omega).all()
    assert np.abs(track.omega[-1] - OMEGA[2]).max() < 1e-3


# Observer ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_observer_has_the_poles_that_were_asked_for(n):
    squares, poles, gains = OMEGA[n] ** 2, 2.0 * 1.2 ** np.arange(2 * n), np.empty(2 * n)
    place_poles(squares, poles, gains)
    # The derivative of a unit state is a column of the closed-loop matrix.
    matrix, slope = np.empty((2 * n, 2 * n)), np.empty((n + 1, 2 * n))
    for k in range(2 * n):
        states = np.zeros((n + 1, 2 * n))
        states[0, k] = 1.0
        observer_slope(states, 0.0, squares, gains, slope)
        matrix[:, k] = slope[0]
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(matrix).real), -np.sort(poles)[::-1], rtol=1e-4)
    assert np.poly(matrix) == pytest.approx(np.poly(-poles), rel=1e-8)


def test_sensitivities_are_derivatives_of_the_observer():
    rng = np.random.default_rng(0)
    squares, gains = OMEGA[2] ** 2, rng.standard_normal(4)
    states = rng.standard_normal((3, 4))
    slope, plus, minus = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4))
    observer_slope(states, 0.7, squares, gains, slope)
    for p in range(2):
        # d/dt of the sensitivity is the change of the slope along (sensitivity, unit change of the square).
        for sign, out in ((1, plus), (-1, minus)):
            moved = states.copy()
            moved[0] += sign * 1e-6 * states[p + 1]
            observer_slope(moved, 0.7, squares + sign * 1e-6 * np.eye(2)[p], gains, out)
        np.testing.assert_allclose(slope[p + 1], (plus[0] - minus[0]) / 2e-6, atol=1e-8)


def test_observer_stays_at_the_truth():
    errors = []
    for finer in (1, 2):
        interval = INTERVAL / finer
        track = AdaptiveObserver(tones=2, initial_frequencies=tuple(OMEGA[2])).start(interval)
        error = np.abs(track.run(tones(2, 3000 * finer, interval).sum(axis=1)).omega - OMEGA[2]).max(axis=1)
        assert error.max() < 0.25  # while its states, zero at first, are wrong
        errors.append(error[-1])
    # Lines between the samples are all that is wrong in the end: an error of second order.
    assert errors[0] < 1e-3
    assert 3.0 < errors[0] / errors[1] < 5.0


@pytest.mark.parametrize("n", [1, 2])
def test_observer_converges_from_nearby(n):
    y = tones(n, 9000).sum(axis=1)
    track = AdaptiveObserver(tones=n, initial_frequencies=tuple(OMEGA[n] + 0.3)).start(INTERVAL).run(y)
    assert np.abs(track.omega[-1] - OMEGA[n]).max() < 2e-3
    assert track.valid[-500:].all()


def test_observer_keeps_its_bounds_and_says_so():
    y = np.sin(9.5 * INTERVAL * np.arange(4000))
    options = AdaptiveObserver(tones=2, initial_frequencies=(2.0, 5.0), highest_frequency=6.0)
    track = options.start(INTERVAL).run(y)
    assert (track.omega >= 0.2).all()
    assert (track.omega <= 6.0).all()
    assert (np.diff(track.omega, axis=1) >= 0.3 - 1e-12).all()
    assert (track.flags & Flag.OUT_OF_BOUNDS).any()
    assert not track.valid.any()


def test_observer_runs_on_through_a_gap():
    y = tones(2, 6000).sum(axis=1)
    options = AdaptiveObserver(tones=2, initial_frequencies=tuple(OMEGA[2]))
    whole = options.start(INTERVAL).run(y)
    y[4000:4050] = np.nan
    track = options.start(INTERVAL).run(y)
    assert np.array_equal(np.flatnonzero(track.flags & Flag.GAP), np.arange(4000, 4051))
    assert (track.omega[4000:4050] == track.omega[4000]).all()
    # The prediction is good: nothing happens when the samples come back.
    assert np.abs(track.omega - whole.omega)[4000:].max() < 2e-3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"initial_frequencies": (2.0,)}, "initial_frequencies must hold one number for each of the 2 tones"),
        ({"initial_frequencies": (2.0, 2.1)}, "must rise from lowest_frequency to highest_frequency"),
        ({"initial_frequencies": (3.0, 2.0)}, "must rise from lowest_frequency"),
        ({"initial_frequencies": (0.1, 2.0)}, "must rise from lowest_frequency"),
        ({"initial_frequencies": (2.0, 9.0)}, "must rise from lowest_frequency"),
        ({"ratio": 0.9}, "ratio must be 1 or more"),
        ({"highest_frequency": 0.4}, "2 frequencies, 0.3 rad/s apart, do not fit between"),
        ({"pole": 0.0}, "pole must be a positive number"),
        ({"rate": -1.0}, "rate must be a positive number"),
    ],
)
def test_impossible_observers_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        AdaptiveObserver(**{"tones": 2, "initial_frequencies": (2.0, 5.0), **options})


@pytest.mark.parametrize("pole", [320.0, 1e300])
def test_filters_too_fast_for_the_clock_are_refused(pole):
    with pytest.raises(
        ValueError, match=r"is beyond what samples every 0\.01 s can show; use one below 314\.159 rad/s"
    ):
        FilterRegression(tones=2, pole=pole).start(INTERVAL)


def test_observers_too_fast_for_the_clock_are_refused():
    options = AdaptiveObserver(tones=2, initial_frequencies=(2.0, 5.0))
    with pytest.raises(
        ValueError, match=r"the fastest pole of the observer, 3.456 rad/s, needs a sampling interval below"
    ):
        options.start(0.5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pole": 0.0}, "pole must be a positive number"),
        ({"forgetting": 0.0}, "forgetting must be a positive number"),
        ({"algorithm": "best"}, "algorithm must be 'least_squares' or 'gradient'"),
        ({"gains": (1.0,)}, "gains must hold one number for each of the 2 tones"),
        ({"lowest_frequency": 3.0, "highest_frequency": 2.0}, "must be below highest_frequency"),
    ],
)
def test_impossible_filters_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        FilterRegression(**{"tones": 2, "pole": 3.0, **options})
