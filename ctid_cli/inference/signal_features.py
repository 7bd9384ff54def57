"""How an input moves, and faults of an output: outliers, limits, coarse steps, growth."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IntArray
from ctid_cli.inference.intervals import robust_deviation
from ctid_cli.inference.noise_model import fit_noise_model
from ctid_cli.signals.record import Record

#: An input with at most this many changes gives single responses in time and no averages over frequency.
FEW_CHANGES = 3
#: An input that takes at most this many values moves between levels.
FEW_LEVELS = 20
#: Spread of a measured level, and share of the samples that make one, both as a fraction of the whole.
LEVEL_WIDTH = 0.1
LEVEL_SHARE = 0.02


@dataclass(frozen=True)
class InputMoves:
    """What the input does over the time of a record."""

    kind: Literal["constant", "steps", "levels", "continuous"]
    #: The values it returns to [input unit], at most 20 of them; empty where there are more.
    levels: tuple[float, ...]
    #: Instants of the changes after the beginning of the record [s]; empty for a continuous input, shape (n,).
    changes: Array
    #: Shortest time between two changes [s]; nan with fewer than two.
    shortest_hold: float
    noisy: bool = False


def input_moves(record: Record) -> InputMoves:
    """How the input moves between the first and the last output sample.

    A measured input counts as moving between levels when nine samples in ten lie in a few narrow heaps; its
    changes are then those between heaps. An input known at the instants of the output only is taken to change there.
    """
    first, signal = record.t[0], record.input
    inside = (signal.t > first) & (signal.t <= record.t[-1])
    # The value that the record begins with counts too.
    t, u = np.append(first, signal.t[inside]), np.append(signal.at([first]), signal.values[inside])
    spread = float(np.ptp(u))
    if spread <= 1e-9 * float(np.abs(u).max()):
        return InputMoves("constant", (float(u[0]),), np.empty(0), np.nan)
    values, exact = np.unique(u, return_inverse=True)
    label = np.asarray(exact, dtype=np.int64)
    heaps = _heaps(u, spread)
    noisy = False
    # Where the values flicker about their levels, the changes that count are those between levels.
    if heaps is not None and _changes(heaps) < _changes(label) / 3:
        label, noisy = heaps, True
        values = np.array([float(np.median(u[label == k])) for k in np.unique(label)])
    elif values.size > FEW_LEVELS and np.mean(u[1:] == u[:-1]) < 0.5:
        return InputMoves("continuous", (), np.empty(0), np.nan)
    changes = t[1:][label[1:] != label[:-1]]
    hold = float(np.diff(changes).min()) if changes.size > 1 else np.nan
    levels = tuple(float(value) for value in values) if values.size <= FEW_LEVELS else ()
    return InputMoves("steps" if changes.size <= FEW_CHANGES else "levels", levels, changes, hold, noisy)


def _changes(label: IntArray) -> int:
    return int(np.count_nonzero(label[1:] != label[:-1]))


def _heaps(u: Array, spread: float) -> IntArray | None:
    """Number of the heap that each value lies in or came from; None where the values do not lie in narrow heaps."""
    bins = np.minimum((50 * (u - u.min()) / spread).astype(np.int64), 49)
    full = np.flatnonzero(np.bincount(bins, minlength=50) >= LEVEL_SHARE * u.size)
    if not full.size:
        return None
    # Coarsely quantised values leave bins empty between them: full bins less than three apart make one heap.
    number = 1 + np.cumsum(np.diff(full, prepend=full[0]) > 2)
    heap_of_bin = np.zeros(50, dtype=np.int64)
    for first, last, k in zip(full[:-1], full[1:], number[1:], strict=True):
        heap_of_bin[first : last + 1] = np.where(last - first > 2, 0, k)
    heap_of_bin[full] = number
    for _ in range(3):  # the rare values at the skirts of a heap
        beside = np.maximum(np.append(0, heap_of_bin[:-1]), np.append(heap_of_bin[1:], 0))
        heap_of_bin = np.where(heap_of_bin == 0, beside, heap_of_bin)
    heap = heap_of_bin[bins]
    if heap.max() < 2 or np.mean(heap > 0) < 0.9 - LEVEL_WIDTH:
        return None
    widths = [np.ptp(u[heap == k]) for k in range(1, int(heap.max()) + 1)]
    if max(widths) > 2 * LEVEL_WIDTH * spread or len(widths) > FEW_LEVELS:
        return None
    known = np.flatnonzero(heap > 0)
    last = known[np.maximum(np.searchsorted(known, np.arange(u.size), side="right") - 1, 0)]
    return np.asarray(heap[last], dtype=np.int64)


#: A sample this many robust standard deviations away from its neighbours is an outlier.
OUTLIER = 10.0
#: Neighbours on each side that show how large residuals are about one of them.
ABOUT = 20
#: Share of values that come more than once in an output whose single samples at a limit tell as much as runs do.
SELDOM_ALIKE = 0.02
#: A part of the record in which an unstable plant grows by less than this is not told from a polynomial in time.
GROWTH = 4.0


def outliers(y: Array) -> IntArray:
    """Single samples, or pairs, far from the median of the five about them."""
    return far_off(y)[0]


def far_off(y: Array) -> tuple[IntArray, Array]:
    """Outliers, and how far they are from the median of their neighbours."""
    if y.size < 20:
        return np.empty(0, dtype=np.int64), np.empty(0)
    padded = np.pad(y, 2, mode="edge")
    rest = y - np.median(np.lib.stride_tricks.sliding_window_view(padded, 5), axis=1)
    spread = robust_deviation(rest)
    # The fast part of a response leaves its own medians behind, everywhere and not at one sample in ten.
    usual = float(np.quantile(np.abs(rest), 0.9))
    step = quantum(y)
    limit = max(OUTLIER * spread, 6 * usual, 0.2 * float(y.std()), 0.0 if math.isnan(step) else 4 * step)
    found = np.flatnonzero(np.abs(rest) > limit)
    return found, rest[found]


def residual_outliers(e: Array) -> tuple[IntArray, Array]:
    """Residuals that are far off, and that others do not foretell, as they do the peaks of a smooth sequence.

    Where all about are as large, as a nonlinear system leaves them in its large swings, none is a fault of the sensor.
    """
    found, off = far_off(e)
    usual = e.copy()
    usual[found] -= off
    surprise = fit_noise_model([usual]).innovations(usual)
    usual_about = np.array([_level_about(surprise, k) for k in found.tolist()])
    sudden = np.abs(surprise[found] + off) > OUTLIER * np.fmax(robust_deviation(surprise), usual_about)
    return found[sudden], off[sudden]


def _level_about(surprise: Array, k: int) -> float:
    """Robust deviation before or after a sample, the larger of the two; NaN where there are too few."""
    sides = (surprise[max(k - ABOUT, 0) : k], surprise[k + 1 : k + 1 + ABOUT])
    return max((robust_deviation(side) for side in sides if side.size == ABOUT), default=math.nan)


def saturated(y: Array) -> float:
    """Fraction of the samples that a limit seems to have cut off; the output may begin, or end, at rest at a limit."""
    values, counts = np.unique(y, return_counts=True)
    if values.size < 10:
        return 0.0
    # Where no other value comes twice, single samples tell as much as runs do.
    alone = float(np.mean(counts[1:-1] == 1)) > 1 - SELDOM_ALIKE
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
    """Where runs of marked samples begin, and where the samples after them are."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], marked.astype(int), [0]))))
    return edges[::2], edges[1::2]


def growth_time(t: Array, y: Array, u: Array) -> float:
    """Time in which an output that diverges exponentially grows by the factor e; nan for any other."""
    if y.size < 64:
        return math.nan
    sizes = []
    for x in (u, y):
        parts = np.array_split(x - np.median(x[: x.size // 8]), 8)
        sizes.append(np.log([float(np.mean(part**2)) or np.finfo(float).tiny for part in parts[3:]]) / 2)
    driven, grown = sizes
    steps = np.diff(grown)
    # An exponential grows in the same ratio all the time; powers of time ever more slowly, and a late event at once.
    even = steps[-2:].min() > 0.5 * steps[-2:].max() and steps[-2:].sum() > 0.8 * steps[:2].sum()
    by_itself = grown[-1] - grown[-3] > max(math.log(GROWTH), 2 * (driven[-1] - driven[-3]))
    return float((t[-1] - t[0]) / 4 / (grown[-1] - grown[-3])) if even and by_itself else math.nan


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
