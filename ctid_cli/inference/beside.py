"""What columns leave of others, in blocks of rows: nothing as large as a long record with all its columns is made."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ctid_cli.arrays import Array

#: Rows of a block: a few dozen columns of them stay in the processor's cache.
ROWS = 4096


class Rows(Protocol):
    """Columns that are made, or looked up, a block of rows at a time."""

    def __len__(self) -> int:
        """Number of rows."""

    def __getitem__(self, rows: slice, /) -> Array:
        """Some rows, shape (count, columns)."""


def row_blocks(count: int) -> Iterator[slice]:
    """Slices that cover so many rows."""
    return (slice(first, min(first + ROWS, count)) for first in range(0, count, ROWS))


@dataclass(frozen=True, eq=False)
class SideBySide:
    """The columns of several."""

    parts: tuple[Rows, ...]

    def __len__(self) -> int:
        return len(self.parts[0])

    def __getitem__(self, rows: slice, /) -> Array:
        return np.column_stack([part[rows] for part in self.parts])


@dataclass(frozen=True, eq=False)
class Rest:
    """What others leave of columns, by least squares."""

    columns: Rows
    beside: Rows
    weights: Array

    @classmethod
    def of(cls, columns: Rows, beside: Rows) -> "Rest":
        """Project columns on others."""
        combined = orthonormal(beside)
        along = [(beside[rows] @ combined).T @ columns[rows] for rows in row_blocks(len(beside))]
        return cls(columns, beside, combined @ np.sum(along, axis=0))

    def __len__(self) -> int:
        return len(self.columns)

    def __getitem__(self, rows: slice, /) -> Array:
        rest: Array = self.columns[rows] - self.beside[rows] @ self.weights
        return rest


def constant(count: int) -> Array:
    """A column of ones that takes no memory."""
    return np.broadcast_to(1.0, (count, 1))


def rest_of(e: Array, beside: Rows) -> Array:
    """What columns leave of one."""
    rest = Rest.of(e[:, None], beside)
    return np.concatenate([rest[rows][:, 0] for rows in row_blocks(e.size)])


def orthonormal(columns: Rows, least: float | None = None) -> Array:
    """Weights with which columns become orthonormal ones of the same span, shape (columns, rank).

    Directions with less than a least share of the largest singular value are rounding.
    """
    triangle = columns[:0]
    for rows in row_blocks(len(columns)):
        triangle = np.asarray(np.linalg.qr(np.vstack((triangle, columns[rows])), mode="r"))
    lengths = np.linalg.norm(triangle, axis=0)
    # A column of zeros has no length to divide by: the rounding of its weights would grow beyond bounds.
    lengths[lengths == 0] = 1.0
    _, values, vectors = np.linalg.svd(triangle / lengths, full_matrices=False)
    kept = values > (len(columns) * np.finfo(float).eps if least is None else least) * values[0]
    return np.asarray(vectors[kept].T / values[kept] / lengths[:, None])
