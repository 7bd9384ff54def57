"""The tests of the standard, carried out on the measurement of this package."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array, BoolArray, ComplexArray
from ctid_cli.errors import DataError
from ctid_cli.frequency import synchrophasor_signals as signals
from ctid_cli.frequency.synchrophasor import FEWEST_SAMPLES, SynchrophasorTrack, longest_half_window, measure_at
from ctid_cli.frequency.synchrophasor_filters import PerformanceClass, design_filters, frequency_range
from ctid_cli.frequency.synchrophasor_limits import (
    STEP_FE,
    STEP_TVE,
    TESTS,
    Limit,
    limits_of,
    ramp_exclusion,
    step_rfe,
)
from ctid_cli.frequency.synchrophasor_signals import TestSignal
from ctid_cli.signals.checks import require_positive
from ctid_cli.text import ShownAsTable

#: Samples of a nominal cycle if nobody says otherwise: the 50th harmonic is not folded.
USUAL_SAMPLES = 128
#: Instants at which the errors of a steady or modulated signal are looked at, within its period and at least so many
#: cycles: multiples of the golden section, which meet the phases of every harmonic and interference evenly.
INSTANTS = 24
SHORTEST_CYCLES = 16.0
GOLDEN = 0.5 * (5.0**0.5 - 1.0)
#: Instants of a step in each cycle (class P) or in each of the longer of a cycle and a reporting interval (class M).
STEP_INSTANTS = 32
#: Phases of the tone at which a step comes [rad].
STEP_PHASES = (0.0, 0.25 * np.pi, 0.5 * np.pi)


@dataclass(frozen=True)
class CheckedLimit:
    """The worst of a test beside its limit.

    Parameters
    ----------
    limit : Limit
        The limit.
    worst : float
        Largest error, in the unit of the quantity.
    condition : str
        Condition of the test under which it was found.
    """

    limit: Limit
    worst: float
    condition: str

    @property
    def passed(self) -> bool:
        """Whether the limit is kept; where there is none it is."""
        return self.limit.largest is None or self.worst <= self.limit.largest


@dataclass(frozen=True)
class SynchrophasorCheck(ShownAsTable):
    """Worst errors of all tests of the standard, with their limits.

    Parameters
    ----------
    nominal : int
        Nominal frequency [Hz].
    performance_class : {"P", "M"}
        Class.
    reporting_rate : int
        Reports in a second [1/s].
    sampling_rate : float
        Samples in a second [1/s].
    rows : tuple of CheckedLimit
        Every limit of the standard with the worst that was found, in its order.
    """

    nominal: int
    performance_class: PerformanceClass
    reporting_rate: int
    sampling_rate: float
    rows: tuple[CheckedLimit, ...]

    @property
    def passed(self) -> bool:
        """Whether all limits are kept."""
        return all(row.passed for row in self.rows)


#: Worst values of a test with the conditions they were found under.
_Worst = dict[str, tuple[float, str]]


@dataclass(frozen=True)
class _Setting:
    nominal: int
    kind: PerformanceClass
    rate: int
    sampling_rate: float

    @property
    def half(self) -> float:
        return longest_half_window(
            design_filters(self.nominal, self.kind, self.rate), self.nominal, self.kind, self.rate
        )

    def measure(self, signal: TestSignal, t: Array) -> SynchrophasorTrack:
        # A little more than the window on both sides, on a clock that has no sample at time zero.
        interval = 1.0 / self.sampling_rate
        first = float(np.floor((t[0] - self.half) / interval) - 1.0) + 0.37
        count = int((t[-1] - t[0] + 2.0 * self.half) / interval) + 4
        clock = np.asarray((first + np.arange(count)) * interval)
        values = signal.samples(clock)[:, None]
        return measure_at(values, interval, float(clock[0]), t, self.nominal, self.kind, self.rate)

    def errors(self, signal: TestSignal, t: Array) -> tuple[dict[str, Array], ComplexArray]:
        """Total vector error [%], frequency error [Hz], ROCOF error [Hz/s] and the phasor at the instants."""
        found, true = self.measure(signal, t), signal.phasor(t)
        errors = {
            "tve": 100.0 * np.abs(found.phasor - true) / np.abs(true),
            "fe": np.abs(found.frequency - self.nominal - signal.deviation(t)),
            "rfe": np.abs(found.rocof - signal.rocof(t)),
        }
        return errors, found.phasor


def check_synchrophasors(
    nominal: int = 50,
    performance_class: PerformanceClass = "P",
    reporting_rate: int | None = None,
    sampling_rate: float | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> SynchrophasorCheck:
    """Test the synchrophasor measurement of one phase as the standard asks.

    Parameters
    ----------
    nominal : {50, 60}, default 50
        Nominal frequency [Hz].
    performance_class : {"P", "M"}, default "P"
        Class.
    reporting_rate : int, optional
        Reports in a second [1/s]; the nominal frequency if not given.
    sampling_rate : float, optional
        Samples in a second [1/s]; 128 to a nominal cycle if not given. Harmonics that it would fold are left out.
    on_progress : callable, optional
        Called with how many of the tests are done, and their number.

    Returns
    -------
    SynchrophasorCheck
        The worst error of every test beside its limit.

    Raises
    ------
    DataError
        If a cycle has fewer than 12 samples.
    OptionError
        If the standard has no such nominal frequency, class or reporting rate.

    Notes
    -----
    The signals are those of IEEE C37.118.1-2011 with IEEE C37.118.1a-2014, without noise. Errors of steady and
    modulated signals are looked at between the reporting instants too, at instants that meet their phases evenly.

    Examples
    --------
    >>> check_synchrophasors(60, "P", 60, sampling_rate=1920.0).passed
    True
    """
    rate = nominal if reporting_rate is None else reporting_rate
    design_filters(nominal, performance_class, rate)
    sampling_rate = float(USUAL_SAMPLES * nominal) if sampling_rate is None else sampling_rate
    require_positive("sampling_rate", sampling_rate, "Hz")
    if sampling_rate < FEWEST_SAMPLES * nominal:
        few = f"a sampling rate of {sampling_rate:g} Hz is too low"
        raise DataError(f"{few}: {FEWEST_SAMPLES} samples to a cycle are needed, {FEWEST_SAMPLES * nominal} Hz")
    setting = _Setting(nominal, performance_class, rate, sampling_rate)
    limits = limits_of(nominal, performance_class, rate)
    asked = [test for test in TESTS if any(limit.test == test for limit in limits)]
    worst: dict[str, _Worst] = {}
    for done, test in enumerate(asked):
        worst[test] = _carry_out(test, setting)
        if on_progress is not None:
            on_progress(done + 1, len(asked))
    rows = (CheckedLimit(limit, *worst[limit.test][limit.quantity]) for limit in limits if worst[limit.test])
    return SynchrophasorCheck(nominal, performance_class, rate, sampling_rate, tuple(rows))


def _carry_out(test: str, setting: _Setting) -> _Worst:
    nominal, kind, rate = setting.nominal, setting.kind, setting.rate
    if test == "latency":
        return {"latency": (setting.half, "lowest frequency")}
    if test == "frequency_ramp":
        return _ramps(setting)
    if test in signals.STEPS:
        return _steps(test, setting)
    courses: dict[str, Callable[[], Iterable[TestSignal]]] = {
        "signal_frequency": lambda: signals.steady_frequencies(nominal, kind, rate),
        "signal_magnitude": lambda: signals.magnitudes(nominal),
        "phase_angle": lambda: [signals.off_nominal(nominal, by) for by in (-0.2, 0.2)],
        "harmonic_distortion": lambda: signals.harmonic_distortions(nominal, kind, setting.sampling_rate),
        "out_of_band": lambda: signals.interferences(nominal, rate),
        "amplitude_modulation": lambda: signals.modulations(nominal, kind, rate, test),
        "phase_modulation": lambda: signals.modulations(nominal, kind, rate, test),
    }
    worst: _Worst = {}
    for signal in courses[test]():
        t = np.sort(np.mod(GOLDEN * np.arange(INSTANTS), 1.0)) * max(signal.period, SHORTEST_CYCLES / nominal)
        _keep_worst(worst, setting.errors(signal, t)[0], signal.condition)
    return worst


def _keep_worst(worst: _Worst, errors: dict[str, Array], condition: str) -> None:
    for quantity, values in errors.items():
        largest = float(np.max(values))
        # What is no number is worse than any.
        if not largest <= worst.get(quantity, (-1.0, ""))[0]:
            worst[quantity] = (largest if np.isfinite(largest) else np.inf, condition)


def _ramps(setting: _Setting) -> _Worst:
    worst: _Worst = {}
    furthest = frequency_range(setting.kind, setting.rate)
    exclusion = ramp_exclusion(setting.kind, setting.rate)
    end = furthest / signals.RAMP
    # Beyond its ends the ramp is a steady tone; so far the window may still see it.
    beyond = end + 2.0 * exclusion
    for slope in (signals.RAMP, -signals.RAMP):
        signal = signals.ramp(setting.nominal, furthest, slope)
        t = np.arange(np.ceil(-beyond * setting.rate), beyond * setting.rate + 0.5) / setting.rate
        t = t[np.abs(np.abs(t) - end) >= exclusion]
        _keep_worst(worst, setting.errors(signal, t)[0], signal.condition)
    return worst


def _steps(test: str, setting: _Setting) -> _Worst:
    slower = 1.0 / setting.nominal if setting.kind == "P" else max(1.0 / setting.nominal, 1.0 / setting.rate)
    # The windows of all instants outside see no step.
    t = np.arange(-8.0 * slower, 8.0 * slower, slower / STEP_INSTANTS)
    thresholds = {"tve": STEP_TVE, "fe": STEP_FE, "rfe": step_rfe(setting.kind)}
    worst: _Worst = {}
    for sign in (1.0, -1.0):
        for phase in STEP_PHASES:
            signal = signals.step(setting.nominal, test, sign, phase)
            found, measured = setting.errors(signal, t)
            found = {f"{name}_response": _response(found[name] > limit, t) for name, limit in thresholds.items()}
            turned = np.abs(measured) * np.sqrt(2.0) - 1.0
            if test == "phase_step":
                turned = np.angle(measured * np.exp(-1j * phase))
            delay, overshoot = _shape(turned / (sign * signals.STEPS[test]), t)
            found |= {"delay": np.array([delay]), "overshoot": np.array([overshoot])}
            _keep_worst(worst, found, f"{signal.condition} at {np.degrees(phase):g} degrees")
    return worst


def _response(outside: BoolArray, t: Array) -> Array:
    """How long the error is beyond its limit, from first to last."""
    places = np.flatnonzero(outside)
    return np.array([t[places[-1]] - t[places[0]] if places.size else 0.0])


def _shape(course: Array, t: Array) -> tuple[float, float]:
    """Distance of the middle of a step from 0 to 1 at time zero [s], and how far it leaves these bounds [%]."""
    after = int(np.argmax(course >= 0.5))
    low, high = course[after - 1], course[after]
    middle = t[after - 1] + (0.5 - low) / (high - low) * (t[after] - t[after - 1])
    return abs(float(middle)), 100.0 * float(max(course.max() - 1.0, -course.min(), 0.0))
