"""Records from comma-separated files, with errors that name the line."""

import os
import re
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal, NoReturn, get_args

import numpy as np

from ctid_cli.arrays import Array, IntArray
from ctid_cli.errors import DataError
from ctid_cli.signals.checks import require_choice
from ctid_cli.signals.files import quoted, require_file
from ctid_cli.signals.held import HeldSignal, Hold
from ctid_cli.signals.record import Record
from ctid_cli.signals.table import Table, wrong_header

if TYPE_CHECKING:
    from pandas import DataFrame, Series

Offset = Literal["none", "remove"]

#: Columns of the widest file, and letters of its first line.
MAX_COLUMNS, MAX_HEADER = 10_000, 1_000_000
#: Digits, a sign and digits again, as in 2024-03-01, 1/3/24 or 12:30.
DATE = re.compile(r"\d[-/.]\d{1,2}[-/.]\d|\d:\d\d")
#: What stands for a missing sample (upper and lower case alike).
MISSING = ("", "nan", "na")


def read_record(
    path: str | os.PathLike[str],
    *,
    time: str = "t",
    input: str = "u",
    output: str = "y",
    hold: Hold = "zoh",
    offset: Offset = "none",
) -> Record:
    """Record from a file with one line per instant.

    Parameters
    ----------
    path : str or path-like
        A comma-separated file whose first line names the columns.
    time : str, default "t"
        Column of the instants [s], strictly increasing.
    input : str, default "u"
        Column of the input [input unit].
    output : str, default "y"
        Column of the output [output unit]; an empty field or NaN is a missing sample.
    hold : {"zoh", "foh", "band-limited"}, default "zoh"
        How the input behaves between its samples.
    offset : {"none", "remove"}, default "none"
        ``remove`` subtracts the mean of the input and the mean of the present output samples.

    Returns
    -------
    Record
        The record; its name is `path`.

    Raises
    ------
    DataError
        If the file cannot be used; the message names the file, the line and what to do.
    """
    require_choice("hold", hold, get_args(Hold))
    require_choice("offset", offset, get_args(Offset))
    table = read_csv_table(path)
    t = table.times(time)
    u = table.check_input(input, table.numbers(input))
    y = table.check_output(output, table.numbers(output))
    if offset == "remove":
        u = u - u.mean()
        y = y - np.nanmean(y)
    return Record(t, y, HeldSignal(t, u, hold), name=table.file)


def read_held_signal(
    path: str | os.PathLike[str], *, time: str = "t", input: str = "u", hold: Hold = "zoh"
) -> HeldSignal:
    """Input signal from a file with one line per break."""
    table = read_csv_table(path)
    return HeldSignal(table.times(time), table.check_input(input, table.numbers(input)), hold)


def read_csv_table(path: str | os.PathLike[str]) -> Table:
    """Columns of a comma-separated file."""
    file = require_file(path, "1: the file is empty; its first line must name the columns")
    _require_header(path, file)
    # Columns of numbers become numbers as they are read: as text they would take twenty times the memory.
    frame = _parsed(path, file, na_values=[*MISSING, "NaN", "NAN", "NA"])
    names = tuple(str(column).strip() for column in frame.columns)
    kept = np.ones(len(frame), dtype=bool)
    kept[_blank_rows(path, np.flatnonzero(frame.isna().all(axis="columns")))] = False
    lines = np.flatnonzero(kept) + 2

    def convert(name: str) -> Array:
        column = frame.iloc[kept, names.index(name)]
        if column.size == 0:
            raise DataError(f"{file}:2: the file has a header and no data")
        if column.dtype.kind in "iuf":
            return column.to_numpy(dtype=float)
        text = _parsed(path, file, dtype=str).iloc[kept, names.index(name)].str.strip()
        return _numbers(text, lambda k: f"{file}:{lines[k]}: column {name!r} holds {quoted(text.iloc[k])}")

    return Table(file, names, convert, lines)


