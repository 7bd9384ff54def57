"""Residual of a record after subtraction of the tones of its track."""

from typing import NamedTuple

import numpy as np
from scipy.fft import rfft

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.frequency.flags import Flag
from ctid_cli.tones import constants as c
from ctid_cli.tones.condition import find_spikes
from ctid_cli.tones.track import Track


class LeftOver(NamedTuple):
    """A signal without its mean, its residual, and the amplitude spectra of both."""

    signal: Array
    residual: Array
    #: True where a tone is unknown, or the sample is missing or a spike, shape (N,).
    unknown: BoolArray
    #: Samples in a segment of the spectra.
    size: int
    #: Spectra scaled to the amplitude of a steady tone, medians over segments [signal unit].
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
        """RMS of the signal and of the residual where all tones are known [signal unit]."""
        signal, residual = (np.sqrt(np.mean(each[~self.unknown] ** 2)) for each in (self.signal, self.residual))
        return float(signal), float(residual)

    @property
    def percent_of_power(self) -> float:
        """Share of the power of the signal in the residual [%]."""
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
    """Return the residual of a track; None if no segment has known rows throughout."""
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


def synthesised(track: Track, t: Array) -> Array:
    """Return the sum of the tones of a track at instants [s], shape (N,); NaN where a tone or its row is unknown.

    Each row describes sinusoids with a known phase at its instant; between two rows the signal is cross-faded. Before
    the first row and after the last, each tone is extrapolated for half of its window.
    """
    if not track.t.size:
        return np.full(t.size, np.nan)
    absent = ((track.flags & int(Flag.ABSENT)) != 0) & ~np.isfinite(track.omega)
    # The numbers of an absent tone are not used.
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
    # Weighted mean of a segment, with the weights of the window.
    tapered -= tapered.sum(axis=1, keepdims=True) * taper
    return np.asarray(np.median(2.0 * np.abs(rfft(tapered, c.SPECTRUM_PADDING * size)), axis=0))
