"""Excitations: what theory says of each signal, and where it takes its values."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.errors import DataError
from ctid_cli.signals.excitation import (
    TAPS,
    Gaussian,
    InputFile,
    Prbs,
    Step,
    maximal_length_sequence,
)
from ctid_cli.signals.multisine import Multisine
from ctid_cli.signals.sampling import RegularSampling, UniformIntervals
from ctid_cli.signals.streams import stream


def rng(replicate=0):
    return stream(7, "input", replicate)


def register(stages, length, state):
    """The shift register itself, bit by bit: the route that the block-wise generator is checked against."""
    bits = [(state >> k) & 1 for k in range(stages)]
    while len(bits) < length:
        bits.append(int(np.bitwise_xor.reduce([bits[-lag] for lag in TAPS[stages]])))
    return bits[:length]


# --- the register ---------------------------------------------------------------------------------


def test_taps_cover_all_register_sizes():
    assert sorted(TAPS) == list(range(2, 21))


@pytest.mark.parametrize("stages", TAPS)
def test_register_visits_every_state_but_zero(stages):
    period = 2**stages - 1
    bits = maximal_length_sequence(stages, period + stages - 1, state=1).astype(np.int64)
    states = sum(bits[k : k + period] << k for k in range(stages))
    assert np.array_equal(np.sort(states), np.arange(1, period + 1))


@pytest.mark.parametrize("stages", TAPS)
def test_register_repeats_after_its_period(stages):
    period = 2**stages - 1
    bits = maximal_length_sequence(stages, 2 * period + 3, state=period)
    assert np.array_equal(bits[period:], bits[: period + 3])


@pytest.mark.parametrize("stages", TAPS)
def test_period_has_one_more_one_than_zeros(stages):
    assert maximal_length_sequence(stages, 2**stages - 1, state=1).sum() == 2 ** (stages - 1)


@pytest.mark.parametrize("stages", TAPS)
def test_autocorrelation_has_two_values(stages):
    period = 2**stages - 1
    chips = 2.0 * maximal_length_sequence(stages, period, state=1) - 1
    spectrum = np.fft.rfft(chips)
    correlation = np.fft.irfft(np.abs(spectrum) ** 2, n=period)
    assert correlation[0] == pytest.approx(period, rel=1e-9)
    np.testing.assert_allclose(correlation[1:], -1.0, atol=1e-9 * period)


@given(st.data(), st.sampled_from(sorted(TAPS)), st.integers(1, 500))
def test_blocks_equal_the_bit_by_bit_register(data, stages, length):
    state = data.draw(st.integers(1, 2**stages - 1))
    assert maximal_length_sequence(stages, length, state).tolist() == register(stages, length, state)


# --- PRBS -----------------------------------------------------------------------------------------


def test_prbs_generates_only_the_chips_of_the_record():
    signal = Prbs(stages=20, clock_period=0.5).generate(np.array([0.0, 0.2, 1.7]), rng())
    np.testing.assert_allclose(signal.t, [0.0, 0.5, 1.0, 1.5])


def test_prbs_edge_at_the_last_sample_counts_whatever_the_rounding():
    assert 0.7 / 0.1 < 7
    assert Prbs(10, 0.1).generate(np.array([0.0, 0.7]), rng()).t.size == 8
    for interval in (0.05, 0.1, 0.3, 0.01):
        times = RegularSampling(interval, 4000).times(rng())
        assert Prbs(10, interval).generate(times, rng()).t.size == 4000
        np.testing.assert_allclose(Prbs(10, interval).generate(times, rng()).t, times, rtol=1e-14)


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


def test_prbs_phase_differs_between_replicates_and_never_locks_at_zero():
    times = RegularSampling(1.0, 2).times(rng())
    starts = {tuple(Prbs(2, 1.0).generate(times, rng(k)).values) for k in range(40)}
    # Two stages have three states; the fourth, all zeros, would stay for ever.
    assert starts == {(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0)}


# --- multisine ------------------------------------------------------------------------------------


def test_multisine_has_its_rms_and_equal_amplitudes_over_whole_periods():
    times = 0.01 * np.arange(2000)
    base = 2 * np.pi / 20
    signal = Multisine(3 * base, 30 * base, tones=10, amplitude=1.7).generate(times, rng())
    assert np.sqrt(np.mean(signal.values**2)) == pytest.approx(1.7, rel=1e-12)
    lines = 2 * np.abs(np.fft.rfft(signal.values)) / 2000
    expected = np.zeros_like(lines)
    expected[3:31:3] = 1.7 * np.sqrt(2 / 10)
    np.testing.assert_allclose(lines, expected, atol=1e-12)


def test_multisine_phases_are_random_and_repeatable():
    excitation = Multisine(1, 5, tones=5)
    times = 0.1 * np.arange(50)
    first, again, other = (excitation.generate(times, rng(k)).values for k in (0, 0, 1))
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)


def test_longer_multisine_begins_with_the_shorter():
    excitation = Multisine(1, 5, tones=5, clock_period=0.2)
    short = excitation.generate(0.1 * np.arange(50), rng()).values
    long = excitation.generate(0.1 * np.arange(500), rng()).values
    assert np.array_equal(long[: short.size], short)


def test_multisine_beyond_its_clock_is_refused():
    times = 0.1 * np.arange(50)
    Multisine(1, 31.4, tones=2).generate(times, rng())
    with pytest.raises(DataError, match=r"31\.5 rad/s, is not below 31\.4159 rad/s = pi / 0\.1 s"):
        Multisine(1, 31.5, tones=2).generate(times, rng())
    with pytest.raises(DataError, match=r"is not below 15\.708 rad/s = pi / 0\.2 s"):
        Multisine(1, 31.4, tones=2, clock_period=0.2).generate(times, rng())


# --- Gaussian, step -------------------------------------------------------------------------------


def test_gaussian_has_its_moments():
    values = Gaussian(standard_deviation=3.0).generate(np.arange(40_000.0), rng()).values
    # Four standard errors of the mean and of the standard deviation.
    assert abs(values.mean()) < 4 * 3 / 200
    assert abs(values.std() - 3) < 4 * 3 / np.sqrt(80_000)


@pytest.mark.parametrize("excitation", [Gaussian(), Multisine(1, 2, tones=3)])
def test_without_a_clock_every_instant_has_a_value(excitation):
    times = UniformIntervals(0.01, 0.09, 100).times(rng())
    signal = excitation.generate(times, rng())
    assert np.array_equal(signal.t, times)
    assert np.unique(signal.values).size == 100


def test_step_is_zero_before_its_time_and_held_after():
    signal = Step(amplitude=-2.0, time=1.05).generate(np.array([0.0, 1.0, 1.1, 5.0]), rng())
    assert signal.at([0.0, 1.0, 1.05, 1.1, 5.0]).tolist() == [0.0, 0.0, -2.0, -2.0, -2.0]
    assert Step().generate(np.array([0.0, 1.0]), rng()).at([0.0, 1.0]).tolist() == [1.0, 1.0]
    with pytest.raises(DataError, match="step at 5 s comes too late for a record that ends at 5 s"):
        Step(time=5.0).generate(np.array([0.0, 5.0]), rng())


# --- the user's file ------------------------------------------------------------------------------


@pytest.fixture
def input_file(tmp_path):
    def write(text):
        path = tmp_path / "input.csv"
        path.write_text(text)
        return str(path)

    return write


def test_file_is_applied_on_its_own_times(input_file):
    excitation = InputFile(input_file("s,volt\n0,1\n0.25,-1\n1,3\n9,4\n10,5\n"), time="s", input="volt")
    signal = excitation.generate(np.array([0.0, 0.7, 2.0]), rng())
    assert signal.at([0.0, 0.2, 0.25, 0.99, 1.0, 2.0]).tolist() == [1.0, 1.0, -1.0, -1.0, 3.0, 3.0]
    assert signal.t.size == 4  # only what the record needs


def test_file_with_straight_lines_reaches_the_end_of_the_record(input_file):
    signal = InputFile(input_file("t,u\n0,0\n10,20\n11,0\n"), hold="foh").generate(np.array([0.0, 4.0]), rng())
    assert signal.at([0.0, 1.0, 4.0]).tolist() == [0.0, 2.0, 8.0]


@pytest.mark.parametrize(("hold", "first"), [("zoh", 1.0), ("foh", 2.0)])
def test_what_lies_before_the_record_is_not_applied(input_file, hold, first):
    signal = InputFile(input_file("t,u\n-1,1\n1,3\n2,4\n"), hold=hold).generate(np.array([0.0, 5.0]), rng())
    assert signal.at([-0.5, 0.0, 1.0, 5.0]).tolist() == [0.0, first, 3.0, 4.0]


def test_break_at_the_first_sample_stays_one_break_whatever_the_rounding(input_file):
    excitation = InputFile(input_file(f"t,u\n0.2,1\n{0.1 + 0.2!r},3\n0.4,4\n"))
    signal = excitation.generate(np.array([0.3, 0.5]), rng())
    assert signal.t.tolist() == [0.3, 0.4]
    assert signal.values.tolist() == [3.0, 4.0]


def test_file_that_begins_late_is_zero_before_or_refused(input_file):
    excitation = InputFile(input_file("t,u\n1,3\n2,4\n"))
    assert excitation.generate(np.array([0.0, 5.0]), rng()).at([0.0, 1.0]).tolist() == [0.0, 3.0]
    with pytest.raises(DataError, match=r"begins at 1 s, and the record ends at 0\.5 s"):
        excitation.generate(np.array([0.0, 0.5]), rng())
    # What begins with the last sample moves nothing in the record either.
    with pytest.raises(DataError, match="begins at 1 s, and the record ends at 1 s"):
        excitation.generate(np.array([0.0, 1.0]), rng())


# --- options --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Prbs(1, 1.0), "stages must be an integer from 2 to 20, not 1"),
        (lambda: Prbs(21, 1.0), "stages must be an integer from 2 to 20, not 21"),
        (lambda: Prbs(4.0, 1.0), "stages must be an integer from 2 to 20, not 4.0"),
        (lambda: Prbs(10, 0.0), r"clock_period must be a positive number \[s\], not 0.0"),
        (lambda: Prbs(10, float("nan")), "clock_period must be a positive number"),
        (lambda: Prbs(10, 1.0, amplitude=-1.0), "amplitude must be a positive number"),
        (lambda: Prbs(10, 1.0, amplitude=True), "amplitude must be a positive number"),
        (lambda: Multisine(0.0, 1.0, 3), "lowest_frequency must be a positive number"),
        (lambda: Multisine(1.0, float("inf"), 3), "highest_frequency must be a positive number"),
        (
            lambda: Multisine(2.0, 1.0, 3),
            "lowest_frequency must not exceed highest_frequency; they are 2 and 1 rad/s",
        ),
        (lambda: Multisine(2.0, 2.0, 3), "3 tones need a band"),
        (lambda: Multisine(1.0, 2.0, 0), "tones must be an integer of at least 1, not 0"),
        (lambda: Multisine(1.0, 2.0, 3, clock_period=-1.0), "clock_period must be a positive number"),
        (lambda: Gaussian(0.0), "standard_deviation must be a positive number"),
        (lambda: Gaussian(clock_period=0.0), "clock_period must be a positive number"),
        (lambda: Step(0.0), "amplitude must not be zero"),
        (lambda: Step(float("inf")), "amplitude must be a finite number"),
        (lambda: Step(time=-1.0), "time must be zero or a positive number"),
        (lambda: InputFile("a.csv", hold="cubic"), "hold must be 'zoh' or 'foh' or 'band-limited', not 'cubic'"),
        (lambda: InputFile("a.csv", time="u"), "time and input must be two columns; both are 'u'"),
    ],
)
def test_impossible_options_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
