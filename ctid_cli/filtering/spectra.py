r"""Finite-record spectra of a record's output and of its delayed input, exactly, for any clock, hold and delay.

Over a window ``[t_0, t_1]`` of length T, at its frequencies ``w_k = 2 pi k / T``, the spectrum of a signal v is

.. math:: V(w_k) = \frac{1}{T} \int_{t_0}^{t_1} v(t) e^{-j w_k (t - t_0)} dt.

There ``exp(-j w_k T) = 1``: a derivative ``p^i v`` has the spectrum ``(jw)^i V`` plus a real polynomial in ``jw`` of
degree ``i - 1`` from the end values of v. A differential equation therefore holds exactly between finite spectra,
up to one real polynomial for the states at both ends of the window.

By Parseval the mean square of v over the window is ``|V(0)|^2 + 2 sum_k |V(w_k)|^2``.
"""

from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, ComplexArray, IntArray
from ctid_cli.errors import DataError
from ctid_cli.filtering.filter_data import plain_array
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

#: Partial sums are stored for this number of stretches of breaks; within a stretch they are computed when needed.
STRETCHES = 128
#: No stretch is shorter than this number of breaks.
SHORTEST_STRETCH = 8
#: Number of groups of similar sampling intervals used to compute the damping of the output by interpolation.
STEP_GROUPS = 64


class RecordSpectra(NamedTuple):
    """Spectra of a record's output and of its input at any delay.

    The input is exact. The output is interpolated linearly between its samples, without the missing ones. That keeps
    the values and slopes at the ends of the window and damps a wave ``exp(jwt)`` by ``(sin(wh/2)/(wh/2))^2`` in an
    interval of length h. The spectrum is divided by the mean of that factor over the window. Images of other
    frequencies remain: they are small, and noise-like on an irregular clock, but an estimate should be completed in the
    time domain.
    """

    window: tuple[float, float]
    #: Frequencies [rad/s], shape (K,).
    frequencies: Array
    #: Mean factor by which linear interpolation damps each frequency [-], shape (K,).
    damping: Array
    #: Spectrum of the output [output unit], shape (K,).
    outputs: ComplexArray
    #: The input, laid out for its spectrum at any delay.
    input: "HeldSpectrum"
    greatest_delay: float

    @property
    def duration(self) -> float:
        """Length of the window [s]."""
        return self.window[1] - self.window[0]

    def inputs(self, delay: float, count: int | None = None) -> ComplexArray:
        """Return the spectrum of the delayed input over the window, at the first ``count`` frequencies (or all)."""
        if not 0.0 <= delay <= self.greatest_delay:
            raise ValueError(f"the delay must lie between 0 and {self.greatest_delay:g} s, not {delay:g} s")
        first = int(self.frequencies[0] > 0.0)
        count = self.frequencies.size if count is None else count
        return self.input.at(delay, np.ones(count - 1 + first))[first:]


def record_spectra(
    record: Record, start: float, highest: float, greatest_delay: float, *, keep_mean: bool = True
) -> RecordSpectra:
    """Lay out the spectra of a record from a time after its first input on, up to a highest frequency [rad/s]."""
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
            f"{where}the {last - first:g} s from {first:g} s on contain no full period of {highest:g} rad/s; "
            "take a longer record, a smaller greatest delay or a higher frequency"
        )
    window, kept = (first, last), slice(0 if keep_mean else 1, None)
    frequencies = 2 * np.pi / (last - first) * np.arange(count + 1, dtype=np.float64)
    damping = _damping(record, window, frequencies)
    joined = _held_spectrum(HeldSignal(record.t, record.bridged_y, "foh"), first, last - first, 0.0, count)
    outputs = joined.at(0.0, 1.0 / damping[1:])[kept]
    held = _held_spectrum(record.input, first, last - first, greatest_delay, count)
    return RecordSpectra(window, frequencies[kept], damping[kept], outputs, held, greatest_delay)


