"""Named columns of numbers, wherever they come from, and the checks that make a record of three of them."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from ctid_cli.errors import DataError


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of numbers from one file; each is converted when it is asked for.

    Parameters
    ----------
    file : str
        Name of the file as the user gave it.
    names : tuple of str
        The columns, in the order of the file.
    convert : callable
        Takes the name of a column to its numbers, shape (N,); NaN where a number is missing.
    lines : ndarray of int, optional
        The line of the file that each row comes from, counted from 1; None for files without lines.
    noun : str, default "column"
        What the file calls its columns.
    hint : str, default ""
        Sentence for the user who asks for a column that is not there.
    """

    file: str
    names: tuple[str, ...]
    convert: Callable[[str], NDArray[np.float64]]
    lines: NDArray[np.int64] | None = None
    noun: str = "column"
    hint: str = ""

    @property
    def head(self) -> str:
        """The place of the names, for messages."""
        return self.file if self.lines is None else f"{self.file}:1"

    def row(self, k: int) -> str:
        """Name of a row.

        Parameters
        ----------
        k : int
            Number of the row, from 0.

        Returns
        -------
        str
            For example ``line 12``.
        """
        return f"sample {k + 1}" if self.lines is None else f"line {self.lines[k]}"

    def place(self, k: int) -> str:
        """Place of a row, for the beginning of a message.

        Parameters
        ----------
        k : int
            Number of the row, from 0.

        Returns
        -------
        str
            For example ``pump.csv:12``.
        """
        return f"{self.file}: sample {k + 1}" if self.lines is None else f"{self.file}:{self.lines[k]}"

    def numbers(self, name: str) -> NDArray[np.float64]:
        """One column.

        Parameters
        ----------
        name : str
            Its name as it stands in the file.

        Returns
        -------
        ndarray, shape (N,)
            The numbers; NaN where one is missing.

        Raises
        ------
        DataError
            If there is no such column or it holds something else than numbers.
        """
        self.require(name)
        return self.convert(name)

    def require(self, name: str) -> None:
        """Refuse a name that the file does not have.

        Parameters
        ----------
        name : str
            Name of a column.

        Raises
        ------
        DataError
            With the names that there are, and the one that may have been meant.
        """
        if name not in self.names:
            refuse_missing(self, name)

    def times(self, name: str, unit: str = "s") -> NDArray[np.float64]:
        """The column of the instants.

        Parameters
        ----------
        name : str
            Its name.
        unit : str, default "s"
            Unit of time, for messages.

        Returns
        -------
        ndarray, shape (N,)
            Instants [time unit], strictly increasing.

        Raises
        ------
        DataError
            If one is missing or they do not increase strictly.
        """
        return self.check_times(name, self.numbers(name), unit)

    def check_times(self, name: str, t: NDArray[np.float64], unit: str = "s") -> NDArray[np.float64]:
        """Refuse instants that are missing or do not increase.

        Parameters
        ----------
        name : str
            Name of the column.
        t : ndarray, shape (N,)
            Its numbers [time unit].
        unit : str, default "s"
            Unit of time, for messages.

        Returns
        -------
        ndarray, shape (N,)
            The same numbers.

        Raises
        ------
        DataError
            If one is missing or they do not increase strictly.
        """
        if not np.isfinite(t).all():
            k = int(np.argmin(np.isfinite(t)))
            every = "sample" if self.lines is None else "line"
            raise DataError(
                f"{self.place(k)}: time {name!r} is missing or not finite; every {every} needs its instant [{unit}]"
            )
        steps = np.diff(t)
        if not (steps > 0).all():
            k = int(np.argmin(steps > 0))
            how = "repeats" if steps[k] == 0 else "goes back to"
            raise DataError(
                f"{self.place(k + 1)}: time {name!r} {how} {t[k + 1]:.12g} {unit} after {t[k]:.12g} {unit} "
                f"on {self.row(k)}; times must increase strictly"
            )
        return t

    def check_input(self, name: str, u: NDArray[np.float64], first: int = 0) -> NDArray[np.float64]:
        """Refuse an input with gaps.

        Parameters
        ----------
        name : str
            Name of the column.
        u : ndarray, shape (M,)
            Its numbers [input unit], or a part of them.
        first : int, default 0
            Row of the first of them.

        Returns
        -------
        ndarray, shape (M,)
            The same numbers.

        Raises
        ------
        DataError
            If one of them is missing or not finite.
        """
        if not np.isfinite(u).all():
            k = first + int(np.argmin(np.isfinite(u)))
            raise DataError(
                f"{self.place(k)}: input {name!r} is missing or not finite; only the output may have gaps, "
                "since the system answers to its input whether or not that was recorded"
            )
        return u

    def check_output(self, name: str, y: NDArray[np.float64], first: int = 0) -> NDArray[np.float64]:
        """Refuse an output that is infinite somewhere or missing everywhere.

        Parameters
        ----------
        name : str
            Name of the column.
        y : ndarray, shape (M,)
            Its numbers [output unit], or a part of them; NaN where a sample is missing.
        first : int, default 0
            Row of the first of them.

        Returns
        -------
        ndarray, shape (M,)
            The same numbers.

        Raises
        ------
        DataError
            If a sample is infinite, or none is a finite number.
        """
        if np.isinf(y).any():
            k = first + int(np.argmax(np.isinf(y)))
            raise DataError(
                f"{self.place(k)}: output {name!r} is infinite; leave the field empty where a sample is missing"
            )
        if not np.isfinite(y).any():
            raise DataError(f"{self.place(first)}: no sample of the output {name!r} is a finite number")
        return y


