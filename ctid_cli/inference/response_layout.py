"""A record as columns of a regression: its responses to the input over short intervals, and slow terms."""

from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.signals.held import HeldSignal

#: Length of the impulse response [decay times]; its prior deviation is then e^-4 of the first.
LENGTH = 8.0
#: Time constants of free responses [decay times of the impulse response].
FREE = (0.7, 2.0, 6.0)
#: The longest of them [duration of the record]: longer ones cannot be distinguished from a straight line.
LONGEST_FREE = 1 / 6
#: Relative increase of the diagonal of a covariance before its factorisation.
JITTER = 1e-10

#: Columns of X.
CONSTANT, LINE, INTEGRAL, FIRST_FREE = range(4)
START = tuple(range(FIRST_FREE, FIRST_FREE + len(FREE)))


class Signals(NamedTuple):
    """Samples of an output, possibly a subset, the input, and the sampling interval."""

    t: Array
    y: Array
    input: HeldSignal
    interval: float


class Pulse(NamedTuple):
    """Integral of an input about its value before the record."""

    t: Array
    values: Array
    slopes: Array
    sums: Array

    @classmethod
    def of(cls, signal: HeldSignal, before: float) -> "Pulse":
        """Integrate a held or piecewise linear signal exactly."""
        w, steps, slopes = signal.values - before, np.diff(signal.t), np.zeros(signal.t.size)
        if signal.hold != "zoh":
            slopes[:-1] = np.diff(w) / steps
        areas = steps * (w[:-1] + 0.5 * slopes[:-1] * steps)
        return cls(signal.t, w, slopes, np.append(0.0, np.cumsum(areas)))

    def at(self, times: Array) -> Array:
        """Return the integral up to given instants; zero before the record."""
        k = np.maximum(np.searchsorted(self.t, times, side="right") - 1, 0)
        since = np.maximum(times - self.t[k], 0.0)
        return np.asarray(self.sums[k] + since * (self.values[k] + 0.5 * self.slopes[k] * since))


class Layout(NamedTuple):
    """Columns for one decay time and one value of the input before the record."""

    before: float
    decay: float
    #: Ends of the intervals of the impulse response [s], shape (K + 1,).
    edges: Array
    #: Responses to the input over each interval, X and the output, shape (N, K + q + 1).
    columns: Array

    @classmethod
    def of(cls, signals: Signals, before: float, decay: float, taps: int) -> "Layout":
        """Lay signals out; ``taps`` is the greatest number of intervals."""
        t, y, signal, interval = signals
        duration = float(t[-1] - t[0])
        since, pulse = t - t[0], Pulse.of(signal, before)
        edges = _edges(min(LENGTH * decay, duration), interval, taps)
        responses = -np.diff(pulse.at(t[:, None] - edges), axis=1)
        free = [np.exp(-since / min(factor * decay, LONGEST_FREE * duration)) for factor in FREE]
        columns = np.column_stack([responses, np.ones(t.size), since / duration, pulse.at(t), *free, y])
        return cls(before, decay, edges, columns)

    @property
    def taps(self) -> int:
        """Number of intervals."""
        return int(self.edges.size - 1)


def _edges(length: float, interval: float, taps: int) -> Array:
    """Return the ends of the intervals of an impulse response: sampling intervals at first, then equal longer ones."""
    if length <= taps * interval:
        return np.asarray(interval * np.arange(max(round(length / interval), 4) + 1.0))
    first = interval * np.arange(taps // 3 + 1.0)
    return np.append(first, np.linspace(first[-1], length, taps - taps // 3 + 1)[1:])


def prior_factor(layout: Layout, smooth: bool) -> Array:
    """Return the Cholesky factor of the prior covariance of an impulse response, of scale 1."""
    theta = np.exp(-0.5 * (layout.edges[1:] + layout.edges[:-1]) / layout.decay)
    least = np.minimum(theta[:, None], theta)
    covariance = 0.5 * (3 * np.outer(theta, theta) * least - least**3) if smooth else least
    covariance[np.diag_indices_from(covariance)] *= 1 + JITTER
    return np.linalg.cholesky(covariance)
