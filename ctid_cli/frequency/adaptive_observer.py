"""Frequencies from an adaptive observer: a comparator, derived, not the published algorithm."""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, IntArray
from ctid_cli.errors import OptionError
from ctid_cli.frequency.decoding import flag_uncertain
from ctid_cli.frequency.flags import GAP, OUT_OF_BOUNDS, STARTING, UNDETERMINED
from ctid_cli.frequency.inputs import samples_in
from ctid_cli.frequency.moments import factorise, substitute
from ctid_cli.frequency.tracking import OnlineEstimator, Output, Recursion
from ctid_cli.signals.checks import require_not_negative, require_positive

#: Ridge of the Gauss-Newton matrix, as a fraction of its trace.
RIDGE = 1e-4


class Adaptation(NamedTuple):
    """Settings of the observer."""

    #: [s]
    interval: float
    #: Poles with the sign changed [rad/s], shape (2 n,).
    poles: Array
    #: Of forgetting [1/s].
    rate: float
    #: Samples without adaptation.
    hold: int
    #: Smallest distance of two frequencies, and bounds [rad/s].
    smallest_gap: float
    lowest: float
    highest: float


class Observer(NamedTuple):
    """State of the observer."""

    #: Squared frequencies [rad^2/s^2], shape (n,).
    squares: Array
    #: Each tone and its derivative; below, their sensitivities to each squared frequency, shape (n + 1, 2 n).
    states: Array
    #: Averaged products of the sensitivities of the prediction, and the squared error, shape (n + 1, n + 1).
    moments: Array
    #: The last sample, and how many so far.
    last: Array
    #: Frequencies, averaged [rad/s], shape (n,).
    average: Array
    seen: IntArray


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

    initial_frequencies: tuple[float, ...]
    pole: float = 2.0
    ratio: float = 1.2
    rate: float = 0.3
    hold: float = 2.0
    smallest_gap: float = 0.3
    lowest_frequency: float = 0.2
    highest_frequency: float = 8.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("pole", "smallest_gap", "lowest_frequency", "highest_frequency"):
            require_positive(name, getattr(self, name), "rad/s")
        require_positive("ratio", self.ratio, "-")
        require_positive("rate", self.rate, "1/s")
        require_not_negative("hold", self.hold, "s")
        if self.ratio < 1.0:
            raise OptionError("ratio", f"ratio must be 1 or more, not {self.ratio!r}.")
        if self.highest_frequency < self.lowest_frequency + (self.tones - 1) * self.smallest_gap:
            bounds = f"between {self.lowest_frequency:g} and {self.highest_frequency:g} rad/s"
            apart = f"{self.tones} frequencies, {self.smallest_gap:g} rad/s apart,"
            raise OptionError("highest_frequency", f"{apart} do not fit {bounds}.")
        self._keep_one_for_each("initial_frequencies", "rad/s")
        edges = np.concatenate(([self.lowest_frequency - self.smallest_gap], self.initial_frequencies))
        if (np.diff(edges) < self.smallest_gap - 1e-12).any() or edges[-1] > self.highest_frequency:
            rising = "must rise from lowest_frequency to highest_frequency in steps of at least smallest_gap"
            raise OptionError("initial_frequencies", f"initial_frequencies {rising}, not {self.initial_frequencies!r}.")

    def _recursion(self, interval: float) -> Recursion:
        n = self.tones
        poles: Array = self.pole * self.ratio ** np.arange(2 * n, dtype=float)
        if poles[-1] * interval > 1.0:
            fastest = f"the fastest pole of the observer, {poles[-1]:g} rad/s,"
            raise OptionError("pole", f"{fastest} needs a sampling interval below {1.0 / poles[-1]:g} s.")
        if self.rate * interval >= 1.0:
            needed = f"a sampling interval below {1.0 / self.rate:g} s"
            raise OptionError("rate", f"rate = {self.rate:g} 1/s needs {needed}.")
        limits = (float(self.smallest_gap), float(self.lowest_frequency), float(self.highest_frequency))
        settings = Adaptation(interval, poles, float(self.rate), samples_in(self.hold, interval), *limits)
        initial = np.asarray(self.initial_frequencies, dtype=float)
        states, moments = np.zeros((n + 1, 2 * n)), np.zeros((n + 1, n + 1))
        state = Observer(initial**2, states, moments, np.full(1, np.nan), initial, np.zeros(1, np.int64))
        return Recursion(advance_observer, (settings,), (state,))


@njit(cache=True, nogil=True)
def place_poles(squares: Array, poles: Array, gains: Array) -> None:
    """Observer gains for given frequencies."""
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
def observer_slope(states: Array, y: float, squares: Array, gains: Array, slope: Array) -> None:
    """Time derivative of the observer and of its sensitivities."""
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


@njit(cache=True, nogil=True, forceinline=True)
def predict(
    before: float, change: float, interval: float, squares: Array, gains: Array, observer: Array, memory: Array
) -> None:
    """Classical Runge-Kutta step for a signal that changes linearly; ``memory`` has the shape (3, n + 1, 2 n)."""
    stage, total, slope = memory[0], memory[1], memory[2]
    states, now, sums, steps = observer.ravel(), stage.ravel(), total.ravel(), slope.ravel()
    now[:] = states
    sums[:] = 0.0
    # Where in the interval a slope is taken, its weight, and how far it leads to the next one.
    for share, weight, ahead in ((0.0, 1.0, 0.5), (0.5, 2.0, 0.5), (0.5, 2.0, 1.0), (1.0, 1.0, 1.0)):
        observer_slope(stage, before + share * change, squares, gains, slope)
        for i in range(states.size):
            sums[i] += weight * steps[i]
            now[i] = states[i] + ahead * interval * steps[i]
    for i in range(states.size):
        states[i] += interval / 6.0 * sums[i]


