"""Columns of numbers from text files, whose layout is determined from their first lines."""

import codecs
import csv
import io
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from itertools import chain, zip_longest
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.progress import doing, report
from ctid_cli.signals.data_checks import Rows
from ctid_cli.signals.files import quoted, require_file
from ctid_cli.signals.table import Found, Table, split_header

if TYPE_CHECKING:
    from pandas import DataFrame

#: Number of lines used to determine separator and decimal sign, and the maximum size of these lines [bytes].
HEAD_LINES, HEAD_BYTES = 50, 1_000_000
#: Maximum number of columns.
MAX_COLUMNS = 10_000
#: Rows converted at once: memory is needed for these and for the numbers of the used columns.
CHUNK = 1 << 17
#: Separators in order of preference; the blank stands for any number of blanks and tabs.
SEPARATORS = ("\t", ";", ",", " ")
#: Prefixes of comments, which are allowed before the data.
COMMENTS = ("#", "%", "//")
#: Notations of a missing sample.
MISSING = ("", "nan", "NaN", "NAN", "na", "NA", "N/A", "#N/A")
#: Digits, a sign and digits again, as in 2024-03-01, 1/3/24 or 12:30.
DATE = re.compile(r"\d[-/.]\d{1,2}[-/.]\d|\d:\d\d")
#: A date with a time of day after ISO 8601, possibly with a blank between them.
INSTANT = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d+)?)?(Z|[+-]\d\d(:?\d\d)?)?")
#: A number by its decimal sign.
NUMBERS = {
    sign: re.compile(rf"[+-]?(\d+{mark}?\d*|{mark}\d+)(e[+-]?\d+)?|[+-]?inf(inity)?|true|false", re.IGNORECASE)
    for sign, mark in ((".", r"\."), (",", ","))
}
#: A number that is not missing, not infinite, and no truth value.
PLAIN = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]{1,2})?")
NO_DATA = "the file has a header and no data"
TEXT = "this is not a text file in UTF-8, or in UTF-16 with a byte order mark"
FORMATS = "records are read from text (.csv, .txt), MATLAB files (.mat) and HDF5 files (.h5)"


@dataclass(frozen=True)
class Layout:
    """Layout of a file: encoding, separators, columns, and line numbers of names and first sample.

    Columns of dates have the first of them in ``origins``, by their place; times in seconds are counted from there.
    """

    path: str | os.PathLike[str]
    encoding: str
    separator: str
    decimal: str
    columns: tuple[str, ...]
    header: int
    first: int
    notes: tuple[str, ...]
    comments: tuple[tuple[int, str], ...]
    origins: dict[int, str]

    def opened(self) -> io.TextIOBase:
        """Open the file at its first sample."""
        # Undecodable text is not a number, which is allowed in unused columns.
        text = open(self.path, encoding=self.encoding, errors="replace", newline="")  # noqa: SIM115
        for _ in range(self.first - 1):
            text.readline()
        return text

    def error(self, line: int, problem: str) -> DataError:
        """Return the error about a line."""
        return DataError(f"{os.fspath(self.path)}:{line}: {problem}")


def read_text_table(path: str | os.PathLike[str]) -> Table:
    """Open a text file with one line per instant, whose first line names the columns."""
    file = require_file(path, "1: the file is empty; its first line must name the columns")
    layout = _layout(path, file)
    names, head = tuple(filter(None, layout.columns)), f"{file}:{layout.header}"

    def read(wanted: Sequence[str]) -> Found:
        with doing(f"reading {os.path.basename(file)}"):
            return _read_columns(layout, wanted)

    return Table(file, names, read, head, is_text=True, notes=layout.notes, comments=layout.comments)


# --- first lines ----------------------------------------------------------------------------------


