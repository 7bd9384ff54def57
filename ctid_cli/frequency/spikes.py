"""Samples that no sum of a few tones can have: so far above all others around them that they are taken as missing."""

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, BoolArray

#: A spike is so many times as large as the largest of so many samples on each side, those next to it left out.
TIMES = 6.0
AROUND = 64
WIDTH = 2
#: Records with a larger share of such samples are made of pulses.
MOST = 0.01


def find_spikes(samples: Array) -> BoolArray:
    """Where the spikes of a record are, which may have missing samples (NaN)."""
    there = np.isfinite(samples)
    if not there.any():
        return there
    size = np.where(there, np.abs(samples - np.median(samples[there])), 0.0)
    spikes = np.zeros(size.size, np.bool_)
    _mark_spikes(size, spikes)
    return spikes if spikes.mean() <= MOST else np.zeros_like(spikes)


@njit(cache=True, nogil=True)
def _mark_spikes(size: Array, spikes: BoolArray) -> None:
    """Mark what is so much larger than all around it, where that is not all zero."""
    for k in range(size.size):
        found = True
        positive = False
        # From the sample outwards: nearly always one of the first is large enough.
        for away in range(WIDTH + 1, WIDTH + AROUND + 1):
            for i in (k - away, k + away):
                if 0 <= i < size.size:
                    positive |= size[i] > 0.0
                    found &= size[k] > TIMES * size[i]
            if not found:
                break
        spikes[k] = found and positive


def spikes_told(spikes: BoolArray) -> list[str]:
    """What is said of the spikes of a record."""
    told = f"Spikes, {TIMES:g} times as high as all around them, are taken as missing: {spikes.sum()}."
    return [told] if spikes.any() else []


def without_spikes(samples: Array) -> Array:
    """The record with its spikes as missing samples."""
    return np.where(find_spikes(samples), np.nan, samples)
