"""Noise: covariance by two methods, first samples, levels; and random streams."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from ctid_cli.errors import DataError
from ctid_cli.signals.noise import ROLES, ArmaNoise, WhiteNoise, stream

OUTPUT = 3.0 + np.sin(0.1 * np.arange(500))
FILTERS = {
    "first order": ((1.0, 0.5), (1.0, -0.85)),
    "autoregressive": ((1.0,), (1.0, -1.2, 0.7)),
    "moving average": ((1.0, -0.4, 0.3, 0.2), (1.0,)),
    "longer numerator": ((2.0, 1.0, 0.5, 0.25), (0.5, -0.2)),
    "common zero": ((1.0, -0.5), (1.0, -0.5)),
    "white": ((3.0,), (2.0,)),
}
#: The noise of the first example of González, Classens, Rojas, Welsh and Oomen.
PUBLISHED = {"numerator": (1.0, 0.5), "denominator": (1.0, -0.85)}


class Given:
    """Generator that returns given numbers in order."""

    def __init__(self, numbers):
        self.numbers = list(numbers)

    def standard_normal(self, count):
        taken, self.numbers = self.numbers[:count], self.numbers[count:]
        assert len(taken) == count
        return np.array(taken)


def rng(replicate=0):
    return stream(11, "noise", replicate)


def by_impulse_response(numerator, denominator, lags, length=4000):
    """Return the covariance as the sum of products of the impulse response."""
    response = lfilter(numerator, denominator, np.eye(1, length)[0])
    return np.array([response[: length - lag] @ response[lag:] for lag in lags])


@pytest.mark.parametrize("name", FILTERS)
def test_covariance_is_that_of_the_impulse_response(name):
    noise = ArmaNoise(*FILTERS[name], innovation_variance=0.3)
    lags = [0, 1, 2, 3, 7, -20]
    expected = 0.3 * by_impulse_response(*FILTERS[name], np.abs(lags))
    np.testing.assert_allclose(noise.autocovariance(lags), expected, atol=1e-13)


@pytest.mark.parametrize("name", FILTERS)
def test_every_sample_is_drawn_from_the_stationary_distribution(name):
    # The noise is a linear map of independent standard normal numbers, so its covariance is the map's square.
    noise = ArmaNoise(*FILTERS[name], innovation_variance=0.3)
    states, samples = max(len(part) for part in FILTERS[name]) - 1, 9
    rows = [noise.generate(np.zeros(samples), Given(unit)) for unit in np.eye(states + samples)]
    covariance = np.array(rows).T @ np.array(rows)
    lags = np.abs(np.subtract.outer(np.arange(samples), np.arange(samples)))
    np.testing.assert_allclose(covariance, noise.autocovariance(lags), atol=1e-12)


@given(st.floats(-40, 60), st.integers(0, 20))
def test_levels_scale_one_shape(snr_db, replicate):
    variance = np.mean(OUTPUT**2) / 10 ** (snr_db / 10)
    white, coloured = rng(replicate).standard_normal(500), ArmaNoise(**PUBLISHED, variance=1.0)
    for noise, unit in [
        (WhiteNoise(snr_db=snr_db), white),
        (WhiteNoise(variance=variance), white),
        (WhiteNoise(standard_deviation=np.sqrt(variance)), white),
        (ArmaNoise((1.0,), (1.0,), variance=variance), white),
        (ArmaNoise(**PUBLISHED, snr_db=snr_db), coloured.generate(OUTPUT, rng(replicate))),
        # The gain of a filter is another way to set the level.
        (ArmaNoise((2.0, 1.0), (2.0, -1.7), variance=variance), coloured.generate(OUTPUT, rng(replicate))),
    ]:
        drawn = noise.generate(OUTPUT, rng(replicate))
        np.testing.assert_allclose(drawn, np.sqrt(variance) * unit, rtol=1e-10)
        assert noise.autocovariance([0], OUTPUT)[0] == pytest.approx(variance)
        # Longer records begin with the shorter ones.
        if noise.snr_db is None:
            assert np.array_equal(noise.generate(OUTPUT[:80], rng(replicate)), drawn[:80])


@pytest.mark.parametrize("noise", [WhiteNoise(snr_db=10.0), ArmaNoise((1.0,), (1.0, -0.5), snr_db=10.0)])
def test_a_ratio_needs_an_output(noise):
    with pytest.raises(DataError, match="noise-free output is zero"):
        noise.generate(np.zeros(10), rng())
    with pytest.raises(DataError, match="relative to a noise-free output"):
        noise.autocovariance([0])


def test_streams_are_those_of_the_spawn_keys_and_differ():
    # Stored results are repeatable only if these numbers never change.
    assert ROLES == {"input": 0, "sampling": 1, "noise": 2, "start": 3, "parameters": 4}
    expected = np.random.default_rng(np.random.SeedSequence(20170331, spawn_key=(2, 5))).standard_normal(3)
    assert np.array_equal(stream(20170331, "noise", 5).standard_normal(3), expected)
    draws = {float(stream(s, role, k).random()) for s in (0, 1) for role in ROLES for k in range(5)}
    assert len(draws) == 2 * len(ROLES) * 5
