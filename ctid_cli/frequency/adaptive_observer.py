"""Frequencies from an adaptive observer: a comparator, derived, not the published algorithm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ctid_cli.arrays import Array, IntArray
from ctid_cli.errors import OptionError
from ctid_cli.frequency.checks import one_for_each, samples_in
from ctid_cli.frequency.decoding import flag_uncertain
from ctid_cli.frequency.flags import GAP, OUT_OF_BOUNDS, STARTING, UNDETERMINED
from ctid_cli.frequency.moments import factorise, substitute
from ctid_cli.frequency.regression import MOST_TONES
from ctid_cli.frequency.tracking import OnlineEstimator, Recursion
from ctid_cli.signals.checks import require_integer, require_not_negative, require_positive

#: Ridge of the Gauss-Newton matrix, as a fraction of its trace.
RIDGE = 1e-4


@dataclass(frozen=True, kw_only=True)
class AdaptiveObserver(OnlineEstimator):
    r"""Frequencies by prediction errors of an observer that adapts them; derived, not the published algorithm.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.
    initial_frequencies : tuple of float
        Frequencies to begin with [rad/s], ascending and at least ``smallest_gap`` apart.
    pole : float, default 2.0
        Slowest rate of the observer [rad/s], near the frequencies.
    ratio : float, default 1.2
        Ratio of one rate to the next [-], 1 or more.
    rate : float, default 0.3
        Rate of the adaptation [1/s].
    hold : float, default 2.0
        No adaptation before this time [s].
    smallest_gap : float, default 0.3
        Frequencies are kept this far apart [rad/s].
    lowest_frequency : float, default 0.2
        Lower bound of the frequencies [rad/s].
    highest_frequency : float, default 8.0
        Upper bound of the frequencies [rad/s].

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    Derived, not the published algorithm: an adaptive observer with direct estimates of the squared frequencies is known
    from the literature, but this adaptation law is our own.

    The state holds each tone and its derivative. With ``e = y - sum s_i``, ``s_i' = v_i + l_i1 e``,
    ``v_i' = -w_i^2 s_i + l_i2 e``; the gains put the observer's poles at ``-pole ratio^k``, k = 0 ... 2n - 1, for the
    present frequencies. The sensitivities of the prediction error to the squared frequencies are integrated beside it
    (Runge-Kutta, signal linear between samples) and drive recursive Gauss-Newton steps with exponential forgetting.
    Convergence is local.
    """

    kind: ClassVar[str] = "adaptive_observer"

    tones: int
    initial_frequencies: tuple[float, ...]
    pole: float = 2.0
    ratio: float = 1.2
    rate: float = 0.3
    hold: float = 2.0
    smallest_gap: float = 0.3
    lowest_frequency: float = 0.2
    highest_frequency: float = 8.0

    def __post_init__(self) -> None:
        require_integer("tones", self.tones, 1, MOST_TONES)
        for name in ("pole", "smallest_gap", "lowest_frequency", "highest_frequency"):
            require_positive(name, getattr(self, name), "rad/s")
        require_positive("ratio", self.ratio, "-")
        require_positive("rate", self.rate, "1/s")
        require_not_negative("hold", self.hold, "s")
        if self.ratio < 1.0:
            raise OptionError("ratio", f"ratio must be 1 or more, not {self.ratio!r}.")
        if self.highest_frequency < self.lowest_frequency + (self.tones - 1) * self.smallest_gap:
            raise OptionError(
                "highest_frequency",
                f"{self.tones} frequencies, {self.smallest_gap:g} rad/s apart, do not fit between lowest_frequency "
                f"({self.lowest_frequency:g} rad/s) and highest_frequency ({self.highest_frequency:g} rad/s).",
            )
        initial = one_for_each("initial_frequencies", self.initial_frequencies, self.tones, "rad/s")
        object.__setattr__(self, "initial_frequencies", initial)
        edges = np.concatenate(([self.lowest_frequency - self.smallest_gap], self.initial_frequencies))
        if (np.diff(edges) < self.smallest_gap - 1e-12).any() or edges[-1] > self.highest_frequency:
            raise OptionError(
                "initial_frequencies",
                f"initial_frequencies must rise from lowest_frequency to highest_frequency in steps of at least "
                f"smallest_gap, not {self.initial_frequencies!r}.",
            )

    def recursion(self, interval: float) -> Recursion:
        """The compiled recursion for a sampling interval.

        Parameters
        ----------
        interval : float
            Sampling interval [s].

        Returns
        -------
        Recursion
            With the state before the first sample.

        Raises
        ------
        ValueError
            If the options make no sense at this sampling interval.
        """
        n = self.tones
        poles = self.pole * self.ratio ** np.arange(2 * n)
        if poles[-1] * interval > 1.0:
            raise OptionError(
                "pole",
                f"the fastest pole of the observer, {poles[-1]:g} rad/s, needs a sampling interval below "
                f"{1.0 / poles[-1]:g} s, not {interval:g} s.",
            )
        if self.rate * interval >= 1.0:
            raise OptionError(
                "rate", f"rate = {self.rate:g} 1/s needs a sampling interval below {1.0 / self.rate:g} s."
            )
        constants = (
            float(interval),
            poles,
            float(self.rate),
            samples_in(self.hold, interval),
            float(self.smallest_gap),
            float(self.lowest_frequency),
            float(self.highest_frequency),
        )
        state = {
            "squares": np.asarray(self.initial_frequencies) ** 2,
            "observer": np.zeros((n + 1, 2 * n)),
            "moments": np.zeros((n + 1, n + 1)),
            "last": np.full(1, np.nan),
            "average": np.asarray(self.initial_frequencies, dtype=float).copy(),
            "counters": np.zeros(1, np.int64),
        }
        return Recursion(advance_observer, constants, state)


@njit(cache=True, nogil=True)
def place_poles(squares: Array, poles: Array, gains: Array) -> None:
    """Observer gains for given frequencies."""
    for i in range(squares.size):
        omega = np.sqrt(squares[i])
        value = complex(1.0, 0.0)
        for k in range(poles.size):
            value *= complex(poles[k], omega)
        others = 1.0
        for j in range(squares.size):
            if j != i:
                others *= squares[j] - squares[i]
        gains[2 * i] = value.imag / (omega * others)
        gains[2 * i + 1] = value.real / others


@njit(cache=True, nogil=True)
def observer_slope(states: Array, y: float, squares: Array, gains: Array, slope: Array) -> None:
    """Time derivative of the observer and of its sensitivities."""
    n = squares.size
    for p in range(n + 1):
        error = y if p == 0 else 0.0
        for i in range(n):
            error -= states[p, 2 * i]
        for i in range(n):
            slope[p, 2 * i] = states[p, 2 * i + 1] + gains[2 * i] * error
            slope[p, 2 * i + 1] = -squares[i] * states[p, 2 * i] + gains[2 * i + 1] * error
        if p > 0:
            slope[p, 2 * p - 1] -= states[0, 2 * p - 2]


@njit(cache=True, nogil=True)
def advance_observer(
    samples: Array,
    omega: Array,
    uncertainty: Array,
    flags: NDArray[np.uint16],
    interval: float,
    poles: Array,
    rate: float,
    hold: int,
    smallest_gap: float,
    lowest: float,
    highest: float,
    squares: Array,
    observer: Array,
    moments: Array,
    last: Array,
    average: Array,
    counters: IntArray,
) -> None:
    """Observer, sensitivities and recursive Gauss-Newton steps."""
    n = squares.size
    gains, no_gains, xi = np.empty(2 * n), np.zeros(2 * n), np.empty(n + 1)
    stage, total, slope = np.empty_like(observer), np.empty_like(observer), np.empty_like(observer)
    matrix, factor = np.empty((n + 1, n + 1)), np.empty((n, n))
    step, scales, unit, no_rounding = np.empty(n), np.empty(n), np.empty(n), np.zeros(n)
    smoothing = rate * interval
    for k in range(samples.size):
        y = samples[k]
        flag = STARTING if counters[0] < hold else 0
        present = np.isfinite(y) and np.isfinite(last[0])
        if counters[0] > 0:
            before, change = 0.0, 0.0
            if present:
                place_poles(squares, poles, gains)
                before, change = last[0], y - last[0]
            # Without samples the observer runs on by itself.
            used = gains if present else no_gains
            for p in range(n + 1):
                for i in range(2 * n):
                    stage[p, i] = observer[p, i]
                    total[p, i] = 0.0
            for part in range(4):
                share = 0.0 if part == 0 else (1.0 if part == 3 else 0.5)
                observer_slope(stage, before + share * change, squares, used, slope)
                weight = 1.0 if part in (0, 3) else 2.0
                ahead = 0.5 if part < 2 else 1.0
                for p in range(n + 1):
                    for i in range(2 * n):
                        total[p, i] += weight * slope[p, i]
                        stage[p, i] = observer[p, i] + ahead * interval * slope[p, i]
            for p in range(n + 1):
                for i in range(2 * n):
                    observer[p, i] += interval / 6.0 * total[p, i]
        if not np.isfinite(y):
            flag |= GAP
        elif not present:
            flag |= GAP if counters[0] > 0 else STARTING
        else:
            for p in range(n + 1):
                xi[p] = 0.0
                for i in range(n):
                    xi[p] += observer[p, 2 * i]
            error = y - xi[0]
            trace = 0.0
            for p in range(n):
                for j in range(p + 1):
                    moments[p, j] += smoothing * (xi[p + 1] * xi[j + 1] - moments[p, j])
                trace += moments[p, p]
            moments[n, n] += smoothing * (error * error - moments[n, n])
            if counters[0] >= hold:
                for p in range(n):
                    for j in range(p + 1):
                        matrix[p, j] = moments[p, j]
                    matrix[p, p] += RIDGE * trace + smoothing * xi[p + 1] * xi[p + 1]
                    step[p] = smoothing * xi[p + 1] * error
                if factorise(matrix, 0.0, factor, scales):
                    for p in range(n):
                        step[p] /= scales[p]
                    substitute(factor, step)
                    bound = lowest
                    for p in range(n):
                        wanted = max(squares[p] + step[p] / scales[p], 0.0)
                        ceiling = highest - (n - 1 - p) * smallest_gap
                        frequency = min(max(np.sqrt(wanted), bound), ceiling)
                        allowed = wanted if frequency == np.sqrt(wanted) else frequency * frequency
                        if allowed != wanted:
                            flag |= OUT_OF_BOUNDS
                        change = allowed - squares[p]
                        squares[p] = allowed
                        for i in range(2 * n):
                            observer[0, i] += observer[p + 1, i] * change
                        bound = frequency + smallest_gap
        last[0] = y
        counters[0] += 1
        determined = factorise(moments, 0.0, factor, scales)
        for p in range(n):
            omega[k, p] = np.sqrt(squares[p])
            average[p] += smoothing * (omega[k, p] - average[p])
            uncertainty[k, p] = np.nan
            if determined:
                for j in range(n):
                    unit[j] = 0.0
                unit[p] = 1.0 / scales[p]
                substitute(factor, unit)
                misfit = np.sqrt(max(unit[p], 0.0) / scales[p] * moments[n, n]) / (2.0 * omega[k, p])
                # An estimate that still moves is not where it will be.
                uncertainty[k, p] = misfit + abs(omega[k, p] - average[p])
        if determined:
            # The effective length of an exponential window, and the delay of the observer.
            elapsed = counters[0] * interval
            span = min(elapsed, 2.0 / rate + 1.0 / poles[0])
            flag |= flag_uncertain(omega[k], uncertainty[k], no_rounding, span, elapsed)
        elif counters[0] > hold:
            flag |= UNDETERMINED
        flags[k] = flag