def lowpass_weight(frequencies: Array, lowpass: Lowpass | None) -> Array:
    """Return the squared gain of a Butterworth low-pass filter."""
    if lowpass is None:
        return np.ones(frequencies.size)
    # Far above the cut-off the power overflows to infinity, and the weight is correctly 0.
    with np.errstate(over="ignore"):
        weight: Array = 1.0 / (1.0 + (frequencies / lowpass.cutoff) ** (2 * lowpass.order))
    return weight


def _damping(record: Record, window: tuple[float, float], frequencies: Array) -> Array:
    """Return the mean of ``(sin(wh/2)/(wh/2))^2`` over the sampling intervals in a window, weighted by their length."""
    present = record.t[record.valid]
    steps = np.sort(np.diff(present[(present >= window[0]) & (present <= window[1])]))
    # Each group of similar intervals is replaced by one length with the same mean to second order in the frequency.
    groups = np.array_split(steps, min(steps.size, STEP_GROUPS))
    lengths = np.array([group.sum() for group in groups])
    typical = np.sqrt(np.array([(group**3).sum() for group in groups]) / lengths)
    damping: Array = np.sinc(np.outer(frequencies, typical) / (2 * np.pi)) ** 2 @ lengths / lengths.sum()
    return damping


class HeldSpectrum(NamedTuple):
    """A held signal laid out for its spectrum over a window, at any delay.

    Integration by parts gives sums over the breaks: of the jumps of the value for a constant hold, of the jumps of the
    slope for a linear one. Their partial sums are stored for every few breaks at both ends of the window.
    """

    #: Breaks with a jump, from the start of the window [s]; values, slopes, jumps and integrals there, shape (M,).
    times: Array
    values: Array
    slopes: Array
    jumps: Array
    integral: Array
    foh: bool
    #: Numbers of breaks up to which partial sums are stored, and these sums, shape (marks, count).
    marks: IntArray
    sums: ComplexArray
    duration: float

    def at(self, delay: float, gain: Array) -> ComplexArray:
        """Return the spectrum of the signal delayed by ``delay`` [s] at zero and the next ``gain.size`` frequencies.

        The gain multiplies the contribution of the breaks inside the window, not that of its ends.
        """
        from ctid_cli.filtering.spectral_kernels import window_spectrum  # numba is slow to import

        return np.asarray(window_spectrum(*self, delay, gain))


def _held_spectrum(
    signal: HeldSignal, start: float, duration: float, greatest_delay: float, count: int
) -> HeldSpectrum:
    """Lay out a signal for ``count`` frequencies."""
    from ctid_cli.filtering.spectral_kernels import partial_sums  # numba is slow to import

    signal = signal.lines
    times, values, foh = signal.t - start, plain_array(signal.values), signal.hold == "foh"
    steps = np.diff(times)
    slopes = np.zeros(times.size)
    if foh:
        slopes[:-1] = np.diff(values) / steps
    jumps = np.diff(slopes if foh else values, prepend=0.0)
    integral = np.concatenate(([0.0], np.cumsum(steps * (values[:-1] + 0.5 * slopes[:-1] * steps))))
    # Breaks without a jump contribute nothing, nor do those after the window.
    kept = (jumps != 0.0) & (times < duration)
    kept[0] = True
    times, values, slopes, jumps, integral = (array[kept] for array in (times, values, slopes, jumps, integral))
    early = int(np.searchsorted(times, 0.0, side="right"))
    late = int(np.searchsorted(times, duration - greatest_delay))
    stretch = max(SHORTEST_STRETCH, (early + times.size - late) // STRETCHES)
    marks = np.union1d(np.arange(0, early + 1, stretch), np.arange(late, times.size + 1, stretch)).astype(np.int64)
    sums = partial_sums(times, jumps, marks, 2 * np.pi / duration, count)
    return HeldSpectrum(times, values, slopes, jumps, integral, foh, marks, sums, duration)
