r"""Finite-record spectra of a record's output and of its delayed input, exactly, for any clock, hold and delay.

Over a window ``[t_0, t_1]`` of length T and at its own frequencies ``w_k = 2 pi k / T`` the spectrum of a signal v is

.. math:: V(w_k) = \frac{1}{T} \int_{t_0}^{t_1} v(t) e^{-j w_k (t - t_0)} dt.

There ``exp(-j w_k T) = 1``: a derivative ``p^i v`` has the spectrum ``(jw)^i V`` plus a real polynomial in ``jw`` of
degree ``i - 1`` made of the end values of v. A differential equation therefore holds exactly between finite spectra,
up to one real polynomial for the states at both ends of the window.

By Parseval the mean square of v over the window is ``|V(0)|^2 + 2 sum_k |V(w_k)|^2``.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray, IntArray
from ctid_cli.errors import DataError
from ctid_cli.filtering.exponential import place
from ctid_cli.filtering.filter_data import plain_array
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

#: Partial sums are kept for this many stretches of breaks; within a stretch they are formed when a delay asks.
STRETCHES = 128
#: No stretch is shorter than this number of breaks.
SHORTEST_STRETCH = 8
#: Sampling intervals are sorted into this many groups of like ones to find what interpolation does to the output.
STEP_GROUPS = 64


class RecordSpectra:
    """Spectra of a record's output and of its input at any delay.

    The input is exact. The output is joined by straight lines between its samples, missing ones left out. That keeps
    the values and slopes at the ends of the window and damps the curvature between them: a wave ``exp(jwt)`` by
    ``(sin(wh/2)/(wh/2))^2`` in an interval of length h. The mean of that factor over the window is taken out of the
    spectrum. What remains are images of other frequencies: small, and noise-like on an irregular clock, but a reason
    to finish an estimate in the time domain.
    """

    def __init__(
        self, record: Record, window: tuple[float, float], count: int, greatest_delay: float, keep_mean: bool = True
    ) -> None:
        start, end = window
        self.window = window
        self.greatest_delay = greatest_delay
        self._first = 0 if keep_mean else 1
        frequencies = 2 * np.pi / (end - start) * np.arange(count + 1, dtype=np.float64)
        damping = _damping(record, window, frequencies)
        #: Frequencies [rad/s], shape (K,).
        self.frequencies: Array = frequencies[self._first :]
        output = HeldSignal(record.t, record.bridged_y, "foh")
        #: Mean factor by which straight lines between the samples damp each frequency [-], shape (K,).
        self.damping: Array = damping[self._first :]
        joined = _held_spectrum(output, start, end - start, 0.0, count)
        #: Spectrum of the output [output unit], shape (K,).
        self.outputs: ComplexArray = window_spectrum(joined, 0.0, 1.0 / damping[1:])[self._first :]
        #: The input, laid out for its spectrum at any delay.
        self.input = _held_spectrum(record.input, start, end - start, greatest_delay, count)

    @property
    def duration(self) -> float:
        """Length of the window [s]."""
        return self.window[1] - self.window[0]

    def inputs(self, delay: float) -> ComplexArray:
        """Spectrum of the delayed input over the window."""
        if not 0.0 <= delay <= self.greatest_delay:
            raise ValueError(f"the delay must lie between 0 and {self.greatest_delay:g} s, not {delay:g} s")
        ones = np.ones(self.frequencies.size - 1 + self._first)
        return np.asarray(window_spectrum(self.input, delay, ones)[self._first :])


def record_spectra(
    record: Record, start: float, highest: float, greatest_delay: float, *, keep_mean: bool = True
) -> RecordSpectra:
    """Lay out the spectra of a record."""
    present = record.t[record.valid]
    first = max(float(record.input.t[0]) + start, float(present[0]))
    inside = present[present >= first]
    where = f"{record.name}: " if record.name else ""
    if inside.size < 2:
        raise DataError(
            f"{where}fewer than two samples are left {start:g} s after the first input; take a longer record, or a "
            "smaller greatest delay"
        )
    last = float(inside[-1])
    highest = min(highest, np.pi / float(np.median(np.diff(inside))))
    count = int(np.floor(highest * (last - first) / (2 * np.pi)))
    if count < 1:
        raise DataError(
            f"{where}the {last - first:g} s from {first:g} s on hold no full period of {highest:g} rad/s; "
            "take a longer record, a smaller greatest delay or a higher frequency"
        )
    return RecordSpectra(record, (first, last), count, greatest_delay, keep_mean)


def lowpass_weight(frequencies: Array, lowpass: Lowpass | None) -> Array:
    """Squared gain of a Butterworth low-pass filter."""
    if lowpass is None:
        return np.ones(frequencies.size)
    # Far above a sharp filter the power overflows to infinity and the weight is 0, as it should be.
    with np.errstate(over="ignore"):
        weight: Array = 1.0 / (1.0 + (frequencies / lowpass.cutoff) ** (2 * lowpass.order))
    return weight


def _damping(record: Record, window: tuple[float, float], frequencies: Array) -> Array:
    """Mean of ``(sin(wh/2)/(wh/2))^2`` over the sampling intervals in a window, each counted with its length."""
    present = record.t[record.valid]
    steps = np.sort(np.diff(present[(present >= window[0]) & (present <= window[1])]))
    # Intervals of about the same length share one: that which has their mean to second order in the frequency.
    groups = np.array_split(steps, min(steps.size, STEP_GROUPS))
    lengths = np.array([group.sum() for group in groups])
    typical = np.sqrt(np.array([(group**3).sum() for group in groups]) / lengths)
    damping: Array = np.sinc(np.outer(frequencies, typical) / (2 * np.pi)) ** 2 @ lengths / lengths.sum()
    return damping


class HeldSpectrum(NamedTuple):
    """A held signal laid out for its spectrum over a window, at any delay.

    Integration by parts leaves sums over the breaks: of the jumps of the value for a constant hold, of the jumps of
    the slope for a linear one. Their partial sums are kept at every few breaks at both ends of the window.
    """

    #: Breaks that jump, from the start of the window [s]; values, slopes, jumps and integrals there, shape (M,).
    times: Array
    values: Array
    slopes: Array
    jumps: Array
    integral: Array
    foh: bool
    #: Numbers of breaks up to which partial sums are kept, and these, shape (marks, 2, count).
    marks: IntArray
    sums: Array
    duration: float


def _held_spectrum(
    signal: HeldSignal, start: float, duration: float, greatest_delay: float, count: int
) -> HeldSpectrum:
    """Lay out a signal for ``count`` frequencies."""
    signal = signal.lines
    times, values, foh = signal.t - start, plain_array(signal.values), signal.hold == "foh"
    steps = np.diff(times)
    slopes = np.zeros(times.size)
    if foh:
        slopes[:-1] = np.diff(values) / steps
    jumps = np.diff(slopes if foh else values, prepend=0.0)
    integral = np.concatenate(([0.0], np.cumsum(steps * (values[:-1] + 0.5 * slopes[:-1] * steps))))
    # Nothing happens at a break without a jump, and nothing after the window matters.
    kept = (jumps != 0.0) & (times < duration)
    kept[0] = True
    times, values, slopes, jumps, integral = (array[kept] for array in (times, values, slopes, jumps, integral))
    early = int(np.searchsorted(times, 0.0, side="right"))
    late = int(np.searchsorted(times, duration - greatest_delay))
    stretch = max(SHORTEST_STRETCH, (early + times.size - late) // STRETCHES)
    marks = np.union1d(np.arange(0, early + 1, stretch), np.arange(late, times.size + 1, stretch)).astype(np.int64)
    sums = _partial_sums(times, jumps, marks, 2 * np.pi / duration, count)
    return HeldSpectrum(times, values, slopes, jumps, integral, foh, marks, sums, duration)


@njit(cache=True, nogil=True)
def _phases(angle: float, count: int, re: Array, im: Array) -> None:
    """Real and imaginary parts of ``exp(-j k angle)``, k = 1 … count, by doubling: vector operations throughout."""
    power_re, power_im = np.cos(angle), -np.sin(angle)
    re[0], im[0] = power_re, power_im
    done = 1
    while done < count:
        for i in range(min(done, count - done)):
            re[done + i] = power_re * re[i] - power_im * im[i]
            im[done + i] = power_re * im[i] + power_im * re[i]
        power_re, power_im = power_re * power_re - power_im * power_im, 2.0 * power_re * power_im
        done *= 2


@njit(cache=True, nogil=True)
def _add_jumps(times: Array, jumps: Array, first: int, last: int, base: float, phases: Array, total: Array) -> None:
    """Add ``sum jump_i exp(-j k base t_i)`` over the breaks ``first … last - 1`` to ``total``."""
    count = total.shape[1]
    phase_re, phase_im = phases[0], phases[1]
    total_re, total_im = total[0], total[1]
    for i in range(first, last):
        _phases(base * times[i], count, phase_re, phase_im)
        for k in range(count):
            total_re[k] += jumps[i] * phase_re[k]
            total_im[k] += jumps[i] * phase_im[k]


@njit(cache=True, nogil=True)
def _partial_sums(times: Array, jumps: Array, marks: IntArray, base: float, count: int) -> Array:
    """Sums over the first ``marks[r]`` breaks, shape (marks, 2, count)."""
    sums = np.zeros((marks.size, 2, count))
    phases, total = np.zeros((2, count)), np.zeros((2, count))
    done = 0
    for r in range(marks.size):
        _add_jumps(times, jumps, done, marks[r], base, phases, total)
        done = marks[r]
        place(sums[r], 0, 0, total)
    return sums


@njit(cache=True, nogil=True)
def _last_at(grid: Array | IntArray, value: float) -> int:
    """Index of the last entry not above ``value``; 0 if there is none."""
    low, high = 0, grid.size
    while high - low > 1:
        middle = (low + high) // 2
        if grid[middle] <= value:
            low = middle
        else:
            high = middle
    return low


@njit(cache=True, nogil=True)
def window_spectrum(held: HeldSpectrum, delay: float, gain: Array) -> ComplexArray:
    """Spectrum at zero frequency and at as many above it as there are gains, of the signal later by ``delay``.

    The gain multiplies what happens inside the window, as opposed to its ends.

    With a and b the ends of the window on the undelayed signal's clock, value v and slope r there, and D the sum of
    ``jump exp(-jw t)`` over the breaks between them,

    ``T V = (v(a) e_a - v(b))/jw + (r(a) e_a - r(b))/(jw)^2 + gain exp(-jw delay) D/(jw)^i``,

    i = 1 for a constant hold (whose slopes are zero) and 2 for a linear one. ``e_a`` is 1 unless a precedes the first
    break, where the signal begins with a jump.
    """
    times, values, slopes, jumps, integral, foh, marks, sums, duration = held
    count = gain.size
    spectrum = np.zeros(count + 1, np.complex128)
    # a and b; before its first break the signal is zero.
    begin, end = max(-delay, times[0]), duration - delay
    if end <= begin:
        return spectrum
    base = 2.0 * np.pi / duration
    # v, r and the integral of v at both ends, from the last break before each.
    left, right = _last_at(times, begin), _last_at(times, end)
    before, after = begin - times[left], end - times[right]
    value_left, value_right = values[left] + slopes[left] * before, values[right] + slopes[right] * after
    total_left = integral[left] + before * (values[left] + 0.5 * slopes[left] * before)
    total_right = integral[right] + after * (values[right] + 0.5 * slopes[right] * after)
    spectrum[0] = (total_right - total_left) / duration
    if count == 0:
        return spectrum
    phases = np.zeros((2, count))
    # D: kept sums up to the nearest marks, completed break by break.
    row, upper = _last_at(marks, left + 1), _last_at(marks, right + 1)
    total, early = sums[upper, :, :count].copy(), sums[row, :, :count].copy()
    _add_jumps(times, jumps, marks[upper], right + 1, base, phases, total)
    _add_jumps(times, jumps, marks[row], left + 1, base, phases, early)
    _phases(base * delay, count, phases[0], phases[1])
    # e_a, and the equation above.
    starts = np.zeros((2, count))
    if begin > -delay:
        _phases(base * (delay + begin), count, starts[0], starts[1])
    else:
        for k in range(count):
            starts[0, k] = 1.0
    for k in range(count):
        jw = 1j * (base * (k + 1))
        start = complex(starts[0, k], starts[1, k])
        inside = complex(total[0, k] - early[0, k], total[1, k] - early[1, k])
        inside *= gain[k] * complex(phases[0, k], phases[1, k])
        value = value_left * start - value_right
        slope = slopes[left] * start - slopes[right]
        if foh:
            slope += inside
        else:
            value += inside
        spectrum[k + 1] = (value + slope / jw) / jw / duration
    return spectrum
