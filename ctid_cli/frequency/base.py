"""What every estimator of frequencies has in common: the option ``tones``, and a track of a whole record.

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

#: More tones than this cannot be told apart in double precision.
MOST_TONES = 8
#: A sample larger than this counts as missing: its powers would overflow.
LARGEST_SAMPLE = 1e30


@dataclass(frozen=True, eq=False)
class FrequencyTrack(Shown):
    """Frequencies over time.

    Parameters
    ----------
    t : ndarray, shape (N,)
        Instants since the first sample [s]. An estimator that gives one estimate for the whole record has one row, at
        the last sample.
    frequencies : ndarray, shape (N, n)
        Frequencies [rad/s], ascending in each row; NaN where there is no estimate.
    flags : ndarray of uint16, shape (N,)
        Bit field of :class:`Flag`: why a row must not be trusted; 0 if it may.
    """

    t: Array
    frequencies: Array
    flags: NDArray[np.uint16]

    def __repr__(self) -> str:
        rows = f"{self.t.size} rows of {self.frequencies.shape[1]} frequencies"
        return f"FrequencyTrack({rows}, {np.mean(self.valid):.3g} of them valid)"

    @property
    def valid(self) -> BoolArray:
        """Rows without any flag, shape (N,)."""
        return np.asarray(self.flags == 0)

    def reasons(self, row: int) -> tuple[str, ...]:
        """Say why a row must not be trusted.

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
    """Options of an estimator of frequencies.

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
    #: Whether one estimate stands for the whole record: its track has one row, at the last sample.
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
            Signal on a regular clock [signal unit]; NaN where missing.
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
            If the options do not fit to the sampling interval.
        """

    def check(self, count: int, interval: float) -> None:  # noqa: B027 - most estimators take any record
        """Refuse records that the options do not fit to, before there are any.

        Parameters
        ----------
        count : int
            Number of samples.
        interval : float
            Sampling interval [s].

        Raises
        ------
        DataError
            If the options do not fit, or the samples are too few; ``DataError(message, "h")`` blames the option h.
        """

    def warnings(self, interval: float, highest: float) -> Iterator[tuple[str, str]]:
        """Say what is allowed but unwise on a signal: the name of an option, and a sentence about it.

        Parameters
        ----------
        interval : float
            Sampling interval [s].
        highest : float
            Highest frequency of the signal [rad/s].

        Yields
        ------
        tuple of str
            The option and the sentence.
        """
        yield from ()

    def keep_one_for_each(self, name: str, unit: str) -> None:
        """Check an option that holds one positive number for each tone, and keep it as a tuple.

        Parameters
        ----------
        name : str
            The option.
        unit : str
            Its unit.
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
    """Return one series of real numbers, with NaN for whatever counts as missing."""
    values = np.asarray(samples)
    if values.ndim != 1 or values.dtype.kind not in "fiu":
        found = f"shape {values.shape} and type {values.dtype}"
        raise DataError(f"the samples must be one series of real numbers, not of {found}.")
    values = values.astype(np.float64)
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(values) <= LARGEST_SAMPLE, values, np.nan)
