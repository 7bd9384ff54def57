"""When the output is sampled."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar, Literal, get_args

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import OptionError
from ctid_cli.signals.checks import require_choice, require_integer, require_positive

InputRecord = Literal["sampled", "exact"]


def geometric_sizes(first: int, last: int, count: int) -> list[int]:
    """Whole numbers spaced geometrically, such as the record lengths of a study of how accuracy grows with them."""
    require_integer("the first size", first, 1)
    require_integer("the last size", last, 1)
    require_integer("the count", count, 2)
    if first >= last:
        raise ValueError(f"the first size must be below the last; they are {first} and {last}.")
    sizes = [int(size) for size in np.rint(np.geomspace(first, last, count))]
    if len(set(sizes)) < count:
        raise ValueError(f"there are no {count} different sizes from {first} to {last}, spaced geometrically.")
    return sizes


class Sampling(ABC):
    """When the output is sampled, and what the estimator is told of the input."""

    kind: ClassVar[str]

    samples: int
    input_record: InputRecord = "exact"

    @property
    def length(self) -> int:
        """Number of samples of a record; that of one record where it is not known."""
        samples = getattr(self, "samples", None)
        return samples if isinstance(samples, int) else len(self.times(np.random.default_rng(0)))

    @property
    def mean_interval(self) -> float:
        """Expected interval between samples [s]; that of one record where it is not known."""
        times = np.asarray(self.times(np.random.default_rng(0)), dtype=float)
        return float(np.ptp(times) / max(times.size - 1, 1))

    @abstractmethod
    def times(self, rng: np.random.Generator) -> Array:
        """Sampling instants.

        Parameters
        ----------
        rng : numpy.random.Generator
            Source of whatever is random in them.

        Returns
        -------
        ndarray, shape (N,)
            Instants [s], the first 0.
        """


@dataclass(frozen=True)
class OfInterval(Sampling):
    """What schemes have in common that are given by an interval, of a clock or on average."""

    interval: float
    samples: int = field(metadata={"geometric": True})

    def __post_init__(self) -> None:
        require_positive("interval", self.interval, "s")
        require_integer("samples", self.samples, 2)
        require_choice("input_record", self.input_record, get_args(InputRecord))

    @property
    def mean_interval(self) -> float:
        """Expected interval between samples [s]."""
        return float(self.interval)


@dataclass(frozen=True)
class RegularSampling(OfInterval):
    """Samples at equal intervals, from 0 s.

    Parameters
    ----------
    interval : float
        Sampling interval [s].
    samples : int
        Number of samples, at least 2.
    input_record : {"sampled", "exact"}, default "sampled"
        What the estimator is told of the input: its samples at the output's instants, or its true edges.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli.signals.sampling import RegularSampling
    >>> RegularSampling(interval=0.5, samples=4).times(np.random.default_rng(0))
    array([0. , 0.5, 1. , 1.5])
    """

    kind: ClassVar[str] = "regular"
    #: No random number is drawn.
    deterministic: ClassVar[bool] = True

    input_record: InputRecord = "sampled"

    def times(self, rng: np.random.Generator) -> Array:
        """The clock; nothing is drawn."""
        return self.interval * np.arange(self.samples, dtype=float)


@dataclass(frozen=True)
class UniformIntervals(Sampling):
    """Samples at independent random intervals, each uniform between two bounds, from 0 s.

    Parameters
    ----------
    low : float
        Shortest interval [s].
    high : float
        Longest interval [s].
    samples : int
        Number of samples, at least 2.
    input_record : {"sampled", "exact"}, default "exact"
        What the estimator is told of the input: its samples at the output's instants, or its true edges.

    Notes
    -----
    Holding the samples of an input whose edges fall between them makes it late by half an interval on
    average, which biases the delay: that is what ``sampled`` is for. :class:`IrregularSampling` is the same scheme by
    its mean.
    """

    kind: ClassVar[str] = "uniform_intervals"

    low: float
    high: float
    samples: int = field(metadata={"geometric": True})
    input_record: InputRecord = "exact"

    def __post_init__(self) -> None:
        require_positive("low", self.low, "s")
        require_positive("high", self.high, "s")
        if self.low > self.high:
            raise OptionError("low", f"low must not exceed high; they are {self.low:g} s and {self.high:g} s.")
        require_integer("samples", self.samples, 2)
        require_choice("input_record", self.input_record, get_args(InputRecord))

    @property
    def mean_interval(self) -> float:
        """Expected interval between samples [s]."""
        return 0.5 * float(self.low + self.high)

    def times(self, rng: np.random.Generator) -> Array:
        """Instants at intervals that are drawn."""
        return from_zero(rng.uniform(self.low, self.high, self.samples - 1))


def from_zero(intervals: Array) -> Array:
    """Instants at given intervals [s], the first 0."""
    return np.concatenate(([0.0], np.cumsum(intervals)))