def _layout(path: str | os.PathLike[str], file: str) -> Layout:
    """Determine the layout of a file."""
    text, encoding = _head(path, file)
    comments: list[tuple[int, str]] = []
    content: list[tuple[int, str]] = []
    for number, line in enumerate(io.StringIO(text, newline=None), start=1):
        if line.strip() and len(content) < HEAD_LINES:
            (comments if line.lstrip().startswith(COMMENTS) else content).append((number, line))
    if not content:
        raise DataError(f"{file}:1: the file has no data; its first line must name the columns")
    separator = _separator([line for _, line in content])
    rows = [(k, _fields(line, separator)) for k, line in content]
    if _all_numbers(rows[0][1]):
        # Some programs write the column names as a comment.
        before, comment = next(((k, line) for k, line in reversed(comments) if k < rows[0][0]), (0, ""))
        rows.insert(0, (before, _fields(comment.lstrip().lstrip("#%/"), separator)))
        if len(rows[0][1]) != len(rows[1][1]) or _all_numbers(rows[0][1]):
            wrong = "the first line names no columns; it must name them, for example t,u,y"
            raise DataError(f"{file}:{rows[1][0]}: {wrong}")
    header, names = rows[0]
    notes = ["The file is not UTF-8; it was read as Windows-1252."] if encoding == "cp1252" else []
    if _is_units(rows):
        names = [_with_unit(*pair) for pair in zip_longest(names, rows[1][1], fillvalue="")]
        notes.append(f"Line {rows[1][0]} was taken as the units of the columns.")
        del rows[1]
    if len(names) > MAX_COLUMNS:
        raise DataError(f"{file}:{header}: the line names {len(names)} columns; at most {MAX_COLUMNS} are read")
    if len(rows) < 2:
        raise DataError(f"{file}:{header + 1}: {NO_DATA}")
    decimal = _decimal(chain.from_iterable(fields for _, fields in rows[1:]))
    if decimal == ",":
        notes.append("Numbers were read with decimal commas.")
    origins = _origins(names, [fields for _, fields in rows[1:]])
    first = rows[1][0]
    return Layout(
        path, encoding, separator, decimal, tuple(names), header, first, tuple(notes), tuple(comments), origins
    )


def _head(path: str | os.PathLike[str], file: str) -> tuple[str, str]:
    """Return the complete lines at the beginning of a file, and its encoding."""
    try:
        with open(path, "rb") as content:
            head = content.read(HEAD_BYTES)
    except OSError as error:
        raise DataError(f"{file}: cannot be read: {error.strerror}") from None
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encodings = ["utf-16"]
    else:
        encodings = ["utf-8-sig", "cp1252"] if b"\0" not in head else []
    for encoding in encodings:
        try:
            # The last character may be incomplete.
            text = codecs.getincrementaldecoder(encoding)().decode(head)
        except UnicodeDecodeError:
            continue
        if len(head) == HEAD_BYTES:
            text = text[: max(text.rfind("\n"), text.rfind("\r")) + 1]
            if not text:
                raise DataError(f"{file}:1: the line has more than {HEAD_BYTES} bytes; it must name the columns")
        return text, encoding
    raise DataError(f"{file}: {TEXT}; {FORMATS}")


def _split(line: str, separator: str) -> list[str]:
    """Return the stripped fields of a line."""
    line = line.strip("\r\n")
    if separator == " ":
        # Keep a name and its unit together.
        line = re.sub(r"\s+", " ", re.sub(r"\s+(?=[\[(])", "", line.strip()))
    try:
        row = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:  # a field of more than 131072 letters
        return []
    return [field.strip() for field in row]


def _fields(line: str, separator: str) -> list[str]:
    """Return the fields of a line up to the last non-empty one."""
    fields = _split(line, separator)
    while fields and not fields[-1]:
        del fields[-1]
    return fields


def _separator(lines: Sequence[str]) -> str:
    """Return the separator for which most lines have one field per column, with several columns.

    If there is none, the file has one column, or the lines are refused later when fields are counted.
    """

    def fitness(separator: str) -> tuple[int, bool, bool, int]:
        names, *rows = (_fields(line, separator) for line in lines)
        agreeing = sum(len(row) == len(names) for row in rows) if len(names) > 1 else 0
        one_column = len(names) == 1 and all(map(_all_numbers, rows))
        return agreeing, separator in lines[0] and separator != " ", one_column, len(names)

    return max(SEPARATORS, key=fitness)


def _decimal(fields: Iterable[str]) -> str:
    """Return the decimal sign used by most of the numbers that have one."""
    found = [sign for field in fields for sign in NUMBERS if sign in field and NUMBERS[sign].fullmatch(field)]
    return "," if found.count(",") > found.count(".") else "."


