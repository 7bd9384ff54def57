"""Data sets of signals, estimates of their frequencies, and what is measured of these against the true ones.

Names of the measures, each with the number of the tone behind it where it is one number per tone, by rising frequency:

- ``omega_1``: last estimate [rad/s];
- ``valid_from``: first instant of a valid estimate [s];
- ``settling_time_1``: when the error came into the band to stay there to the end, or to the first step of a frequency
  [s]; ``settling_after_step_1``: the same from the last step of a frequency to the end, counted from the step [s].
  They have no value if that never happened. Flags do not matter; an estimate that begins at the truth has settled at 0;
- ``rms_1``, ``bias_1``: root mean square and mean of the error over the window [rad/s];
- ``false_alarms``: alarms with no step of a frequency or an amplitude in the last two periods of the lowest frequency,
  of trackers that raise any;
- ``valid_share``: share of the record with a valid estimate [%].

An estimate of a whole record has ``omega``, ``rms`` and ``bias`` of this one error, and ``valid_share`` 0 or 100.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.tracking import FrequencyEstimate, FrequencyTrack
from ctid_cli.signals.noise import stream
from ctid_cli.signals.sampling import RegularSampling
from ctid_cli.signals.sinusoids import Disturbance, SineDisturbance, SumOfSinusoids, disturb

#: Units of the measures, in the order of columns.
MEASURE_UNITS = {
    "omega": "rad/s",
    "valid_from": "s",
    "settling_time": "s",
    "settling_after_step": "s",
    "rms": "rad/s",
    "bias": "rad/s",
    "false_alarms": "-",
    "valid_share": "%",
}
#: An alarm within so many periods of the lowest frequency after a step answers to it.
ALARM_PERIODS = 2.0
#: Length of the window of rms and bias, before the end of the record, if none is given [s].
USUAL_WINDOW = 10.0
#: Kinds of trackers that raise alarms.
_ALARMING = ("restarting_least_squares",)


@dataclass(frozen=True)
class Measuring:
    """What is measured of every estimate."""

    #: Largest error of a settled frequency [rad/s]; without it no settling times are measured.
    band: float | None = None
    #: First and last instant of the window of rms and bias [s]; the last 10 s if not given.
    window: tuple[float, float] | None = None


def true_frequencies(signal: SumOfSinusoids, disturbance: Disturbance | None, tones: int, times: Array) -> Array:
    """Return the frequencies that an estimator of ``tones`` tones should find."""
    true = signal.frequencies_at(times)
    if tones == true.shape[1] + 1 and isinstance(disturbance, SineDisturbance):
        true = np.sort(np.column_stack((true, np.full(true.shape[0], disturbance.frequency))), axis=1)
    if tones != true.shape[1]:
        raise ValueError(f"tones must be {true.shape[1]}, as many as the signal has, not {tones}.")
    return true


def measure_track(
    track: FrequencyTrack, true: Array, signal: SumOfSinusoids, measuring: Measuring, options: Any
) -> dict[str, float | None]:
    """Measure the estimates of an online estimator."""
    t, errors, valid = track.t, track.omega - true, track.valid
    count = errors.shape[1]
    found = _numbered("omega", track.omega[-1])
    found["valid_from"] = float(t[np.argmax(valid)]) if valid.any() else None
    if measuring.band is not None:
        steps = [float(step) for step in signal.frequency_steps]
        # The first sample of a piece may come before the instant of the step by a rounding error.
        places = [0, *(int(np.searchsorted(t, step * (1.0 - 1e-9))) for step in steps), t.size]
        inside = np.abs(errors) <= measuring.band
        for k in range(count):
            found[f"settling_time_{k + 1}"] = _settling(inside[:, k], t, 0, places[1], 0.0)
            if steps:
                after = _settling(inside[:, k], t, places[-2], places[-1], steps[-1])
                found[f"settling_after_step_{k + 1}"] = after
    chosen = errors[_in_window(t, measuring.window)]
    found |= _numbered("rms", np.sqrt(np.mean(chosen**2, axis=0)))
    found |= _numbered("bias", np.mean(chosen, axis=0))
    if options.kind in _ALARMING:
        found["false_alarms"] = float(_false_alarms(track, signal))
    found["valid_share"] = 100.0 * float(np.mean(valid))
    return {name: found[name] for name in measure_names([found])}


def measure_estimate(estimate: FrequencyEstimate, true: Array, window: tuple[float, float] | None, times: Array) -> Any:
    """Measure the estimate of a whole record."""
    error = estimate.omega - true[_in_window(times, window)].mean(axis=0)
    found = _numbered("omega", estimate.omega) | _numbered("rms", np.abs(error)) | _numbered("bias", error)
    return found | {"valid_share": 100.0 if estimate.valid else 0.0}


def measure_names(rows: Iterable[Mapping[str, Any] | None]) -> list[str]:
    """Return the names of the measures that any estimate has, in the order of columns."""
    order = list(MEASURE_UNITS)

    def place(name: str) -> tuple[int, int]:
        base, tone = base_name(name)
        return order.index(base), tone

    return sorted({name for row in rows if row for name in row}, key=place)


def base_name(name: str) -> tuple[str, int]:
    """Return a measure without the number of its tone, and that number."""
    base, _, tone = name.rpartition("_")
    return (base, int(tone)) if tone.isdigit() else (name, 0)


def is_settled(measures: Mapping[str, float | None] | None, band: float, by: float | None) -> bool:
    """Return whether all frequencies came into the band in time and stayed there."""
    if not measures:
        return False
    times = [value for name, value in measures.items() if name.startswith("settling_")]
    if times:
        return all(time is not None and (by is None or time <= by) for time in times)
    errors = [value for name, value in measures.items() if base_name(name)[0] == "rms"]
    return all(error is not None and error <= band for error in errors)


def _numbered(name: str, values: Array) -> dict[str, float | None]:
    return {f"{name}_{k + 1}": float(value) if np.isfinite(value) else None for k, value in enumerate(values)}


def _settling(inside: BoolArray, t: Array, first: int, last: int, since: float) -> float | None:
    place = first + int(np.flatnonzero(~inside[first:last]).max(initial=-1)) + 1
    # A difference of instants, without the last digits of either.
    return None if place == last else max(0.0, round(float(t[place] - since), 9))


def _in_window(t: Array, window: tuple[float, float] | None) -> BoolArray:
    low, high = (t[-1] - USUAL_WINDOW, t[-1]) if window is None else window
    slack = 1e-9 * max(1.0, abs(high))
    return np.asarray((t >= low - slack) & (t <= high + slack))


def _false_alarms(track: FrequencyTrack, signal: SumOfSinusoids) -> int:
    alarm = (track.flags & int(Flag.CHANGED)) != 0
    begins = track.t[np.flatnonzero(alarm & ~np.concatenate(([False], alarm[:-1])))]
    steps = np.array(signal.steps)
    graces = ALARM_PERIODS * 2.0 * np.pi / signal.frequencies_at(steps)[:, 0]
    return sum(not ((steps <= begin + 1e-9) & (begin <= steps + graces)).any() for begin in begins)


# --------------------------------------------------------------------------------------------------------------------
# Data sets and estimates


@dataclass(frozen=True, eq=False)
class SignalRecord:
    """What estimators of frequencies are given."""

    #: Disturbed signal [signal unit], shape (N,).
    samples: Array
    #: Sampling interval [s].
    interval: float


@dataclass(frozen=True, eq=False)
class SignalDataSet:
    """A record, and what is known of its origin."""

    record: SignalRecord
    source: SignalSource
    replicate: int
    true_model: ClassVar[None] = None

    def result_of(self, fit: FrequencyFit, start: Any, terms: Any) -> dict[str, Any]:
        """Return what is stored of a fit to the record."""
        source, measuring = self.source, self.source.measuring
        times = self.record.interval * np.arange(self.record.samples.size, dtype=float)
        true = true_frequencies(source.signal, source.disturbance, fit.options.tones, times)
        last = fit.last
        result: dict[str, Any] = {"status": "VALID", "message": "The last estimate is valid."}
        if not last.valid:
            result = {"status": "INVALID", "message": " ".join(last.reasons)}
        if not isinstance(fit.found, FrequencyTrack):
            return result | {"measures": measure_estimate(last, true, measuring.window, times)}
        return result | {"measures": measure_track(fit.found, true, source.signal, measuring, fit.options)}


@dataclass(frozen=True, eq=False)
class SignalSource:
    """Data sets of a signal."""

    signal: SumOfSinusoids
    disturbance: Disturbance | None
    sampling: RegularSampling
    seed: int
    measuring: Measuring

    def dataset(self, replicate: int) -> SignalDataSet:
        """Make one realisation."""
        times = self.sampling.times(stream(self.seed, "sampling", replicate))
        signal = self.signal.generate(times)
        samples = disturb(signal, times, self.disturbance, stream(self.seed, "noise", replicate))
        return SignalDataSet(SignalRecord(samples, self.sampling.interval), self, replicate)


@dataclass(frozen=True)
class FrequencyEstimation:
    """An estimator of frequencies in the place of an estimator of models."""

    options: Any
    start_from: ClassVar[None] = None

    def prepare(self, record: SignalRecord) -> PreparedFrequencies:
        """Get ready for a record."""
        tracker = self.options.start(record.interval) if self.options.online else None
        return PreparedFrequencies(self.options, record, tracker)

    def compile(self, interval: float) -> None:
        """Compile the kernels of the estimator."""
        if self.options.online:
            self.options.start(interval).update(0.0)


@dataclass(frozen=True, eq=False)
class PreparedFrequencies:
    """An estimator of frequencies before the first sample of a record."""

    options: Any
    record: SignalRecord
    tracker: Any

    def fit(self, start: None = None) -> FrequencyFit:
        """Estimate the frequencies."""
        if self.tracker is None:
            return FrequencyFit(self.options, self.options.estimate(self.record.samples, self.record.interval))
        return FrequencyFit(self.options, self.tracker.run(self.record.samples))


@dataclass(frozen=True, eq=False)
class FrequencyFit:
    """Estimated frequencies."""

    options: Any
    found: FrequencyTrack | FrequencyEstimate

    @property
    def last(self) -> FrequencyEstimate:
        """The estimate at the end of the record."""
        return self.found.final if isinstance(self.found, FrequencyTrack) else self.found
