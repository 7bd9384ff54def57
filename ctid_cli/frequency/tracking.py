"""What all online estimators share: one object that takes samples one by one or by the million, and can be saved."""

from __future__ import annotations

import hashlib
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from numbers import Real
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError, OptionError
from ctid_cli.frequency import base
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.frequency_kernels import Output
from ctid_cli.frequency.inputs import LARGEST_SAMPLE, MOST_TONES, series_of
from ctid_cli.frequency.prefilter import convolve, fast_convolve
from ctid_cli.signals.checks import require_integer, require_positive
from ctid_cli.text import ShownAsTable


@dataclass(frozen=True, eq=False)
class FrequencyEstimate:
    """Frequencies at one instant.

    Parameters
    ----------
    omega : ndarray, shape (n,)
        Frequencies [rad/s], ascending.
    flags : Flag
        Why they must not be trusted; no flag if they may.
    uncertainty : ndarray, shape (n,)
        Error that the misfit of the equations could make in its worst direction [rad/s]; NaN if unknown. Random noise
        makes far smaller errors.
    """

    omega: Array
    flags: Flag
    uncertainty: Array

    @property
    def valid(self) -> bool:
        """Whether no flag is set."""
        return not self.flags

    @property
    def reasons(self) -> tuple[str, ...]:
        """One sentence for each flag."""
        return self.flags.sentences


@dataclass(frozen=True, eq=False)
class FrequencyTrack(ShownAsTable):
    """Frequencies over time."""

    t: Array
    omega: Array
    flags: NDArray[np.uint16]
    uncertainty: Array

    def __repr__(self) -> str:
        rows = f"{self.t.size} rows of {self.omega.shape[1]} frequencies"
        return f"FrequencyTrack({rows}, {np.mean(self.flags == 0):.3g} of them valid)"

    @property
    def valid(self) -> BoolArray:
        """Samples without any flag, shape (N,)."""
        return np.asarray(self.flags == 0)

    def __getitem__(self, row: int) -> FrequencyEstimate:
        return FrequencyEstimate(self.omega[row].copy(), Flag(int(self.flags[row])), self.uncertainty[row].copy())

    @property
    def final(self) -> FrequencyEstimate:
        """The last estimate."""
        return self[-1]


class Recursion(NamedTuple):
    """A compiled recursion, ``advance(samples, output, *settings, *states)``, with everything it needs."""

    advance: Callable[..., None]
    #: Named tuples of what stays the same.
    settings: tuple[Any, ...]
    #: Named tuples of arrays, before the first sample; the kernel changes them in place.
    states: tuple[Any, ...]
    #: Impulse response of the prefilter, newest sample first; one weight for none, shape (L + 1,).
    weights: Array = np.ones(1)
    #: What the signal is taken for before the first sample.
    past: float = np.nan
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class FrequencyEstimator(base.FrequencyEstimator):
    """Options of an estimator of frequencies."""

    kind: ClassVar[str]
    online: ClassVar[bool]

    tones: int

    def __post_init__(self) -> None:
        require_integer("tones", self.tones, 1, MOST_TONES)

    def _keep_one_for_each(self, name: str, unit: str) -> None:
        """Check an option that holds one positive number for each tone, and keep it as a tuple."""
        values = getattr(self, name)
        if values is None:
            return
        numbers = tuple(float(value) for value in values)
        if len(numbers) != self.tones:
            raise OptionError(name, f"{name} must hold one number for each of the {self.tones} tones, not {values!r}.")
        for number in numbers:
            require_positive(name, number, unit)
        object.__setattr__(self, name, numbers)


class OnlineEstimator(FrequencyEstimator):
    """Options of an estimator that takes sample after sample."""

    online: ClassVar[bool] = True

    def track(self, samples: ArrayLike, interval: float) -> base.FrequencyTrack:
        """Return the estimate at every sample of the record."""
        found = self.start(interval).run(samples)
        return base.FrequencyTrack(found.t, found.omega, found.flags)

    def check(self, count: int, interval: float) -> None:
        """Refuse delays and memories that are longer than the record, and options that the clock cannot have."""
        duration = interval * count
        # First of all, since the estimator would keep all the samples of such a time.
        for name in ("prefilter", "difference", "d", "hold", *(("memory",) if self.kind == "drem_window" else ())):
            value = getattr(self, name, 0.0)
            if value > duration:
                raise OptionError(name, f"{name} = {value:g} s is longer than the record, {duration:g} s")
        rows = getattr(self, "first_row", 0) + self.tones - 1 if hasattr(self, "d") else 0
        filled = 2 * self.tones * getattr(self, "h", 0.0) + rows * getattr(self, "d", 0.0)
        filled += getattr(self, "prefilter", 0.0) + getattr(self, "difference", 0.0)
        if filled >= duration:
            ends = f"the record ends at {duration:g} s; take a smaller h"
            raise OptionError("h", f"its delays are filled after {filled:g} s, {ends}")
        self.start(interval)

    def warnings(self, interval: float, highest: float) -> Iterator[tuple[str, str]]:
        """Say that a frequency has an alias at the delay, or that the clock does not have the delay."""
        delay = getattr(self, "h", 0.0)
        if highest * delay > np.pi:
            limit = f"with h = {delay:g} s, frequencies above pi/h = {np.pi / delay:.4g} rad/s"
            yield "h", f"{limit} are seen as lower ones, and the signal has {highest:g} rad/s"
        for note in self.start(interval).notes:
            yield "h", note

    @abstractmethod
    def _recursion(self, interval: float) -> Recursion:
        """The compiled recursion for a sampling interval."""

    def start(self, interval: float) -> Tracker:
        """Begin before the first sample."""
        return Tracker(self, interval)

    def restore(self, interval: float, state: Mapping[str, ArrayLike]) -> Tracker:
        """Go on where another tracker stopped."""
        tracker = Tracker(self, interval)
        tracker.load(state)
        return tracker


