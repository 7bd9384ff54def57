"""Chirps, staircases, doublets and binary noise: what each formula, or its definition, says of them."""

import numpy as np
import pytest
from scipy.signal import chirp
from scipy.stats import chi2

from ctid_cli.errors import DataError
from ctid_cli.signals.chirp import Chirp
from ctid_cli.signals.excitation import Gbn
from ctid_cli.signals.sampling import UniformIntervals
from ctid_cli.signals.steps import Doublets, Steps
from ctid_cli.signals.streams import stream

TIMES = 0.01 * np.arange(3001)


@pytest.mark.parametrize("ends", [(0.5, 20.0), (20.0, 0.5)])
@pytest.mark.parametrize(("sweep", "method"), [("linear", "linear"), ("logarithmic", "logarithmic")])
def test_chirp_is_that_of_scipy(ends, sweep, method):
    first, last = (end / (2 * np.pi) for end in ends)
    values = Chirp(*ends, amplitude=1.5, sweep=sweep).generate(TIMES + 2.0, None).values
    np.testing.assert_allclose(values, 1.5 * chirp(TIMES, first, 30.0, last, method, phi=-90), atol=1e-9)
    # A sweep of ten seconds begins anew twice.
    again = Chirp(*ends, sweep=sweep, duration=10.0).generate(TIMES, None).values
    np.testing.assert_allclose(again[1000:2000], again[:1000], atol=1e-9)


def test_chirp_stays_on_its_clock():
    signal = Chirp(1.0, 3.0, clock_period=0.5).generate(TIMES, None)
    np.testing.assert_allclose(signal.t, 0.5 * np.arange(61))
    with pytest.raises(DataError, match=r"the chirp's highest frequency, 7 rad/s, is not below 6.28319"):
        Chirp(7.0, 3.0, clock_period=0.5).generate(TIMES, None)


def test_steps_hold_their_levels():
    signal = Steps((1.0, 2.5, 40.0), (2.0, -1.0, 5.0)).generate(TIMES, None)
    assert signal.at([0.0, 0.99, 1.0, 2.49, 2.5, 30.0]).tolist() == [0.0, 0.0, 2.0, 2.0, -1.0, -1.0]
    assert Steps((0.0,), (3.0,)).generate(TIMES, None).t.tolist() == [0.0]
    with pytest.raises(DataError, match="the first step, at 31 s, comes too late for a record that ends at 30 s"):
        Steps((31.0,), (1.0,)).generate(TIMES, None)


@pytest.mark.parametrize("pause", [0.0, 0.7])
def test_doublets_are_their_definition(pause):
    width, begin = 0.5, 1.25
    signal = Doublets(width, amplitude=-2.0, time=begin, count=3, pause=pause).generate(TIMES, None)
    place = (TIMES + 1e-9 - begin) % (2 * width + pause)
    inside = (begin - 1e-9 <= TIMES) & (TIMES + 1e-9 < begin + 3 * (2 * width + pause))
    expected = np.where(place < width, -2.0, np.where(place < 2 * width, 2.0, 0.0)) * inside
    np.testing.assert_array_equal(signal.at(TIMES), expected)
    with pytest.raises(DataError, match="the doublet at 30 s comes too late"):
        Doublets(width, time=30.0).generate(TIMES, None)


@pytest.mark.parametrize("probability", [0.1, 0.5, 1.0])
def test_gbn_switches_as_often_as_it_is_told(probability):
    times = UniformIntervals(0.1, 0.3, 100_001).times(stream(4, "sampling", 0))
    signal = Gbn(0.2, probability, amplitude=3.0).generate(times, stream(4, "input", 1))
    assert set(np.abs(signal.values)) == {3.0}
    np.testing.assert_allclose(np.diff(signal.t), 0.2, rtol=1e-6)
    changes = np.diff(signal.values) != 0
    # Four standard errors of a share, and of the mean holding time 0.2 / p.
    assert abs(changes.mean() - probability) <= 4 * np.sqrt(probability * (1 - probability) / changes.size)
    held = 0.2 * np.diff(np.flatnonzero(changes))
    error = 0.2 * np.sqrt(1 - probability) / probability / np.sqrt(held.size)
    assert abs(held.mean() - 0.2 / probability) <= 4 * error + 1e-12
    firsts = [Gbn(0.2).generate(np.array([0.0, 1.0]), stream(4, "input", k)).values[0] for k in range(200)]
    assert chi2.sf((sum(firsts) ** 2) / 200, 1) > 1e-4


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Chirp(1.0, 1.0), "last_frequency is that of the beginning, 1 rad/s"),
        (lambda: Chirp(0.0, 1.0), "first_frequency must be a positive number"),
        (lambda: Chirp(1.0, 2.0, sweep="log"), "sweep must be 'linear' or 'logarithmic', not 'log'"),
        (lambda: Chirp(1.0, 2.0, duration=-1.0), "duration must be a positive number"),
        (lambda: Steps((0.0, 1.0), (1.0,)), "levels must be as many as times, and there are 1 of them and 2 times"),
        (lambda: Steps((1.0, 1.0), (1.0, 2.0)), r"times must increase from 0 s on; they are \[1.0, 1.0\] s"),
        (lambda: Steps((-1.0,), (1.0,)), "times must increase from 0 s on"),
        (lambda: Steps((0.0,), (0.0,)), "levels must not all be zero"),
        (lambda: Doublets(0.0), "width must be a positive number"),
        (lambda: Doublets(1.0, amplitude=0.0), "amplitude must not be zero"),
        (lambda: Doublets(1.0, count=0), "count must be an integer from 1"),
        (lambda: Gbn(1.0, 0.0), r"switching_probability must be a number above 0 and at most 1 \[-\], not 0.0"),
        (lambda: Gbn(1.0, 1.5), "switching_probability must be a number above 0 and at most 1"),
    ],
)
def test_impossible_options_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