def _origins(names: Sequence[str], rows: Sequence[Sequence[str]]) -> dict[int, str]:
    """Return the first date of every column that has only dates with a time of day and, if any, the unit second."""
    found = {}
    for place, (name, *fields) in enumerate(zip_longest(names, *rows, fillvalue="")):
        if all(map(INSTANT.fullmatch, fields)) and split_header(name)[1] in (None, "s"):
            found[place] = fields[0]
    return found


def _is_units(rows: Sequence[tuple[int, list[str]]]) -> bool:
    """Return whether the line below the names contains units: words, followed by a line with numbers."""
    if len(rows) < 3 or len(rows[1][1]) > len(rows[0][1]):
        return False
    words = [field for field in rows[1][1] if field not in MISSING]
    return bool(words) and not any(map(_has_number, words)) and any(map(_has_number, rows[2][1]))


def _with_unit(name: str, unit: str) -> str:
    """Return a column name with its unit, unless it already has one."""
    unit = unit.strip("[]()").strip()
    return f"{name} [{unit}]" if name and unit and split_header(name)[1] is None else name


def _has_number(field: str) -> bool:
    return DATE.search(field) is not None or any(number.fullmatch(field) for number in NUMBERS.values())


def _all_numbers(fields: Sequence[str]) -> bool:
    return all(field in MISSING or _has_number(field) for field in fields)


# --- the columns ----------------------------------------------------------------------------------


def _read_columns(layout: Layout, names: Sequence[str]) -> Found:
    """Read some columns; lines with only empty fields are left out."""
    places, width = [layout.columns.index(name) for name in names], len(layout.columns)
    plain = _plain_numbers(layout, places)
    parts: list[Any] = [] if plain is None else [plain]
    try:
        for frame in _chunks(layout, places) if plain is None else ():
            if frame[width].notna().any():
                raise ValueError("a line has too many fields")
            parts.append(_numbers(layout, frame[places]).T)
            report("", note=f"{sum(part.shape[1] for part in parts):,} lines")
    except ValueError as error:  # some field is no number, or a quotation mark is never closed
        _refuse(layout, places, str(error))
    values = np.concatenate(parts, axis=1)
    parts.clear()
    missing = np.isnan(values)
    doubtful = set(np.flatnonzero(missing.all(axis=0)).tolist())
    last = values.shape[1] - 1
    notes = [f"Times are in seconds after {layout.origins[place]}." for place in places if place in layout.origins]
    if missing[:, last:].any():
        doubtful.add(last)
    empty = []
    for k, line in _lines(layout, doubtful):
        if not _fields(line, layout.separator):
            empty.append(k)
        elif k == last and not line.endswith(("\r", "\n")) and len(_split(line, layout.separator)) < width:
            empty.append(k)
            notes.append(f"Line {layout.first + k}, the last, breaks off before its last field; it was left out.")
    lines: Any = range(layout.first, layout.first + last + 1)
    if empty:
        values, lines = np.delete(values, empty, axis=1), np.delete(np.array(lines), empty)
    if not len(lines):
        raise layout.error(layout.header + 1, NO_DATA)
    return Found(dict(zip(names, values, strict=True)), Rows(os.fspath(layout.path), lines), tuple(notes))


def _plain_numbers(layout: Layout, places: Sequence[int]) -> Array | None:
    """Return columns of a small file of plain numbers only, shape (columns, rows); None for any other file.

    pandas would read the same numbers, the nearest ones, but its import takes a third of a second.
    """
    with layout.opened() as file:
        text = file.read(HEAD_BYTES + 1)
    if len(text) > HEAD_BYTES or layout.decimal != "." or '"' in text:
        return None
    lines = text.replace("\r\n", "\n").removesuffix("\n")
    rows = [line.split(None if layout.separator == " " else layout.separator) for line in lines.split("\n")]
    if "\r" in lines or any(len(row) != len(layout.columns) for row in rows):
        return None
    columns = [[row[place] for row in rows] for place in places]
    if not all(map(PLAIN.fullmatch, chain.from_iterable(columns))):
        return None
    return np.array([list(map(float, column)) for column in columns])


def _numbers(layout: Layout, frame: "DataFrame") -> Array:
    """Return columns as numbers, shape (rows, columns); dates become seconds after the first of the file."""
    import pandas as pd

    for place, first in layout.origins.items():
        if place in frame:
            dates = pd.to_datetime(frame[place], format="ISO8601", utc=True)
            frame[place] = (dates - pd.to_datetime(first, utc=True)) / pd.Timedelta("1s")
    return frame.to_numpy(float)


