"""Synchrophasors: truth by formulas, the same equations solved in another way, and what makes a row invalid."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import freqz

from ctid_cli.errors import DataError, OptionError
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.synchrophasor import measure_synchrophasors
from ctid_cli.frequency.synchrophasor_filters import POINTS, REPORTING_RATES, design_filters, frequency_range

ALL = [(nominal, kind, rate) for nominal, rates in REPORTING_RATES.items() for rate in rates for kind in "PM"]


def tone(t, frequency, phase=0.3, amplitude=1.0):
    return amplitude * np.cos(2 * np.pi * frequency * t + phase)


def measured(samples, rate, start=0.0, nominal=50, kind="P", reports=None):
    options = {"nominal": nominal, "performance_class": kind, "reporting_rate": reports}
    return measure_synchrophasors(samples, 1 / rate, start=start, **options)


@pytest.mark.parametrize(("nominal", "kind", "reports"), ALL)
def test_a_steady_tone_is_exact_at_any_frequency_on_any_clock(nominal, kind, reports):
    rate, start = 1234.5, 7.00031
    t = start + np.arange(int(1.7 * rate)) / rate
    frequency = nominal - 1.3
    found = measured(tone(t, frequency, amplitude=230 * math.sqrt(2)), rate, start, nominal, kind, reports)
    true = 230 * np.exp(1j * (0.3 + 2 * np.pi * (frequency - nominal) * found.t))
    # Two cycles meet the image of the tone as well as the last iteration has centred them.
    assert np.abs(found.phasor - true).max() < 1e-6 * 230
    assert np.abs(found.frequency - frequency).max() < 1e-8
    assert np.abs(found.rocof).max() < 1e-6
    assert found.valid.all()
    # Reports at the multiples of the reporting interval, as many as have their window within the record.
    assert found.t * reports == pytest.approx(np.round(found.t * reports), abs=1e-9)
    assert found.t[0] - start >= found.latency - 1e-9


def test_harmonics_and_an_offset_do_not_count_whatever_the_frequency():
    rate, frequency = 6000.0, 51.3
    t = np.arange(int(0.4 * rate)) / rate
    y = tone(t, frequency) + 0.5 + sum(0.1 / h * tone(t, h * frequency, h) for h in range(2, 40))
    for kind, reports in (("P", 50), ("P", 100), ("M", 50)):
        found = measured(y, rate, kind=kind, reports=reports)
        assert np.abs(found.frequency - frequency).max() < 3e-3
        assert np.abs(np.abs(found.phasor) * math.sqrt(2) - 1).max() < 1e-4


def test_the_compiled_solution_is_that_of_the_equations():
    """Any signal: kernels by interpolation, six equations by a general solver."""
    rng, rate = np.random.default_rng(5), 1600.0
    t = np.arange(400) / rate + 0.0002
    y = tone(t, 49.2) + 0.05 * rng.standard_normal(t.size)
    found = measured(y, rate, float(t[0]), kind="P", reports=25)
    filters, k = design_filters(50, "P", 25), 2
    u = (t - found.t[k]) * found.frequency[k]
    grid = (np.arange(filters.tables.shape[0]) - filters.tables.shape[0] // 2) / POINTS
    kernels = [np.interp(u, grid, filters.tables[:, i], left=0.0, right=0.0) for i in range(3)]
    carrier, powers = np.exp(2j * np.pi * u), [np.ones_like(u), u, u * u / 2]
    # Real part and imaginary part of p as six unknowns: x = sum Re(carrier) u^m a_m - Im(carrier) u^m b_m.
    columns = [m * carrier.real for m in powers] + [-m * carrier.imag for m in powers]
    rows, right = [], []
    for i, kernel in enumerate(kernels):
        instrument = kernel * carrier.conj()
        equation = np.array([(instrument * column).sum() for column in columns])
        if i == 0:  # the phasor of class P is not corrected for its curvature
            equation[[2, 5]] = 0.0
        rows += [equation.real, equation.imag]
        right += [(instrument * y).sum().real, (instrument * y).sum().imag]
    a = np.linalg.solve(np.array(rows), np.array(right))
    p = a[:3] + 1j * a[3:]
    assert found.phasor[k] == pytest.approx(p[0] * np.exp(-2j * np.pi * 50 * found.t[k]) / math.sqrt(2), rel=1e-4)
    assert found.frequency[k] * (1 + (p[1] / p[0]).imag / (2 * np.pi)) == pytest.approx(found.frequency[k], abs=2e-3)
    curvature = (p[2] / p[0]).imag - 2 * (p[1] / p[0]).real * (p[1] / p[0]).imag
    assert curvature * found.frequency[k] ** 2 / (2 * np.pi) == pytest.approx(found.rocof[k], rel=1e-3)


@pytest.mark.parametrize(("nominal", "kind", "reports"), ALL)
def test_kernels_yield_one_power_of_time_each_and_no_harmonic(nominal, kind, reports):
    filters = design_filters(nominal, kind, reports)
    tables = filters.tables.T / POINTS
    u = (np.arange(tables.shape[1]) - tables.shape[1] // 2) / POINTS
    powers = np.array([np.ones_like(u), u, u * u / 2])
    moments = tables[:3] @ powers.T
    # That of the phasor has a second moment, which the solution knows of.
    moments[0, 2] = 0.0
    assert moments == pytest.approx(np.eye(3), abs=1e-9)
    turns = np.exp(-2j * np.pi * np.outer(u, (1, 2, 3, 17, 51)))
    assert np.abs(tables[:3] @ turns).max() < 1e-9
    lowest = nominal - frequency_range(kind, reports)
    assert filters.half_cycles / lowest < (7 if kind == "M" else 2) / reports


@pytest.mark.parametrize(("nominal", "reports"), [(n, r) for n, rates in REPORTING_RATES.items() for r in rates])
def test_class_m_passes_its_band_and_stops_the_rest(nominal, reports):
    kernel = design_filters(nominal, "M", reports).tables[:, 0] / POINTS
    edge = min(reports / 5, 5.0)
    inside, outside = np.linspace(0, edge, 20), np.linspace(0.45 * reports, 5 * nominal, 400)
    _, passed = freqz(kernel, worN=inside, fs=POINTS * nominal)
    _, stopped = freqz(kernel, worN=outside, fs=POINTS * nominal)
    assert np.abs(np.abs(passed) - 1).max() < 0.3
    # An interference of 10 % may move the frequency by 0.01 Hz.
    assert (0.1 * outside * np.abs(stopped)).max() < 0.01


@given(st.floats(0.01, 1e6), st.floats(-3.0, 3.0), st.integers(-40, 40))
def test_amplitude_phase_and_shifts_by_a_second(amplitude, phase, seconds):
    rate = 800.0
    t = np.arange(160) / rate
    base = measured(tone(t, 50.4), rate)
    other = measured(amplitude * tone(t, 50.4, 0.3 + phase), rate, float(seconds))
    assert other.t == pytest.approx(base.t + seconds, abs=1e-9)
    assert other.phasor == pytest.approx(amplitude * base.phasor * np.exp(1j * phase), rel=1e-7)
    assert other.frequency == pytest.approx(base.frequency, abs=1e-8)


def test_three_phases_and_their_positive_sequence():
    rate, f = 3000.0, 60.7
    t = np.arange(900) / rate
    a = np.exp(2j * np.pi / 3)
    positive, negative, zero = 100 * np.exp(0.4j), 9 * np.exp(1j), 5.0
    phases = np.array([positive * a**-k + negative * a**k + zero for k in range(3)])
    y = (phases[None, :] * np.exp(2j * np.pi * f * t)[:, None]).real
    found = measured(y, rate, nominal=60)
    turned = np.exp(2j * np.pi * 0.7 * found.t) / math.sqrt(2)
    assert found.phases == pytest.approx(turned[:, None] * phases, rel=1e-7)
    assert found.phasor == pytest.approx(turned * positive, rel=1e-7)
    assert found.frequency == pytest.approx(f, abs=1e-8)
    single = measured(y[:, 1], rate, nominal=60)
    assert single.phasor == pytest.approx(found.phases[:, 1], rel=1e-6)


def test_a_ramp_has_its_rate():
    rate, t = 2000.0, np.arange(4000) / 2000.0
    y = np.cos(2 * np.pi * (49.0 * t + 0.5 * t * t))
    for kind in "PM":
        found = measured(y, rate, kind=kind)
        assert np.abs(found.rocof - 1.0).max() < 1e-3
        assert np.abs(found.frequency - 49.0 - found.t).max() < 1e-4


CHANGES = {
    "step of the phase": lambda t: tone(t, 50, 0.3 + 0.17 * (t > 1)),
    "step of the amplitude": lambda t: tone(t, 50) * np.where(t > 1, 0.8, 1.0),
    "spike": lambda t: tone(t, 50) + 50.0 * (np.abs(t - 1) < 0.2e-3),
}


@pytest.mark.parametrize("kind", ["P", "M"])
@pytest.mark.parametrize("change", CHANGES)
def test_a_change_within_the_window_withdraws_valid(change, kind):
    t = np.arange(8000) / 4000.0
    found = measured(CHANGES[change](t), 4000.0, kind=kind, reports=50)
    near = np.abs(found.t - 1.0) < 0.4 * found.latency
    assert not found.valid[near].any()
    assert (found.flags[near] & Flag.CHANGE).all()
    assert found.valid[np.abs(found.t - 1.0) > found.latency + 1e-3].all()


def test_fast_reports_are_judged_over_four_cycles():
    t = np.arange(8000) / 4000.0
    found = measured(tone(t, 50, 0.3 + 0.17 * (t > 1.0031)), 4000.0, reports=100)
    assert not found.valid[np.abs(found.t - 1.0) < 0.015].any()


def test_another_tone_withdraws_valid_unless_the_class_rejects_it():
    t = np.arange(8000) / 4000.0
    y = tone(t, 50.1) + 0.1 * tone(t, 80.0)
    assert not measured(y, 4000.0).valid.any()
    rejecting = measured(y, 4000.0, kind="M")
    assert rejecting.valid.all()
    assert np.abs(rejecting.frequency - 50.1).max() < 0.01


def test_gaps_silence_and_frequencies_out_of_range():
    t = np.arange(8000) / 4000.0
    y = tone(t, 50.0)
    y[4000] = np.nan
    found = measured(y, 4000.0)
    gone = np.abs(found.t - 1.0) < 0.036
    assert (found.flags[gone] == Flag.GAP).all()
    assert np.isnan(found.frequency[gone]).all()
    assert found.valid[np.abs(found.t - 1.0) > 0.04].all()
    assert (measured(tone(t, 53.0), 4000.0).flags & Flag.OUT_OF_BOUNDS).all()
    assert measured(tone(t, 53.0), 4000.0).frequency == pytest.approx(53.0, abs=1e-3)
    assert measured(tone(t, 53.0), 4000.0, kind="M").valid.all()
    silent = measured(np.where(t < 1, y, 0.0), 4000.0)
    assert (silent.flags[silent.t > 1.1] & Flag.ABSENT).all()
    assert measured(0.0 * t, 4000.0).flags.all()


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"nominal": 55}, "50 or 60"),
        ({"kind": "X"}, "performance_class"),
        ({"reports": 60}, "10, 25, 50 and 100"),
    ],
)
def test_what_the_standard_does_not_have(change, word):
    with pytest.raises(OptionError, match=word):
        measured(np.ones(100), 4000.0, **change)


def test_records_that_do_not_do():
    with pytest.raises(DataError, match="600 Hz"):
        measured(np.ones(100), 500.0)
    with pytest.raises(DataError, match=r"lasts 0\.05 s"):
        measured(np.ones(201), 4000.0)
    with pytest.raises(DataError, match="three phases"):
        measured(np.ones((1000, 2)), 4000.0)
    with pytest.raises(DataError, match="finite"):
        measured(np.full(1000, np.nan), 4000.0)
