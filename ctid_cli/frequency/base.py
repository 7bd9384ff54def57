"""Base class of frequency estimators: the option ``tones``, and the track of a whole record.

A plugin is a frozen dataclass of options derived from :class:`FrequencyEstimator` whose method ``track`` returns a
:class:`FrequencyTrack`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError, OptionError
from ctid_cli.frequency.flags import Flag
from ctid_cli.signals.checks import require_integer, require_positive
from ctid_cli.text import Shown

#: Largest number of tones that double precision can resolve.
MOST_TONES = 8
#: Larger samples count as missing: their powers would overflow.
LARGEST_SAMPLE = 1e30


@dataclass(frozen=True, eq=False)
class FrequencyTrack(Shown):
    """Frequencies over time.

    Parameters
    ----------
    t : ndarray, shape (N,)
        Instants since the first sample [s]. An estimator with one estimate for the whole record has one row, at the
        last sample.
    frequencies : ndarray, shape (N, n)
        Frequencies [rad/s], ascending in each row; NaN without an estimate.
    flags : ndarray of uint16, shape (N,)
        Bit field of :class:`Flag`: reasons why a row is unreliable; 0 for a valid row.
    """

    t: Array
    frequencies: Array
    flags: NDArray[np.uint16]

    def __repr__(self) -> str:
        rows = f"{self.t.size} rows of {self.frequencies.shape[1]} frequencies"
        return f"FrequencyTrack({rows}, {np.mean(self.valid):.3g} of them valid)"

    @property
    def valid(self) -> BoolArray:
        """Mask of the rows without flags, shape (N,)."""
        return np.asarray(self.flags == 0)

    def reasons(self, row: int) -> tuple[str, ...]:
        """Return the reasons why a row is unreliable.

        Parameters
        ----------
        row : int
            Number of the row.

        Returns
        -------
        tuple of str
            One sentence for each flag.
        """
        return Flag(int(self.flags[row])).sentences


@dataclass(frozen=True, kw_only=True)
class FrequencyEstimator(ABC):
    """Options of a frequency estimator.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.

    Raises
    ------
    ValueError
        If an option is out of range.
    """

    kind: ClassVar[str]
    #: Whether there is one estimate for the whole record: the track then has one row, at the last sample.
    whole_record: ClassVar[bool] = False
    #: Whether the flag CHANGED is an alarm, so that false alarms are counted.
    raises_alarms: ClassVar[bool] = False

    tones: Annotated[int, require_integer, 1, MOST_TONES]

    def __post_init__(self) -> None:
        require_integer("tones", self.tones, 1, MOST_TONES)

    @abstractmethod
    def track(self, samples: ArrayLike, interval: float) -> FrequencyTrack:
        """Estimate the frequencies of a record.

        Parameters
        ----------
        samples : array_like, shape (N,)
            Regularly sampled signal [signal unit]; NaN if missing.
        interval : float
            Sampling interval [s].

        Returns
        -------
        FrequencyTrack
            Frequencies at the instants of the samples.

        Raises
        ------
        DataError
            If the samples are not a series of real numbers, or too few.
        ValueError
            If the options are invalid for the sampling interval.
        """

    def check(self, count: int, interval: float) -> None:  # noqa: B027 - most estimators take any record
        """Raise DataError if the options are invalid for records of a given size.

        Parameters
        ----------
        count : int
            Number of samples.
        interval : float
            Sampling interval [s].

        Raises
        ------
        DataError
            If the options are invalid, or the samples too few; ``DataError(message, "h")`` refers to the option h.
        """

    def warnings(self, interval: float, highest: float) -> Iterator[tuple[str, str]]:
        """Yield warnings about options that are valid but unsuitable for a signal.

        Parameters
        ----------
        interval : float
            Sampling interval [s].
        highest : float
            Highest frequency of the signal [rad/s].

        Yields
        ------
        tuple of str
            Name of the option, and a sentence.
        """
        yield from ()

    def keep_one_for_each(self, name: str, unit: str) -> None:
        """Check an option with one positive number for each tone, and store it as a tuple.

        Parameters
        ----------
        name : str
            Name of the option.
        unit : str
            Unit of the option.
        """
        values = getattr(self, name)
        if values is None:
            return
        numbers = tuple(float(value) for value in values)
        if len(numbers) != self.tones:
            raise OptionError(name, f"{name} must hold one number for each of the {self.tones} tones, not {values!r}.")
        for number in numbers:
            require_positive(name, number, unit)
        object.__setattr__(self, name, numbers)


def series_of(samples: ArrayLike) -> Array:
    """Return one series of real numbers, with NaN for missing samples."""
    values = np.asarray(samples)
    if values.ndim != 1 or values.dtype.kind not in "fiu":
        found = f"shape {values.shape} and type {values.dtype}"
        raise DataError(f"the samples must be one series of real numbers, not of {found}.")
    values = values.astype(np.float64)
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(values) <= LARGEST_SAMPLE, values, np.nan)
