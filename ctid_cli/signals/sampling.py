"""Sampling schemes: instants of the output samples."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, ClassVar, Literal

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError, OptionError
from ctid_cli.signals import checks
from ctid_cli.signals.measurement import read_instants

InputRecord = Literal["sampled", "exact"]
#: Number of samples of a record.
Samples = Annotated[int, checks.require_integer, 2]


class Sampling(ABC):
    """Sampling instants of the output, and input information given to the estimator."""

    kind: ClassVar[str]

    samples: int
    input_record: InputRecord = "exact"

    @property
    def length(self) -> int:
        """Number of samples of a record; if it is random, that of one record."""
        samples = getattr(self, "samples", None)
        return samples if isinstance(samples, int) else len(self.times(np.random.default_rng(0)))

    @property
    def mean_interval(self) -> float:
        """Expected interval between samples [s]; if it is unknown, that of one record."""
        times = np.asarray(self.times(np.random.default_rng(0)), dtype=float)
        return float(np.ptp(times) / max(times.size - 1, 1))

    @abstractmethod
    def times(self, rng: np.random.Generator) -> Array:
        """Return the sampling instants.

        Parameters
        ----------
        rng : numpy.random.Generator
            Source of all random numbers.

        Returns
        -------
        ndarray, shape (N,)
            Instants [s], increasing.
        """


@dataclass(frozen=True)
class OfInterval(checks.Checked, Sampling):
    """Base of schemes with an interval, exact or on average."""

    interval: Annotated[float, checks.require_positive, "s"]
    samples: Samples = field(metadata={"geometric": True})

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
        Input given to the estimator: its samples at the output's instants, or its true edges.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli.signals.sampling import RegularSampling
    >>> RegularSampling(interval=0.5, samples=4).times(np.random.default_rng(0))
    array([0. , 0.5, 1. , 1.5])
    """

    kind: ClassVar[str] = "regular"
    #: No random numbers are drawn.
    deterministic: ClassVar[bool] = True

    input_record: InputRecord = "sampled"

    def times(self, rng: np.random.Generator) -> Array:
        """Return the ticks of the clock; no random numbers are drawn."""
        return self.interval * np.arange(self.samples, dtype=float)


@dataclass(frozen=True)
class UniformIntervals(checks.Checked, Sampling):
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
        Input given to the estimator: its samples at the output's instants, or its true edges.

    Notes
    -----
    Holding samples of an input with edges between them delays it by half an interval on average, which biases
    the delay: ``sampled`` shows this effect. :class:`IrregularSampling` draws the same intervals, given by their
    mean.
    """

    kind: ClassVar[str] = "uniform_intervals"

    low: Annotated[float, checks.require_positive, "s"]
    high: Annotated[float, checks.require_positive, "s"]
    samples: Samples = field(metadata={"geometric": True})
    input_record: InputRecord = "exact"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.low > self.high:
            raise OptionError("low", f"low must not exceed high; they are {self.low:g} s and {self.high:g} s.")

    @property
    def mean_interval(self) -> float:
        """Expected interval between samples [s]."""
        return 0.5 * float(self.low + self.high)

    def times(self, rng: np.random.Generator) -> Array:
        """Return instants at random intervals."""
        return np.concatenate(([0.0], np.cumsum(rng.uniform(self.low, self.high, self.samples - 1))))


@dataclass(frozen=True)
class IrregularSampling(OfInterval):
    """Samples at independent random intervals around a mean, from 0 s.

    Parameters
    ----------
    interval : float
        Mean interval [s]; in place of interval and samples, ``times`` may list the instants, or ``file`` name a file.
    samples : int
        Number of samples, at least 2.
    spread : float, default 0.5
        Intervals are uniform within this fraction below and above the mean [-], above 0 and below 1.
    input_record : {"sampled", "exact"}, default "exact"
        Input given to the estimator: its samples at the output's instants, or its true edges.

    Notes
    -----
    Equivalent to ``uniform_intervals`` with ``low = (1 - spread) interval`` and ``high = (1 + spread) interval``.
    """

    kind: ClassVar[str] = "irregular"

    spread: Annotated[float, partial(checks.require_share, whole=False)] = 0.5
    input_record: InputRecord = "exact"

    def times(self, rng: np.random.Generator) -> Array:
        """Return instants at random intervals."""
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
        Largest shift of an instant from its tick [s], less than half the interval; shifts are independent and
        uniform, and zero for the first instant.
    input_record : {"sampled", "exact"}, default "exact"
        Input given to the estimator: its samples at the output's instants, or its true edges.

    Notes
    -----
    The instants are known to the estimator: the clock is irregular, but without measurement errors.
    """

    kind: ClassVar[str] = "jitter"

    largest_shift: Annotated[float, checks.require_not_negative, "s"]
    input_record: InputRecord = "exact"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.largest_shift >= 0.5 * self.interval:
            most = f"half the interval, {0.5 * self.interval:g} s; it is {self.largest_shift:g} s"
            raise OptionError("largest_shift", f"largest_shift must be less than {most}: samples would change places.")

    def times(self, rng: np.random.Generator) -> Array:
        """Return the ticks of the clock with random shifts."""
        shifts = rng.uniform(-self.largest_shift, self.largest_shift, self.samples - 1)
        ticks = self.interval * np.arange(self.samples, dtype=float)
        ticks[1:] += shifts
        return ticks


class GivenInstants(checks.Checked, Sampling):
    """Samples at instants known before any data are generated; the record begins at the first of them."""

    kind: ClassVar[str] = "irregular"
    #: No random numbers are drawn.
    deterministic: ClassVar[bool] = True


@dataclass(frozen=True)
class ListedInstants(GivenInstants):
    """Samples at listed instants.

    Parameters
    ----------
    instants : tuple of float
        The instants [s], at least two, increasing.
    input_record : {"sampled", "exact"}, default "exact"
        Input given to the estimator: its samples at the output's instants, or its true edges.
    """

    instants: tuple[float, ...]
    input_record: InputRecord = "exact"

    def times(self, rng: np.random.Generator) -> Array:
        """Return the instants; no random numbers are drawn."""
        return np.array(self.instants, dtype=float)


@dataclass(frozen=True)
class InstantsFile(GivenInstants):
    """Samples at instants from a text (.csv), MATLAB or HDF5 file.

    Parameters
    ----------
    file : str
        Name of the file; its first line names the columns.
    time : str, default "t"
        Column of the instants [s], strictly increasing.
    sha256 : str, optional
        Expected SHA-256 of the file; a specification takes it from the file.
    input_record : {"sampled", "exact"}, default "exact"
        Input given to the estimator: its samples at the output's instants, or its true edges.
    """

    file: str
    time: str = "t"
    sha256: str | None = None
    input_record: InputRecord = "exact"

    def times(self, rng: np.random.Generator) -> Array:
        """Return the instants of the file; no random numbers are drawn."""
        instants = read_instants(self.file, self.time)
        if instants.size < 2:
            raise DataError(f"{self.file}: there is one instant, and a record has two or more")
        return instants
