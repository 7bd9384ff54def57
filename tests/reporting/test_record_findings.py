"""What a record shows before any model: each finding on a record made to have it, and none on a clean one."""

import math

import numpy as np
import pytest
from scipy.signal import lfilter

from ctid_cli import HeldSignal, Record, TransferFunction, simulate
from ctid_cli.inference.input_response import output_bandwidth
from ctid_cli.inference.signal_features import input_moves
from ctid_cli.reporting.record_findings import check_record_quality
from ctid_cli.signals.excitation import Prbs

SECOND_ORDER = TransferFunction([2], [0.25, 0.7, 1], delay=8.0)
RESONANT = TransferFunction([-6400, 1600], [1, 5, 408, 416, 1600], delay=8.0)
FIRST_ORDER = TransferFunction([1], [1, 1], delay=1.3)


def published(system, snr_db, regular, seed):
    """Records of the two systems that delay estimation is usually judged on."""
    rng = np.random.default_rng(seed)
    second = system is SECOND_ORDER
    interval, longest, n = (0.05, 0.09, 4000) if second else (0.01, 0.05, 8000 if regular else 4500)
    t = interval * np.arange(n) if regular else np.cumsum(np.append(0.0, rng.uniform(0.01, longest, n - 1)))
    u = Prbs(stages=10, clock_period=interval if regular else 0.5).generate(t, rng)
    x = simulate(system, u, t)
    noise = rng.standard_normal(n) * math.sqrt(np.mean(x**2) / 10 ** (snr_db / 10))
    return Record(t, x + noise, HeldSignal(t, u.at(t)))


