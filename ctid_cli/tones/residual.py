"""What the tones of a track leave of its record, and the lines that stand out of it."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np
from scipy.fft import rfft

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.frequency.flags import Flag
from ctid_cli.tones import constants as c
from ctid_cli.tones.condition import find_spikes
from ctid_cli.tones.track import MissingLine, Track


class LeftOver(NamedTuple):
    """A signal without its mean, what tones leave of it, and the amplitude spectra of both."""

    signal: Array
    residual: Array
    #: Where not all tones are known, or the sample is missing or a spike, shape (N,).
    unknown: BoolArray
    #: Samples in a segment of the spectra.
    size: int
    #: Amplitude of a steady tone that would stand so high, medians over segments [signal unit].
    signal_spectrum: Array
    residual_spectrum: Array
    #: Sampling interval [s].
    interval: float

    @property
    def hertz(self) -> Array:
        """Return the frequencies of the spectra [Hz]."""
        return np.arange(self.signal_spectrum.size) / (c.SPECTRUM_PADDING * self.segment)

    @property
    def segment(self) -> float:
        """Length of a segment of the spectra [s]."""
        return self.size * self.interval

    @property
    def root_mean_squares(self) -> tuple[float, float]:
        """Return those of the signal and of what the tones leave, where all tones are known [signal unit]."""
        signal, residual = (np.sqrt(np.mean(each[~self.unknown] ** 2)) for each in (self.signal, self.residual))
        return float(signal), float(residual)

    @property
    def percent_of_power(self) -> float:
        """Share of the power of the signal that the tones leave [%]."""
        signal, residual = self.root_mean_squares
        return 100.0 * (residual / signal) ** 2 if signal else 0.0

    @property
    def percent_known(self) -> float:
        """Share of the record where all tones are known [%]."""
        return 100.0 * float(1.0 - self.unknown.mean())


def without_spikes(samples: Array) -> Array:
    """Return the record with its spikes as missing samples."""
    return np.where(find_spikes(samples), np.nan, samples)


def left_over(samples: Array, interval: float, track: Track) -> LeftOver | None:
    """Return what the tones of a track leave; None where their rows are nowhere known for a segment."""
    samples = without_spikes(samples)
    centred = samples - float(np.mean(samples[np.isfinite(samples)]))
    left = centred - synthesised(track, interval * np.arange(samples.size, dtype=np.float64))
    unknown = ~np.isfinite(left)
    least = min(c.SHORTEST_SPECTRUM, samples.size)
    size = min(c.LONGEST_SPECTRUM, max(least, 2 * samples.size // (c.SEGMENTS + 1)), samples.size)
    while size >= least and not unknown.all():
        count = min(c.MOST_SEGMENTS, max(1, 2 * samples.size // size - 1))
        begins = np.linspace(0, samples.size - size, count).astype(int)
        begins = begins[[unknown[k : k + size].mean() <= c.UNKNOWN for k in begins]]
        if begins.size:
            whole, rest = (median_spectrum(np.where(unknown, 0.0, each), begins, size) for each in (centred, left))
            return LeftOver(centred, left, unknown, size, whole, rest, interval)
        size //= 2
    return None


def with_lines_left(track: Track, samples: Array, interval: float) -> Track:
    """Return a track that names no lines with those that stand out of what its tones leave."""
    left = None if track.missing else left_over(samples, interval, track)
    return track if left is None else replace(track, missing=tuple(islice(_lines(left, interval, track), 5)))


def _lines(left: LeftOver, interval: float, track: Track) -> Iterator[MissingLine]:
    """Return lines of what is left that the signal has too, the strongest first: rows that are wrong leave others."""
    turn = 2.0 * np.pi / (left.size * interval)
    bins, amplitudes = significant(left.residual_spectrum)
    own_bins, own_amplitudes = significant(left.signal_spectrum)
    ranges = [
        np.percentile(column[np.isfinite(column)], [c.ASIDE, 100.0 - c.ASIDE]) / turn
        for column in track.omega.T
        if np.isfinite(column).any()
    ]
    for place, amplitude in zip(bins.tolist(), amplitudes.tolist(), strict=True):
        near = any(low - c.BESIDE_TONE <= place <= high + c.BESIDE_TONE for low, high in ranges)
        same = (np.abs(own_bins - place) < c.SAME_LINE) & (own_amplitudes < c.MOST_SHRUNK * amplitude)
        if same.any() and not near:
            yield MissingLine(place * turn, np.nan, amplitude)


def synthesised(track: Track, t: Array) -> Array:
    """Return the sum of the tones of a track at some instants [s], shape (N,); NaN where a tone or its row is unknown.

    Each row describes sinusoids whose phase is known at its instant; between two rows the signal goes over from those
    of one to those of the other. Before the first row and after the last, each is followed for half of its window.
    """
    if not track.t.size:
        return np.full(t.size, np.nan)
    absent = ((track.flags & int(Flag.ABSENT)) != 0) & ~np.isfinite(track.omega)
    # Where a tone is absent its numbers do not matter.
    omega, amplitudes, phase = (np.where(absent, 0.0, each) for each in (track.omega, track.amplitudes, track.phase))
    growth, rate = np.nan_to_num(track.growth), np.nan_to_num(track.rate)
    window = track.window[np.isfinite(track.window)]
    reach = 0.5 * max(float(np.median(window)) if window.size else 0.0, track.every)
    total = np.empty(t.size)
    for begin in range(0, t.size, c.BLOCK_SAMPLES):
        part = t[begin : begin + c.BLOCK_SAMPLES]
        before = np.clip(np.searchsorted(track.t, part, side="right") - 1, 0, track.t.size - 1)
        after = np.minimum(before + 1, track.t.size - 1)
        step = np.where(after > before, track.t[after] - track.t[before], 1.0)
        share = np.clip((part - track.t[before]) / step, 0.0, 1.0)
        value = np.zeros(part.size)
        for row, weight in ((before, 1.0 - share), (after, share)):
            x = part - track.t[row]
            for k in range(track.omega.shape[1]):
                angle = phase[row, k] + (omega[row, k] + 0.5 * rate[row, k] * x) * x
                grown = np.exp(np.clip(growth[row, k] * x, -c.MOST_GROWN, c.MOST_GROWN))
                value += weight * amplitudes[row, k] * grown * np.sin(angle)
        outside = np.maximum(track.t[0] - part, part - track.t[-1])
        total[begin : begin + part.size] = np.where(outside <= reach, value, np.nan)
    return total


def median_spectrum(values: Array, begins: Array, size: int) -> Array:
    """Return the median over segments of the amplitude spectrum, with a Hann window."""
    taper = np.sin(np.pi * (np.arange(size) + 0.5) / size) ** 2
    taper /= taper.sum()
    tapered = taper * np.array([values[k : k + size] for k in begins])
    # The mean of a segment, with the weights of the window.
    tapered -= tapered.sum(axis=1, keepdims=True) * taper
    return np.asarray(np.median(2.0 * np.abs(rfft(tapered, c.SPECTRUM_PADDING * size)), axis=0))


def significant(spectrum: Array) -> tuple[Array, Array]:
    """Return places [bins] and amplitudes of the peaks that are neither noise nor leakage, the largest first."""
    coarse = spectrum[:: c.SPECTRUM_PADDING]
    around = np.lib.stride_tricks.sliding_window_view(np.pad(coarse, c.AROUND, mode="reflect"), 2 * c.AROUND + 1)
    floor = np.repeat(np.median(around, axis=1), c.SPECTRUM_PADDING)
    inner = spectrum[1:-1]
    places = 1 + np.flatnonzero((inner > spectrum[:-2]) & (inner >= spectrum[2:]))
    high = spectrum[places] > np.maximum(c.ABOVE_FLOOR * floor[places], c.ROUNDING * spectrum.max())
    places = places[(places >= c.CLOSEST * c.SPECTRUM_PADDING) & high]
    bins: list[float] = []
    amplitudes: list[float] = []
    for place in places[np.argsort(-spectrum[places])]:
        # The top of a parabola. (That through the logarithms would be far off near a zero of the spectrum.)
        left, top, right = spectrum[place - 1 : place + 2]
        shift = 0.5 * (left - right) / (left - 2.0 * top + right)
        bin_, amplitude = float(place + shift) / c.SPECTRUM_PADDING, float(top - 0.25 * (left - right) * shift)
        distance = np.abs(np.array(bins) - bin_)
        if bins and distance.min() < c.CLOSEST:
            continue
        # Envelope of the side lobes of the Hann window.
        leakage = np.array(amplitudes) / (np.pi * distance * (distance**2 - 1.0))
        if amplitude > c.ABOVE_LEAKAGE * leakage.sum():
            bins.append(bin_)
            amplitudes.append(amplitude)
    return np.array(bins), np.array(amplitudes)
