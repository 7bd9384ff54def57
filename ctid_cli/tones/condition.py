"""Conditioning of a recorded signal: checks, removal of spikes, and decimation if its tones are low."""

from typing import NamedTuple

import numpy as np
from scipy.fft import next_fast_len, rfft

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError
from ctid_cli.tones import constants as c


class Conditioned(NamedTuple):
    """Conditioned samples, and the operations applied to the record."""

    #: Samples divided by ``scale``, NaN if missing, shape (M,).
    samples: Array
    #: Sampling interval [s], and instant of the first conditioned sample [s since the first of the record].
    interval: float
    begins: float
    scale: float
    #: Impulse response of the low-pass filter, and decimation factor.
    weights: Array
    factor: int
    #: Sentences for the user.
    reasons: tuple[str, ...]

    def gain(self, turn: Array) -> Array:
        """Return the gain of the filter at frequencies [rad/sample]."""
        if self.weights.size == 1:
            return np.ones_like(turn)
        response = np.abs(rfft(self.weights, 2 * c.RESPONSE_PADDING * self.weights.size))
        return np.asarray(np.interp(turn / self.factor, np.linspace(0.0, np.pi, response.size), response))


def condition(samples: Array, interval: float) -> Conditioned:
    """Check a record, mark its spikes as missing, and decimate it as far as its highest line allows."""
    refuse_unusable(samples)
    spikes = find_spikes(samples)
    reasons = []
    if spikes.any():
        samples = np.where(spikes, np.nan, samples)
        told = f"Spikes, {c.SPIKE_TIMES:g} times as high as all around them, are taken as missing"
        reasons.append(f"{told}: {spikes.sum()}.")
    scale = float(np.nanmax(np.abs(samples)))
    # Dither: a rounded signal has no noise from which errors could be estimated.
    samples = samples / scale + c.DITHER * np.random.default_rng(0).standard_normal(samples.size)
    most = samples.size // c.FEWEST_KEPT
    top = highest_line(samples) if most > 1 else np.pi
    factor = min(most, int(np.pi * c.TONE_BAND / top))
    if factor <= 1:
        return Conditioned(samples, interval, 0.0, scale, np.ones(1), 1, tuple(reasons))
    weights = low_pass(factor)
    bridged = bridge_gaps(samples, int(c.BRIDGED * 2.0 * np.pi / top))
    thinned = thinned_by(bridged, weights, factor)
    thin = factor * interval
    kept = f"One of {factor} samples is kept, every {thin:.4g} s"
    edge = 0.5 * c.KEPT_BAND / thin
    reasons.append(f"{kept}, after a low-pass that keeps what is below {edge:.4g} Hz.")
    begins = 0.5 * (weights.size - 1) * interval
    return Conditioned(thinned, thin, begins, scale, weights, factor, tuple(reasons))


def low_pass(factor: int) -> Array:
    """Return the impulse response of the decimation filter, with an odd number of taps."""
    from scipy.signal import firwin, kaiserord  # slow to import

    # The stop band covers the frequencies that alias into the kept band.
    taps, beta = kaiserord(c.STOP_BAND, 2.0 * (1.0 - c.KEPT_BAND) / factor)
    return np.asarray(firwin(taps | 1, 1.0 / factor, window=("kaiser", beta)))


