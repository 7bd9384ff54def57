"""Spectra of finite records against quadrature of the held signals, and effects of sampling on the output."""

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.filtering.spectra import lowpass_weight, record_spectra
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)


def quadrature(function, breaks, window, frequencies):
    """Return ``1/T int v exp(-jw(t - t0)) dt`` by Gauss's rule between the breaks: exact up to rounding."""
    start, end = window
    edges = np.unique(np.concatenate((breaks[(breaks > start) & (breaks < end)], window)))
    middle, half = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2
    t = middle[:, None] + half[:, None] * NODES
    integrand = (function(t) * WEIGHTS * half[:, None]).ravel()
    return np.exp(-1j * np.outer(frequencies, (t - start).ravel())) @ integrand / (end - start)


def clock(regular, n, seed=0):
    return 0.05 * np.arange(n) if regular else np.cumsum(np.random.default_rng(seed).uniform(0.01, 0.09, n))


def noisy_record(hold="zoh", regular=True, n=800, input_times=None):
    rng = np.random.default_rng(1)
    t = clock(regular, n)
    tu = t if input_times is None else input_times
    return Record(t, rng.standard_normal(n), HeldSignal(tu, rng.standard_normal(tu.size), hold), name="a record")


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("start", [9.0, 2.0])
def test_delayed_input_is_integrated_exactly(regular, hold, start):
    # With a start of 2 s the longer delays reach back before the first break, where the input is zero. The delays, in
    # mixed order, are the first and last possible ones, multiples of the interval and arbitrary ones.
    record = noisy_record(hold, regular)
    spectra = record_spectra(record, start, 6.0, 9.0)
    u = record.input
    for delay in (9.0, 0.0, 4.4, 0.05, 8.123456, 2.0, np.pi):
        breaks = np.append(u.t + delay, u.t[0] + delay)
        values = quadrature(lambda t, d=delay: u.at(t - d), breaks, spectra.window, spectra.frequencies)
        np.testing.assert_allclose(spectra.inputs(delay), values, rtol=0, atol=1e-11)


@pytest.mark.parametrize("regular", [True, False])
def test_output_is_integrated_as_straight_lines_and_undamped(regular):
    # Value and slope at the ends of the window are not changed; the rest is divided by the mean of sinc^2.
    record = noisy_record(regular=regular)
    spectra = record_spectra(record, 3.217, 6.0, 3.0)
    (a, b), w = spectra.window, spectra.frequencies[1:]
    lines = quadrature(lambda t: np.interp(t, record.t, record.y), record.t, (a, b), spectra.frequencies)
    inside = record.t[record.t >= a]
    h = np.diff(inside)
    damping = (np.sinc(np.outer(w, h) / (2 * np.pi)) ** 2 @ h) / h.sum()
    # Up to rounding of the sums; irregular intervals are grouped by length.
    tolerance = h.size * np.finfo(float).eps if regular else 1e-5
    np.testing.assert_allclose(spectra.damping, np.append(1.0, damping), rtol=tolerance)
    np.testing.assert_allclose(1 - spectra.damping[1:], 1 - damping, rtol=1e-3)
    first, last = np.interp([a, a + 1e-3, b - 1e-3, b], record.t, record.y).reshape(2, 2)
    ends = (first[0] - last[1]) / (1j * w) + (np.diff(first) - np.diff(last)) / 1e-3 / (1j * w) ** 2
    ends /= b - a
    expected = np.append(lines[0], ends + (lines[1:] - ends) / spectra.damping[1:])
    np.testing.assert_allclose(spectra.outputs, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize(("regular", "bound"), [(True, 2e-5), (False, 1e-3)])
def test_smooth_outputs_keep_their_spectrum(regular, bound):
    # Waves between the bins, a drift and a curvature: no part is periodic in the window.
    def smooth(t):
        return np.sin(2.3 * t) + 0.3 * np.cos(5.1 * t + 1) + 0.2 * t - 0.004 * t**2

    t = clock(regular, 800)
    record = Record.from_arrays(t, np.ones(t.size), smooth(t))
    spectra = record_spectra(record, 3.0, 6.0, 3.0)
    exact = quadrature(smooth, t, spectra.window, spectra.frequencies)
    lines = quadrature(lambda s: np.interp(s, t, record.y), t, spectra.window, spectra.frequencies)
    error, as_lines = (np.linalg.norm(values - exact) / np.linalg.norm(exact) for values in (spectra.outputs, lines))
    assert error < bound
    assert error < 0.2 * as_lines


def test_missing_samples_are_left_out():
    # Equal to a record sampled without the masked samples; masked ends shorten the window.
    record = noisy_record("foh")
    y = record.y.copy()
    missing = np.r_[0:100, 300, 301, 440, 790:800]
    y[missing] = np.nan
    masked = record_spectra(Record(record.t, y, record.input), 3.0, 6.0, 3.0)
    thinned = record_spectra(
        Record(np.delete(record.t, missing), np.delete(record.y, missing), record.input), 3.0, 6.0, 3.0
    )
    assert masked.window == thinned.window == (record.t[100], record.t[789])
    np.testing.assert_allclose(masked.outputs, thinned.outputs, rtol=0, atol=1e-10)
    assert np.array_equal(masked.inputs(1.2), thinned.inputs(1.2))


def test_without_the_mean_an_offset_has_no_effect():
    record = noisy_record()
    offset = Record(record.t, record.y + 5, record.input)
    full, without, moved = (
        record_spectra(r, 2.0, 6.0, 2.0, keep_mean=keep)
        for r, keep in ((record, True), (record, False), (offset, False))
    )
    assert np.array_equal(without.frequencies, full.frequencies[1:])
    assert np.array_equal(without.outputs, full.outputs[1:])
    assert np.array_equal(without.inputs(1.1), full.inputs(1.1)[1:])
    np.testing.assert_allclose(moved.outputs, without.outputs, rtol=0, atol=1e-11)


def test_weight_is_the_squared_gain():
    frequencies = np.array([0.0, 0.1, 0.3, 0.6, 2.0])
    for order in (1, 10):
        gain = np.abs(Lowpass(0.3, order).model.frequency_response(frequencies))
        np.testing.assert_allclose(lowpass_weight(frequencies, Lowpass(0.3, order)), gain**2, rtol=1e-9)
    assert np.array_equal(lowpass_weight(frequencies, None), np.ones(5))
    assert np.array_equal(lowpass_weight(np.array([0.0, 1e30]), Lowpass(0.3, 20)), [1.0, 0.0])


def test_impossible_windows_and_delays_are_refused():
    record = noisy_record(n=100)
    with pytest.raises(DataError, match=r"a record: fewer than two samples are left 4\.95 s after the first input"):
        record_spectra(record, 4.95, 6.0, 4.95)
    with pytest.raises(DataError, match=r"a record: the 2\.95 s from 2 s on contain no full period of 2 rad/s"):
        record_spectra(record, 2.0, 2.0, 2.0)
    spectra = record_spectra(record, 2.0, 6.0, 2.0)
    for delay in (-1e-3, 2.001, np.nan):
        with pytest.raises(ValueError, match="the delay must lie between 0 and 2 s"):
            spectra.inputs(delay)
