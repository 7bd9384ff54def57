"""How the input of a record moves: constant, in a few steps, between levels, or continuously."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ctid_cli.arrays import Array, IntArray
from ctid_cli.signals.record import Record

#: An input with at most this many changes gives single answers in time and no averages over frequency.
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
