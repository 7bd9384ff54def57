"""One object for samples and records: the same numbers however they arrive, and after a restart in the middle."""

import io
from dataclasses import fields

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.frequency.drem_finite_time import DremFiniteTime
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares
from ctid_cli.frequency.tracking import FrequencyEstimate
from ctid_cli.kinds import KINDS, classes
from ctid_cli.specification.messages import option_docs
from tests.frequency.signals import INTERVAL, OMEGA, online_estimators, tones

ESTIMATORS = online_estimators()
IDS = [f"{number}-{estimator.kind}" for number, estimator in enumerate(ESTIMATORS)]
each = pytest.mark.parametrize("options", ESTIMATORS, ids=IDS)


def eventful(count=1500):
    """Two tones with noise, a gap, a step and an infinite sample."""
    y = tones(2, count).sum(axis=1) + 0.01 * np.random.default_rng(0).standard_normal(count)
    y[800:] = 1.3 * tones(2, count, omega=OMEGA[2] * 1.2).sum(axis=1)[800:]
    y[500:503] = np.nan
    y[1200] = np.inf
    return y


def same(one, other):
    assert np.array_equal(one.omega, other.omega, equal_nan=True)
    assert np.array_equal(one.uncertainty, other.uncertainty, equal_nan=True)
    assert np.array_equal(one.flags, other.flags)


def joined(parts):
    return FrequencyEstimate(
        np.concatenate([part.omega for part in parts]),
        np.concatenate([part.flags for part in parts]),
        np.concatenate([part.uncertainty for part in parts]),
    )


@each
def test_samples_one_by_one_give_the_numbers_of_the_record(options):
    y = eventful()
    track = options.start(INTERVAL).run(y)
    tracker = options.start(INTERVAL)
    single = [tracker.update(sample) for sample in y]
    assert np.array_equal([item.omega for item in single], track.omega, equal_nan=True)
    assert np.array_equal([item.uncertainty for item in single], track.uncertainty, equal_nan=True)
    assert np.array_equal([item.flags for item in single], track.flags)
    assert np.array_equal([item.valid for item in single], track.valid)
    # The signal was made so that something happens to every estimator.
    assert len(set(track.flags.tolist())) > 2
    assert (np.nanstd(track.omega[1000:], axis=0) > 0).all()


@each
def test_a_record_in_pieces_gives_the_same_numbers(options):
    y = eventful()
    tracker = options.start(INTERVAL)
    parts = [tracker.run(part) for part in np.split(y, [1, 7, 7, 499, 501, 801, 1199])]
    whole = options.start(INTERVAL).run(y)
    same(joined(parts), whole)
    np.testing.assert_array_equal(np.concatenate([part.t for part in parts]), whole.t)
    np.testing.assert_allclose(whole.t, INTERVAL * np.arange(y.size), rtol=1e-15)


@each
@pytest.mark.parametrize("cut", [0, 137, 501, 810, 1300])
def test_restored_trackers_go_on_bit_for_bit(options, cut):
    y = eventful()
    tracker = options.start(INTERVAL)
    tracker.run(y[:cut])
    file = io.BytesIO()
    np.savez(file, **tracker.state())
    expected = tracker.run(y[cut:])
    restored = options.restore(INTERVAL, np.load(io.BytesIO(file.getvalue())))
    track = restored.run(y[cut:])
    same(track, expected)
    np.testing.assert_array_equal(track.t, expected.t)


@each
def test_a_saved_state_is_a_copy(options):
    y = eventful()
    tracker = options.start(INTERVAL)
    tracker.run(y[:400])
    state = tracker.state()
    kept = {name: array.copy() for name, array in state.items()}
    tracker.run(y[400:])
    assert all(np.array_equal(state[name], kept[name], equal_nan=True) for name in kept)
    # Nor does a restored tracker change it.
    options.restore(INTERVAL, state).run(y[400:])
    assert all(np.array_equal(state[name], kept[name], equal_nan=True) for name in kept)


def test_states_of_other_options_are_refused():
    options = DremFiniteTime(tones=2, h=0.4, d=0.3)
    state = options.start(INTERVAL).state()
    message = r"this is not the state of .* restore it with the options and the interval"
    for other, interval in (
        (DremFiniteTime(tones=2, h=0.4, d=0.3, gamma=2.0), INTERVAL),  # arrays of the same shapes
        (DremFiniteTime(tones=2, h=0.4, d=0.31), INTERVAL),
        (options, 1.001 * INTERVAL),
        (RestartingLeastSquares(tones=2, h=0.4), INTERVAL),
    ):
        with pytest.raises(DataError, match=message):
            other.restore(interval, state)
    with pytest.raises(DataError, match=message):
        options.restore(INTERVAL, {name: array for name, array in state.items() if name != "rows"})
    # The same numbers written differently are the same options.
    DremFiniteTime(tones=2, h=0.4, d=0.3, gamma=1).restore(INTERVAL, state)


