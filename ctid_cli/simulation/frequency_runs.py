"""Data sets of signals, and the estimates of their frequencies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.frequency.tracking import FrequencyEstimate, FrequencyTrack
from ctid_cli.signals.sampling import RegularSampling
from ctid_cli.signals.sinusoids import Disturbance, SumOfSinusoids, disturb
from ctid_cli.signals.streams import stream
from ctid_cli.simulation.frequency_measures import (
    Measuring,
    measure_estimate,
    measure_track,
    true_frequencies,
)


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
        """What is stored of a fit to the record."""
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
        """One realisation."""
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
