"""Data sets of signals, estimates of their frequencies, and measures of these against the true frequencies.

Names of the measures; those with one value per tone end in the number of the tone, by rising frequency:

- ``omega_1``: last estimate [rad/s];
- ``valid_from``: first instant of a valid estimate [s];
- ``settling_time_1``: instant from which the error stays in the band to the end, or to the first frequency step [s];
  ``settling_after_step_1``: settling time after the last frequency step, counted from the step [s]. They have no value
  if the error does not settle. Flags are ignored; an estimate that starts at the true value has settled at 0;
- ``rms_1``, ``bias_1``: root mean square and mean of the error over the window [rad/s];
- ``false_alarms``: number of alarms without a step of a frequency or an amplitude in the last two periods of the lowest
  frequency, for estimators that raise alarms;
- ``valid_share``: share of the record with a valid estimate [%].

A track of one row is an estimate of the whole record: it has ``omega``, ``rms``, ``bias`` and ``valid_share`` only.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError
from ctid_cli.frequency.base import FrequencyEstimator, FrequencyTrack
from ctid_cli.frequency.flags import Flag
from ctid_cli.signals.noise import stream
from ctid_cli.signals.sampling import RegularSampling
from ctid_cli.signals.sinusoids import Disturbance, SineDisturbance, SumOfSinusoids, disturb
from ctid_cli.simulation.components import ComponentError, Prepared, called, is_custom

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
#: An alarm within this number of periods of the lowest frequency after a step is attributed to the step.
ALARM_PERIODS = 2.0
#: Default length of the window of rms and bias, at the end of the record [s].
USUAL_WINDOW = 10.0
#: Number of samples of the record used to compile an estimator.
COMPILED_WITH = 16


@dataclass(frozen=True)
class Measuring:
    """Settings of the measures."""

    #: Largest error of a settled frequency [rad/s]; None omits the settling times.
    band: float | None = None
    #: First and last instant of the window of rms and bias [s]; the last 10 s if not given.
    window: tuple[float, float] | None = None


def true_frequencies(signal: SumOfSinusoids, disturbance: Disturbance | None, tones: int, times: Array) -> Array:
    """Return the frequencies that an estimator of ``tones`` tones should find."""
    true = signal.frequencies_at(times)
    if tones == true.shape[1] + 1 and isinstance(disturbance, SineDisturbance):
        true = np.sort(np.column_stack((true, np.full(true.shape[0], disturbance.frequency))), axis=1)
    if tones != true.shape[1]:
        raise ValueError(f"tones must be {true.shape[1]}, the number in the signal, not {tones}.")
    return true


def measure_track(
    track: FrequencyTrack, times: Array, true: Array, signal: SumOfSinusoids, measuring: Measuring, *, alarms: bool
) -> dict[str, float | None]:
    """Return the measures of estimates against the true frequencies at the samples; alarms are optional."""
    found = _numbered("omega", track.frequencies[-1])
    # The single row of a whole-record estimate applies to all instants.
    errors = track.frequencies - true
    if track.t.size > 1:
        found["valid_from"] = float(times[np.argmax(track.valid)]) if track.valid.any() else None
        if measuring.band is not None:
            found |= _settling_times(np.abs(errors) <= measuring.band, times, signal)
    chosen = errors[_in_window(times, measuring.window)]
    found |= _numbered("rms", np.sqrt(np.mean(chosen**2, axis=0)))
    found |= _numbered("bias", np.mean(chosen, axis=0))
    if alarms:
        found["false_alarms"] = float(_false_alarms(track, signal))
    found["valid_share"] = 100.0 * float(np.mean(track.valid))
    return {name: found[name] for name in measure_names([found])}


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


def _settling_times(inside: BoolArray, times: Array, signal: SumOfSinusoids) -> dict[str, float | None]:
    """Return the settling time of each error, from the start and after the last frequency step."""
    steps = [float(step) for step in signal.frequency_steps]
    # The first sample of a segment may precede the instant of the step by a rounding error.
    places = [0, *(int(np.searchsorted(times, step * (1.0 - 1e-9))) for step in steps), times.size]
    found: dict[str, float | None] = {}
    for k in range(inside.shape[1]):
        found[f"settling_time_{k + 1}"] = _settling(inside[:, k], times, 0, places[1], 0.0)
        if steps:
            after = _settling(inside[:, k], times, places[-2], places[-1], steps[-1])
            found[f"settling_after_step_{k + 1}"] = after
    return found


def _settling(inside: BoolArray, t: Array, first: int, last: int, since: float) -> float | None:
    place = first + int(np.flatnonzero(~inside[first:last]).max(initial=-1)) + 1
    # Rounded, to remove the rounding errors of both instants.
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
    """Record for frequency estimators."""

    #: Disturbed signal [signal unit], shape (N,); read-only.
    samples: Array
    #: Sampling interval [s].
    interval: float

    @property
    def times(self) -> Array:
        """Instants of the samples [s], shape (N,)."""
        return self.interval * np.arange(self.samples.size, dtype=float)


@dataclass(frozen=True, eq=False)
class SignalDataSet:
    """A record with its source."""

    record: SignalRecord
    source: SignalSource
    replicate: int
    true_model: ClassVar[None] = None

    def result_of(self, fit: FrequencyFit, start: Any, terms: Any) -> dict[str, Any]:
        """Return the stored quantities of a fit to the record."""
        signal, times, options = self.source.signal, self.record.times, fit.options
        true = true_frequencies(signal, self.source.disturbance, options.tones, times)
        reasons = " ".join(fit.track.reasons(-1))
        measures = measure_track(fit.track, times, true, signal, self.source.measuring, alarms=options.raises_alarms)
        status, message = ("INVALID", reasons) if reasons else ("VALID", "The last estimate is valid.")
        return {"status": status, "message": message, "measures": measures}


@dataclass(frozen=True, eq=False)
class SignalSource:
    """Data sets of a signal."""

    signal: SumOfSinusoids
    disturbance: Disturbance | None
    sampling: RegularSampling
    seed: int
    measuring: Measuring

    def dataset(self, replicate: int) -> SignalDataSet:
        """Return one realisation."""
        times = self.sampling.times(stream(self.seed, "sampling", replicate))
        signal = self.signal.generate(times)
        samples = disturb(signal, times, self.disturbance, stream(self.seed, "noise", replicate))
        samples.setflags(write=False)
        return SignalDataSet(SignalRecord(samples, self.sampling.interval), self, replicate)


@dataclass(frozen=True)
class FrequencyEstimation:
    """Adapter of a frequency estimator to the interface of model estimators."""

    options: FrequencyEstimator
    start_from: ClassVar[None] = None

    def prepare(self, record: SignalRecord) -> Prepared:
        """Return the estimator bound to the record."""
        return Prepared(partial(self._fit, record))

    def _fit(self, record: SignalRecord, start: None = None) -> FrequencyFit:
        track = called(self.options, "track", record.samples, record.interval)
        _require_track(track, self.options, record, f"{type(self.options).__name__}.track")
        return FrequencyFit(self.options, track)

    def compile(self, interval: float) -> None:
        """Compile the kernels of an estimator of ctid; custom ones are compiled at their trial run."""
        if not is_custom(self.options):
            # The record may be too short for the estimator.
            with suppress(ValueError, DataError):
                self.options.track(np.zeros(COMPILED_WITH), interval)


def _require_track(track: Any, options: FrequencyEstimator, record: SignalRecord, what: str) -> None:
    """Raise an error if the returned value is not a track of the record."""
    if not isinstance(track, FrequencyTrack):
        expected = "a ctid_cli.FrequencyTrack(t, frequencies, flags) is expected"
        raise ComponentError(f"{what} returned {type(track).__name__}, and {expected}")
    times = record.times[-1:] if options.whole_record else record.times
    shapes = {"t": (times.size,), "frequencies": (times.size, options.tones), "flags": (times.size,)}
    for name, shape in shapes.items():
        found = np.shape(getattr(track, name))
        if found != shape:
            raise ComponentError(f"{what} returned {name} of shape {found}, and {shape} is expected")
    if np.asarray(track.flags).dtype.kind not in "iu":
        raise ComponentError(f"{what} returned flags that are not integers; combine those of ctid_cli.Flag")
    if not np.allclose(track.t, times, rtol=1e-9, atol=1e-9 * record.interval):
        raise ComponentError(f"{what} returned t that differ from the sampling instants, interval * np.arange(N)")
    if not np.isfinite(track.frequencies[track.valid]).all():
        raise ComponentError(f"{what} returned an unflagged row with frequencies that are not finite; set a flag")


@dataclass(frozen=True, eq=False)
class FrequencyFit:
    """Estimated frequencies."""

    options: FrequencyEstimator
    track: FrequencyTrack
