"""Samples that no sum of a few tones can have: so far above all others around them that they are taken as missing."""

import numpy as np

from ctid_cli.arrays import Array, BoolArray

#: A spike is so many times as large as the largest of so many samples on each side, those next to it left out.
TIMES = 6.0
AROUND = 64
WIDTH = 2
#: Records with a larger share of such samples are made of pulses.
MOST = 0.01


def find_spikes(samples: Array) -> BoolArray:
    """Where the spikes of a record are, which may have missing samples (NaN)."""
    from scipy.ndimage import maximum_filter1d

    there = np.isfinite(samples)
    if not there.any():
        return there
    size = np.where(there, np.abs(samples - np.median(samples[there])), 0.0)
    # The largest on each side: a filter over so many samples that ends WIDTH before, or begins WIDTH after the sample.
    padded = np.pad(size, AROUND + WIDTH)
    largest = maximum_filter1d(padded, AROUND, mode="constant", origin=-(AROUND // 2))
    after = largest[AROUND + 2 * WIDTH + 1 :][: size.size]
    before = largest[: size.size]
    around = np.maximum(before, after)
    spikes = (size > TIMES * around) & (around > 0.0)
    return spikes if spikes.mean() <= MOST else np.zeros_like(spikes)


def spikes_told(spikes: BoolArray) -> list[str]:
    """What is said of the spikes of a record."""
    told = f"Spikes, {TIMES:g} times as high as all around them, are taken as missing: {spikes.sum()}."
    return [told] if spikes.any() else []


def without_spikes(samples: Array) -> Array:
    """The record with its spikes as missing samples."""
    return np.where(find_spikes(samples), np.nan, samples)
