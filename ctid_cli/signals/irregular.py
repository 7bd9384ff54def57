"""Clocks that are not regular: by mean and spread, with jitter, with samples missing, and at random."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import OptionError
from ctid_cli.signals.checks import require_not_negative, require_share
from ctid_cli.signals.missing import check_loss, ticks_between
from ctid_cli.signals.sampling import InputRecord, OfInterval, UniformIntervals, from_zero


@dataclass(frozen=True)
class IrregularSampling(OfInterval):
    """Samples at independent random intervals around a mean, from 0 s.

    Parameters
    ----------
    interval : float
        Mean interval [s].
    samples : int
        Number of samples, at least 2.
    spread : float, default 0.5
        Intervals are uniform within this fraction below and above the mean [-], above 0 and below 1.
    input_record : {"sampled", "exact"}, default "exact"
        What the estimator is told of the input: its samples at the output's instants, or its true edges.

    Notes
    -----
    The same as ``uniform_intervals`` with ``low = (1 - spread) interval`` and ``high = (1 + spread) interval``.
    """

    kind: ClassVar[str] = "irregular"

    spread: float = 0.5
    input_record: InputRecord = "exact"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_share("spread", self.spread, whole=False)

    def times(self, rng: np.random.Generator) -> Array:
        """Instants at intervals that are drawn."""
        low, high = (1 - self.spread) * self.interval, (1 + self.spread) * self.interval
        return UniformIntervals(low, high, self.samples).times(rng)


@dataclass(frozen=True)
class JitteredSampling(OfInterval):
    """Samples near the ticks of a regular clock, from 0 s; the errors of the instants do not add up.

    Parameters
    ----------
    interval : float
        Interval of the clock [s].
    samples : int
        Number of samples, at least 2.
    largest_shift : float
        Each instant but the first is off its tick by an independent time, uniform within plus or minus this [s];
        less than half the interval.
    input_record : {"sampled", "exact"}, default "exact"
        What the estimator is told of the input: its samples at the output's instants, or its true edges.

    Notes
    -----
    The instants are known to the estimator: this is a clock that is recorded, not one that is mistaken.
    """

    kind: ClassVar[str] = "jitter"

    largest_shift: float
    input_record: InputRecord = "exact"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_not_negative("largest_shift", self.largest_shift, "s")
        if self.largest_shift >= 0.5 * self.interval:
            most = f"half the interval, {0.5 * self.interval:g} s; it is {self.largest_shift:g} s"
            raise OptionError("largest_shift", f"largest_shift must be less than {most}: samples would change places.")

    def times(self, rng: np.random.Generator) -> Array:
        """The clock with shifts that are drawn."""
        shifts = rng.uniform(-self.largest_shift, self.largest_shift, self.samples - 1)
        ticks = self.interval * np.arange(self.samples, dtype=float)
        ticks[1:] += shifts
        return ticks


@dataclass(frozen=True)
class MissingSamples(OfInterval):
    """Samples at the ticks of a regular clock, some of which are missing, one by one or in bursts, from 0 s.

    Parameters
    ----------
    interval : float
        Interval of the clock [s].
    samples : int
        Number of samples that are there, at least 2.
    missing : float
        Share of the ticks that have no sample [-], above 0 and below 1.
    mean_burst : float, optional
        Mean number of samples that are missing in a row [samples]; None for losses that are independent, which
        come ``1 / (1 - missing)`` in a row on average.
    input_record : {"sampled", "exact"}, default "exact"
        What the estimator is told of the input: its samples at the output's instants, or its true edges.

    Raises
    ------
    ValueError
        If there cannot be so many losses in such short bursts.

    Notes
    -----
    After each sample a burst begins with a probability that makes the share right, and its length is geometric. What
    is missing leaves no trace in the record; to mark the outputs that are missing, use ``recorder`` with a regular
    clock.
    """

    kind: ClassVar[str] = "missing_samples"

    missing: float
    mean_burst: float | None = None
    input_record: InputRecord = "exact"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_share("missing", self.missing, whole=False)
        check_loss(self.missing, self.mean_burst)

    @property
    def mean_interval(self) -> float:
        """Expected interval between samples [s]."""
        return float(self.interval / (1 - self.missing))

    def times(self, rng: np.random.Generator) -> Array:
        """The ticks whose samples are not lost; losses are drawn."""
        return self.interval * from_zero(ticks_between(rng, self.samples - 1, self.missing, self.mean_burst))


@dataclass(frozen=True)
class PoissonSampling(OfInterval):
    """Samples at the instants of a Poisson process, from 0 s: at any time the next one is equally likely.

    Parameters
    ----------
    interval : float
        Mean interval [s].
    samples : int
        Number of samples, at least 2.
    dead_time : float, default 0.0
        Shortest interval [s], below the mean; the rest of each interval is exponential.
    input_record : {"sampled", "exact"}, default "exact"
        What the estimator is told of the input: its samples at the output's instants, or its true edges.
    """

    kind: ClassVar[str] = "poisson"

    dead_time: float = 0.0
    input_record: InputRecord = "exact"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_not_negative("dead_time", self.dead_time, "s")
        if self.dead_time >= self.interval:
            raise OptionError("dead_time", f"dead_time must be below the mean interval, {self.interval:g} s.")

    def times(self, rng: np.random.Generator) -> Array:
        """Instants at intervals that are drawn."""
        return from_zero(self.dead_time + rng.exponential(self.interval - self.dead_time, self.samples - 1))
