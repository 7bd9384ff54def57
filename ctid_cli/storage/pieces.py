"""Arrays of many rows, written and read piece by piece, so that however many there are, only some are in memory."""

import tempfile
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

#: Rows that are held at once.
ROWS = 8192
#: Bytes in memory before they go to a file without a name.
IN_MEMORY = 16_000_000

AnyArray = NDArray[Any]


class Table(Protocol):
    """Arrays by name, all with a row for each estimate."""

    @property
    def count(self) -> int:
        """Number of rows."""

    def has(self, name: str) -> bool:
        """Whether there is such an array."""

    def read(self, name: str, start: int = 0, stop: int | None = None) -> AnyArray:
        """Some of its rows."""

    def parts(self, name: str) -> list[str]:
        """Names of the columns of an array that has several."""


class Window:
    """Some rows of a table, following each other."""

    def __init__(self, table: Table, start: int, stop: int) -> None:
        self._table, self._start, self.count = table, start, stop - start

    def has(self, name: str) -> bool:
        """Whether there is such an array."""
        return self._table.has(name)

    def parts(self, name: str) -> list[str]:
        """Names of the columns of an array that has several."""
        return self._table.parts(name)

    def read(self, name: str, start: int = 0, stop: int | None = None) -> AnyArray:
        """Some rows of an array."""
        stop = self.count if stop is None else min(stop, self.count)
        return self._table.read(name, self._start + start, self._start + stop)


class _Place(NamedTuple):
    """Where a piece is in the file, and what it is."""

    offset: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]


class Pieces:
    """Arrays that are appended to, ``ROWS`` rows at a time, then read; in a folder as far as memory is not enough."""

    def __init__(self, folder: Path | None = None) -> None:
        self._file = tempfile.SpooledTemporaryFile(IN_MEMORY, dir=None if folder is None else str(folder))  # noqa: SIM115 - it lives as long as this
        self._places: dict[str, list[_Place]] = defaultdict(list)
        self._end = 0

    def append(self, name: str, rows: AnyArray) -> None:
        """Add a piece to an array."""
        self._file.seek(self._end)
        self._file.write(np.ascontiguousarray(rows).tobytes())
        self._places[name].append(_Place(self._end, rows.dtype, rows.shape))
        self._end += rows.nbytes

    def pieces(self, name: str, start: int, stop: int) -> Iterator[tuple[int, AnyArray]]:
        """The pieces of an array that have some of these rows, each with the number of its first one."""
        for number, place in enumerate(self._places[name][start // ROWS : -(-stop // ROWS)], start // ROWS):
            yield number * ROWS, self._piece(place)

    def _piece(self, place: _Place) -> AnyArray:
        self._file.seek(place.offset)
        size = place.dtype.itemsize * int(np.prod(place.shape))
        return np.frombuffer(self._file.read(size), place.dtype).reshape(place.shape)

    def kinds(self, name: str) -> list[tuple[np.dtype[Any], tuple[int, ...]]]:
        """Type and shape of every piece of an array."""
        return [place[1:] for place in self._places[name]]


def ranges(count: int, size: int | None = None) -> Iterator[tuple[int, int]]:
    """First row, and the one after the last, of every piece of so many rows."""
    size = size or ROWS
    return ((start, min(start + size, count)) for start in range(0, count, size))
