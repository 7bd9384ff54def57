"""Records out of a damaged SQLite file, read from its pages without SQLite, which refuses a file as a whole.

The layout of pages is that of https://www.sqlite.org/fileformat2.html. Nothing found here is to be trusted before its
checksum is compared: pages that were given up still hold older rows, and damaged ones hold anything.
"""

import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

#: SQLite's own choice since 2016, which nobody changes here.
PAGE = 4096
_LOG_HEADER, _FRAME_HEADER = 32, 24
#: Pages with records: interior and leaf of an index or a table without row numbers, leaf of a table with them.
_INTERIOR, _LEAF, _TABLE_LEAF = 0x02, 0x0A, 0x0D
_WIDTHS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}

Value = None | int | float | str | bytes
Pages = Mapping[int, bytes]


def carved_records(path: Path) -> Iterator[list[Value]]:
    """Every record of a file and of its write-ahead log that can be taken apart; a row number stands in front."""
    data = path.read_bytes()
    log = path.with_name(f"{path.name}-wal")
    frames = log.read_bytes()[_LOG_HEADER:] if log.exists() else b""
    pages = {k + 1: data[k * PAGE : (k + 1) * PAGE] for k in range(len(data) // PAGE)}
    newer = dict(pages)
    for place in range(0, len(frames) - _FRAME_HEADER - PAGE + 1, _FRAME_HEADER + PAGE):
        page = frames[place + _FRAME_HEADER : place + _FRAME_HEADER + PAGE]
        newer[int.from_bytes(frames[place : place + 4])] = page
    for view in (newer, pages):
        for number, page in view.items():
            yield from _records(page, 100 if number == 1 else 0, view)


def _records(page: bytes, header: int, pages: Pages) -> Iterator[list[Value]]:
    """The records of one page."""
    kind = page[header]
    if kind not in (_INTERIOR, _LEAF, _TABLE_LEAF):
        return
    (count,) = struct.unpack_from(">H", page, header + 3)
    first = header + (12 if kind == _INTERIOR else 8)
    for place in range(first, min(first + 2 * count, PAGE - 1), 2):
        # Whatever a damaged cell leads to, the others are worth reading.
        with suppress(IndexError, KeyError, ValueError, struct.error, MemoryError):
            (cell,) = struct.unpack_from(">H", page, place)
            yield _record(page, cell, kind, pages)


def _record(page: bytes, cell: int, kind: int, pages: Pages) -> list[Value]:
    size, place = _varint(page, cell + (4 if kind == _INTERIOR else 0))
    row = None
    if kind == _TABLE_LEAF:
        row, place = _varint(page, place)
    values = _values(_payload(page, place, size, kind, pages))
    if row is not None and values[0] is None:
        values[0] = row
    return values


def _payload(page: bytes, place: int, size: int, kind: int, pages: Pages) -> bytes:
    """The bytes of a record, those on overflow pages included."""
    most = PAGE - 35 if kind == _TABLE_LEAF else (PAGE - 12) * 64 // 255 - 23
    least = (PAGE - 12) * 32 // 255 - 23
    if size > len(pages) * PAGE:
        raise ValueError(size)
    if size <= most:
        return page[place : place + size]
    here = least + (size - least) % (PAGE - 4)
    here = here if here <= most else least
    content = page[place : place + here]
    (following,) = struct.unpack_from(">I", page, place + here)
    while len(content) < size:
        content += pages[following][4:]
        (following,) = struct.unpack_from(">I", pages[following])
    return content[:size]


def _values(payload: bytes) -> list[Value]:
    length, place = _varint(payload, 0)
    values: list[Value] = []
    content = length
    while place < length:
        kind, place = _varint(payload, place)
        value, content = _value(payload, content, kind)
        values.append(value)
    return values


def _value(payload: bytes, place: int, kind: int) -> tuple[Value, int]:
    """A value of a record and where the next one begins."""
    if kind in (0, 8, 9):
        return {0: None, 8: 0, 9: 1}[kind], place
    if kind == 7:
        (number,) = struct.unpack_from(">d", payload, place)
        return float(number), place + 8
    if kind in _WIDTHS:
        end = place + _WIDTHS[kind]
        return int.from_bytes(payload[place:end], signed=True), end
    end = place + (kind - 12) // 2
    if kind < 12 or end > len(payload):
        raise ValueError(kind)
    return (payload[place:end].decode() if kind % 2 else payload[place:end]), end


def _varint(data: bytes, place: int) -> tuple[int, int]:
    value = 0
    for k in range(9):
        byte = data[place + k]
        if k == 8:
            return (value << 8) | byte, place + 9
        value = (value << 7) | (byte & 0x7F)
        if byte < 0x80:
            return value, place + k + 1
    raise ValueError(place)
