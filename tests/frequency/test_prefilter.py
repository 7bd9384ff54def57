"""Prefilters: gain, the fast route against the direct one, missing samples."""

import numpy as np
import pytest

from ctid_cli.frequency.prefilter import convolve, fast_convolve, impulse_response

LENGTHS = [(0.0, 0.0), (1.0, 0.0), (0.0, 0.7), (1.0, 0.7), (0.013, 0.01)]


def direct(samples, weights):
    out = np.empty(samples.size - weights.size + 1)
    convolve(samples, np.ascontiguousarray(weights[::-1]), out)
    return out


@pytest.mark.parametrize(("length", "difference"), LENGTHS)
def test_prefilter_is_a_hann_window_and_a_difference(length, difference):
    weights = impulse_response(length, difference, 0.01)
    order, shift = round(length / 0.01), round(difference / 0.01)
    assert weights.size == order + shift + 1
    window = np.hanning(order + 3)[1:-1]
    expected = np.convolve(window / window.sum(), [1.0, *[0.0] * (shift - 1), -1.0] if shift else [1.0])
    np.testing.assert_allclose(weights, expected, atol=1e-15)
    assert weights.sum() == pytest.approx(0.0 if shift else 1.0, abs=1e-14)


@pytest.mark.parametrize(("length", "difference"), LENGTHS)
def test_sinusoids_stay_sinusoids_with_the_gain_of_the_weights(length, difference):
    weights = impulse_response(length, difference, 0.01)
    past = weights.size - 1
    t = 0.01 * np.arange(-past, 500)
    gain = weights @ np.exp(-2.3j * 0.01 * np.arange(weights.size))
    expected = np.imag(gain * np.exp(1j * (2.3 * t[past:] + 0.4)))
    np.testing.assert_allclose(direct(np.sin(2.3 * t + 0.4), weights), expected, atol=1e-13)


@pytest.mark.parametrize(("length", "difference"), LENGTHS)
@pytest.mark.parametrize("missing", [[], [0], [299], [100, 101, 180]])
def test_fast_route_equals_the_direct_one(length, difference, missing):
    weights = impulse_response(length, difference, 0.01)
    samples = 1e3 * np.random.default_rng(0).standard_normal(300 + weights.size - 1)
    samples[missing] = np.nan
    slow, fast = direct(samples, weights), fast_convolve(samples, weights)
    assert np.array_equal(np.isnan(slow), np.isnan(fast))
    lost = np.zeros(slow.size, bool)
    for place in missing:
        lost[max(0, place - weights.size + 1) : place + 1] = True
    assert np.array_equal(np.isnan(slow), lost)
    np.testing.assert_allclose(fast, slow, rtol=0, atol=1e-12 * 1e3)
