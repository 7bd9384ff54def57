"""Medians of many short rows at once, compiled."""

import numpy as np
from numba import njit

from ctid_cli.arrays import Array

#: Columns that are gathered at once: rows of a table are far apart in memory.
TOGETHER = 32
#: Fewer values are put in order one by one.
FEW = 12


@njit(cache=True, nogil=True)
def middle_of(values: Array) -> float:
    """Median of finite values, which lose their order."""
    # Hoare's selection: whatever is left of `low` is no larger, whatever is right of `high` no smaller.
    low, high, half = 0, values.size - 1, values.size // 2
    while high - low >= FEW:
        first, pivot, last = values[low], values[(low + high) // 2], values[high]
        if (first < pivot) == (last < first):
            pivot = first
        elif (last < pivot) == (first < last):
            pivot = last
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if half <= j:
            high = j
        elif half >= i:
            low = i
        else:
            low = high = half
    for i in range(low + 1, high + 1):
        value, k = values[i], i
        while k > low and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value
    upper = values[half]
    if values.size % 2:
        return float(upper)
    lower = values[0]
    for k in range(1, half):
        lower = max(lower, values[k])
    return float(0.5 * (lower + upper))


@njit(cache=True, nogil=True)
def medians_of_columns(table: Array) -> Array:
    """Median of each column of a table of finite values, shape (M,)."""
    rows, columns = table.shape
    out, gathered = np.empty(columns), np.empty((TOGETHER, rows))
    for first in range(0, columns, TOGETHER):
        count = min(TOGETHER, columns - first)
        for row in range(rows):
            for k in range(count):
                gathered[k, row] = table[row, first + k]
        for k in range(count):
            out[first + k] = middle_of(gathered[k])
    return out