def refuse_missing(table: Table, wanted: str) -> NoReturn:
    """Say which columns there are in place of one that there is not.

    Parameters
    ----------
    table : Table
        The file.
    wanted : str
        The name that was asked for.

    Raises
    ------
    DataError
        Always.
    """
    refuse_nameless(table)
    message = f"{table.head}: there is no {table.noun} {wanted!r}; {listing(table)}"
    if separated := wrong_separator(table):
        message += f". {separated}"
    elif close := closest(wanted, table.names):
        message += f". Did you mean {close!r}?"
    if table.hint:
        message += f". {table.hint}"
    raise DataError(message)


def refuse_nameless(table: Table) -> None:
    """Refuse a file whose first line holds numbers where names should be.

    Parameters
    ----------
    table : Table
        The file.

    Raises
    ------
    DataError
        If all names are numbers.
    """
    if table.names and all(_is_number(name) for name in table.names):
        raise DataError(f"{table.head}: the first line holds numbers; it must name the columns, for example t,u,y")


def wrong_separator(table: Table) -> str:
    """What separates the columns, where it is not commas.

    Parameters
    ----------
    table : Table
        The file.

    Returns
    -------
    str
        A sentence without its full stop; empty where commas separate them.
    """
    if len(table.names) == 1 and table.lines is not None:
        for sign, word in ((";", "semicolons"), ("\t", "tabs"), (" ", "spaces")):
            if sign in table.names[0]:
                return f"Its columns seem to be separated by {word}; separate them by commas"
    return ""


def listing(table: Table) -> str:
    """The columns of a file.

    Parameters
    ----------
    table : Table
        The file.

    Returns
    -------
    str
        For example ``the file has 't', 'u', 'y'``.
    """
    return f"the file has {', '.join(map(repr, table.names)) or f'no {table.noun} of numbers'}"


def closest(wanted: str, names: Sequence[str]) -> str | None:
    """The name that may have been meant.

    Parameters
    ----------
    wanted : str
        What was written.
    names : sequence of str
        What there is.

    Returns
    -------
    str or None
        One of `names`, or None where none resembles it.
    """
    found = difflib.get_close_matches(wanted.lower(), [name.lower() for name in names], n=1)
    return next(name for name in names if name.lower() == found[0]) if found else None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
