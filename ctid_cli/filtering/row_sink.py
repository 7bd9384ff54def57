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
    #: Sums of the products of the leading ones with all, shape (p, q).
    gram: Array
    #: Model output at every sample, used or not, shape (N,).
    output: Array


@njit(cache=True, nogil=True)
def row_sink(q: int, use: BoolArray, want_rows: bool, leading: int = -1) -> RowSink:
    """A sink for the rows of q entries of the used samples, or for their second moments: of some leading ones with all.

    All are leading if nobody says how many.
    """
    rows = np.zeros((np.count_nonzero(use) if want_rows else 0, q))
    gram = np.zeros((0, 0) if want_rows else (q if leading < 0 else leading, q))
    return RowSink(np.zeros((q, BLOCK)), rows, gram, np.zeros(0))


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def accumulate(block: Array, count: int, gram: Array) -> None:
    """Add the products of the leading buffered rows with all that follow them to the upper part of a Gram matrix.

    Two rows with four others at a time: each number that is loaded enters several products, and eight sums do not wait
    for each other.
    """
    leading, q = gram.shape
    for i in range(0, leading - 1, 2):
        one, two = block[i], block[i + 1]
        # Below the diagonal of a tile products too many are formed; they are overwritten at the end.
        tiled = i + (q - i) // 4 * 4
        for j in range(i, tiled, 4):
            a, b, c, d = block[j], block[j + 1], block[j + 2], block[j + 3]
            one_a, one_b, one_c, one_d, two_a, two_b, two_c, two_d = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(count):
                one_a += one[k] * a[k]
                one_b += one[k] * b[k]
                one_c += one[k] * c[k]
                one_d += one[k] * d[k]
                two_a += two[k] * a[k]
                two_b += two[k] * b[k]
                two_c += two[k] * c[k]
                two_d += two[k] * d[k]
            gram[i, j] += one_a
            gram[i, j + 1] += one_b
            gram[i, j + 2] += one_c
            gram[i, j + 3] += one_d
            gram[i + 1, j] += two_a
            gram[i + 1, j + 1] += two_b
            gram[i + 1, j + 2] += two_c
            gram[i + 1, j + 3] += two_d
        for j in range(tiled, q):
            a, one_a, two_a = block[j], 0.0, 0.0
            for k in range(count):
                one_a += one[k] * a[k]
                two_a += two[k] * a[k]
            gram[i, j] += one_a
            gram[i + 1, j] += two_a
    # The leading row left over.
    if leading % 2 == 1:
        one = block[leading - 1]
        for j in range(leading - 1, q):
            a, one_a = block[j], 0.0
            for k in range(count):
                one_a += one[k] * a[k]
            gram[leading - 1, j] += one_a


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
    """Empty the last block, and complete the moments, of which only the upper part was summed."""
    emit(sink, filled, written)
    for i in range(sink.gram.shape[0]):
        for j in range(i):
            sink.gram[i, j] = sink.gram[j, i]
