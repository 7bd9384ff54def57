"""Where the compiled passes put their rows: written out, or summed to second moments."""

from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, BoolArray

#: Rows are collected in blocks of this many samples, so that the products run along contiguous memory.
BLOCK = 128


class RowSink(NamedTuple):
    """What a pass fills; an empty array is not wanted."""

    #: Rows on their way, one in each column, shape (q, BLOCK).
    block: Array
    #: Rows of the used samples, shape (count, q).
    rows: Array
    #: Sums of their products, shape (q, q).
    gram: Array
    #: Model output at every sample, used or not, shape (N,).
    output: Array


@njit(cache=True, nogil=True)
def row_sink(q: int, use: BoolArray, want_rows: bool) -> RowSink:
    """A sink for the rows of q entries of the used samples, or for their second moments."""
    rows = np.zeros((np.count_nonzero(use) if want_rows else 0, q))
    gram = np.zeros((0, 0) if want_rows else (q, q))
    return RowSink(np.zeros((q, BLOCK)), rows, gram, np.zeros(0))


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def accumulate(block: Array, count: int, gram: Array) -> None:
    """Add the products of buffered rows to the upper triangle of a Gram matrix.

    Two rows with two others at a time: each number that is loaded enters two products, which halves the time.
    """
    q = block.shape[0]
    for i in range(0, q - 1, 2):
        left, left_next = block[i], block[i + 1]
        for j in range(i, q - 1, 2):
            right, right_next = block[j], block[j + 1]
            total, total_right, total_left, total_both = 0.0, 0.0, 0.0, 0.0
            # Below the diagonal of a 2 x 2 tile one product too many is formed; it is overwritten at the end.
            for k in range(count):
                total += left[k] * right[k]
                total_right += left[k] * right_next[k]
                total_left += left_next[k] * right[k]
                total_both += left_next[k] * right_next[k]
            gram[i, j] += total
            gram[i, j + 1] += total_right
            gram[i + 1, j] += total_left
            gram[i + 1, j + 1] += total_both
    # The row left over, with all others.
    if q % 2 == 1:
        right = block[q - 1]
        for i in range(q):
            left = block[i]
            total = 0.0
            for k in range(count):
                total += left[k] * right[k]
            gram[i, q - 1] += total


@njit(cache=True, nogil=True)
def emit(sink: RowSink, filled: int, written: int) -> int:
    """Empty the block, of which so many columns are filled; returns the number of rows written so far."""
    if sink.gram.size:
        accumulate(sink.block, filled, sink.gram)
    if sink.rows.size:
        for k in range(filled):
            for i in range(sink.block.shape[0]):
                sink.rows[written + k, i] = sink.block[i, k]
    return written + filled


@njit(cache=True, nogil=True)
def finish(sink: RowSink, filled: int, written: int) -> None:
    """Empty the last block, and complete the moments, of which only the upper triangle was summed."""
    emit(sink, filled, written)
    for i in range(sink.gram.shape[0]):
        for j in range(i):
            sink.gram[i, j] = sink.gram[j, i]
