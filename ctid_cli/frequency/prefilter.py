"""Finite impulse responses in front of an estimator: they keep every sinusoid, and an exact estimate exact."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


def impulse_response(length: float, difference: float, interval: float) -> Array:
    r"""Impulse response of the prefilter.

    Parameters
    ----------
    length : float
        Length of the Hann low-pass [s]; 0 for none.
    difference : float
        Distance of the two samples whose difference is taken against a bias [s]; 0 for none.
    interval : float
        Sampling interval [s].

    Returns
    -------
    ndarray, shape (L + 1,)
        Weights of the newest sample, the one before it, and so on; a low-pass has gain 1 at zero frequency.

    Notes
    -----
    ``w_k = sin^2(pi (k + 1)/(L + 2))``, scaled to the sum 1: the Hann window without its two zeros.

    Examples
    --------
    >>> impulse_response(2.0, 0.0, 1.0)
    array([0.25, 0.5 , 0.25])
    >>> impulse_response(0.0, 3.0, 1.0)
    array([ 1.,  0.,  0., -1.])
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
    """Direct sum of a finite impulse response, the same for a sample whether it comes alone or in a long record.

    Parameters
    ----------
    samples : ndarray, shape (N + L,)
        L earlier samples and N new ones.
    reversed_weights : ndarray, shape (L + 1,)
        Impulse response, oldest weight first.
    out : ndarray, shape (N,)
        Receives the filtered samples; NaN where one of the L + 1 samples is.
    """
    taps = reversed_weights.size
    for k in range(out.size):
        total = 0.0
        for j in range(taps):
            total += reversed_weights[j] * samples[k + j]
        out[k] = total


def fast_convolve(samples: Array, weights: Array) -> Array:
    """The same as :func:`convolve` by fast Fourier transforms, up to rounding.

    Parameters
    ----------
    samples : ndarray, shape (N + L,)
        L earlier samples and N new ones; NaN where missing.
    weights : ndarray, shape (L + 1,)
        Impulse response, newest weight first.

    Returns
    -------
    ndarray, shape (N,)
        Filtered samples; NaN where one of the L + 1 samples is.
    """
    from scipy.signal import oaconvolve  # slow to import, needed only here

    missing = np.isnan(samples)
    out = np.asarray(oaconvolve(np.where(missing, 0.0, samples), weights, mode="valid"))
    if missing.any():
        counts = np.concatenate(([0], np.cumsum(missing)))
        out[counts[weights.size :] > counts[: -weights.size]] = np.nan
    return out