def thinned_by(samples: Array, weights: Array, factor: int) -> Array:
    """Return the decimated samples of a filtered record, where the filter does not extend beyond it."""
    from scipy.signal import upfirdn  # slow to import

    # This shift makes the first output of the complete filter one of the kept samples.
    later = -(weights.size - 1) % factor
    first = (weights.size - 1 + later) // factor
    thinned = upfirdn(np.pad(weights, (later, 0)), samples, down=factor)
    return np.asarray(thinned[first:][: (samples.size - weights.size) // factor + 1])


def refuse_unusable(samples: Array) -> None:
    """Raise DataError for a signal that is too short, constant, or out of range."""
    present = samples[np.isfinite(samples)]
    if present.size < c.FEWEST:
        raise DataError(f"{present.size} samples are too few: there must be {c.FEWEST}")
    low, high = float(present.min()), float(present.max())
    largest = max(abs(low), abs(high))
    if high - low <= c.CONSTANT * largest:
        raise DataError(f"the signal is constant ({low:.6g}): it has no tones")
    if not c.SMALLEST_SAMPLE <= largest <= c.LARGEST_SAMPLE:
        raise DataError(f"the square of the largest sample, {largest:.3g}, is no normal number; use another unit")


def find_spikes(samples: Array) -> BoolArray:
    """Return the mask of spikes: values that no sum of a few tones can have; samples may be missing."""
    there = np.isfinite(samples)
    if not there.any():
        return there
    size = np.where(there, np.abs(samples - np.median(samples[there])), 0.0)
    # Block maxima; on each side of a spike, the next block or the one after it lies within the range compared.
    half, reach = c.SPIKE_AROUND // 2, c.SPIKE_WIDTH + c.SPIKE_AROUND
    blocks = np.pad(size, (0, -size.size % half)).reshape(-1, half).max(axis=1)
    around = np.pad(blocks, 2)
    before, after = np.minimum(around[:-4], around[1:-3]), np.minimum(around[3:-1], around[4:])
    least = c.SPIKE_TIMES * np.repeat(np.maximum(before, after), half)[: size.size]
    spikes = np.zeros(size.size, np.bool_)
    padded = np.pad(size, reach)
    for place in np.flatnonzero(size > least):
        left = padded[place : place + c.SPIKE_AROUND].max()
        right = padded[place + reach + c.SPIKE_WIDTH + 1 :][: c.SPIKE_AROUND].max()
        spikes[place] = 0.0 < c.SPIKE_TIMES * max(left, right) < size[place]
    return spikes if spikes.mean() <= c.MOST_SPIKES else np.zeros_like(spikes)


def bridge_gaps(samples: Array, longest: int) -> Array:
    """Interpolate gaps of at most ``longest`` samples linearly."""
    missing = ~np.isfinite(samples)
    if longest < 1 or not missing.any():
        return samples
    steps = np.diff(missing.astype(np.int8), prepend=0, append=0)
    first, after = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)
    short = (after - first <= longest) & (first > 0) & (after < samples.size)
    places = np.arange(samples.size)
    bridged = np.interp(places, places[~missing], samples[~missing])
    bridged[missing] = np.where(np.repeat(short, after - first), bridged[missing], np.nan)
    return np.asarray(bridged)


def highest_line(samples: Array) -> float:
    """Return the highest line frequency of a record [rad/sample], from segments of several lengths.

    A line is an ordinate of a tapered periodogram with a ratio to the local median that white noise exceeds in one of
    a thousand records. Long segments detect weak lines, short ones varying or transient lines.
    """
    values = np.nan_to_num(samples - np.nanmean(samples))
    top, length = 0.0, values.size
    while length >= c.SHORTEST_SEGMENT:
        segments = values[: values.size // length * length].reshape(-1, length)
        size = next_fast_len(length, real=True)
        taper = np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2
        together = max(1, c.BLOCK_SAMPLES // length)
        for first in range(0, len(segments), together):
            power = np.abs(rfft(segments[first : first + together] * taper, size)) ** 2
            whole = power.shape[1] // c.FLOOR_BINS * c.FLOOR_BINS
            blocks = power[:, :whole].reshape(len(power), -1, c.FLOOR_BINS)
            floor = np.median(blocks, axis=2) / np.log(2.0)
            known = c.MEDIAN_EFFICIENCY * c.FLOOR_BINS
            height = known * ((c.FALSE_LINES / values.size) ** (-1.0 / known) - 1.0)
            lines = (blocks > height * np.maximum(floor, c.SMALLEST_FLOOR)[:, :, None]).any(axis=0)
            if lines.any():
                top = max(top, 2.0 * np.pi * (int(np.flatnonzero(lines)[-1]) + 1) / size)
        length = min(length // 8, 2 ** int(np.log2(length // 8))) if length >= 8 else 0
    return min(top, np.pi) or np.pi