def _lines(layout: Layout, rows: set[int]) -> Iterator[tuple[int, str]]:
    """Return some lines of a file unchanged."""
    if rows:
        with layout.opened() as text:
            yield from ((k, line) for k, line in enumerate(text) if k in rows)


class _Widened:
    """A text preceded by a line of names, one more than there are columns.

    pandas then expects that number of fields: the last one is empty unless a line has too many.
    """

    def __init__(self, text: io.TextIOBase, layout: Layout) -> None:
        self._text = text
        self._front = layout.separator.join(map(str, range(len(layout.columns) + 1))) + "\n"

    def read(self, size: int = -1) -> str:
        """Read the line of names, then the text."""
        front, self._front = self._front, ""
        return front or self._text.read(size)

    def __iter__(self) -> Iterator[str]:
        return iter(self._text)


def _chunks(layout: Layout, places: Sequence[int]) -> Iterator["DataFrame"]:
    """Read columns by position, and an additional one that is empty unless a line has too many fields."""
    import pandas as pd  # takes a second, only when a file is read

    width = len(layout.columns)
    options: Any = {"header": 0, "names": range(width + 1), "usecols": [*places, width], "index_col": False}
    options |= {"sep": r"\s+" if layout.separator == " " else layout.separator, "decimal": layout.decimal}
    options |= {"na_values": list(MISSING), "keep_default_na": False, "skip_blank_lines": False}
    types = {place: str if place in layout.origins else float for place in options["usecols"]}
    options |= {"skipinitialspace": True, "dtype": types, "chunksize": CHUNK, "engine": "c"}
    with layout.opened() as text:
        widened: Any = _Widened(text, layout)
        yield from pd.read_csv(widened, **options)


def _refuse(layout: Layout, places: Sequence[int], error: str) -> NoReturn:
    """Refuse the first line with too many fields or without a number, and quote it."""
    number, width = NUMBERS[layout.decimal], len(layout.columns)
    if unclosed := re.search(r"inside string starting at row (\d+)", error):
        why = "a quotation mark is opened and never closed; export the file anew, or correct the line"
        raise layout.error(layout.first + int(unclosed[1]) - 1, why)
    with layout.opened() as text:
        for line, written in enumerate(text, start=layout.first):
            if (count := len(_fields(written, layout.separator))) > width:
                there = f"the line has {count} fields where line {layout.header} names {width}"
                commas = "; numbers with decimal commas need another separator, such as the semicolon"
                raise layout.error(line, there + commas * (layout.separator == ","))
            for place, field in enumerate(_split(written, layout.separator)):
                is_right = _is_date if place in layout.origins else number.fullmatch
                if place in places and field not in MISSING and not is_right(field):
                    found = f"column {layout.columns[place]!r} holds {quoted(field)}"
                    raise layout.error(line, f"{found}, which is {_instead(field, place, layout)}")
    raise layout.error(layout.first, "the columns cannot be read as numbers; write them with one decimal sign")


def _is_date(text: str) -> bool:
    """Return whether a text is a date of the calendar with a time of day."""
    with suppress(ValueError):
        return INSTANT.fullmatch(text) is not None and datetime.fromisoformat(text) is not None
    return False


def _instead(text: str, place: int, layout: Layout) -> str:
    """Describe the text found in place of a number or a date, with a remedy."""
    decimal = layout.decimal
    if place in layout.origins:
        return f"not a date and a time of day like {layout.origins[place]}"
    if DATE.search(text):
        return "a date or a time of day; write times as 2024-03-01T12:30:00.5, or as seconds since the first sample"
    if text.startswith(COMMENTS):
        return "a comment; move comments above the names of the columns, or delete them"
    other, name = (",", "comma") if decimal == "." else (".", "point")
    if NUMBERS[other].fullmatch(text):
        return f"a number with a decimal {name}, unlike the first {HEAD_LINES} lines; write all with one decimal sign"
    if NUMBERS[decimal].fullmatch(re.sub(rf"[{re.escape(other)}' \u00a0\u202f]", "", text)):
        return "a number with separators between its digits; write it with digits and one decimal sign"
    return "not a number; leave the field empty if the sample is missing"
