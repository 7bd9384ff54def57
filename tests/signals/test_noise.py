"""White noise at a level."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.errors import DataError
from ctid_cli.signals.noise import WhiteNoise
from ctid_cli.signals.streams import stream


def rng(replicate=0):
    return stream(11, "noise", replicate)


OUTPUT = 3.0 + np.sin(0.1 * np.arange(500))


@given(st.floats(-40, 120), st.integers(0, 20))
def test_levels_scale_one_shape(snr_db, replicate):
    reference = rng(replicate).standard_normal(OUTPUT.size)
    noise = WhiteNoise(snr_db=snr_db).generate(OUTPUT, rng(replicate))
    scale = np.sqrt(np.mean(OUTPUT**2) / 10 ** (snr_db / 10))
    np.testing.assert_allclose(noise, scale * reference, rtol=1e-12)
    np.testing.assert_allclose(WhiteNoise(standard_deviation=scale).generate(OUTPUT, rng(replicate)), noise, rtol=1e-12)
    np.testing.assert_allclose(WhiteNoise(variance=scale**2).generate(OUTPUT, rng(replicate)), noise, rtol=1e-12)
    for level in (WhiteNoise(snr_db=snr_db), WhiteNoise(standard_deviation=scale), WhiteNoise(variance=scale**2)):
        assert level.variance_of(OUTPUT) == pytest.approx(scale**2, rel=1e-12)


def test_snr_is_reached():
    output = np.sin(0.01 * np.arange(100_000))
    noise = WhiteNoise(snr_db=5.0).generate(output, rng())
    reached = 10 * np.log10(np.mean(output**2) / np.mean(noise**2))
    # Four standard errors: the variance of N samples has the relative deviation sqrt(2/N).
    assert abs(reached - 5) < 4 * 10 / np.log(10) * np.sqrt(2 / 100_000)


def test_noise_is_white_and_independent_of_the_output():
    noise = WhiteNoise(standard_deviation=1.0).generate(np.ones(40_000), rng())
    bound = 4 / np.sqrt(noise.size)
    assert abs(noise.mean()) < bound
    for lag in (1, 2, 10):
        assert abs(np.mean(noise[lag:] * noise[:-lag])) < bound


def test_output_is_not_changed():
    output = OUTPUT.copy()
    WhiteNoise(snr_db=0.0).generate(output, rng())
    assert np.array_equal(output, OUTPUT)


def test_zero_deviation_is_no_noise_and_draws_as_much():
    generator, same = rng(), rng()
    assert not WhiteNoise(standard_deviation=0.0).generate(OUTPUT, generator).any()
    same.standard_normal(OUTPUT.size)
    assert generator.random() == same.random()


def test_snr_of_nothing_is_refused():
    with pytest.raises(DataError, match="noise-free output is zero"):
        WhiteNoise(snr_db=10.0).generate(np.zeros(10), rng())
    with pytest.raises(DataError, match="beside a noise-free output"):
        WhiteNoise(snr_db=10.0).variance_of()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "needs exactly one of snr_db .*, standard_deviation .*, variance .*; none was given"),
        ({"snr_db": 5.0, "standard_deviation": 1.0}, "snr_db and standard_deviation were given"),
        ({"variance": 5.0, "standard_deviation": 1.0}, "standard_deviation and variance were given"),
        ({"variance": -0.1}, r"variance must be zero or a positive number \[output unit\^2\], not -0.1"),
        ({"snr_db": float("inf")}, r"snr_db must be a finite number \[dB\], not inf"),
        ({"snr_db": "loud"}, "snr_db must be a finite number"),
        (
            {"standard_deviation": -1.0},
            r"standard_deviation must be zero or a positive number \[output unit\], not -1",
        ),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        WhiteNoise(**options)
