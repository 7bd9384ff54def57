"""Frequencies from an adaptive observer: derived, not the published algorithm."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.signal import lfilter

from ctid_cli import DataError, Flag, FrequencyEstimator, FrequencyTrack

from .common import complete_samples, is_certain, require_positive, scaled_inverses

#: Rate of the adaptation [1/s], and the time at which it starts [s].
RATE = 0.3
HOLD = 2.0
#: Bounds of the frequencies, and their least distance [rad/s].
LOWEST = 0.2
HIGHEST = 8.0
SMALLEST_GAP = 0.3
#: Ridge of the Gauss-Newton matrix, as a fraction of its trace.
TRACE_RIDGE = 1e-4


@dataclass(frozen=True, kw_only=True)
class AdaptiveObserver(FrequencyEstimator):
    r"""Frequencies by prediction errors of an observer that adapts them; derived, not the published algorithm.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.
    initial_frequencies : tuple of float
        Initial frequencies [rad/s], ascending 0.3 apart, from 0.2 to 8.
    pole : float, default 2.0
        Slowest rate of the observer [rad/s], near the frequencies.
    ratio : float, default 1.2
        Ratio of one rate to the next [-], 1 or more.

    Notes
    -----
    Derived, not the published algorithm: an adaptive observer with direct estimates of the squared frequencies is known
    from the literature, but this adaptation law is our own.

    The state holds each tone and its derivative. With ``e = y - sum s_i``, ``s_i' = v_i + l_i1 e``,
    ``v_i' = -w_i^2 s_i + l_i2 e``; the gains put the observer's poles at ``-pole ratio^k``, k = 0 ... 2n - 1, for the
    present frequencies. The sensitivities of the prediction error to the squared frequencies are integrated with it
    (Runge-Kutta, signal linear between samples) and drive recursive Gauss-Newton steps with exponential forgetting.
    Convergence is local.
    """

    initial_frequencies: tuple[float, ...]
    pole: float = 2.0
    ratio: float = 1.2

    def __post_init__(self):
        super().__post_init__()
        require_positive(self, "pole")
        if self.ratio < 1.0:
            raise DataError(f"ratio must be 1 or more, not {self.ratio!r}", "ratio")
        self.keep_one_for_each("initial_frequencies", "rad/s")
        edges = np.concatenate(([LOWEST - SMALLEST_GAP], self.initial_frequencies))
        if (np.diff(edges) < SMALLEST_GAP - 1e-12).any() or edges[-1] > HIGHEST:
            rising = f"must rise from {LOWEST:g} to {HIGHEST:g} rad/s in steps of at least {SMALLEST_GAP:g} rad/s"
            raise DataError(f"initial_frequencies {rising}, not {self.initial_frequencies!r}", "initial_frequencies")

    @property
    def poles(self):
        """Poles of the observer with the sign changed [rad/s], shape (2 n,)."""
        return self.pole * self.ratio ** np.arange(2 * self.tones, dtype=float)

    def check(self, count, interval):
        """Refuse clocks that are too slow."""
        fastest = max(float(self.poles[-1]), RATE)
        if fastest * interval >= 1.0:
            needed = f"needs a sampling interval below {1.0 / fastest:g} s"
            raise DataError(f"the fastest rate of the observer, {fastest:g} rad/s, {needed}", "pole")

    def track(self, samples, interval):
        """Return the estimate at every sample of the record."""
        y = complete_samples(samples)
        self.check(y.size, interval)
        n, count = self.tones, y.size
        hold = round(HOLD / interval)
        initial = np.asarray(self.initial_frequencies, dtype=float)
        bounds = np.array([SMALLEST_GAP, LOWEST, HIGHEST])
        omega, prediction = np.empty((count, n)), np.zeros((count, n + 1))
        bounded = np.zeros(count, np.bool_)
        observe(y, interval, self.poles, RATE, hold, bounds, initial, omega, prediction, bounded)

        flags = np.where(np.arange(count) < max(hold, 1), Flag.STARTING, 0)
        flags[bounded] |= Flag.OUT_OF_BOUNDS
        error, determined = self._possible_errors(omega, prediction, initial, interval)
        flags[~determined & (np.arange(count) >= hold)] |= Flag.UNDETERMINED
        # The effective length of an exponential window, and the delay of the observer.
        elapsed = interval * np.arange(1, count + 1)
        span = np.minimum(elapsed, 2.0 / RATE + 1.0 / self.pole)
        flags[determined & ~is_certain(omega, error, span, elapsed)] |= Flag.UNCERTAIN
        return FrequencyTrack(interval * np.arange(count), omega, flags.astype(np.uint16))

    def _possible_errors(self, omega, prediction, initial, interval):
        """Return the error that the mean squared residual can cause in its worst direction, and where it is known.

        The present drift of the estimate is added, as it has not converged.
        """
        forget = RATE * interval
        error, xi = prediction[:, 0], prediction[:, 1:]
        smoothed = ([forget], [1.0, forget - 1.0])
        moments = lfilter(*smoothed, xi[:, :, None] * xi[:, None, :], axis=0)
        mean_square = lfilter(*smoothed, error**2)
        average, _ = lfilter(*smoothed, omega, axis=0, zi=(1.0 - forget) * initial[None, :])
        scales, inverses, determined = scaled_inverses(moments)
        # The error of w_p is that of w_p^2 over 2 w_p.
        variances = np.diagonal(inverses, axis1=1, axis2=2) / scales**2 * mean_square[:, None]
        return np.sqrt(np.maximum(variances, 0.0)) / (2.0 * omega) + np.abs(omega - average), determined


# --------------------------------------------------------------------------------------------------------------------
# Compiled: a kernel calls only kernels of this file, because Numba's cache on disk checks only the file of a function.


@njit(cache=True, nogil=True)
def place_poles(squares, poles, gains):
    """Compute the observer gains for given squared frequencies."""
    # prod(s^2 + w_i^2) + sum (l_i1 s + l_i2) prod_(j != i)(s^2 + w_j^2) = prod(s + p_k), compared at s = j w_i.
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
def observer_slope(states, y, squares, gains, slope):
    """Compute the time derivative of the observer (row 0) and of its sensitivities to each squared frequency."""
    n = squares.size
    for p in range(n + 1):
        # The sensitivities obey the same equations, without the signal.
        error = y if p == 0 else 0.0
        for i in range(n):
            error -= states[p, 2 * i]
        for i in range(n):
            slope[p, 2 * i] = states[p, 2 * i + 1] + gains[2 * i] * error
            slope[p, 2 * i + 1] = -squares[i] * states[p, 2 * i] + gains[2 * i + 1] * error
        if p > 0:
            # Derivative of -w_p^2 s_p with respect to w_p^2 itself.
            slope[p, 2 * p - 1] -= states[0, 2 * p - 2]


@njit(cache=True, nogil=True)
def predict(before, change, interval, squares, gains, states, stage, total, slope):
    """Take a classical Runge-Kutta step of the states for a signal that changes linearly over the interval."""
    now, start, sums, steps = stage.ravel(), states.ravel(), total.ravel(), slope.ravel()
    now[:] = start
    sums[:] = 0.0
    # Place in the interval at which a slope is taken, its weight, and the step from it to the next one.
    for share, weight, ahead in ((0.0, 1.0, 0.5), (0.5, 2.0, 0.5), (0.5, 2.0, 1.0), (1.0, 1.0, 1.0)):
        observer_slope(stage, before + share * change, squares, gains, slope)
        for i in range(start.size):
            sums[i] += weight * steps[i]
            now[i] = start[i] + ahead * interval * steps[i]
    for i in range(start.size):
        start[i] += interval / 6.0 * sums[i]


@njit(cache=True, nogil=True)
def move(squares, states, step, bounds):
    """Change the squared frequencies within bounds, and the states with them; return whether a bound was met."""
    n = squares.size
    smallest_gap, lowest, highest = bounds
    met = False
    for p in range(n):
        # From the lowest frequency upwards, each keeps a distance for those above it: equal ones have no finite gains.
        wanted = max(squares[p] + step[p], 0.0)
        ceiling = highest - (n - 1 - p) * smallest_gap
        frequency = min(max(np.sqrt(wanted), lowest), ceiling)
        allowed = wanted if frequency == np.sqrt(wanted) else frequency * frequency
        met |= allowed != wanted
        # To first order, the states become those for these frequencies in the past.
        for i in range(2 * n):
            states[0, i] += states[p + 1, i] * (allowed - squares[p])
        squares[p] = allowed
        lowest = frequency + smallest_gap
    return met


@njit(cache=True, nogil=True)
def observe(y, interval, poles, rate, hold, bounds, initial, omega, prediction, bounded):
    """Run observer, sensitivities and recursive Gauss-Newton steps.

    For every sample it writes the frequencies, shape (N, n), the error of the prediction and its sensitivities to the
    squared frequencies, shape (N, n + 1), and whether a bound was met, shape (N,).
    """
    n = initial.size
    squares, gains, states = initial**2, np.empty(2 * n), np.zeros((n + 1, 2 * n))
    stage, total, slope = np.empty((n + 1, 2 * n)), np.empty((n + 1, 2 * n)), np.empty((n + 1, 2 * n))
    moments, matrix = np.zeros((n, n)), np.empty((n, n))
    forget = rate * interval
    omega[0] = initial
    for k in range(1, y.size):
        place_poles(squares, poles, gains)
        predict(y[k - 1], y[k] - y[k - 1], interval, squares, gains, states, stage, total, slope)
        # The prediction is the sum of the tones, and its sensitivities are the sums of theirs.
        prediction[k, 0] = y[k]
        for i in range(n):
            prediction[k, 0] -= states[0, 2 * i]
            for p in range(n):
                prediction[k, 1 + p] += states[1 + p, 2 * i]
        error, xi = prediction[k, 0], prediction[k, 1:]
        trace = 0.0
        for p in range(n):
            for j in range(n):
                moments[p, j] += forget * (xi[p] * xi[j] - moments[p, j])
            trace += moments[p, p]
        if k >= hold and 0.0 < trace < np.inf:
            # The ridge bounds the step for nearly singular moments, the newest row for nearly vanishing ones.
            matrix[:] = moments
            for p in range(n):
                matrix[p, p] += TRACE_RIDGE * trace + forget * xi[p] * xi[p]
            bounded[k] = move(squares, states, np.linalg.solve(matrix, forget * error * xi), bounds)
        for p in range(n):
            omega[k, p] = np.sqrt(squares[p])
