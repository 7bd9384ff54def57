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
    there = np.isfinite(samples)
    if not there.any():
        return there
    size = np.where(there, np.abs(samples - np.median(samples[there])), 0.0)
    # The largest of so many samples in a row; zeros stand for those beyond the ends.
    largest = np.lib.stride_tricks.sliding_window_view(np.pad(size, WIDTH + AROUND), AROUND).max(axis=1)
    around = np.maximum(largest[: size.size], largest[-size.size :])
    spikes = (around > 0.0) & (size > TIMES * around)
    return spikes if spikes.mean() <= MOST else np.zeros_like(spikes)


def spikes_told(spikes: BoolArray) -> list[str]:
    """What is said of the spikes of a record."""
    told = f"Spikes, {TIMES:g} times as high as all around them, are taken as missing: {spikes.sum()}."
    return [told] if spikes.any() else []


def without_spikes(samples: Array) -> Array:
    """The record with its spikes as missing samples."""
    return np.where(find_spikes(samples), np.nan, samples)
