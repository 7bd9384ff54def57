"""``timings.csv``: how long each estimate took, in the order of the sealed file."""

import csv
import io
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import StorageError
from ctid_cli.storage.packing import CLOCKS, PackedTable, decoded
from ctid_cli.storage.pieces import AnyArray, Table, Window, ranges

#: Bytes of the file that are taken apart at once.
AT_ONCE = 1_000_000
#: Estimates whose times are looked up one by one before the whole file is taken apart.
FEW = 10


def times_table(table: PackedTable, *, shared: bool) -> bytes:
    """The content of the file; estimates that are shared by two names are in it once."""
    content = io.BytesIO()
    text = io.TextIOWrapper(content, encoding="utf-8", newline="", write_through=True)
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(("id", *CLOCKS, "session"))
    seen: set[str] = set()
    for start, stop in ranges(table.count):
        times = ([None if t != t else t for t in table.read(clock, start, stop).tolist()] for clock in CLOCKS)
        ids, sessions = decoded(table.read("id", start, stop)), table.read("session", start, stop).tolist()
        for row in zip(ids, *times, sessions, strict=True):
            if shared:
                if row[0] in seen:
                    continue
                seen.add(row[0])
            rows.writerow(row)
    return content.getvalue()


class TimedTable(Window):
    """A sealed table with the times that belong to it, read when they are asked for; NaN where they are not known."""

    def __init__(self, table: Table, path: Path) -> None:
        super().__init__(table, 0, table.count)
        self._path = path

    def has(self, name: str) -> bool:
        """Whether there is such an array."""
        return name in CLOCKS or super().has(name)

    def read(self, name: str, start: int = 0, stop: int | None = None) -> AnyArray:
        """Some rows of an array."""
        if name not in CLOCKS:
            return super().read(name, start, stop)
        if stop is not None and stop - start <= FEW and "_times" not in self.__dict__:
            ids = self._table.read("id", start, stop)
            return _times(_lines(self._path, ids.tolist()), ids)[name]
        return self._times[name][start:stop]

    @cached_property
    def _times(self) -> Mapping[str, Array]:
        # Times are extra: results without them, copied from elsewhere, are complete. One that cannot be read is told.
        try:
            with self._path.open("rb") as file:
                return _times(file, self._table.read("id"))
        except FileNotFoundError:
            return _times(io.BytesIO(), self._table.read("id"))
        except OSError as error:
            raise _unreadable(self._path, error) from error


def _unreadable(path: Path, error: OSError) -> StorageError:
    return StorageError(f"{path} cannot be read ({error.strerror or error})")


def _lines(path: Path, ids: Sequence[bytes]) -> io.BytesIO:
    """The lines of some estimates in the file, below its first one."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        content = b""
    except OSError as error:
        raise _unreadable(path, error) from error
    places = [content.find(b"\n" + name + b",") + 1 for name in ids]
    found = [content[place : content.find(b"\n", place) + 1] for place in [0, *(place for place in places if place)]]
    return io.BytesIO(b"".join(found))


def _times(file: BinaryIO, ids: AnyArray) -> Mapping[str, Array]:
    """Times of estimates in the order of their ids."""
    found = {clock: np.full(len(ids), np.nan) for clock in CLOCKS}
    places: dict[bytes, int] = {}
    row = 0
    try:
        names = file.readline().decode().strip().split(",")
        clocks = [clock for clock in CLOCKS if clock in names]
        while lines := file.readlines(AT_ONCE):
            # Nothing in there is quoted, so that cells are what stands between commas.
            cells = b"".join(lines).rstrip(b"\n").replace(b"\n", b",").split(b",")
            known, where = np.array(cells[names.index("id") :: len(names)]), slice(row, row + len(lines))
            row += len(lines)
            inside: Any = slice(None)
            if places or known.shape != ids[where].shape or (known != ids[where]).any():
                places = places or {name: k for k, name in enumerate(ids.tolist())}
                rows = np.array([places.get(name, -1) for name in known.tolist()], dtype=np.intp)
                inside = rows >= 0
                where = rows[inside]
            for clock in clocks:
                values = np.array([float(cell or b"nan") for cell in cells[names.index(clock) :: len(names)]])
                found[clock][where] = values[inside]
    except (ValueError, IndexError):
        return {clock: np.full(len(ids), np.nan) for clock in CLOCKS}
    return found
