"""What sensors and recorders do to an output: outliers, limits, and coarse steps."""

import math

import numpy as np

from ctid_cli.arrays import Array, IntArray

#: A sample this many robust standard deviations away from its neighbours is an outlier.
OUTLIER = 10.0


def outliers(y: Array) -> IntArray:
    """Single samples, or pairs, far from the median of the five about them."""
    if y.size < 20:
        return np.empty(0, dtype=np.int64)
    padded = np.pad(y, 2, mode="edge")
    rest = y - np.median(np.lib.stride_tricks.sliding_window_view(padded, 5), axis=1)
    spread = 1.4826 * float(np.median(np.abs(rest)))
    # The fast part of an answer leaves its own medians behind, everywhere and not at single samples.
    usual = float(np.quantile(np.abs(rest), 0.98))
    step = quantum(y)
    limit = max(OUTLIER * spread, 4 * usual, 0.2 * float(y.std()), 0.0 if math.isnan(step) else 4 * step)
    return np.flatnonzero(np.abs(rest) > limit)


def saturated(y: Array) -> float:
    """Fraction of the samples that a limit seems to have cut off."""
    values, counts = np.unique(y, return_counts=True)
    if values.size < 10:
        return 0.0
    total = 0
    for k, inner in ((0, 1), (-1, -2)):
        at = y == values[k]
        edges = np.flatnonzero(np.diff(np.concatenate(([0], at.astype(int), [0]))))
        runs = edges[1::2] - edges[::2]
        in_runs = int(runs[runs >= 5].sum())
        if in_runs >= 0.01 * y.size and counts[k] > 5 * counts[inner]:
            total += in_runs
    return total / y.size


def quantum(y: Array) -> float:
    """Step of a coarsely quantised signal."""
    values = np.unique(y)
    gaps = np.diff(values)
    gaps = gaps[gaps > 1e-6 * np.ptp(y)] if gaps.size else gaps
    if gaps.size < 2 or values.size > max(y.size / 2, 4):
        return math.nan
    step = float(np.median(gaps))
    multiples = gaps / step
    # Quantised values are written with a rounding of their own.
    fits = np.abs(multiples - np.round(multiples)) < 0.15
    return step if np.mean(fits) > 0.9 and step > 0.01 * y.std() else math.nan
