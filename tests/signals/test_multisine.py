"""Multisines: lines where they are asked for and nowhere else, and crest factors beside published ones."""

import numpy as np
import pytest

from ctid_cli.signals.multisine import Multisine
from ctid_cli.signals.streams import stream

PERIOD = 20.0
BASE = 2 * np.pi / PERIOD


def lines(excitation, points=8192):
    """Amplitudes of the harmonics over one period, and the samples."""
    times = PERIOD / points * np.arange(points)
    values = excitation.generate(times, stream(3, "input", 0)).values
    return 2 * np.abs(np.fft.rfft(values)) / points, values


def crest(excitation):
    _, values = lines(excitation)
    return np.abs(values).max() / np.sqrt(np.mean(values**2))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"frequencies": (3 * BASE, 7.001 * BASE, 20 * BASE)}, [3, 7, 20]),
        ({"lowest_frequency": 4 * BASE, "highest_frequency": 9 * BASE}, [4, 5, 6, 7, 8, 9]),
        ({"lowest_frequency": 4 * BASE, "highest_frequency": 9.9 * BASE, "spacing": "odd"}, [5, 7, 9]),
        ({"lowest_frequency": 1.1 * BASE, "highest_frequency": 12 * BASE, "tones": 3, "spacing": "odd"}, [3, 7, 11]),
        ({"lowest_frequency": BASE, "highest_frequency": 64 * BASE, "tones": 7, "spacing": "logarithmic"},
         [1, 2, 4, 8, 16, 32, 64]),
        # Crowded tones become one.
        ({"lowest_frequency": BASE, "highest_frequency": 3 * BASE, "tones": 9}, [1, 2, 3]),
    ],
)  # fmt: skip
@pytest.mark.parametrize("phases", ["random", "schroeder", "low_crest"])
def test_power_is_at_the_tones_and_nowhere_else(options, expected, phases):
    excitation = Multisine(**options, period=PERIOD, phases=phases, amplitude=1.5)
    found, values = lines(excitation)
    wanted = np.zeros_like(found)
    wanted[expected] = 1.5 * np.sqrt(2 / len(expected))
    np.testing.assert_allclose(found, wanted, atol=1e-10)
    assert np.sqrt(np.mean(values**2)) == pytest.approx(1.5, rel=1e-10)


def test_without_a_period_tones_are_where_they_are_said():
    assert Multisine(frequencies=(3.3, 0.1)).frequencies_used.tolist() == [0.1, 3.3]
    spread = Multisine(1.0, 100.0, tones=5, spacing="logarithmic").frequencies_used
    np.testing.assert_allclose(spread[1:] / spread[:-1], 10**0.5)


@pytest.mark.parametrize("tones", [15, 31, 100])
def test_crest_factors_are_the_published_ones(tones):
    """Schroeder 1970, about 1.7; Guillaume et al. 1991, about 1.4 for flat spectra without gaps."""
    band = {"lowest_frequency": BASE, "highest_frequency": tones * BASE, "period": PERIOD}
    times = PERIOD / 8192 * np.arange(8192)
    values = Multisine(**band, phases="schroeder").generate(times, None).values
    n = np.arange(1, tones + 1)
    explicit = np.cos(np.outer(BASE * times, n) - np.pi * n * (n - 1) / tones).sum(axis=1)
    np.testing.assert_allclose(values, np.sqrt(2 / tones) * explicit, atol=1e-10)
    assert 1.6 < crest(Multisine(**band, phases="schroeder")) < 1.85
    assert crest(Multisine(**band, phases="low_crest")) < 1.45
    # Odd harmonics repeat after half a period, with the other sign: the same holds of them.
    odd = {"lowest_frequency": BASE, "highest_frequency": 2 * tones * BASE, "period": PERIOD, "spacing": "odd"}
    assert 1.6 < crest(Multisine(**odd, phases="schroeder")) < 1.85
    assert crest(Multisine(**odd, phases="low_crest")) < 1.45


def test_low_phases_are_found_for_sparse_tones_and_repeat():
    sparse = {"lowest_frequency": BASE, "highest_frequency": 200 * BASE, "tones": 20, "spacing": "logarithmic"}
    low = Multisine(**sparse, period=PERIOD, phases="low_crest")
    drawn = [
        Multisine(**sparse, period=PERIOD).generate(0.005 * np.arange(4000), stream(1, "input", k)) for k in range(50)
    ]
    best = min(np.abs(signal.values).max() for signal in drawn)
    assert crest(low) < 2.2 < best
    times = 0.01 * np.arange(5000)
    first, other = (low.generate(times, stream(1, "input", k)).values for k in (0, 1))
    np.testing.assert_array_equal(first, other)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "lowest_frequency is missing"),
        ({"lowest_frequency": 1.0, "highest_frequency": 2.0}, "tones is missing: the number of tones; with a period"),
        ({"lowest_frequency": 1.0, "highest_frequency": 2.0, "period": 9.0, "spacing": "logarithmic"}, "tones is miss"),
        (
            {"lowest_frequency": 1.0, "highest_frequency": 2e9, "period": 9.0},
            "is filled up to harmonic 10000",
        ),
        ({"lowest_frequency": 1.0, "highest_frequency": 1.1, "period": 1.0}, r"no harmonic of 6.28319 rad/s in the b"),
        ({"lowest_frequency": 1.0, "highest_frequency": 2.0, "tones": 3, "spacing": "odd"}, "odd needs the period"),
        ({"frequencies": (1.0, 2.0), "phases": "low_crest"}, "low_crest needs the period"),
        ({"frequencies": (1.0, 2.0), "tones": 2}, "tones is of a band, and frequencies are given"),
        ({"frequencies": (1.0, 2.0), "spacing": "odd", "period": 6.0}, "spacing is how a band is filled"),
        ({"frequencies": (1.0, 2.0), "period": 1e300}, "the tones are up to harmonic 1000000 of the period"),
        ({"frequencies": (1.0, 9.0), "period": 6e3, "phases": "low_crest"}, "searched for up to harmonic 4000"),
        ({"frequencies": (1.0, 1.0)}, "two of the frequencies are the same; leave"),
        ({"frequencies": (1.0, 1.1), "period": 6.0}, "the same harmonic of the period"),
        ({"frequencies": (1.0, -1.1)}, r"each of the frequencies must be a positive number \[rad/s\], not -1.1"),
        ({"frequencies": (1.0,), "phases": "flat"}, "phases must be 'random' or 'schroeder' or 'low_crest'"),
        ({"frequencies": (1.0,), "period": 0.0}, "period must be a positive number"),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Multisine(**options)