@njit(cache=True, nogil=True, forceinline=True)
def adapt(
    y: float, settings: Adaptation, state: Observer, xi: Array, step: Array, matrix: Array, factor: Array, scales: Array
) -> int:
    """Recursive Gauss-Newton step of the squared frequencies; flags a bound that it meets."""
    n = state.squares.size
    smoothing = settings.rate * settings.interval
    states, moments, squares = state.states, state.moments, state.squares
    # The prediction is the sum of the tones; so are its sensitivities those of theirs.
    for p in range(n + 1):
        xi[p] = 0.0
        for i in range(n):
            xi[p] += states[p, 2 * i]
    error = y - xi[0]
    trace = 0.0
    for p in range(n):
        for j in range(p + 1):
            moments[p, j] += smoothing * (xi[p + 1] * xi[j + 1] - moments[p, j])
        trace += moments[p, p]
    moments[n, n] += smoothing * (error * error - moments[n, n])
    if state.seen[0] < settings.hold:
        return 0
    for p in range(n):
        for j in range(p + 1):
            matrix[p, j] = moments[p, j]
        # The ridge bounds the step while the moments are nearly singular, the newest row while they are nearly zero.
        matrix[p, p] += RIDGE * trace + smoothing * xi[p + 1] * xi[p + 1]
        step[p] = smoothing * xi[p + 1] * error
    if not factorise(matrix, 0.0, factor, scales):
        return 0
    for p in range(n):
        step[p] /= scales[p]
    substitute(factor, step)
    flag = 0
    bound = settings.lowest
    for p in range(n):
        # From the lowest frequency upwards, each leaves room for those above it: equal ones have no finite gains.
        wanted = max(squares[p] + step[p] / scales[p], 0.0)
        ceiling = settings.highest - (n - 1 - p) * settings.smallest_gap
        frequency = min(max(np.sqrt(wanted), bound), ceiling)
        allowed = wanted if frequency == np.sqrt(wanted) else frequency * frequency
        if allowed != wanted:
            flag = OUT_OF_BOUNDS
        # The states move with the frequencies, to first order: what they would be, had these been there before.
        for i in range(2 * n):
            states[0, i] += states[p + 1, i] * (allowed - squares[p])
        squares[p] = allowed
        bound = frequency + settings.smallest_gap
    return flag


@njit(cache=True, nogil=True)
def advance_observer(samples: Array, output: Output, settings: Adaptation, state: Observer) -> None:
    """Observer, sensitivities and recursive Gauss-Newton steps."""
    n = output.omega.shape[1]
    gains, no_gains, xi = np.empty(2 * n), np.zeros(2 * n), np.empty(n + 1)
    memory, matrix, factor = np.empty((3, n + 1, 2 * n)), np.empty((n + 1, n + 1)), np.empty((n, n))
    scales, step, unit, no_rounding = np.empty(n), np.empty(n), np.empty(n), np.zeros(n)
    # Arrays are taken out of their tuples once: in the loop, each would cost two counts of its references.
    squares, observer, moments, last, average, seen = state
    omegas, uncertainty, flags = output
    poles = settings.poles
    smoothing = settings.rate * settings.interval
    for k in range(samples.size):
        y = samples[k]
        flag = STARTING if seen[0] < settings.hold else 0
        present = np.isfinite(y) and np.isfinite(last[0])
        if seen[0] > 0 and present:
            place_poles(squares, poles, gains)
            predict(last[0], y - last[0], settings.interval, squares, gains, observer, memory)
        elif seen[0] > 0:
            # Without samples the observer runs on by itself.
            predict(0.0, 0.0, settings.interval, squares, no_gains, observer, memory)
        if present:
            flag |= adapt(y, settings, state, xi, step, matrix, factor, scales)
        else:
            flag |= GAP if seen[0] > 0 or not np.isfinite(y) else STARTING
        last[0] = y
        seen[0] += 1
        determined = factorise(moments, 0.0, factor, scales)
        for p in range(n):
            omega = np.sqrt(squares[p])
            average[p] += smoothing * (omega - average[p])
            omegas[k, p] = omega
            uncertainty[k, p] = np.nan
            if determined:
                # Error of w_p that the mean squared residual makes in the worst direction: w_p^2 over 2 w_p.
                unit[:] = 0.0
                unit[p] = 1.0 / scales[p]
                substitute(factor, unit)
                misfit = np.sqrt(max(unit[p], 0.0) / scales[p] * moments[n, n]) / (2.0 * omega)
                # An estimate that still moves is not where it will be.
                uncertainty[k, p] = misfit + abs(omega - average[p])
        if determined:
            # The effective length of an exponential window, and the delay of the observer.
            elapsed = seen[0] * settings.interval
            span = min(elapsed, 2.0 / settings.rate + 1.0 / poles[0])
            flag |= flag_uncertain(omegas[k], uncertainty[k], no_rounding, span, elapsed)
        elif seen[0] > settings.hold:
            flag |= UNDETERMINED
        flags[k] = flag
