"""Coloured noise: its covariance by two routes, its first samples, and what is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.errors import DataError
from ctid_cli.signals.noise import ArmaNoise, WhiteNoise
from ctid_cli.signals.streams import stream

ZEROS = np.zeros(500)
#: The noise of the first example of González, Classens, Rojas, Welsh and Oomen.
PUBLISHED = ArmaNoise((1.0, 0.5), (1.0, -0.85), innovation_variance=0.02)

FILTERS = {
    "first order": ((1.0, 0.5), (1.0, -0.85)),
    "autoregressive": ((1.0,), (1.0, -1.2, 0.7)),
    "moving average": ((1.0, -0.4, 0.3, 0.2), (1.0,)),
    "longer numerator": ((2.0, 1.0, 0.5, 0.25), (0.5, -0.2)),
    "common zero": ((1.0, -0.5), (1.0, -0.5)),
    "white": ((3.0,), (2.0,)),
}


class Given:
    """Stands for a generator: hands out the numbers that it was given, in order."""

    def __init__(self, numbers):
        self.numbers = list(numbers)

    def standard_normal(self, count):
        taken, self.numbers = self.numbers[:count], self.numbers[count:]
        assert len(taken) == count
        return np.array(taken)


def rng(replicate=0):
    return stream(11, "noise", replicate)


def by_impulse_response(numerator, denominator, lags, length=4000):
    """Covariance as the sum of products of the impulse response, by plain recursion."""
    response = np.zeros(length)
    for k in range(length):
        value = numerator[k] if k < len(numerator) else 0.0
        value -= sum(denominator[j] * response[k - j] for j in range(1, min(k, len(denominator) - 1) + 1))
        response[k] = value / denominator[0]
    return np.array([response[: length - lag] @ response[lag:] for lag in lags])


@pytest.mark.parametrize("name", FILTERS)
def test_covariance_is_that_of_the_impulse_response(name):
    noise = ArmaNoise(*FILTERS[name], innovation_variance=0.3)
    lags = [0, 1, 2, 3, 7, 20]
    expected = 0.3 * by_impulse_response(*FILTERS[name], lags)
    np.testing.assert_allclose(noise.autocovariance(lags), expected, atol=1e-13)
    np.testing.assert_array_equal(noise.autocovariance([-7, 0]), noise.autocovariance([7, 0]))
    assert noise.variance_of() == noise.autocovariance([0])[0]


@pytest.mark.parametrize("name", FILTERS)
def test_every_sample_is_drawn_from_the_stationary_distribution(name):
    # The noise is a linear map of independent standard normal numbers, so its covariance is the map's square.
    noise = ArmaNoise(*FILTERS[name], innovation_variance=0.3)
    states, samples = max(len(part) for part in FILTERS[name]) - 1, 9
    rows = [noise.generate(np.zeros(samples), Given(unit)) for unit in np.eye(states + samples)]
    covariance = np.array(rows).T @ np.array(rows)
    lags = np.abs(np.subtract.outer(np.arange(samples), np.arange(samples)))
    np.testing.assert_allclose(covariance, noise.autocovariance(lags), atol=1e-12)


def test_published_level():
    assert PUBLISHED.variance_of() == pytest.approx(0.1513513514, rel=1e-9)
    # (1 + c^2 + 2 c d) / (1 - d^2) for (1 + c q^-1) / (1 - d q^-1)
    assert PUBLISHED.variance_of() == pytest.approx(0.02 * (1 + 0.25 + 2 * 0.5 * 0.85) / (1 - 0.85**2), rel=1e-12)
    assert PUBLISHED.coloured
    assert PUBLISHED.filter == ((1.0, 0.5), (1.0, -0.85))


@given(st.floats(-40, 60), st.integers(0, 20))
def test_levels_scale_one_shape(snr_db, replicate):
    output = 3.0 + np.sin(0.1 * np.arange(300))
    unit = ArmaNoise((1.0, 0.5), (1.0, -0.85), variance=1.0).generate(output, rng(replicate))
    variance = np.mean(output**2) / 10 ** (snr_db / 10)
    by_ratio = ArmaNoise((1.0, 0.5), (1.0, -0.85), snr_db=snr_db)
    np.testing.assert_allclose(by_ratio.generate(output, rng(replicate)), np.sqrt(variance) * unit, rtol=1e-10)
    assert by_ratio.variance_of(output) == pytest.approx(variance)
    assert by_ratio.autocovariance([0], output)[0] == pytest.approx(variance)
    # The gain of a filter is one more way to say the level.
    doubled = ArmaNoise((2.0, 1.0), (2.0, -1.7), variance=variance).generate(output, rng(replicate))
    np.testing.assert_allclose(doubled, np.sqrt(variance) * unit, rtol=1e-10)


def test_longer_records_begin_with_the_shorter_ones():
    np.testing.assert_array_equal(PUBLISHED.generate(ZEROS, rng())[:80], PUBLISHED.generate(np.zeros(80), rng()))


def test_a_trivial_filter_is_white_noise():
    white = WhiteNoise(variance=0.04)
    arma = ArmaNoise((1.0,), (1.0,), innovation_variance=0.04)
    np.testing.assert_array_equal(arma.generate(ZEROS, rng()), white.generate(ZEROS, rng()))
    np.testing.assert_array_equal(arma.autocovariance([0, 1, 5]), white.autocovariance([0, 1, 5]))
    assert white.filter == arma.filter == ((1.0,), (1.0,))
    assert not white.coloured


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"innovation_variance": None},
            "exactly one of snr_db .*, variance .*, innovation_variance .*; none was given",
        ),
        ({"variance": 1.0}, "variance and innovation_variance were given"),
        ({"innovation_variance": -1.0}, r"innovation_variance must be zero or a positive number \[output unit\^2\]"),
        ({"denominator": (1.0, -1.0)}, "denominator has a zero of magnitude 1: the noise would grow without bound"),
        ({"denominator": (1.0, 0.0, 1.44)}, "denominator has a zero of magnitude 1.2"),
        ({"denominator": (0.0, 1.0)}, "the first coefficient of denominator is zero"),
        ({"numerator": (0.0, 1.0)}, "the first coefficient of numerator is zero"),
        ({"numerator": ()}, "numerator must hold at least one coefficient"),
        ({"numerator": (1.0, float("nan"))}, "a coefficient of numerator must be a finite number"),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ArmaNoise(**{"numerator": (1.0, 0.5), "denominator": (1.0, -0.85), "innovation_variance": 0.02} | options)


def test_a_ratio_needs_an_output():
    relative = ArmaNoise((1.0,), (1.0, -0.5), snr_db=10.0)
    with pytest.raises(DataError, match="noise-free output is zero"):
        relative.generate(np.zeros(10), rng())
    with pytest.raises(DataError, match="beside a noise-free output"):
        relative.variance_of()
