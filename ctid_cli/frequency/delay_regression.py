r"""Delay regression of a multi-sinusoidal signal, and base classes of its estimators.

For ``y = sum A_i sin(w_i t + p_i)`` and a delay h, with ``c_i = cos(w_i h)`` and
``prod(c - c_i) = c^n + theta_1 c^(n-1) + ... + theta_n``, the operator ``prod(Z^2 + 1 - 2 c_i Z)`` annihilates y, where
Z delays by h. Expanded, ``psi = phi' theta`` with ``psi = -(Z^2 + 1)^n y`` and
``phi_k = (2 Z)^k (Z^2 + 1)^(n-k) y``: a linear regression for theta that is exact from t = 2 n h on.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from math import comb, gcd
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctid_cli.arrays import Array
from ctid_cli.errors import OptionError
from ctid_cli.frequency.base import FrequencyEstimator, FrequencyTrack, series_of
from ctid_cli.signals.checks import Checked, require_not_negative, require_positive

if TYPE_CHECKING:
    from ctid_cli.frequency.delay_kernels import Clock

#: Longest delay in sampling intervals: the samples of 2 n delays are stored.
LONGEST_DELAY = 10_000_000
#: Approximate fraction of the second delay to the first, as far as possible from simple ratios.
GOLDEN_FRACTION = (np.sqrt(5.0) - 1.0) / 2.0
#: Largest distance to a number without a common divisor, for all allowed delays.
SEARCHED = 100
#: Checks per delay h, and the greatest number of samples between two of them.
CHECKS_PER_DELAY = 64
MOST_BETWEEN = 8
#: Relative change of a delay by rounding to whole sampling intervals above which there is a warning.
NOTEWORTHY_ROUNDING = 0.01
#: Rows per tone, and fraction of n h, after which an estimate can be valid: earlier rows are too few or too similar to
#: reveal a disagreement.
ROWS_PER_TONE = 4
STARTING_SPAN = 0.25
#: Samples of a record that are processed at once: their moments stay in the cache. Measured at five tones.
BLOCK = 1 << 12


@dataclass(frozen=True, kw_only=True)
class DelayRegression(Checked, FrequencyEstimator):
    """Common options of the estimators on the delay regression.

    Parameters
    ----------
    h : float
        Delay of the regression [s], below pi over the highest frequency, since frequencies above pi/h alias; rounded to
        whole sampling intervals.
    prefilter : float, default 0.0
        Length of a Hann low-pass filter of the signal [s]; 0 for none.
    difference : float, default 0.0
        If positive, the signal delayed by this time is subtracted [s], which removes a constant bias.

    Raises
    ------
    ValueError
        If an option is out of range.
    """

    #: Names of further options with a time for which samples are stored [s].
    _kept: ClassVar[tuple[str, ...]] = ()

    h: Annotated[float, require_positive, "s"]
    prefilter: Annotated[float, require_not_negative, "s"] = 0.0
    difference: Annotated[float, require_not_negative, "s"] = 0.0

    @property
    def _stacked_over(self) -> float:
        """Time span of the rows of an estimate [s]."""
        return 0.0

    @abstractmethod
    def start(self, interval: float) -> Online:
        """Start an online estimation with the sampling interval [s]."""

    def track(self, samples: ArrayLike, interval: float) -> FrequencyTrack:
        """Estimate the frequencies at every sample of a record, see :meth:`FrequencyEstimator.track`."""
        online, y = self.start(interval), series_of(samples)
        omega, flags = np.empty((y.size, self.tones)), np.zeros(y.size, np.uint16)
        for first in range(0, y.size, BLOCK):
            part = slice(first, first + BLOCK)
            online.advance(y[part], omega[part], flags[part])
        return FrequencyTrack(interval * np.arange(y.size, dtype=float), omega, flags)

    def check(self, count: int, interval: float) -> None:
        """Refuse delays longer than a record of ``count`` samples, and options that are invalid for its clock."""
        duration = interval * count
        # This check is first, since the estimation would store all samples of such a time.
        for name in ("prefilter", "difference", *self._kept):
            value = getattr(self, name)
            if value > duration:
                raise OptionError(name, f"{name} = {value:g} s is longer than the record, {duration:g} s")
        filled = 2 * self.tones * self.h + self.prefilter + self.difference + self._stacked_over
        if filled >= duration:
            ends = f"the record ends at {duration:g} s; take a smaller h"
            raise OptionError("h", f"its delays are filled after {filled:g} s, {ends}")
        self.start(interval)

    def warnings(self, interval: float, highest: float) -> Iterator[tuple[str, str]]:
        """Yield warnings about aliases of frequencies at the delay, and about a rounded delay."""
        if highest * self.h > np.pi:
            limit = f"with h = {self.h:g} s, frequencies above pi/h = {np.pi / self.h:.4g} rad/s"
            yield "h", f"{limit} are aliases of lower ones, and the signal has {highest:g} rad/s"
        delay = whole_delay("h", self.h, interval) * interval
        if abs(delay - self.h) > NOTEWORTHY_ROUNDING * self.h:
            whole = f"no whole number of sampling intervals of {interval:g} s"
            yield "h", f"h = {self.h:g} s is {whole}; {delay:g} s is used."

    def clock(self, interval: float) -> Clock:
        """Return the regression at a sampling interval [s]."""
        from ctid_cli.frequency.delay_kernels import Clock  # numba is slow to import

        lag = whole_delay("h", self.h, interval)
        second, every = second_lag(lag), max(1, min(lag // CHECKS_PER_DELAY, MOST_BETWEEN))
        return Clock(float(interval), lag, lag * interval, second, second * interval, every)

    def weights(self, interval: float) -> Array:
        """Return the impulse response of the prefilter, shape (L + 1,).

        ``w_k = sin^2(pi (k + 1)/(L + 2))``, scaled to the sum 1: the Hann window without its two zeros. Sinusoids
        remain sinusoids, so that exact estimates remain exact.
        """
        order, shift = (
            whole_delay(name, getattr(self, name), interval) if getattr(self, name) > 0 else 0
            for name in ("prefilter", "difference")
        )
        weights = np.sin(np.pi * np.arange(1, order + 2) / (order + 2)) ** 2
        weights = np.pad(weights / weights.sum(), (0, shift))
        return weights - np.roll(weights, shift) if shift else weights

    def rows_before_valid(self, clock: Clock) -> int:
        """Return the number of rows before an estimate can be valid."""
        return max(ROWS_PER_TONE * self.tones, int(STARTING_SPAN * self.tones * clock.lag))

    def require_samples(self, memory: float, samples: float, interval: float) -> None:
        """Refuse a memory [s] with fewer samples than an estimate needs."""
        needed = ROWS_PER_TONE * self.tones
        if samples < needed:
            few = f"{samples:.3g} samples of {interval:g} s, fewer than the {needed} that {self.tones} tones need."
            raise OptionError("memory", f"memory = {memory:g} s holds {few}")


class Online(ABC):
    """Online estimation from single samples, or blocks of samples.

    Both use the same code: single samples give the results of a whole record, up to rounding.
    """

    def __init__(self, options: DelayRegression, interval: float, *, past: float = np.nan) -> None:
        require_positive("interval", interval, "s")
        self.options, self.clock = options, options.clock(interval)
        self.weights = options.weights(interval)
        self.table = delay_table(options.tones)
        self._count = 0
        self._unfiltered = Tail(np.full(self.weights.size - 1, past))
        self._filtered = Tail(np.full(2 * options.tones * self.clock.lag, past))

    @abstractmethod
    def advance(self, samples: Array, omega: Array, flags: NDArray[np.uint16]) -> None:
        """Process samples, and write the frequencies and the flags at their instants."""

    def update(self, sample: float) -> FrequencyTrack:
        """Process the next sample, NaN if missing, and return the row of the track at its instant."""
        omega, flags = np.empty((1, self.options.tones)), np.zeros(1, np.uint16)
        self.advance(series_of([float(sample)]), omega, flags)
        self._count += 1
        return FrequencyTrack(np.array([(self._count - 1) * self.clock.interval]), omega, flags)

    def rows(self, samples: Array) -> Array:
        """Return the rows ``[phi psi]`` at h and at the second delay, (2, N, n + 1); NaN for missing samples."""
        if self.weights.size > 1:
            samples = np.convolve(self._unfiltered.extended(samples), self.weights, "valid")
        past, delays = self._filtered.extended(samples), np.arange(2 * self.options.tones + 1)
        newest, rows = len(past) - samples.size, np.empty((2, samples.size, len(self.table)))
        for lag, into in zip((self.clock.lag, self.clock.second_lag), rows, strict=True):
            delayed = np.stack([past[newest - age : len(past) - age] for age in lag * delays])
            np.matmul(delayed.T, self.table.T, out=into)
        return rows


class Tail:
    """Newest rows of a stream, as required by a delay, a filter or a mixing."""

    def __init__(self, kept: Array) -> None:
        self._kept = kept

    def extended(self, new: Array) -> Array:
        """Return the stored rows followed by new ones, and store the last of them."""
        whole = np.concatenate((self._kept, new))
        self._kept = whole[len(new) :].copy()
        return whole


def delay_table(tones: int) -> Array:
    """Return the coefficients of ``[phi psi] = table @ [y(t), y(t - h), ... y(t - 2 n h)]``."""
    table = np.zeros((tones + 1, 2 * tones + 1))
    for k in range(tones + 1):
        # (2 Z)^k (Z^2 + 1)^(n - k); the first one, with the other sign, is psi in the last row.
        table[k - 1, k : 2 * tones - k + 1 : 2] = [2**k * comb(tones - k, i) for i in range(tones - k + 1)]
    table[-1] *= -1.0
    return table


def whole_delay(name: str, delay: float, interval: float) -> int:
    """Return a delay rounded to whole sampling intervals."""
    require_positive("interval", interval, "s")
    if delay / interval > LONGEST_DELAY:
        longest = f"{LONGEST_DELAY:,} sampling intervals of {interval:g} s"
        raise OptionError(name, f"{name} = {delay:g} s is more than {longest}; keep fewer of the samples.")
    count = round(delay / interval)
    if count < 1:
        raise OptionError(name, f"{name} = {delay:g} s is shorter than half a sampling interval of {interval:g} s.")
    return count


def second_lag(lag: int) -> int:
    """Return the second delay for a given first one, in sampling intervals."""
    if lag == 1:
        return 1  # no alias lies below the Nyquist frequency
    wanted = GOLDEN_FRACTION * lag
    near = range(max(1, round(wanted) - SEARCHED), min(lag, round(wanted) + SEARCHED + 1))
    return min((m for m in near if gcd(m, lag) == 1), key=lambda m: abs(m - wanted))


def theta_of(omega: ArrayLike, delay: float) -> Array:
    """Return the parameters of the regression for given frequencies."""
    return np.asarray(np.poly(np.cos(np.asarray(omega, dtype=float) * delay))[1:])