def first_order(seed=0, n=3000, hold=20, noise=0.05):
    """Times, binary input, output in noise; 0.1 s apart."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(n)
    u = np.repeat(rng.choice([-1.0, 1.0], n // hold + 1), hold)[:n]
    return t, u, simulate(FIRST_ORDER, HeldSignal(t, u), t) + noise * rng.standard_normal(n)


def found(record, level=None):
    return {f.topic: f.sentence for f in check_record_quality(record).findings if level in (None, f.level)}


# --- bandwidth and delay --------------------------------------------------------------------------


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("snr_db", [5, 15])
def test_bandwidth_and_delay_of_a_second_order_system(snr_db, regular):
    for seed in range(3):
        report = check_record_quality(published(SECOND_ORDER, snr_db, regular, seed))
        assert 2.0 < report.output_bandwidth < 6.0
        assert 7.0 < report.delay_early <= 8.0 <= report.delay_late < 8.6
        assert report.snr_db == pytest.approx(snr_db, abs=2)
        assert report.suggested_delay == (0.0, 20.0)


@pytest.mark.parametrize("regular", [True, False])
def test_the_fast_resonance_is_in_the_band(regular):
    # With the slow clock of the irregular record it holds 1 % of the output's power, and bends the cost all the same.
    for seed in range(3):
        report = check_record_quality(published(RESONANT, 15, regular, seed))
        assert 19.5 < report.output_bandwidth < 45
        # With the input known at the samples only, the answer seems to come early by up to an interval.
        assert report.delay_early - (0.0 if regular else 0.05) <= 8.0 <= report.delay_late


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_units_of_time_and_output_do_not_matter(scale):
    t, u, y = first_order()
    report = check_record_quality(Record.from_arrays(t, u, y))
    scaled = check_record_quality(Record.from_arrays(t * scale, u, y / scale))
    assert scaled.output_bandwidth == pytest.approx(report.output_bandwidth / scale, rel=1e-6)
    assert scaled.delay_late == pytest.approx(report.delay_late * scale, rel=1e-6)
    assert [f.topic for f in scaled.findings] == [f.topic for f in report.findings]


def test_bandwidth_of_white_noise_through_a_first_order_system():
    # Half of the power of 1/(1 + w^2) per octave of atan: 95 % of it lies below tan(0.95 pi/2) = 12.7 rad/s.
    rng = np.random.default_rng(1)
    t = 0.02 * np.arange(20_000)
    u = rng.standard_normal(t.size)
    x = simulate(FIRST_ORDER, HeldSignal(t, u), t)
    assert output_bandwidth(Record.from_arrays(t, u, x)) == pytest.approx(12.7, rel=0.15)
    noisy = x + 0.3 * x.std() * rng.standard_normal(t.size)
    assert 0.5 * 12.7 < output_bandwidth(Record.from_arrays(t, u, noisy)) < 1.15 * 12.7


def test_bandwidth_where_nothing_is_seen_is_that_of_the_clock():
    rng = np.random.default_rng(2)
    t = 0.1 * np.arange(2000)
    record = Record.from_arrays(
        t, rng.choice([-1.0, 1.0], t.size), lfilter([1], [1, -0.8], rng.standard_normal(t.size))
    )
    assert output_bandwidth(record) == pytest.approx(math.pi / 0.1)
    assert "answer" in found(record, "problem")
    assert check_record_quality(record).suggested_delay is None


def test_coloured_noise_hides_neither_answer_nor_delay():
    for seed in range(8):
        t, u, y = first_order(seed)
        noise = 0.2 * lfilter([1], [1, -0.95], np.random.default_rng(100 + seed).standard_normal(t.size))
        report = check_record_quality(Record.from_arrays(t, u, y + noise))
        assert report.delay_early <= 1.3 <= report.delay_late < 2.5
        assert report.worst in ("ok", "note")
        assert 0.3 < report.explained < 0.95


def test_an_answer_from_an_operating_point_is_seen_and_noise_is_none():
    t = 0.1 * np.arange(300)
    u = np.where(t >= 10, 80.0, 50.0)
    rng = np.random.default_rng(9)
    noise = lfilter([1], [1, -0.8], rng.standard_normal(t.size))
    y = 20 + simulate(FIRST_ORDER, HeldSignal(t, u - 50.0), t) + noise
    answering = Record.from_arrays(t, u, y)
    assert check_record_quality(answering).answer_p_value < 0.05
    assert "answer" not in found(answering, "problem")
    alone = Record.from_arrays(t, u, 20 + noise)
    assert check_record_quality(alone).answer_p_value > 0.05
    assert found(alone, "problem")["answer"].startswith("The output is not seen to answer to the input (p = ")
    assert not {"delay", "clock", "start"} & found(alone).keys()


@pytest.mark.parametrize("start", [0.1, 20.0])
def test_the_delay_after_a_single_step(start):
    t = 0.1 * np.arange(1000)
    u = np.where(t >= start, 50.0, 0.0)
    y = 20 + simulate(FIRST_ORDER, HeldSignal(t, u), t) + 0.5 * np.random.default_rng(3).standard_normal(t.size)
    report = check_record_quality(Record.from_arrays(t, u, y))
    assert report.delay_early <= 1.3 + 1e-9 <= report.delay_late < 1.8
    assert report.output_bandwidth == pytest.approx(12.7, rel=0.3)
    assert report.suggested_offset == "estimate"
    assert {"input", "offset"} == set(found(Record.from_arrays(t, u, y), "warning"))


def test_missing_samples_and_gaps_do_not_spoil_the_hint():
    t, u, y = first_order()
    y[500:800] = np.nan
    y[np.random.default_rng(4).random(t.size) < 0.1] = np.nan
    keep = np.r_[0:1500, 1900:3000]
    report = check_record_quality(Record.from_arrays(t[keep], u[keep], y[keep]))
    assert report.delay_early <= 1.3 <= report.delay_late < 2.2
    (gap,) = report.gaps
    assert (gap.start, gap.length) == (pytest.approx(149.9), pytest.approx(40.1))
    assert report.n_masked == np.count_nonzero(np.isnan(y[keep]))


# --- how the input moves --------------------------------------------------------------------------


def moves(u, interval=1.0):
    t = interval * np.arange(len(u))
    return input_moves(Record.from_arrays(t, u, np.ones(len(u))))


def test_levels_changes_and_holds():
    exact = moves([0, 0, 0, 1, 1, 0, 0, 0, 0, 1], interval=0.5)
    assert (exact.kind, exact.levels) == ("steps", (0.0, 1.0))
    assert exact.changes.tolist() == [1.5, 2.5, 4.5]
    assert exact.shortest_hold == 1.0
    assert moves([3.0] * 8).kind == "constant"
    assert moves(np.sin(0.1 * np.arange(200))).kind == "continuous"
    staircase = moves(np.repeat(np.random.default_rng(0).standard_normal(60), 5))
    assert (staircase.kind, staircase.levels, staircase.changes.size) == ("levels", (), 59)


def test_a_measured_binary_input_has_two_levels():
    rng = np.random.default_rng(5)
    clean = np.repeat(rng.choice([2.0, 5.0], 100), 10)
    true = moves(clean)
    noisy = moves(clean + 0.03 * rng.standard_normal(clean.size))
    assert noisy.noisy
    assert not true.noisy
    assert noisy.levels == pytest.approx((2.0, 5.0), abs=0.02)
    assert np.array_equal(noisy.changes, true.changes)
    coarse = moves(np.round(clean + 0.05 * rng.standard_normal(clean.size), 1))
    assert np.array_equal(coarse.changes, true.changes)


def test_the_input_has_its_own_times():
    t = np.arange(10.0)
    signal = HeldSignal(np.array([-5.0, 2.25, 6.75, 40.0]), np.array([1.0, 2.0, 1.0, 9.0]))
    seen = input_moves(Record(t, t, signal))
    assert seen.changes.tolist() == [2.25, 6.75]
    assert seen.levels == (1.0, 2.0)


@pytest.mark.parametrize("tones", [1, 2, 4])
def test_excitation_counts_two_for_every_tone(tones):
    t = 0.1 * np.arange(4000)
    u = sum(np.sin(w * t + w) for w in (0.5, 1.3, 2.9, 4.7)[:tones])
    report = check_record_quality(Record.from_arrays(t, u, simulate(FIRST_ORDER, HeldSignal(t, u, "foh"), t)))
    assert report.excitation_order == 2 * tones
    assert ("input" in [f.topic for f in report.findings if f.level == "warning"]) == (tones == 1)
    assert (report.suggested_delay is None) == (tones == 1)


# --- findings -------------------------------------------------------------------------------------


def test_a_good_record_gives_no_reason_to_worry():
    t, u, y = first_order()
    report = check_record_quality(Record.from_arrays(t, u, y))
    assert report.worst == "ok"
    assert {f.topic for f in report.findings} == {"sampling", "input", "answer", "clock", "delay", "start"}


def corrupted(kind):
    t, u, y = first_order()
    rng = np.random.default_rng(6)
    match kind:
        case "constant input":
            return Record.from_arrays(t, np.full(t.size, 3.0), y)
        case "zero input":
            return Record.from_arrays(t, np.zeros(t.size), y)
        case "constant output":
            return Record.from_arrays(t, u, np.full(t.size, 3.0))
        case "offset":
            return Record.from_arrays(t, u + 5, y + 20)
        case "trend":
            return Record.from_arrays(t, u, y + 0.005 * (t - t.mean()))
        case "outlier":
            return Record.from_arrays(t, u, np.where(np.arange(t.size) == 1000, 9.0, y))
        case "saturation":
            return Record.from_arrays(t, u, np.clip(y, -2, 0.6))
        case "quantisation":
            return Record.from_arrays(t, u, np.round(y / 0.16) * 0.16)
        case "missing":
            return Record.from_arrays(t, u, np.where(rng.random(t.size) < 0.3, np.nan, y))
        case "gap":
            keep = np.r_[0:1500, 1600 : t.size]
            return Record.from_arrays(t[keep], u[keep], y[keep])
        case "short":
            return Record.from_arrays(t[:40], u[:40], y[:40])
        case "jitter":
            return Record.from_arrays(t + 0.001 * rng.uniform(-1, 1, t.size), u, y)
        case "irregular":
            times = np.cumsum(rng.uniform(0.02, 0.18, t.size))
            exact = HeldSignal(t, u)
            return Record(times, simulate(FIRST_ORDER, exact, times), HeldSignal(times, exact.at(times)))
        case "under way":
            x = simulate(TransferFunction([1], [1, 1], delay=8.0), HeldSignal(t, u), t)
            return Record.from_arrays(t[1000:] - 100, u[1000:], x[1000:])
        case "feedback":
            noise = 0.05 * lfilter([1], [1, -0.9], rng.standard_normal(t.size))
            v, z, state = np.zeros(t.size), np.zeros(t.size), 0.0
            for k in range(t.size):
                z[k] = state + noise[k]
                v[k] = u[k] - 1.5 * z[k]
                state = 0.905 * state + 0.095 * v[k]
            return Record.from_arrays(t, v, z)
        case "slow clock":
            v = rng.standard_normal(t.size)
            return Record.from_arrays(t, v, np.append(0.0, v[:-1]) + 0.1 * rng.standard_normal(t.size))
    raise AssertionError(kind)


CORRUPTED = {
    "constant input": ("problem", "input", "The input is constant at 3 V"),
    "zero input": ("problem", "input", "The input is zero throughout"),
    "constant output": ("problem", "output", "The output is constant at 3 degC"),
    "offset": ("warning", "offset", "(--offset remove)"),
    "trend": ("warning", "trend", "The output drifts by 1."),
    "outlier": ("warning", "outliers", "1 output sample lies far from the neighbours (t = 100 s)"),
    "saturation": ("warning", "saturation", "sit exactly at the least or greatest value"),
    "quantisation": ("warning", "resolution", "in steps of 0.16 degC"),
    "missing": ("warning", "missing", "of 3000 output samples (30 %) are missing"),
    "gap": ("warning", "gaps", "A gap longer than 3 median intervals, the longest of 10.1 s after t = 149.9 s"),
    "short": ("warning", "samples", "Only 40 output samples"),
    "jitter": ("note", "sampling", "The clock jitters"),
    "irregular": ("warning", "edges", "late by 0.05"),
    "under way": ("warning", "start", "(--initial-state estimate)"),
    "feedback": ("warning", "feedback", "The input seems to follow the output"),
    "slow clock": ("warning", "clock", "Sample faster"),
}


@pytest.mark.parametrize("kind", CORRUPTED)
def test_what_is_wrong_is_said(kind):
    level, topic, words = CORRUPTED[kind]
    report = check_record_quality(corrupted(kind), input_unit="V", output_unit="degC")
    (finding,) = [f for f in report.findings if f.topic == topic]
    assert (finding.level, words in finding.sentence) == (level, True), finding.sentence
    severities = [("problem", "warning", "note", "ok").index(f.level) for f in report.findings]
    assert severities == sorted(severities)


@pytest.mark.parametrize("kind", ["offset", "trend", "outlier", "saturation", "gap", "jitter", "under way", "feedback"])
def test_one_fault_is_not_taken_for_another(kind):
    warnings = set(found(corrupted(kind), "warning")) | set(found(corrupted(kind), "problem"))
    allowed = {CORRUPTED[kind][1]} if CORRUPTED[kind][0] == "warning" else set()
    assert warnings == allowed


def test_edges_that_are_known_are_not_complained_of():
    rng = np.random.default_rng(7)
    t, u, _ = first_order()
    times = np.cumsum(rng.uniform(0.02, 0.18, t.size))
    exact = HeldSignal(t, u)
    assert "edges" not in found(Record(times, simulate(FIRST_ORDER, exact, times), exact))


def test_a_periodic_input_makes_delays_ambiguous():
    t = 0.1 * np.arange(4000)
    u = np.tile(np.random.default_rng(8).choice([-1.0, 1.0], 200), 20)
    report = check_record_quality(Record.from_arrays(t, u, simulate(FIRST_ORDER, HeldSignal(t, u), t)))
    assert report.input_period == pytest.approx(20.0)
    assert "repeats itself every 20 s" in {f.topic: f.sentence for f in report.findings}["delay"]


@pytest.mark.parametrize("n", [1, 2, 3, 5, 9, 20])
def test_the_shortest_records_are_judged_too(n):
    t, u, y = first_order(hold=1)
    report = check_record_quality(Record.from_arrays(t[:n], u[:n], y[:n]))
    assert report.worst in ("problem", "warning")
    assert report.findings


def test_the_record_is_not_changed():
    t, u, y = first_order()
    before = [array.copy() for array in (t, u, y)]
    check_record_quality(Record.from_arrays(t, u, y))
    assert all(np.array_equal(a, b) for a, b in zip(before, (t, u, y), strict=True))
