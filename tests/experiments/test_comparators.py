"""Comparators of the frequency study: against SciPy and plain formulas, convergence, and refusals."""

import sys

import numpy as np
import pytest
from scipy import signal

from ctid_cli import DataError, Flag
from ctid_cli.custom_code import STUDIES, find_class
from ctid_cli.reporting.study import find_study
from tests.frequency.signals import INTERVAL, NO_TWO_TONES, OMEGA, T, tones

STUDY = find_study("finite-time-frequency")
COMPARATORS = STUDIES / "finite_time_frequency" / "comparators"
#: Loaded as from specifications, so that the module names match Numba's caches.
Observer, Filter, Esprit, Nonlinear = (
    find_class(f"./{kind}", COMPARATORS)
    for kind in (
        *("adaptive_observer.py:AdaptiveObserver", "filter_regression.py:FilterRegression"),
        *("whole_record.py:Esprit", "whole_record.py:NonlinearLeastSquares"),
    )
)
observer, regression, whole = (sys.modules[each.__module__] for each in (Observer, Filter, Esprit))


@pytest.mark.parametrize("n", [1, 2, 3])
def test_rows_are_derivatives_of_the_filtered_signal(n):
    # At s = j w: w_j = (l/(s + l))^j y, and row k is (-1)^(k + 1) s^(2 (n - k)) w_2n, the last s^(2 n) w_2n.
    pole, s = 3.0, 1.7j
    chain = (pole / (s + pole)) ** np.arange(2 * n + 1)
    rows = regression.derivative_rows(n, pole) @ chain
    powers = [(-1) ** (k + 1) * s ** (2 * (n - k)) for k in range(1, n + 1)] + [s ** (2 * n)]
    np.testing.assert_allclose(rows, np.array(powers) * chain[-1], rtol=1e-12)


def test_chain_is_that_of_scipy_for_a_linearly_held_signal():
    y = tones(2, 600).sum(axis=1)
    chain = regression.filter_chain(y, 3.0, 4, INTERVAL)
    for order in range(1, 5):
        system = signal.lti([3.0**order], np.poly(np.full(order, -3.0)))
        _, expected, _ = signal.lsim(system, y, INTERVAL * np.arange(y.size))
        np.testing.assert_allclose(chain[:, order], expected, atol=1e-9)


def test_the_gradient_is_implicit_and_normalised():
    rows = np.random.default_rng(1).standard_normal((50, 3))
    gains, found = np.array([2.0, 0.5]), np.array([1.0, -1.0])
    for row in rows:
        phi, error = row[:2], row[2] - row[:2] @ found
        found = found + gains * phi * error / (1.0 + phi @ (gains * phi))
    last = regression.descend(rows, gains, np.array([1.0, -1.0]))[-1]
    np.testing.assert_allclose(last, found, rtol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_the_filter_converges_with_the_square_of_the_interval(n):
    errors = []
    for finer in (1, 2):
        y = tones(n, 12_000 * finer, INTERVAL / finer).sum(axis=1)
        track = Filter(tones=n, pole=3.0).track(y, INTERVAL / finer)
        errors.append(np.abs(track.frequencies[-1] - OMEGA[n]).max())
        assert track.valid[-3000 * finer :].all()
    # The only error is the interpolation by straight lines between the samples.
    assert errors[0] < 1e-3
    assert 3.0 < errors[0] / errors[1] < 9.0


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_the_observer_has_the_poles_that_were_asked_for(n):
    squares, poles, gains = OMEGA[n] ** 2, 2.0 * 1.2 ** np.arange(2 * n), np.empty(2 * n)
    observer.place_poles(squares, poles, gains)
    # The derivative of a unit state is a column of the closed-loop matrix.
    matrix, slope = np.empty((2 * n, 2 * n)), np.empty((n + 1, 2 * n))
    for k in range(2 * n):
        states = np.zeros((n + 1, 2 * n))
        states[0, k] = 1.0
        observer.observer_slope(states, 0.0, squares, gains, slope)
        matrix[:, k] = slope[0]
    assert np.poly(matrix) == pytest.approx(np.poly(-poles), rel=1e-8)


@pytest.mark.parametrize("n", [1, 2])
def test_the_observer_converges_from_nearby(n):
    track = Observer(tones=n, initial_frequencies=tuple(OMEGA[n] + 0.3)).track(tones(n, 9000).sum(axis=1), INTERVAL)
    assert np.abs(track.frequencies[-1] - OMEGA[n]).max() < 2e-3
    assert track.valid[-500:].all()


def test_the_observer_keeps_its_bounds_and_says_so():
    options = Observer(tones=2, initial_frequencies=(2.0, 5.0))
    track = options.track(np.sin(9.5 * T), INTERVAL)
    assert ((track.frequencies >= 0.2) & (track.frequencies <= 8.0)).all()
    assert (np.diff(track.frequencies, axis=1) >= 0.3 - 1e-12).all()
    assert (track.flags & Flag.OUT_OF_BOUNDS).any()
    assert not track.valid.any()


@pytest.mark.parametrize("n", range(1, 6))
def test_whole_records_are_exact_without_noise(n):
    y = tones(n, 1500).sum(axis=1)
    for options in (Esprit(tones=n, averaging=0.05), Nonlinear(tones=n, averaging=0.05)):
        track = options.track(y, INTERVAL)
        np.testing.assert_allclose(track.frequencies, OMEGA[n][None, :], atol=1e-8)
        assert track.valid.all()


@pytest.mark.parametrize("name", ["zero", "constant", "one tone", "one tone and noise", "noise", "three tones"])
@pytest.mark.parametrize(
    "options", [Filter(tones=2, pole=4.0), Esprit(tones=2, averaging=0.05)], ids=["filter", "whole"]
)
def test_no_estimate_is_valid_where_there_are_no_two_tones(options, name):
    assert not options.track(NO_TWO_TONES[name], INTERVAL).valid.any()


@pytest.mark.parametrize(
    ("kind", "options", "field"),
    [
        (Observer, {"initial_frequencies": (2.0,)}, "initial_frequencies"),
        (Observer, {"initial_frequencies": (2.0, 2.1)}, "initial_frequencies"),
        (Observer, {"initial_frequencies": (2.0, 5.0), "ratio": 0.9}, "ratio"),
        (Observer, {"initial_frequencies": (2.0, 9.0)}, "initial_frequencies"),
        (Filter, {"pole": 0.0}, "pole"),
        (Filter, {"pole": 3.0, "gains": (1.0,)}, "gains"),
        (Esprit, {"averaging": -1.0}, "averaging"),
    ],
)
def test_impossible_options_are_refused(kind, options, field):
    with pytest.raises((DataError, ValueError)) as error:
        kind(tones=2, **options)
    assert error.value.field == field


@pytest.mark.parametrize(
    ("options", "count", "interval", "message"),
    [
        (Observer(tones=2, initial_frequencies=(2.0, 5.0)), 1000, 0.5, "fastest rate of the observer, 3.456 rad/s"),
        (Filter(tones=2, pole=320.0), 1000, 0.01, "one below 314.159 rad/s"),
        (Esprit(tones=2, averaging=29.0), 3000, 0.01, "1 samples, after the averaging, are too few for 2 tones"),
        (Esprit(tones=1), 200_000, 0.01, "200,000 samples are more than the 100,000 .* at least 0.02 s"),
    ],
)
def test_records_that_do_not_fit_are_refused_before_there_are_any(options, count, interval, message):
    with pytest.raises(DataError, match=message):
        options.check(count, interval)