@pytest.mark.parametrize("options", [e for e in ESTIMATORS if getattr(e, "prefilter", 0)], ids=lambda e: e.kind)
def test_prefilter_by_fourier_transforms_is_the_same_up_to_rounding(options):
    y = eventful()
    slow, fast = options.start(INTERVAL).run(y), options.start(INTERVAL).run(y, fft=True)
    assert np.array_equal(slow.flags, fast.flags)
    np.testing.assert_allclose(fast.omega[slow.valid], slow.omega[slow.valid], atol=1e-10)
    # And the state holds samples, not what the route made of them: cuts may change the route.
    tracker = options.start(INTERVAL)
    mixed = [tracker.run(y[:600], fft=True), tracker.run(y[600:])]
    np.testing.assert_allclose(joined(mixed).omega[slow.valid], slow.omega[slow.valid], atol=1e-10)


@each
def test_no_samples_are_no_estimates(options):
    track = options.start(INTERVAL).run(np.empty(0))
    assert track.omega.shape == (0, 2)
    assert track.flags.shape == track.valid.shape == track.t.shape == (0,)


@pytest.mark.parametrize("samples", [np.zeros((5, 2)), np.zeros(5, complex), np.array(["a"]), 3.0])
def test_what_is_no_series_of_numbers_is_refused(samples):
    with pytest.raises(DataError, match="one series of real numbers"):
        RestartingLeastSquares(tones=2, h=0.4).start(INTERVAL).run(samples)


def test_integers_are_numbers():
    y = np.round(100 * tones(2, 600).sum(axis=1)).astype(int)
    options = RestartingLeastSquares(tones=2, h=0.4)
    same(options.start(INTERVAL).run(y), options.start(INTERVAL).run(y.astype(float)))


@pytest.mark.parametrize("interval", [0.0, -0.1, np.nan, np.inf])
@each
def test_impossible_intervals_are_refused(options, interval):
    with pytest.raises(ValueError, match="interval must be a positive number"):
        options.start(interval)


def test_estimates_explain_themselves():
    tracker = RestartingLeastSquares(tones=2, h=0.4).start(INTERVAL)
    estimate = tracker.update(1.0)
    assert not estimate.valid
    assert estimate.flags == Flag.STARTING
    assert estimate.reasons == ("Too few samples have arrived since the start or since the last restart.",)
    final = tracker.run(tones(2, 1000).sum(axis=1)).final
    assert final.valid
    assert final.reasons == ()
    np.testing.assert_allclose(final.omega, OMEGA[2], atol=1e-9)


def test_rounded_delays_are_noted():
    assert RestartingLeastSquares(tones=2, h=0.4).start(0.01).notes == ()
    (note,) = RestartingLeastSquares(tones=2, h=0.4).start(0.03).notes
    assert note == "h = 0.4 s is no whole number of sampling intervals of 0.03 s; 0.39 s is used."


def test_the_table_of_estimators_names_all_kinds():
    assert sorted(KINDS["frequency_estimator"]) == [
        "drem_finite_time",
        "drem_gradient",
        "drem_window",
        "restarting_least_squares",
    ]
    for kind, estimator in classes("frequency_estimator").items():
        assert estimator.kind == kind
        assert set(option_docs(estimator)) == {item.name for item in fields(estimator) if item.init}


def test_a_state_may_go_through_a_text_file():
    import json

    options = RestartingLeastSquares(tones=2, h=0.4, prefilter=0.2)
    y = tones(2, 600).sum(axis=1)
    tracker = options.start(INTERVAL)
    tracker.run(y[:333])
    text = json.dumps({name: array.tolist() for name, array in tracker.state().items()})
    again = options.restore(INTERVAL, json.loads(text)).run(y[333:])
    expected = tracker.run(y[333:])
    assert np.array_equal(again.omega, expected.omega, equal_nan=True)
    assert np.array_equal(again.flags, expected.flags)


@pytest.mark.parametrize("extra", [{}, {"more": np.zeros(1)}])
def test_states_with_more_or_fewer_parts_are_refused(extra):
    options = RestartingLeastSquares(tones=2, h=0.4)
    state = options.start(INTERVAL).state() | extra
    if not extra:
        del state["counters"]
    with pytest.raises(DataError, match=r"this is not the state of"):
        options.restore(INTERVAL, state)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"prefilter": 0.004}, r"prefilter = 0\.004 s is shorter than half a sampling interval"),
        ({"h": 1e300}, r"h = 1e\+300 s is more than 10,000,000 sampling intervals"),
        ({"h": 1e6}, r"h = 1e\+06 s is more than 10,000,000 sampling intervals"),
    ],
)
def test_delays_that_a_clock_cannot_have_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        RestartingLeastSquares(**{"tones": 1, "h": 0.4, **options}).start(INTERVAL)
