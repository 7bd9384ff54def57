"""Features of an input, and faults of an output: outliers, saturation, quantisation, growth."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IntArray
from ctid_cli.inference.intervals import robust_deviation
from ctid_cli.inference.noise_model import fit_noise_model
from ctid_cli.progress import reported
from ctid_cli.signals.record import Record

#: Relative difference from a multiple of a step that counts as rounding.
WHOLE = 1e-3
#: An input with at most this number of changes gives single step responses and no averages over frequency.
FEW_CHANGES = 3
#: An input with at most this number of values changes between levels.
FEW_LEVELS = 20
#: Spread of a measured level, and share of the samples that make one, both as a fraction of the whole.
LEVEL_WIDTH = 0.1
LEVEL_SHARE = 0.02
#: Least time before the first of many changes of an input that shows rest, relative to the longest between two of them.
LONGER = 1.2
#: Blocks of the output before the first change of the input, and their least size. The output is constant if their
#: means differ by less than this number of standard errors, or by less than this share of its deviation.
QUIET_BLOCKS, QUIET_SIZE, QUIET_ERRORS, QUIET_SHARE = 5, 2, 4.5, 0.05


@dataclass(frozen=True)
class InputMoves:
    """Changes of the input during a record."""

    kind: Literal["constant", "steps", "levels", "continuous"]
    #: The values it returns to [input unit], at most 20; empty if there are more.
    levels: tuple[float, ...]
    #: Instants of the changes after the beginning of the record [s]; empty for a continuous input, shape (n,).
    changes: Array
    #: Shortest time between two changes [s]; nan with fewer than two.
    shortest_hold: float
    noisy: bool = False


@reported("changes of the input")
def input_moves(record: Record) -> InputMoves:
    """Return the changes of the input between the first and the last output sample.

    A measured input changes between levels if nine samples in ten are in a few narrow clusters; its changes are then
    those between clusters. An input known at the instants of the output only is assumed to change there.
    """
    first, signal = record.t[0], record.input
    inside = (signal.t > first) & (signal.t <= record.t[-1])
    # Including the value at the beginning of the record.
    t, u = np.append(first, signal.t[inside]), np.append(signal.at([first]), signal.values[inside])
    spread = float(np.ptp(u))
    if spread <= 1e-9 * float(np.abs(u).max()):
        return InputMoves("constant", (float(u[0]),), np.empty(0), np.nan)
    values, exact = np.unique(u, return_inverse=True)
    label = np.asarray(exact, dtype=np.int64)
    clusters = _clusters(u, spread)
    noisy = False
    # With noise about the levels, only changes between levels count.
    if clusters is not None and _changes(clusters) < _changes(label) / 3:
        label, noisy = clusters, True
        values = np.array([float(np.median(u[label == k])) for k in np.unique(label)])
    elif values.size > FEW_LEVELS and np.mean(u[1:] == u[:-1]) < 0.5:
        return InputMoves("continuous", (), np.empty(0), np.nan)
    changes = t[1:][label[1:] != label[:-1]]
    hold = float(np.diff(changes).min()) if changes.size > 1 else np.nan
    levels = tuple(float(value) for value in values) if values.size <= FEW_LEVELS else ()
    return InputMoves("steps" if changes.size <= FEW_CHANGES else "levels", levels, changes, hold, noisy)


def _changes(label: IntArray) -> int:
    return int(np.count_nonzero(label[1:] != label[:-1]))


def _clusters(u: Array, spread: float) -> IntArray | None:
    """Return the present or last cluster of each value; None if the values do not form narrow clusters."""
    bins = np.minimum((50 * (u - u.min()) / spread).astype(np.int64), 49)
    full = np.flatnonzero(np.bincount(bins, minlength=50) >= LEVEL_SHARE * u.size)
    if not full.size:
        return None
    # Coarsely quantised values leave empty bins: full bins less than three apart form one cluster.
    number = 1 + np.cumsum(np.diff(full, prepend=full[0]) > 2)
    cluster_of_bin = np.zeros(50, dtype=np.int64)
    for first, last, k in zip(full[:-1], full[1:], number[1:], strict=True):
        cluster_of_bin[first : last + 1] = np.where(last - first > 2, 0, k)
    cluster_of_bin[full] = number
    for _ in range(3):  # the rare values at the edges of a cluster
        neighbour = np.maximum(np.append(0, cluster_of_bin[:-1]), np.append(cluster_of_bin[1:], 0))
        cluster_of_bin = np.where(cluster_of_bin == 0, neighbour, cluster_of_bin)
    cluster = cluster_of_bin[bins]
    if cluster.max() < 2 or np.mean(cluster > 0) < 0.9 - LEVEL_WIDTH:
        return None
    widths = [np.ptp(u[cluster == k]) for k in range(1, int(cluster.max()) + 1)]
    if max(widths) > 2 * LEVEL_WIDTH * spread or len(widths) > FEW_LEVELS:
        return None
    known = np.flatnonzero(cluster > 0)
    last = known[np.maximum(np.searchsorted(known, np.arange(u.size), side="right") - 1, 0)]
    return np.asarray(cluster[last], dtype=np.int64)


#: An outlier deviates from its neighbours by this number of robust standard deviations.
OUTLIER = 10.0
#: Neighbours on each side for the local deviation of residuals.
LOCAL = 20
#: Largest share of repeated values for which single samples at a limit count as saturated, not only runs.
FEW_REPEATED = 0.02
#: Least growth of an unstable output in part of the record that can be distinguished from a polynomial in time.
GROWTH = 4.0


def begins_quietly(record: Record, share: float = QUIET_SHARE) -> bool:
    """Return whether a record begins at rest: with constant inputs, longer than later ones, and a constant output.

    The output may move by a share of its deviation.
    """
    moves = [input_moves(each) for each in record.each_input]
    changes = np.concatenate([one.changes for one in moves])
    if any(one.kind == "continuous" for one in moves) or not changes.size:
        return False
    times = np.sort(changes)
    if changes.size > FEW_CHANGES and times[0] - record.t[0] < LONGER * np.diff(times).max():
        return False
    y = record.y[record.valid]
    before = y[record.t[record.valid] < changes.min()]
    size = before.size // QUIET_BLOCKS
    if size < QUIET_SIZE:
        return False
    blocks = before[before.size - size * QUIET_BLOCKS :].reshape(QUIET_BLOCKS, size)
    means, inner = blocks.mean(axis=1), blocks - blocks.mean(axis=1, keepdims=True)
    if np.ptp(means) < share * float(y.std()):
        return True
    variance = float(np.sum(inner**2)) / (QUIET_BLOCKS * (size - 1))
    # The variance of a mean of autoregressive noise of order 1 is (1 + r)/(1 - r) times that of white noise.
    together = float(np.sum(inner[:, 1:] * inner[:, :-1])) / max(float(np.sum(inner**2)), np.finfo(float).tiny)
    factor = (1.0 + max(together, 0.0)) / max(1.0 - together, 0.05)
    return bool(np.ptp(means) < QUIET_ERRORS * np.sqrt(factor * variance / size))


def outliers(y: Array) -> IntArray:
    """Return single samples, or pairs, far from the median of five neighbouring samples."""
    return far_off(y)[0]


def far_off(y: Array) -> tuple[IntArray, Array]:
    """Return outliers, and their deviation from the median of their neighbours."""
    if y.size < 20:
        return np.empty(0, dtype=np.int64), np.empty(0)
    padded = np.pad(y, 2, mode="edge")
    rest = y - np.median(np.lib.stride_tricks.sliding_window_view(padded, 5), axis=1)
    spread = robust_deviation(rest)
    # Fast responses deviate from their medians too, but at more than one sample in ten.
    usual = float(np.quantile(np.abs(rest), 0.9))
    step = quantum(y)
    limit = max(OUTLIER * spread, 6 * usual, 0.2 * float(y.std()), 0.0 if math.isnan(step) else 4 * step)
    found = np.flatnonzero(np.abs(rest) > limit)
    return found, rest[found]


def residual_outliers(e: Array) -> tuple[IntArray, Array]:
    """Return outliers of residuals whose innovations are also large, unlike those of peaks of a smooth sequence.

    If neighbouring innovations are as large, as for a nonlinear system at large amplitudes, none is a sensor fault.
    """
    found, off = far_off(e)
    usual = e.copy()
    usual[found] -= off
    innovations = fit_noise_model([usual]).innovations(usual)
    local = np.array([_local_deviation(innovations, k) for k in found.tolist()])
    sudden = np.abs(innovations[found] + off) > OUTLIER * np.fmax(robust_deviation(innovations), local)
    return found[sudden], off[sudden]


def _local_deviation(innovations: Array, k: int) -> float:
    """Return the larger of the robust deviations before and after a sample; NaN if there are too few samples."""
    sides = (innovations[max(k - LOCAL, 0) : k], innovations[k + 1 : k + 1 + LOCAL])
    return max((robust_deviation(side) for side in sides if side.size == LOCAL), default=math.nan)


def saturated(y: Array) -> float:
    """Return the fraction of saturated samples; runs at the beginning or the end of the record may be rest."""
    values, counts = np.unique(y, return_counts=True)
    if values.size < 10:
        return 0.0
    # If other values hardly repeat, single samples at a limit are significant.
    alone = float(np.mean(counts[1:-1] == 1)) > 1 - FEW_REPEATED
    shortest, fewest = (1, 5) if alone else (5, 0.01 * y.size)
    total = 0
    for k, inner in ((0, 1), (-1, -2)):
        at = y == values[k]
        first, end = _runs(at)
        runs = end - first
        in_runs = int(runs[(runs >= shortest) & (first > 0) & (end < y.size)].sum())
        if in_runs >= fewest and counts[k] > 5 * counts[inner]:
            total += in_runs
    return total / y.size


def _runs(marked: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the first index of each run of marked samples, and the index after its end."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], marked.astype(int), [0]))))
    return edges[::2], edges[1::2]


def growth_time(t: Array, y: Array, u: Array) -> float:
    """Return the time constant of an exponentially diverging output; NaN for any other."""
    if y.size < 64:
        return math.nan
    sizes = []
    for x in (u, y):
        parts = np.array_split(x - np.median(x[: x.size // 8]), 8)
        sizes.append(np.log([float(np.mean(part**2)) or np.finfo(float).tiny for part in parts[3:]]) / 2)
    driven, grown = sizes
    steps = np.diff(grown)
    # An exponential grows at a constant rate, powers of time ever more slowly, and a late event suddenly.
    even = steps[-2:].min() > 0.5 * steps[-2:].max() and steps[-2:].sum() > 0.8 * steps[:2].sum()
    # An input that pauses has been as large before.
    unforced = grown[-1] - grown[-3] > max(math.log(GROWTH), 2 * (driven[-1] - driven[:-2].max()))
    return float((t[-1] - t[0]) / 4 / (grown[-1] - grown[-3])) if even and unforced else math.nan


def quantum(y: Array) -> float:
    """Return the step of a coarsely quantised signal; NaN for others."""
    values = np.unique(y)
    gaps = np.diff(values)
    gaps = gaps[gaps > 1e-6 * np.ptp(y)] if gaps.size else gaps
    if gaps.size < 2 or values.size > max(y.size / 2, 4):
        return math.nan
    step = float(np.median(gaps))
    multiples = gaps / step
    # Quantised values may be rounded again in files.
    fits = np.abs(multiples - np.round(multiples)) < 0.15
    return step if np.mean(fits) > 0.9 and step > 0.01 * y.std() else math.nan


def resolution(y: Array) -> float:
    """Return the step of which all differences of a signal are multiples, 0 if there is none."""
    gaps = np.diff(np.unique(y))
    gaps = gaps[gaps > 1e-9 * np.ptp(y)]
    if not gaps.size:
        return 0.0
    multiples = gaps / gaps.min()
    return float(gaps.min()) if np.all(np.abs(multiples - np.round(multiples)) < WHOLE * multiples) else 0.0
