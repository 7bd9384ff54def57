"""Records from comma-separated files, with errors that name the line."""

import os
import re
import warnings
from pathlib import Path
from typing import Literal, NoReturn, get_args

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.signals.checks import require_choice
from ctid_cli.signals.held import HeldSignal, Hold
from ctid_cli.signals.record import Record
from ctid_cli.signals.table import Table

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
    import pandas as pd  # a second of start-up time that only a command that reads a file should pay

    file = require_file(path)
    try:
        with warnings.catch_warnings():
            # A comma at the end of every line is harmless: the nameless column is dropped.
            warnings.simplefilter("ignore", pd.errors.ParserWarning)
            frame = pd.read_csv(
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

    frame.columns = frame.columns.str.strip()
    blank = (frame == "").all(axis="columns")
    frame = frame[~blank]
    lines = frame.index.to_numpy(dtype=np.int64) + 2

    def convert(name: str) -> Array:
        text = frame[name].str.strip()
        numbers = pd.to_numeric(text, errors="coerce").to_numpy(dtype=float, na_value=np.nan)
        wrong = np.isnan(numbers) & ~text.str.lower().isin(MISSING).to_numpy(dtype=bool)
        if wrong.any():
            k = int(np.argmax(wrong))
            raise DataError(f"{file}:{lines[k]}: column {name!r} holds {text.iloc[k]!r}, which is not a number")
        if numbers.size == 0:
            raise DataError(f"{file}:2: the file has a header and no data")
        return numbers

    return Table(file, tuple(str(column) for column in frame.columns), convert, lines)


def require_file(path: str | os.PathLike[str]) -> str:
    """Refuse a path that names no file."""
    file = os.fspath(path)
    if not Path(path).is_file():
        kind = "is not a file" if Path(path).exists() else "does not exist"
        raise DataError(f"{file}: {kind}; relative names start at {Path(path).absolute().parent}")
    return file


def _refuse_ragged(file: str, message: str) -> NoReturn:
    found = re.search(r"Expected (\d+) fields in line (\d+), saw (\d+)", message)
    if found is None:
        raise DataError(f"{file}: this is not a comma-separated file ({message.strip()})") from None
    expected, line, seen = found.groups()
    raise DataError(f"{file}:{line}: the line has {seen} fields where those before it have {expected}") from None
