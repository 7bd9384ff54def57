"""Noise in continuous time: increments, spectra and covariances on clocks of every sort."""

import numpy as np
import pytest
from scipy.stats import kstest

from ctid_cli.errors import DataError
from ctid_cli.signals import drifts
from ctid_cli.signals.drifts import OneOverFNoise, RandomWalk, noise_at
from ctid_cli.signals.irregular import PoissonSampling
from ctid_cli.signals.noise import OutlierNoise, WhiteNoise
from ctid_cli.signals.sinusoids import disturb
from ctid_cli.signals.streams import stream

TIMES = PoissonSampling(0.1, 20_000).times(stream(2, "sampling", 0))
OUTPUT = 3.0 * np.sin(TIMES)


def rng(replicate=0):
    return stream(8, "noise", replicate)


def test_a_random_walk_has_independent_normal_increments():
    walk = RandomWalk(intensity=0.25).generate_at(TIMES, OUTPUT, rng())
    assert walk[0] == 0.0
    increments = np.diff(walk) / np.sqrt(0.25 * np.diff(TIMES))
    assert kstest(increments, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(increments[1:], increments[:-1])[0, 1]) < 4 / np.sqrt(increments.size)


@pytest.mark.parametrize("options", [{"variance": 4.0}, {"snr_db": 10 * np.log10(np.mean(OUTPUT**2) / 4.0)}])
def test_the_mean_square_of_a_random_walk_is_as_asked(options):
    times = TIMES[:300]
    output = OUTPUT[:300] * np.sqrt(np.mean(OUTPUT**2) / np.mean(OUTPUT[:300] ** 2))
    squares = [np.mean(RandomWalk(**options).generate_at(times, output, rng(k)) ** 2) for k in range(2000)]
    assert abs(np.mean(squares) - 4.0) < 4 * np.std(squares) / np.sqrt(2000)


@pytest.mark.parametrize("exponent", [0.5, 1.0, 1.5])
def test_the_density_over_the_band_falls_as_told(exponent):
    corners, shares = OneOverFNoise(1e-4, 1e4, exponent, variance=1.0).processes()
    w = np.geomspace(0.01, 100.0, 200)
    density = (2 * corners * shares / (corners**2 + w[:, None] ** 2)).sum(axis=1)
    slope = np.polyfit(np.log(w), np.log(density), 1)[0]
    assert slope == pytest.approx(-exponent, abs=0.02)


def test_the_density_is_one_over_f_up_to_the_ends_of_the_band():
    corners, shares = OneOverFNoise(1e-4, 1e4, variance=1.0).processes()
    w = np.concatenate(([1e-4, 1e-3], np.geomspace(0.1, 10.0, 100)))
    relative = w * (2 * corners * shares / (corners**2 + w[:, None] ** 2)).sum(axis=1)
    relative *= np.log(corners[1] / corners[0]) / (np.pi * shares[0])
    assert relative[:2] == pytest.approx([0.68, 0.967], abs=0.005)
    assert np.abs(relative[2:] - 1).max() < 1e-3


def test_the_periodogram_falls_like_one_over_f():
    """Periodograms are exponential about the density of the sampled noise, so that the error of a slope is known."""
    count, step, sets = 8192, 0.01, 40
    times = step * np.arange(count)
    noise = OneOverFNoise(0.02, 2000.0, variance=1.0)
    w = 2 * np.pi * np.fft.rfftfreq(count, step)
    # Far below the Nyquist frequency, where little is folded back; a Hann window correlates neighbours only.
    chosen = np.flatnonzero((w > 1) & (w < 20))[::3]
    sets_of = (np.hanning(count) * noise.generate_at(times, times, rng(k)) for k in range(sets))
    power = np.mean([np.abs(np.fft.rfft(one)[chosen]) ** 2 for one in sets_of], axis=0)
    corners, shares = noise.processes()
    a = np.exp(-corners * step)
    sampled = (shares * (1 - a**2) / (1 - 2 * a * np.cos(w[chosen, None] * step) + a**2)).sum(axis=1)
    design = np.column_stack((np.ones(chosen.size), np.log(w[chosen])))
    found, expected = (np.linalg.lstsq(design, np.log(one), rcond=None)[0][1] for one in (power, sampled))
    # The logarithm of a mean of n exponential variables has the variance 1/n, nearly.
    error = np.sqrt(np.linalg.inv(design.T @ design)[1, 1] / sets)
    assert abs(found - expected) < 4 * error < 0.12
    assert expected == pytest.approx(-1.0, abs=0.06)


