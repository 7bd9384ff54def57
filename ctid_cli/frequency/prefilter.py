"""Finite impulse responses in front of an estimator: they keep every sinusoid, and an exact estimate exact."""

import numpy as np
from numba import njit

from ctid_cli.arrays import Array


def impulse_response(length: float, difference: float, interval: float) -> Array:
    r"""Impulse response of the prefilter.

    ``w_k = sin^2(pi (k + 1)/(L + 2))``, scaled to the sum 1: the Hann window without its two zeros.
    """
    order = round(length / interval)
    weights = np.sin(np.pi * np.arange(1, order + 2) / (order + 2)) ** 2
    weights /= weights.sum()
    shift = round(difference / interval)
    if shift > 0:
        weights = np.concatenate((weights, np.zeros(shift))) - np.concatenate((np.zeros(shift), weights))
    return np.asarray(weights)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def convolve(samples: Array, reversed_weights: Array, out: Array) -> None:
    """Direct sum of a finite impulse response, the same for a sample whether it comes alone or in a long record."""
    taps = reversed_weights.size
    for k in range(out.size):
        total = 0.0
        for j in range(taps):
            total += reversed_weights[j] * samples[k + j]
        out[k] = total


def fast_convolve(samples: Array, weights: Array) -> Array:
    """The same as :func:`convolve` by fast Fourier transforms, up to rounding."""
    from scipy.signal import oaconvolve  # slow to import, needed only here

    missing = np.isnan(samples)
    out = np.asarray(oaconvolve(np.where(missing, 0.0, samples), weights, mode="valid"))
    if missing.any():
        counts = np.concatenate(([0], np.cumsum(missing)))
        out[counts[weights.size :] > counts[: -weights.size]] = np.nan
    return out