class Tracker:
    """An estimator at work: takes samples of a regular clock and keeps what it needs of them.

    Parameters
    ----------
    options : OnlineEstimator
        Estimator with its options.
    interval : float
        Sampling interval [s].

    Raises
    ------
    ValueError
        If the options make no sense at this sampling interval.

    Notes
    -----
    One sample and many pass through the same compiled recursion: however a record is cut into pieces, the numbers are
    the same, bit for bit.
    """

    def __init__(self, options: OnlineEstimator, interval: float) -> None:
        require_positive("interval", interval, "s")
        self.options = options
        self.interval = float(interval)
        self._recursion = recursion = options._recursion(self.interval)
        self._reversed_weights = np.ascontiguousarray(recursion.weights[::-1])
        self._state: dict[str, NDArray[Any]] = {
            "fingerprint": np.frombuffer(_fingerprint(options, self.interval), np.uint8),
            "count": np.zeros(1, np.int64),
            "unfiltered": np.full(recursion.weights.size - 1, recursion.past),
        }
        for part in recursion.states:
            self._state |= part._asdict()

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about options that could not be met exactly, such as a delay between two samples."""
        return self._recursion.notes

    def update(self, sample: float) -> FrequencyEstimate:
        """Take the next sample.

        Parameters
        ----------
        sample : float
            Signal one sampling interval after the last one [signal unit]; NaN if it is missing.

        Returns
        -------
        FrequencyEstimate
            Frequencies at this instant.
        """
        value = float(sample)
        output = self._advance(np.array([value if abs(value) <= LARGEST_SAMPLE else np.nan]), fft=False)
        return FrequencyEstimate(output.omega[0], Flag(int(output.flags[0])), output.uncertainty[0])

    def run(self, samples: ArrayLike, *, fft: bool = False) -> FrequencyTrack:
        """Take many samples.

        Parameters
        ----------
        samples : array_like, shape (N,)
            Signal at the next N instants [signal unit]; NaN where missing.
        fft : bool, default False
            Whether the prefilter is computed by fast Fourier transforms: faster, and equal to the direct sum only up to
            rounding (1e-12 of the largest sample).

        Returns
        -------
        FrequencyTrack
            Frequencies at these instants.

        Raises
        ------
        DataError
            If the samples are not a series of real numbers.
        """
        first = int(self._state["count"][0])
        output = self._advance(series_of(samples), fft=fft)
        t = self.interval * np.arange(first, first + len(output.flags), dtype=np.float64)
        return FrequencyTrack(t, output.omega, output.flags, output.uncertainty)

    def state(self) -> dict[str, NDArray[Any]]:
        """Everything that later estimates depend on.

        Returns
        -------
        dict of ndarray
            Copies of the arrays; for :meth:`OnlineEstimator.restore`.
        """
        return {name: array.copy() for name, array in self._state.items()}

    def load(self, state: Mapping[str, ArrayLike]) -> None:
        """Take over a saved state.

        Parameters
        ----------
        state : mapping of str to array_like
            What :meth:`state` returned.

        Raises
        ------
        DataError
            If the state is not one of this estimator with these options and this sampling interval.
        """
        own = self._state
        # Lists, as a state is after its way through a text file, have lost their kind of number.
        arrays = {
            name: np.asarray(array, dtype=own[name].dtype if isinstance(array, list) and name in own else None)
            for name, array in state.items()
        }
        same = arrays.keys() == own.keys() and all(
            (array.shape, array.dtype) == (own[name].shape, own[name].dtype) for name, array in arrays.items()
        )
        if not same or not np.array_equal(arrays.pop("fingerprint"), own["fingerprint"]):
            own_place = f"{self.options!r} at a sampling interval of {self.interval:g} s"
            how = "restore it with the options and the interval that it was saved with"
            raise DataError(f"this is not the state of {own_place}; {how}.")
        for name, array in arrays.items():
            own[name][...] = array

    def _advance(self, samples: Array, *, fft: bool) -> Output:
        state, recursion = self._state, self._recursion
        size, tones = samples.size, self.options.tones
        if recursion.weights.size > 1:
            everything = np.concatenate((state["unfiltered"], samples))
            state["unfiltered"][...] = everything[size:]
            if fft and size:
                samples = fast_convolve(everything, recursion.weights)
            else:
                convolve(everything, self._reversed_weights, samples)
        output = Output(np.empty((size, tones)), np.empty((size, tones)), np.empty(size, np.uint16))
        recursion.advance(samples, output, *recursion.settings, *recursion.states)
        state["count"][0] += size
        return output


def _fingerprint(options: OnlineEstimator, interval: float) -> bytes:
    """Digest of everything that gives a state its meaning."""
    values = []
    for item in fields(options):
        value = getattr(options, item.name)
        # The same number may come as an integer or as a float.
        values.append((item.name, float(value) if isinstance(value, Real) else value))
    return hashlib.sha256(repr((options.kind, values, interval.hex())).encode()).digest()
