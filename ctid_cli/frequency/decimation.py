"""Fewer samples of a record, without what they could not show: band filters and the gaps before them."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from ctid_cli.arrays import Array
from ctid_cli.frequency.prefilter import fast_convolve

#: A long record is filtered in pieces of so many samples, or of some filters if these are longer, and never copied.
PIECE = 2**18
LENGTHS = 4
#: Where no more than so many weights come to a sample that is left out, only what is kept is computed, by its sum.
FEW_WEIGHTS = 64


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
            self._filtered(bridged[first : first + length + taps - 1] - offset)
            for first in range(0, samples.size - taps + 1, length)
        ]
        return np.concatenate(parts or [np.empty(0)])

    def _filtered(self, samples: Array) -> Array:
        """What is kept of a piece."""
        if self.weights.size > FEW_WEIGHTS * self.factor:
            return fast_convolve(samples, self.weights)[:: self.factor]
        out = np.empty((samples.size - self.weights.size) // self.factor + 1)
        _thin(samples, self.weights, self.factor, out)
        return out

    def gain(self, omega: Array, interval: float) -> Array:
        """Factor by which the filter changes amplitudes."""
        turns = np.ascontiguousarray(omega * interval, dtype=np.float64)
        return np.abs(_response(turns.ravel(), self.weights)).reshape(turns.shape)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _thin(samples: Array, weights: Array, factor: int, out: Array) -> None:
    """Every so many samples of what a symmetrical impulse response makes of a signal."""
    for k in range(out.size):
        part = samples[factor * k : factor * k + weights.size]
        total = 0.0
        for j in range(weights.size):
            total += weights[j] * part[j]
        out[k] = total


@njit(cache=True, nogil=True)
def _response(turns: Array, weights: Array) -> Array:
    """Factor of a symmetrical impulse response at some phases from sample to sample [rad]."""
    out = np.empty(turns.size)
    half = 0.5 * (weights.size - 1)
    for k in range(turns.size):
        z, q = np.exp(complex(0.0, -half * turns[k])), np.exp(complex(0.0, turns[k]))
        total = 0.0
        for weight in weights:
            total += weight * z.real
            z *= q
        out[k] = total
    return out


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
    half = int(np.ceil((attenuation - 7.95) / (2.285 * (stop_edge - pass_edge) * interval) / 2.0))
    places = np.arange(-half, half + 1)
    edge = 0.5 * (pass_edge + stop_edge) * interval / np.pi
    weights = np.sinc(edge * places) * np.kaiser(2 * half + 1, _kaiser_beta(attenuation))
    return np.asarray(weights / weights.sum())


def _kaiser_beta(attenuation: float) -> float:
    """Parameter of Kaiser's window for an attenuation [dB], as he gives it."""
    if attenuation > 50.0:
        return 0.1102 * (attenuation - 8.7)
    return 0.5842 * (attenuation - 21.0) ** 0.4 + 0.07886 * (attenuation - 21.0) if attenuation > 21.0 else 0.0


def without_low(weights: Array, stop_edge: float, pass_edge: float, attenuation: float, interval: float) -> Array:
    """Add a high-pass to a filter."""
    high = -low_pass(stop_edge, pass_edge, attenuation, interval)
    high[high.size // 2] += 1.0
    return np.asarray(np.convolve(weights, high))
