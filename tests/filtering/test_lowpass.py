"""Low-pass filtering of a record: the filter itself, and that it commutes with the system."""

import numpy as np
import pytest
from scipy import signal

from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

CASE_1 = TransferFunction([2.0], [0.25, 0.7, 1.0], 0.33)


def record(hold="zoh", regular=True, n=1000):
    rng = np.random.default_rng(0)
    t = 0.05 * np.arange(n) if regular else np.cumsum(rng.uniform(0.01, 0.09, n))
    u = rng.standard_normal(n)
    u[0] = 0.0
    held = HeldSignal(t, u, hold)
    return Record(t, simulate(CASE_1, held, t), held, name="a record")


@pytest.mark.parametrize("order", [1, 2, 10])
def test_gain_is_that_of_a_butterworth_filter(order):
    # |L(jw)|^2 = 1/(1 + (w/wc)^(2 n)): unity at zero frequency and 3 dB down at the cut-off.
    frequencies = np.array([0.0, 0.1, 0.3, 0.6, 2.0])
    gain = np.abs(Lowpass(0.3, order).model.frequency_response(frequencies))
    np.testing.assert_allclose(gain, (1 + (frequencies / 0.3) ** (2 * order)) ** -0.5, rtol=1e-9)


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("order", [1, 2, 10])
def test_filter_commutes_with_the_system_on_a_regular_clock(order, hold):
    # G L u = L G u: both are linear and time-invariant on the samples (a linear hold must rise from zero).
    filtered = Lowpass(0.5, order).apply(record(hold))
    assert filtered.input.hold == hold
    expected = simulate(CASE_1, filtered.input, filtered.t)
    np.testing.assert_allclose(filtered.y, expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("order", [1, 2, 5, 20])
@pytest.mark.parametrize("cutoff", [0.2, 6.0, 60.0])
def test_samples_on_a_regular_clock_are_those_of_the_bilinear_transform(order, cutoff):
    y = np.random.default_rng(order).standard_normal(3000)
    filtered = Lowpass(cutoff, order).apply(Record.from_arrays(0.05 * np.arange(3000), y, y))
    sections = signal.butter(order, cutoff, fs=2 * np.pi / 0.05, output="sos")
    expected = signal.sosfilt(sections, y)
    for found in (filtered.y, filtered.input.values):
        np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_irregular_records_pass_through_the_analogue_filter():
    # The filtered input is the exact response at the samples, and the filtered output that of the interpolated one.
    r = record(regular=False)
    filtered = Lowpass(0.5, 3).apply(r)
    model = Lowpass(0.5, 3).model
    assert filtered.input.hold == "foh"
    np.testing.assert_array_equal(filtered.input.values, simulate(model, r.input, r.t))
    np.testing.assert_array_equal(filtered.y, simulate(model, HeldSignal(r.t, r.y, "foh"), r.t))
    # The system hardly sees the rest of the error: smooth signals lie close to the lines between their samples.
    error = simulate(CASE_1, filtered.input, r.t) - filtered.y
    assert np.abs(error).max() < 2e-3 * np.abs(filtered.y).max()


@pytest.mark.parametrize("regular", [True, False])
def test_masked_samples_stay_masked_and_the_record_unchanged(regular):
    r = record(regular=regular)
    y = r.y.copy()
    y[[0, 10, 11, 999]] = np.nan
    masked = Record(r.t, y, r.input, name="a record")
    filtered = Lowpass(0.5).apply(masked)
    assert np.array_equal(filtered.valid, masked.valid)
    assert filtered.name == "a record"
    assert np.array_equal(masked.y, y, equal_nan=True)
    assert np.array_equal(masked.input.values, r.input.values)


def test_cutoff_beyond_the_clock_is_refused():
    with pytest.raises(ValueError, match=r"70 rad/s is not below half the sampling frequency, 62\.83\d* rad/s"):
        Lowpass(70.0).apply(record())
    Lowpass(70.0).apply(record(regular=False))  # no such limit where the filter is an analogue one


@pytest.mark.parametrize(
    ("cutoff", "order", "message"),
    [
        (0.0, 2, "must be a positive frequency in rad/s, not 0.0"),
        (-1.0, 2, "must be a positive frequency"),
        (np.nan, 2, "must be a positive frequency"),
        (np.inf, 2, "must be a positive frequency"),
        (1.0, 0, "order must be an integer from 1 to 20, not 0"),
        (1.0, 21, "order must be an integer from 1 to 20, not 21"),
        (1.0, 2.5, "order must be an integer from 1 to 20, not 2.5"),
    ],
)
def test_impossible_filters_are_refused(cutoff, order, message):
    with pytest.raises(ValueError, match=message):
        Lowpass(cutoff, order)


# Filtered and resampled -------------------------------------------------------------------------------


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("order", [1, 4, 10])
def test_resampled_signals_are_those_of_the_analogue_filter(order, hold):
    # scipy's exact discretisations of the filter, on the clock of the record, at every fourth sample.
    r, per_period = record(hold), 6.0
    cutoff = 2 * np.pi / (per_period * 4 * 0.05)
    model = Lowpass(cutoff, order).model
    resampled = Lowpass(cutoff, order).resample(r, per_period)
    np.testing.assert_allclose(resampled.t, r.t[::4], atol=1e-9)
    np.testing.assert_allclose(resampled.input.t, resampled.t, rtol=0)
    assert (resampled.input.hold, resampled.interval) == ("foh", pytest.approx(0.2, rel=1e-9))
    state_space = signal.tf2ss(model.numerator, model.denominator)
    for values, kind, found in ((r.input.values, hold, resampled.input.values), (r.y, "foh", resampled.y)):
        a, b, c, d, _ = signal.cont2discrete(state_space, 0.05, kind)
        _, expected, _ = signal.dlsim((a, b, c, d, 0.05), values)
        np.testing.assert_allclose(found, expected[::4, 0], atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("cutoff", [0.3, 2.0, 20.0])
def test_resampling_takes_irregular_records_and_their_own_breaks(cutoff):
    # The input keeps its own clock until it is filtered: the exact response at the new instants.
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(0.01, 0.09, 800)) + 3.0
    breaks = np.arange(1.3, t[-1], 0.37)
    held = HeldSignal(breaks, rng.standard_normal(breaks.size))
    r = Record(t, simulate(CASE_1, held, t), held)
    lowpass = Lowpass(cutoff, 4)
    resampled = lowpass.resample(r)
    assert resampled.t[0] == 1.3  # what happens first, input or output
    assert t[-1] - resampled.interval < resampled.t[-1] <= t[-1] + 1e-9
    assert resampled.input_on_grid
    np.testing.assert_array_equal(resampled.input.values, simulate(lowpass.model, held, resampled.t))
    # Before the output begins there is nothing to compare with.
    assert np.array_equal(resampled.valid, resampled.t >= t[0])


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("cutoff", [1.0, 20.0, 40.0, 62.0, 70.0, 1e4])
def test_resampling_never_adds_samples(cutoff, regular):
    r = record(regular=regular)
    resampled = Lowpass(cutoff, 2).resample(r)
    assert resampled.n_samples <= r.n_samples + 1
    period = 2 * np.pi / cutoff
    wanted = period / np.clip(500 * period / r.duration, 5, 16)
    if regular:
        # Whole intervals of its own clock.
        assert resampled.interval == pytest.approx(0.05 * max(1, np.floor(wanted / 0.05)), rel=1e-9)
    else:
        longest = max(wanted, np.median(np.diff(r.t)), r.duration / r.n_samples)
        assert resampled.interval == pytest.approx(longest, rel=1e-9)


def test_resampling_never_adds_samples_to_bursts():
    t = np.concatenate([10.0 * k + 0.001 * np.arange(20) for k in range(100)])
    rng = np.random.default_rng(0)
    r = Record(t, rng.standard_normal(t.size), HeldSignal(t, rng.standard_normal(t.size)))
    assert Lowpass(3000.0, 2).resample(r).n_samples <= r.n_samples + 1


def test_single_missing_samples_are_bridged():
    r = record()
    y = r.y.copy()
    y[1::2] = np.nan
    # The last sample is missing too: after it there is nothing to bridge to.
    assert Lowpass(2.0, 4).resample(Record(r.t, y, r.input)).valid[:-1].all()


def test_more_samples_per_period_are_more_samples():
    r = record()
    for per_period in (4.0, 6.0, 12.0, 40.0):
        every = np.floor(2 * np.pi / (0.9 * per_period) / 0.05)
        assert Lowpass(0.9, 2).resample(r, per_period).interval == pytest.approx(0.05 * every)


@pytest.mark.parametrize("regular", [True, False])
def test_resampled_holes_stay_masked_and_the_record_unchanged(regular):
    r = record(regular=regular)
    y = r.y.copy()
    first, last = 400, 460
    y[first : last + 1] = np.nan
    y[-3:] = np.nan
    masked = Record(r.t, y, r.input, name="a record")
    resampled = Lowpass(5.0, 3).resample(masked)
    # Present are exactly those that lie between (or on) two samples that are.
    gaps = [(r.t[first - 1], r.t[last + 1]), (r.t[-4], np.inf)]
    inside = np.any([(resampled.t > a + 1e-6) & (resampled.t < b - 1e-6) for a, b in gaps], axis=0)
    assert inside.sum() > 10
    assert np.array_equal(resampled.valid, ~inside)
    # The hole is bridged by a straight line before the filter.
    bridged = Record(r.t, np.interp(r.t, r.t[np.isfinite(y)], y[np.isfinite(y)]), r.input)
    whole = Lowpass(5.0, 3).resample(bridged)
    np.testing.assert_allclose(resampled.y[~inside], whole.y[~inside], rtol=1e-12)
    assert resampled.name == "a record"
    assert np.array_equal(masked.y, y, equal_nan=True)


def test_origin_of_time_does_not_matter_when_resampling():
    r = record()
    moved = Record(r.t + 1.7e5, r.y, HeldSignal(r.t + 1.7e5, r.input.values, "zoh"))
    one, two = Lowpass(2.0, 4).resample(r), Lowpass(2.0, 4).resample(moved)
    np.testing.assert_allclose(two.t - 1.7e5, one.t, atol=1e-9)
    np.testing.assert_allclose(two.y, one.y, atol=1e-7 * np.abs(one.y).max())
    np.testing.assert_allclose(two.input.values, one.input.values, atol=1e-7 * np.abs(one.input.values).max())


def test_straight_lines_lose_what_the_theory_says():
    # A tone at the cut-off, 6 samples a period: the lines between them keep sinc(1/6)^2 of its amplitude, 91 %.
    t = 0.01 * np.arange(60_000)
    w = 2 * np.pi / (6 * 0.2)
    tone = Record(t, np.zeros(t.size), HeldSignal(t, np.sin(w * t), "foh"))
    resampled = Lowpass(w, 10).resample(tone, 6.0)
    fine = t[(t > 400) & (t < 400 + 300 * 1.2)]
    basis = np.column_stack((np.sin(w * fine), np.cos(w * fine)))
    amplitude = np.hypot(*np.linalg.lstsq(basis, resampled.input.at(fine), rcond=None)[0])
    assert amplitude == pytest.approx(np.sinc(1 / 6) ** 2 / np.sqrt(2), rel=1e-3)
