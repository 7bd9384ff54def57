"""Inputs: theoretical properties of each signal, and times of its changes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import max_len_seq

from ctid_cli.errors import DataError
from ctid_cli.signals.excitation import TAPS, Gbn, InputFile, Prbs, Step, Steps, maximal_length_sequence
from ctid_cli.signals.multisine import Multisine
from ctid_cli.signals.noise import stream


def rng(replicate=0):
    return stream(7, "input", replicate)


# --- binary inputs --------------------------------------------------------------------------------


@pytest.mark.parametrize("stages", TAPS)
def test_register_is_that_of_scipy(stages):
    length = min(3 * 2**stages + 7, 3000)
    for state in (1, 2**stages - 1):
        first = [(state >> k) & 1 for k in range(stages)]
        expected, _ = max_len_seq(stages, first, length, TAPS[stages])
        assert np.array_equal(maximal_length_sequence(stages, length, state), expected)


@pytest.mark.parametrize("stages", range(2, 21))
def test_register_visits_every_state_but_zero_and_has_two_correlations(stages):
    period = 2**stages - 1
    bits = maximal_length_sequence(stages, period + stages - 1, state=1).astype(np.int64)
    states = sum(bits[k : k + period] << k for k in range(stages))
    assert np.array_equal(np.sort(states), np.arange(1, period + 1))
    correlation = np.fft.irfft(np.abs(np.fft.rfft(2.0 * bits[:period] - 1)) ** 2, n=period)
    np.testing.assert_allclose(correlation, [period, *[-1.0] * (period - 1)], atol=1e-9 * period)


def test_an_edge_at_the_last_sample_counts_whatever_the_rounding():
    assert 0.7 / 0.1 < 7
    assert Prbs(10, 0.1).generate(np.array([0.0, 0.7]), rng()).t.size == 8


@given(st.floats(0.01, 5), st.integers(0, 20), st.floats(-100, 100))
def test_prbs_clock_is_independent_of_the_sampling(clock, replicate, start):
    fine = start + np.linspace(0, 20, 300)
    coarse = fine[[0, 100, 170, -1]]
    signals = [Prbs(6, clock, amplitude=2.5).generate(times, rng(replicate)) for times in (fine, coarse)]
    assert np.array_equal(signals[0].t, signals[1].t)
    assert np.array_equal(signals[0].values, signals[1].values)
    assert set(np.abs(signals[0].values)) == {2.5}
    assert signals[0].t[0] == fine[0]
    assert signals[0].t[-1] <= fine[-1] + 1e-6 * clock < signals[0].t[-1] + clock * (1 + 1e-5)


@pytest.mark.parametrize("probability", [0.1, 0.5, 1.0])
def test_gbn_switches_as_often_as_it_is_told(probability):
    signal = Gbn(0.2, probability, amplitude=3.0).generate(np.array([0.0, 20_000.0]), rng())
    assert set(np.abs(signal.values)) == {3.0}
    changes = np.diff(signal.values) != 0
    # Four standard errors of a share, and of the mean holding time 0.2 / p.
    assert abs(changes.mean() - probability) <= 4 * np.sqrt(probability * (1 - probability) / changes.size)
    held = 0.2 * np.diff(np.flatnonzero(changes))
    error = 0.2 * np.sqrt(1 - probability) / probability / np.sqrt(held.size)
    assert abs(held.mean() - 0.2 / probability) <= 4 * error + 1e-12
    firsts = [Gbn(0.2).generate(np.array([0.0, 1.0]), rng(k)).values[0] for k in range(400)]
    assert abs(np.mean(firsts)) < 4 / 20


# --- sums of sinusoids ----------------------------------------------------------------------------

PERIOD = 20.0
BASE = 2 * np.pi / PERIOD


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"frequencies": (3 * BASE, 7.001 * BASE, 20 * BASE)}, [3, 7, 20]),
        ({"lowest_frequency": 4 * BASE, "highest_frequency": 9 * BASE}, [4, 5, 6, 7, 8, 9]),
        (
            {"lowest_frequency": BASE, "highest_frequency": 64 * BASE, "tones": 7, "spacing": "logarithmic"},
            [1, 2, 4, 8, 16, 32, 64],
        ),
        # Coinciding tones become one.
        ({"lowest_frequency": BASE, "highest_frequency": 3 * BASE, "tones": 9}, [1, 2, 3]),
    ],
)
@pytest.mark.parametrize("phases", ["random", "schroeder"])
def test_power_is_at_the_tones_and_nowhere_else(options, expected, phases):
    excitation = Multisine(**options, period=PERIOD, phases=phases, amplitude=1.5)
    values = excitation.generate(PERIOD / 4096 * np.arange(4096), rng()).values
    wanted = np.zeros(2049)
    wanted[expected] = 1.5 * np.sqrt(2 / len(expected))
    np.testing.assert_allclose(2 * np.abs(np.fft.rfft(values)) / 4096, wanted, atol=1e-10)


@pytest.mark.parametrize("tones", [15, 100])
def test_schroeder_phases_are_the_published_ones(tones):
    times = PERIOD / 8192 * np.arange(8192)
    values = Multisine(BASE, tones * BASE, period=PERIOD, phases="schroeder").generate(times, None).values
    n = np.arange(1, tones + 1)
    explicit = np.cos(np.outer(BASE * times, n) - np.pi * n * (n - 1) / tones).sum(axis=1)
    np.testing.assert_allclose(values, np.sqrt(2 / tones) * explicit, atol=1e-10)
    assert 1.6 < np.abs(values).max() / np.sqrt(np.mean(values**2)) < 1.85


def test_multisine_beyond_its_clock_is_refused():
    times = 0.1 * np.arange(50)
    Multisine(1, 31.4, tones=2).generate(times, rng())
    with pytest.raises(DataError, match=r"31\.5 rad/s, is not below 31\.4159 rad/s = pi / 0\.1 s"):
        Multisine(1, 31.5, tones=2).generate(times, rng())
    with pytest.raises(DataError, match=r"is not below 15\.708 rad/s = pi / 0\.2 s"):
        Multisine(1, 31.4, tones=2, clock_period=0.2).generate(times, rng())


# --- Gaussian values, steps -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("excitation", "start", "values"),
    [
        (Step(amplitude=-2.0, time=1.05), 0.0, [0.0, 0.0, -2.0, -2.0, -2.0]),
        (Step(), 0.0, [1.0, 1.0, 1.0, 1.0, 1.0]),
        (Steps((1.0, 1.1, 40.0), (2.0, -1.0, 5.0)), 0.0, [0.0, 2.0, 2.0, -1.0, -1.0]),
        # The last of the steps before the record gives its initial value.
        (Steps((0.2, 0.4, 1.1), (7.0, 3.0, -1.0)), 0.5, [0.0, 3.0, 3.0, -1.0, -1.0]),
    ],
)
def test_steps_hold_their_levels(excitation, start, values):
    signal = excitation.generate(np.array([start, 30.0]), None)
    assert signal.t[0] == start
    assert signal.at([0.0, 1.0, 1.05, 1.1, 5.0]).tolist() == values


@pytest.mark.parametrize("excitation", [Step(time=5.0), Steps((5.0,), (1.0,)), Steps((5.0, 6.0), (1.0, 2.0))])
def test_steps_behind_the_record_are_refused(excitation):
    with pytest.raises(DataError, match="step at 5 s comes too late for a record that ends at 5 s"):
        excitation.generate(np.array([0.0, 5.0]), rng())


# --- a file ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "hold", "record", "instants", "values"),
    [
        ("t,u\n0,1\n0.25,-1\n1,3\n9,4\n10,5\n", "zoh", [0.0, 0.7, 2.0], [0.2, 0.25, 0.99, 2.0], [1, -1, -1, 3]),
        # Straight lines extend to the end of the record.
        ("t,u\n0,0\n10,20\n11,0\n", "foh", [0.0, 4.0], [0.0, 1.0, 4.0], [0, 2, 8]),
        # Values before the record are not used.
        ("t,u\n-1,1\n1,3\n2,4\n", "zoh", [0.0, 5.0], [-0.5, 0.0, 1.0, 5.0], [0, 1, 3, 4]),
        ("t,u\n-1,1\n1,3\n2,4\n", "foh", [0.0, 5.0], [-0.5, 0.0, 1.0, 5.0], [0, 2, 3, 4]),
        # Before the first break the input is zero.
        ("t,u\n1,3\n2,4\n", "zoh", [0.0, 5.0], [0.0, 1.0], [0, 3]),
    ],
)
def test_a_file_is_applied_on_its_own_times(tmp_path, text, hold, record, instants, values):
    (tmp_path / "input.csv").write_text(text)
    signal = InputFile(str(tmp_path / "input.csv"), hold=hold).generate(np.array(record), rng())
    assert signal.at(instants).tolist() == values


def test_a_break_at_the_first_sample_stays_one_break_whatever_the_rounding(tmp_path):
    (tmp_path / "input.csv").write_text(f"t,u\n0.2,1\n{0.1 + 0.2!r},3\n0.4,4\n9,5\n")
    signal = InputFile(str(tmp_path / "input.csv")).generate(np.array([0.3, 0.5]), rng())
    assert signal.t.tolist() == [0.3, 0.4, 9.0]
    assert signal.values.tolist() == [3.0, 4.0, 5.0]