def _parsed(path: str | os.PathLike[str], file: str, **options: Any) -> "DataFrame":
    """Rows of a file, row k from line k + 2."""
    import pandas as pd  # a second of start-up time that only a command that reads a file should pay

    try:
        with warnings.catch_warnings():
            # A comma at the end of every line is harmless: the nameless column is dropped. So are columns of numbers
            # and text, which are looked at again.
            warnings.simplefilter("ignore", pd.errors.ParserWarning)
            warnings.simplefilter("ignore", pd.errors.DtypeWarning)
            layout: Any = {"index_col": False, "skipinitialspace": True, "skip_blank_lines": False}
            frame: DataFrame = pd.read_csv(path, keep_default_na=False, **layout, **options)
            return frame
    except pd.errors.EmptyDataError:
        raise DataError(f"{file}:1: the file is empty; its first line must name the columns") from None
    except pd.errors.ParserError as error:
        _refuse_ragged(path, file, str(error))
    except UnicodeDecodeError:
        raise DataError(f"{file}: this is not a text file in UTF-8; export it as comma-separated UTF-8 text") from None
    except OSError as error:
        raise DataError(f"{file}: cannot be read: {error.strerror}") from None


def _require_header(path: str | os.PathLike[str], file: str) -> None:
    """Refuse a first line that cannot name columns, which pandas would take minutes or all memory for."""
    try:
        with open(path, "rb") as content:
            header = content.readline(MAX_HEADER)
    except OSError as error:
        raise DataError(f"{file}: cannot be read: {error.strerror}") from None
    if b"\0" in header:
        raise DataError(f"{file}: this is not a text file in UTF-8; export it as comma-separated UTF-8 text")
    columns = header.count(b",") + 1
    if columns > MAX_COLUMNS or len(header) == MAX_HEADER:
        many = f"{columns} columns" if columns > MAX_COLUMNS else f"more than {MAX_HEADER} characters"
        raise DataError(f"{file}:1: the first line has {many}; it must name the columns, at most {MAX_COLUMNS}")


def _blank_rows(path: str | os.PathLike[str], empty: IntArray) -> list[int]:
    """Those of the rows without a value that do not even say so."""
    if not empty.size:
        return []
    rows = set(empty.tolist())
    with open(path, encoding="utf-8") as text:
        return [k for k, line in enumerate(text, start=-1) if k in rows and not line.strip(', "\t\r\n')]


def _numbers(text: "Series[str]", place: Callable[[int], str]) -> Array:
    """A column that is not numbers only."""
    import pandas as pd

    numbers = pd.to_numeric(text, errors="coerce").to_numpy(dtype=float, na_value=np.nan)
    wrong = np.isnan(numbers) & ~text.str.lower().isin(MISSING).to_numpy(dtype=bool)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise DataError(f"{place(k)}, which is {_instead_of_number(text.iloc[k], k)}")
    return numbers


def _instead_of_number(text: str, row: int) -> str:
    """What stands where a number should, and what to do about it."""
    if DATE.search(text):
        return "a date or a time of day; write times as numbers, such as seconds since the first sample"
    if not row and not re.search(r"\d", text):
        return "not a number; only the first line names columns, with units in brackets, as in t [ms]"
    return "not a number"


def _refuse_ragged(path: str | os.PathLike[str], file: str, message: str) -> NoReturn:
    found = re.search(r"Expected (\d+) fields in line (\d+), saw (\d+)", message)
    if found is None:
        raise DataError(f"{file}: this is not a comma-separated file ({message.strip()})") from None
    with open(path, encoding="utf-8", errors="replace") as text:
        first = text.readline(MAX_HEADER).rstrip("\r\n")
    if why := wrong_header((first,) if "," not in first else ()):
        raise DataError(f"{file}:1: {why}") from None
    expected, line, seen = found.groups()
    raise DataError(f"{file}:{line}: the line has {seen} fields where those before it have {expected}") from None
