"""Comparators of the frequency study: convergence, bounds, and refusals."""

import sys

import numpy as np
import pytest

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
regression = sys.modules[Filter.__module__]


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
        (Filter, {"pole": 3.0, "gains": (1.0,)}, "gains"),
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
