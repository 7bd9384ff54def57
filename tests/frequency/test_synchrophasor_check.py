"""The tests of the standard: limits, signals against their derivatives, and the verdict."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.frequency import synchrophasor_check
from ctid_cli.frequency import synchrophasor_signals as signals
from ctid_cli.frequency.synchrophasor_check import check_synchrophasors
from ctid_cli.frequency.synchrophasor_filters import REPORTING_RATES
from ctid_cli.frequency.synchrophasor_limits import QUANTITIES, TESTS, limits_of

# Spot checks against the printed tables.
LIMITS = [
    (50, "P", 50, "signal_frequency", "fe", 0.005),
    (50, "P", 50, "signal_frequency", "rfe", 0.4),
    (50, "M", 50, "signal_frequency", "rfe", 0.1),
    (60, "P", 10, "harmonic_distortion", "fe", 0.005),
    (60, "M", 20, "harmonic_distortion", "fe", 0.005),
    (60, "M", 30, "harmonic_distortion", "fe", 0.025),
    (60, "M", 30, "harmonic_distortion", "rfe", None),
    (60, "M", 60, "out_of_band", "tve", 1.3),
    (60, "M", 60, "out_of_band", "fe", 0.01),
    (60, "P", 60, "phase_modulation", "fe", 0.06),
    (60, "P", 60, "phase_modulation", "rfe", 2.26),
    (60, "M", 60, "amplitude_modulation", "fe", 0.3),
    (60, "M", 60, "amplitude_modulation", "rfe", 14.1),
    (60, "M", 10, "amplitude_modulation", "fe", 0.12),
    (60, "P", 10, "amplitude_modulation", "fe", 0.03),
    (50, "P", 50, "frequency_ramp", "rfe", 0.4),
    (50, "M", 50, "frequency_ramp", "rfe", 0.2),
    (50, "P", 50, "phase_step", "tve_response", 0.04),
    (50, "P", 50, "phase_step", "fe_response", 0.09),
    (50, "P", 50, "phase_step", "rfe_response", 0.12),
    (50, "M", 10, "phase_step", "tve_response", 0.7),
    (50, "M", 100, "phase_step", "rfe_response", 0.28),
    (50, "M", 50, "magnitude_step", "overshoot", 10),
    (50, "P", 100, "magnitude_step", "delay", 0.0025),
    (60, "P", 60, "latency", "latency", 2 / 60),
    (60, "M", 60, "latency", "latency", 7 / 60),
]


@pytest.mark.parametrize(("nominal", "kind", "rate", "test", "quantity", "largest"), LIMITS)
def test_limits(nominal, kind, rate, test, quantity, largest):
    (limit,) = [x for x in limits_of(nominal, kind, rate) if (x.test, x.quantity) == (test, quantity)]
    assert limit.largest == (None if largest is None else pytest.approx(largest, rel=3e-3))
    assert limit.source.startswith("IEEE C37.118.1")


def test_every_limit_has_words_and_no_two_are_of_the_same():
    for nominal, rates in REPORTING_RATES.items():
        for rate in rates:
            for kind in "PM":
                limits = limits_of(nominal, kind, rate)
                assert {limit.test for limit in limits} == set(TESTS) - ({"out_of_band"} if kind == "P" else set())
                assert {limit.quantity for limit in limits} == set(QUANTITIES)
                assert len({(limit.test, limit.quantity) for limit in limits}) == len(limits)


def of_every_kind():
    yield from signals.steady_frequencies(60, "M", 60)
    yield from signals.magnitudes(60)
    yield from list(signals.harmonic_distortions(60, "P", 7680.0))[:3]
    yield from list(signals.interferences(60, 60))[:3]
    yield from signals.modulations(60, "M", 60, "amplitude_modulation")
    yield from signals.modulations(60, "M", 60, "phase_modulation")
    yield signals.ramp(60, 2.0, 1.0)
    yield signals.ramp(60, 2.0, -1.0)
    yield signals.step(60, "phase_step", 1.0, 0.5)


def test_frequency_and_its_rate_are_the_derivatives_of_the_phase():
    t, h = np.linspace(-3.03, 3.01, 50), 1e-5
    for signal in of_every_kind():
        slope = (signal.angle(t + h) - signal.angle(t - h)) / (4 * np.pi * h)
        assert slope == pytest.approx(signal.deviation(t), abs=1e-7)
        rate = (signal.deviation(t + h) - signal.deviation(t - h)) / (2 * h)
        assert rate == pytest.approx(signal.rocof(t), abs=1e-6)
        # The signal is the real part of its turning phasor, and what disturbs it.
        turning = math.sqrt(2) * (signal.phasor(t) * np.exp(2j * np.pi * 60 * t)).real
        assert signal.samples(t) - signal.disturbance(t) == pytest.approx(turning, abs=1e-9)


def test_the_signals_cover_the_ranges_of_the_standard():
    steady = [float(s.deviation(np.zeros(1))[0]) for s in signals.steady_frequencies(50, "M", 50)]
    assert (min(steady), max(steady)) == (-5.0, 5.0)
    assert max(float(s.deviation(np.zeros(1))[0]) for s in signals.steady_frequencies(60, "M", 12)) == pytest.approx(
        2.4
    )
    orders = [s.condition for s in signals.harmonic_distortions(50, "M", 6400.0)]
    assert (orders[0], orders[-1], len(orders)) == ("harmonic 2", "harmonic 50", 49)
    assert len(list(signals.harmonic_distortions(50, "M", 1000.0))) == 8
    beside = [s.condition for s in signals.interferences(50, 25)]
    assert "37.5 Hz beside 48.75 Hz" in beside
    assert "62.5 Hz beside 51.25 Hz" in beside
    assert "10 Hz beside 50 Hz" in beside
    assert "100 Hz beside 50 Hz" in beside
    assert not any(s.startswith(("38 ", "50 ", "62 ")) for s in beside)
    assert max(s.period for s in signals.modulations(50, "P", 10, "phase_modulation")) == pytest.approx(10.0)
    assert [s.condition for s in signals.modulations(50, "P", 10, "phase_modulation")][-1] == "1 Hz"
    assert signals.step(50, "phase_step", 1.0, 0.0).angle(np.array([-1e-9, 0.0])) == pytest.approx([0.0, math.pi / 18])


WHOLE = [
    *(
        (50, "P", 50, 1600.0),
        (60, "P", 60, 1920.0),
        (50, "P", 100, 1777.7),
        (60, "P", 120, 1920.0),
        (60, "P", 10, 1920.0),
    ),
    *((50, "M", 50, 1000.0), (60, "M", 60, 960.0), (50, "M", 100, 1000.0)),
]


@pytest.mark.parametrize(("nominal", "kind", "rate", "sampling"), WHOLE)
def test_the_class_is_passed_whole(nominal, kind, rate, sampling):
    found = check_synchrophasors(nominal, kind, rate, sampling)
    assert [row for row in found.rows if not row.passed] == []
    assert len(found.rows) == len(limits_of(nominal, kind, rate))
    assert found.passed


def test_what_is_wrong_is_found(monkeypatch):
    measure = synchrophasor_check.measure_at

    def spoilt(values, interval, start, t, *setting):
        found = measure(values, interval, start, t, *setting)
        return replace(found, frequency=found.frequency + 0.006, phasor=found.phasor * np.exp(0.02j))

    monkeypatch.setattr(synchrophasor_check, "measure_at", spoilt)
    found = check_synchrophasors(50, "P", 50, 1600.0)
    failed = {(row.limit.test, row.limit.quantity) for row in found.rows if not row.passed}
    assert not found.passed
    assert {("signal_frequency", "fe"), ("signal_frequency", "tve"), ("harmonic_distortion", "fe")} <= failed
    # As large as what was added, to the second order.
    (row,) = [row for row in found.rows if (row.limit.test, row.limit.quantity) == ("signal_frequency", "tve")]
    assert row.worst == pytest.approx(2.0, rel=1e-3)
    assert ("frequency_ramp", "fe") not in failed


def test_a_slow_clock_is_refused():
    with pytest.raises(DataError, match="720 Hz"):
        check_synchrophasors(60, "P", 60, 700.0)