def test_one_over_f_has_its_covariance_on_an_irregular_clock():
    times = np.array([0.0, 0.05, 0.3, 4.0])
    noise = OneOverFNoise(0.1, 100.0, variance=2.0)
    drawn = np.array([noise.generate_at(times, times, rng(k)) for k in range(6000)])
    corners, shares = noise.processes()
    expected = 2.0 * np.exp(-np.abs(np.subtract.outer(times, times))[..., None] * corners) @ shares
    error = np.sqrt((expected**2 + np.outer(np.diag(expected), np.diag(expected))) / 6000)
    assert (np.abs(drawn.T @ drawn / 6000 - expected) < 4 * error).all()


def test_long_records_are_drawn_in_blocks_and_begin_with_the_shorter_ones(monkeypatch):
    noise = OneOverFNoise(0.1, 100.0, snr_db=10.0)
    whole = noise.generate_at(TIMES[:500], np.ones(500), rng())
    monkeypatch.setattr(drifts, "BLOCK", 64)
    np.testing.assert_array_equal(noise.generate_at(TIMES[:500], np.ones(500), rng()), whole)
    np.testing.assert_array_equal(noise.generate_at(TIMES[:200], np.ones(200), rng()), whole[:200])


def test_a_signal_is_disturbed_at_its_instants():
    noise = OneOverFNoise(0.1, 100.0, variance=2.0)
    disturbed = disturb(OUTPUT, TIMES, noise, rng())
    np.testing.assert_array_equal(disturbed, OUTPUT + noise.generate_at(TIMES, OUTPUT, rng()))


def test_noise_of_samples_needs_no_times():
    white = WhiteNoise(variance=1.0)
    np.testing.assert_array_equal(noise_at(white, TIMES, OUTPUT, rng()), white.generate(OUTPUT, rng()))


def test_outliers_have_their_share_and_size():
    noise = OutlierNoise(share=0.1, size=10.0, standard_deviation=2.0)
    drawn = noise.generate(OUTPUT, rng()) / 2.0
    regular = WhiteNoise(standard_deviation=1.0).generate(OUTPUT, rng())
    outliers = ~np.isclose(drawn, regular)
    np.testing.assert_allclose(drawn[outliers], 10.0 * regular[outliers])
    assert abs(outliers.mean() - 0.1) < 4 * np.sqrt(0.09 / OUTPUT.size)
    assert noise.variance_of() == pytest.approx(4.0 * (0.9 + 0.1 * 100))
    assert noise.autocovariance([0, 1]).tolist() == pytest.approx([noise.variance_of(), 0.0])
    loud = OutlierNoise(share=0.1, size=10.0, snr_db=3.0)
    reached = [10 * np.log10(np.mean(OUTPUT**2) / np.mean(loud.generate(OUTPUT, rng(k)) ** 2)) for k in range(100)]
    assert abs(np.mean(reached) - 3.0) < 0.05


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: RandomWalk(),
            r"needs exactly one of snr_db \[dB\], variance .*, intensity \[output unit\^2/s\]; none",
        ),
        (lambda: RandomWalk(intensity=-1.0), "intensity must be zero or a positive number"),
        (lambda: OneOverFNoise(2.0, 1.0, variance=1.0), "lowest_frequency must be below highest_frequency; they are 2"),
        (lambda: OneOverFNoise(1.0, 2.0, 2.0, variance=1.0), r"exponent must be below 2 \[-\], not 2.0; 2 is a random"),
        (lambda: OneOverFNoise(1.0, 2.0), "needs exactly one of snr_db"),
        (lambda: OutlierNoise(0.0, 9.0, variance=1.0), "share must be a number above 0 and below 1"),
        (lambda: OutlierNoise(0.1, 0.0, variance=1.0), "size must be a positive number"),
        (lambda: OutlierNoise(0.1, 9.0), "needs exactly one of snr_db"),
    ],
)
def test_impossible_options_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_ratio_to_nothing_is_refused():
    with pytest.raises(DataError, match="noise-free output is zero"):
        RandomWalk(snr_db=10.0).generate_at(TIMES, 0 * OUTPUT, rng())
