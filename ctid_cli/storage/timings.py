"""``timings.csv``: how long each estimate took, in the order of the sealed file."""

import csv
import io
from collections.abc import Iterator, Mapping
from functools import cached_property

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.storage.packing import CLOCKS, PackedTable, decoded
from ctid_cli.storage.pieces import AnyArray, Table, ranges

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


class TimedTable:
    """A sealed table with the times that belong to it, read when they are asked for; NaN where they are not known."""

    def __init__(self, table: Table, content: bytes) -> None:
        self._table, self._content = table, content
        self.count = table.count

    def has(self, name: str) -> bool:
        """Whether there is such an array."""
        return name in CLOCKS or self._table.has(name)

    def parts(self, name: str) -> list[str]:
        """Names of the columns of an array that has several."""
        return self._table.parts(name)

    def read(self, name: str, start: int = 0, stop: int | None = None) -> AnyArray:
        """Some rows of an array."""
        if name not in CLOCKS:
            return self._table.read(name, start, stop)
        if stop is not None and stop - start <= FEW and "_times" not in self.__dict__:
            ids = self._table.read("id", start, stop)
            lines = [self._content.partition(b"\n")[0], *filter(None, map(self._line, ids.tolist()))]
            return _times(b"\n".join(lines), ids)[name]
        return self._times[name][start:stop]

    @cached_property
    def _times(self) -> Mapping[str, Array]:
        return _times(self._content, self._table.read("id"))

    def _line(self, name: bytes) -> bytes:
        place = self._content.find(b"\n" + name + b",") + 1
        return self._content[place : self._content.find(b"\n", place)] if place else b""


def _times(content: bytes, ids: AnyArray) -> Mapping[str, Array]:
    """Times of estimates in the order of their ids."""
    nothing = {clock: np.full(len(ids), np.nan) for clock in CLOCKS}
    try:
        head, _, body = content.partition(b"\n")
        names = head.decode().split(",")
        pieces: dict[str, list[AnyArray]] = {name: [] for name in names if name in ("id", *CLOCKS)}
        for some in _pieces(body):
            # Nothing in there is quoted, so that cells are what stands between commas.
            cells = some.rstrip(b"\n").replace(b"\n", b",").split(b",")
            for name, parts in pieces.items():
                column = cells[names.index(name) :: len(names)]
                of_times = name in CLOCKS
                parts.append(np.array([float(cell or b"nan") for cell in column] if of_times else column))
        if not pieces.get("id"):
            return nothing
        found = {name: np.concatenate(parts) for name, parts in pieces.items()}
        known = found.pop("id")
        if known.shape == ids.shape and (known == ids).all():
            return nothing | found
        rows = {name: k for k, name in enumerate(known.tolist())}
        where = np.array([rows.get(name, -1) for name in ids.tolist()], dtype=np.intp)
        return nothing | {clock: np.where(where < 0, np.nan, values[where]) for clock, values in found.items()}
    except (ValueError, IndexError):
        return nothing


def _pieces(content: bytes) -> Iterator[bytes]:
    """Some lines at a time."""
    start = 0
    while start < len(content):
        end = content.find(b"\n", start + AT_ONCE) + 1 or len(content)
        yield content[start:end]
        start = end
