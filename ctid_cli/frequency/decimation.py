"""Fewer samples of a record, without what they could not show: band filters and the gaps before them."""

from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.frequency.prefilter import fast_convolve

#: A long record is filtered in pieces of so many samples, or of some filters if these are longer, and never copied.
PIECE = 2**18
LENGTHS = 4


@dataclass(frozen=True, eq=False)
class Decimation:
    """A symmetrical finite impulse response, of whose output every so many samples are kept."""

    #: Impulse response; one weight for none, shape (L + 1,).
    weights: Array
    factor: int = 1
    longest_gap: int = 0

    def apply(self, samples: Array, offset: float = 0.0) -> Array:
        """Filter and thin a record without a constant; nothing is left of one that is shorter than the filter."""
        bridged, taps = bridge_gaps(samples, self.longest_gap), self.weights.size
        if taps == 1:
            return bridged[:: self.factor] - offset
        length = self.factor * (max(PIECE, LENGTHS * taps) // self.factor)
        parts = [
            fast_convolve(bridged[first : first + length + taps - 1] - offset, self.weights)[:: self.factor]
            for first in range(0, samples.size - taps + 1, length)
        ]
        return np.concatenate(parts or [np.empty(0)])

    def gain(self, omega: Array, interval: float) -> Array:
        """Factor by which the filter changes amplitudes."""
        places = np.arange(self.weights.size) - 0.5 * (self.weights.size - 1)
        return np.asarray(np.abs(np.cos(np.multiply.outer(omega * interval, places)) @ self.weights))


def bridge_gaps(samples: Array, longest: int) -> Array:
    """Fill short gaps by straight lines."""
    missing = ~np.isfinite(samples)
    if longest < 1 or not missing.any() or missing.all():
        return samples
    steps = np.diff(np.concatenate(([0], missing.astype(np.int8), [0])))
    first, after = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)
    out = samples.copy()
    for a, b in zip(first, after, strict=True):
        if b - a <= longest and a > 0 and b < samples.size:
            share = (np.arange(a, b) - a + 1.0) / (b - a + 1.0)
            out[a:b] = (1.0 - share) * samples[a - 1] + share * samples[b]
    return out


def low_pass(pass_edge: float, stop_edge: float, attenuation: float, interval: float) -> Array:
    r"""Symmetrical low-pass of gain 1 at zero frequency.

    Sine cardinal times Kaiser's window: ``L = (attenuation - 7.95)/(2.285 (stop_edge - pass_edge) interval)``.
    """
    from scipy.signal import kaiser_beta  # slow to import, needed only here

    half = int(np.ceil((attenuation - 7.95) / (2.285 * (stop_edge - pass_edge) * interval) / 2.0))
    places = np.arange(-half, half + 1)
    edge = 0.5 * (pass_edge + stop_edge) * interval / np.pi
    weights = np.sinc(edge * places) * np.kaiser(2 * half + 1, kaiser_beta(attenuation))
    return np.asarray(weights / weights.sum())


def without_low(weights: Array, stop_edge: float, pass_edge: float, attenuation: float, interval: float) -> Array:
    """Add a high-pass to a filter."""
    high = -low_pass(stop_edge, pass_edge, attenuation, interval)
    high[high.size // 2] += 1.0
    return np.asarray(np.convolve(weights, high))
