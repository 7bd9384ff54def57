"""Estimates sample by sample: equal to those of the whole record, for any division."""

import numpy as np
import pytest

from ctid_cli.errors import DataError, OptionError
from ctid_cli.frequency.drem import DremFiniteTime, DremWindow
from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares
from tests.frequency.signals import INTERVAL, OMEGA, online_estimators, tones

ESTIMATORS = online_estimators()
IDS = [f"{number}-{estimator.kind}" for number, estimator in enumerate(ESTIMATORS)]
each = pytest.mark.parametrize("options", ESTIMATORS, ids=IDS)


def eventful(count=1500):
    """Return two tones with noise, a gap, a step and an infinite sample."""
    y = tones(2, count).sum(axis=1) + 0.01 * np.random.default_rng(0).standard_normal(count)
    y[800:] = 1.3 * tones(2, count, omega=OMEGA[2] * 1.2).sum(axis=1)[800:]
    y[500:503] = np.nan
    y[1200] = np.inf
    return y


def same(one, other):
    np.testing.assert_allclose(one.t, other.t, rtol=1e-15)
    assert np.array_equal(one.flags, other.flags)
    np.testing.assert_allclose(one.frequencies[one.valid], other.frequencies[one.valid], rtol=1e-9)
    # Complex roots and roots at the bounds amplify rounding.
    np.testing.assert_allclose(one.frequencies, other.frequencies, rtol=1e-5)


@each
def test_samples_one_by_one_give_the_numbers_of_the_record(options):
    y = eventful()
    track, online = options.track(y, INTERVAL), options.start(INTERVAL)
    single = [online.update(sample) for sample in y]
    joined = (np.concatenate([getattr(row, name) for row in single]) for name in ("t", "frequencies", "flags"))
    same(type(track)(*joined), track)
    # The signal contains an event for every estimator.
    assert len(set(track.flags.tolist())) > 2
    assert (np.nanstd(track.frequencies[1000:], axis=0) > 0).all()


@pytest.mark.parametrize("samples", [np.zeros((5, 2)), np.zeros(5, complex), np.array(["a"]), 3.0])
def test_what_is_no_series_of_numbers_is_refused(samples):
    with pytest.raises(DataError, match="one series of real numbers"):
        RestartingLeastSquares(tones=2, h=0.4).track(samples, INTERVAL)


@pytest.mark.parametrize(
    ("kind", "options", "interval", "message"),
    [
        (RestartingLeastSquares, {"prefilter": 0.004}, 0.01, r"prefilter = 0\.004 s is shorter than half a sampling"),
        (RestartingLeastSquares, {"h": 1e6}, 0.01, r"h = 1e\+06 s is more than 10,000,000 sampling intervals"),
        (DremWindow, {"d": 0.3, "memory": 0.05}, 0.01, r"memory = 0.05 s holds 5 samples of 0.01 s, fewer than the 8"),
        (DremFiniteTime, {"d": 0.1}, 0.5, r"d = 0.1 s is shorter than half a sampling interval of 0.5 s"),
    ],
)
def test_options_that_a_clock_cannot_have_are_refused(kind, options, interval, message):
    with pytest.raises(ValueError, match=message):
        kind(**{"tones": 2, "h": 0.4, **options}).start(interval)


@pytest.mark.parametrize(
    ("options", "blamed"),
    [({"d": 11.0}, "d"), ({"prefilter": 11.0}, "prefilter"), ({"h": 2.4}, "h"), ({"difference": 9.0}, "h")],
)
def test_delays_longer_than_the_record_are_refused(options, blamed):
    estimator = DremFiniteTime(**{"tones": 2, "h": 0.4, "d": 0.3, **options})
    with pytest.raises(OptionError) as refused:
        estimator.check(1000, INTERVAL)
    assert refused.value.field == blamed
    estimator.check(10_000, INTERVAL)
