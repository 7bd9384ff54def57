"""Records from comma-separated files, with errors that name the line."""

from __future__ import annotations

import difflib
import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NoReturn, get_args

import numpy as np
from numpy.typing import NDArray

from ctid_cli.errors import DataError
from ctid_cli.signals.checks import require_choice
from ctid_cli.signals.held import HeldSignal, Hold
from ctid_cli.signals.record import Record

Offset = Literal["none", "remove"]

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
    hold : {"zoh", "foh"}, default "zoh"
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
    name = os.fspath(path)
    columns, lines = read_columns(path, (time, input, output))
    t = _times(name, time, columns[time], lines)
    u = _input(name, input, columns[input], lines)
    y = columns[output]
    if np.isinf(y).any():
        line = lines[int(np.argmax(np.isinf(y)))]
        raise DataError(
            f"{name}:{line}: output {output!r} is infinite; leave the field empty where a sample is missing"
        )
    if not np.isfinite(y).any():
        raise DataError(f"{name}:{lines[0]}: no sample of the output {output!r} is a finite number")
    if offset == "remove":
        u = u - u.mean()
        y = y - np.nanmean(y)
    return Record(t, y, HeldSignal(t, u, hold), name=name)


def read_held_signal(
    path: str | os.PathLike[str], *, time: str = "t", input: str = "u", hold: Hold = "zoh"
) -> HeldSignal:
    """Input signal from a file with one line per break.

    Parameters
    ----------
    path : str or path-like
        A comma-separated file whose first line names the columns.
    time : str, default "t"
        Column of the break times [s], strictly increasing.
    input : str, default "u"
        Column of the values [input unit].
    hold : {"zoh", "foh"}, default "zoh"
        How the input behaves between its breaks.

    Returns
    -------
    HeldSignal
        The signal on the file's own times.

    Raises
    ------
    DataError
        If the file cannot be used; the message names the file, the line and what to do.
    """
    name = os.fspath(path)
    columns, lines = read_columns(path, (time, input))
    return HeldSignal(_times(name, time, columns[time], lines), _input(name, input, columns[input], lines), hold)


def read_columns(
    path: str | os.PathLike[str], names: Sequence[str]
) -> tuple[dict[str, NDArray[np.float64]], NDArray[np.int64]]:
    """Columns of numbers from a comma-separated file.

    Parameters
    ----------
    path : str or path-like
        A file whose first line names the columns. Other columns than those asked for may hold anything.
    names : sequence of str
        The columns to read.

    Returns
    -------
    columns : dict of str to ndarray, shape (N,)
        The numbers; NaN where a field is empty, ``NaN`` or ``NA``.
    lines : ndarray of int, shape (N,)
        The line of the file that each number comes from, counted from 1.

    Raises
    ------
    DataError
        If the file is missing, unreadable or empty, lacks a column, or holds text in one of the columns.
    """
    import pandas as pd  # a second of start-up time that only a command that reads a file should pay

    file = os.fspath(path)
    if not Path(path).is_file():
        kind = "is not a file" if Path(path).exists() else "does not exist"
        raise DataError(f"{file}: {kind}; relative names start at {Path(path).absolute().parent}")
    try:
        with warnings.catch_warnings():
            # A comma at the end of every line is harmless: the nameless column is dropped.
            warnings.simplefilter("ignore", pd.errors.ParserWarning)
            table = pd.read_csv(
                path,
                dtype=str,
                na_filter=False,
                index_col=False,
                skipinitialspace=True,
                skip_blank_lines=False,  # so that row k stays on line k + 2
            )
    except pd.errors.EmptyDataError:
        raise DataError(f"{file}:1: the file is empty; its first line must name the columns") from None
    except pd.errors.ParserError as error:
        _refuse_ragged(file, str(error))
    except UnicodeDecodeError:
        raise DataError(f"{file}: this is not a text file in UTF-8; export it as comma-separated UTF-8 text") from None
    except OSError as error:
        raise DataError(f"{file}: cannot be read: {error.strerror}") from None

    table.columns = table.columns.str.strip()
    present = [str(column) for column in table.columns]
    for wanted in names:
        if wanted not in present:
            _refuse_missing_column(file, wanted, present)
    blank = (table == "").all(axis="columns")
    table = table[~blank]
    lines = table.index.to_numpy(dtype=np.int64) + 2
    if table.empty:
        raise DataError(f"{file}:2: the file has a header and no data")

    columns: dict[str, NDArray[np.float64]] = {}
    for wanted in names:
        text = table[wanted].str.strip()
        numbers = pd.to_numeric(text, errors="coerce").to_numpy(dtype=float, na_value=np.nan)
        wrong = np.isnan(numbers) & ~text.str.lower().isin(MISSING).to_numpy(dtype=bool)
        if wrong.any():
            k = int(np.argmax(wrong))
            raise DataError(f"{file}:{lines[k]}: column {wanted!r} holds {text.iloc[k]!r}, which is not a number")
        columns[wanted] = numbers
    return columns, lines


def _times(file: str, column: str, t: NDArray[np.float64], lines: NDArray[np.int64]) -> NDArray[np.float64]:
    if not np.isfinite(t).all():
        k = int(np.argmin(np.isfinite(t)))
        raise DataError(
            f"{file}:{lines[k]}: time {column!r} is missing or not finite; every line needs its instant [s]"
        )
    steps = np.diff(t)
    if not (steps > 0).all():
        k = int(np.argmin(steps > 0))
        how = "repeats" if steps[k] == 0 else "goes back to"
        raise DataError(
            f"{file}:{lines[k + 1]}: time {column!r} {how} {t[k + 1]:.12g} s after {t[k]:.12g} s "
            f"on line {lines[k]}; times must increase strictly"
        )
    return t


def _input(file: str, column: str, u: NDArray[np.float64], lines: NDArray[np.int64]) -> NDArray[np.float64]:
    if not np.isfinite(u).all():
        k = int(np.argmin(np.isfinite(u)))
        raise DataError(
            f"{file}:{lines[k]}: input {column!r} is missing or not finite; only the output may have gaps, "
            "since the system answers to its input whether or not that was recorded"
        )
    return u


def _refuse_missing_column(file: str, wanted: str, present: Sequence[str]) -> NoReturn:
    if all(_is_number(column) for column in present):
        raise DataError(f"{file}:1: the first line holds numbers; it must name the columns, for example t,u,y")
    message = f"{file}:1: there is no column {wanted!r}; the file has {', '.join(map(repr, present))}"
    if len(present) == 1:
        separators = [
            word for sign, word in ((";", "semicolons"), ("\t", "tabs"), (" ", "spaces")) if sign in present[0]
        ]
        if separators:
            message += f". Its columns seem to be separated by {separators[0]}; separate them by commas"
    elif close := difflib.get_close_matches(wanted.lower(), [column.lower() for column in present], n=1):
        match = next(column for column in present if column.lower() == close[0])
        message += f". Did you mean {match!r}?"
    raise DataError(message)


def _refuse_ragged(file: str, message: str) -> NoReturn:
    found = re.search(r"Expected (\d+) fields in line (\d+), saw (\d+)", message)
    if found is None:
        raise DataError(f"{file}: this is not a comma-separated file ({message.strip()})") from None
    expected, line, seen = found.groups()
    raise DataError(f"{file}:{line}: the line has {seen} fields where those before it have {expected}") from None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
