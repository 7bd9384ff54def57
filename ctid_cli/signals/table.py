"""Named columns of numbers, wherever they come from, and the checks that make a record of three of them."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IntArray
from ctid_cli.errors import DataError
from ctid_cli.signals.checks import LONGEST, require_scale, require_steps
from ctid_cli.signals.files import MAX_NAMES, quoted
from ctid_cli.text import closest


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of numbers from one file; each is converted when it is asked for."""

    file: str
    names: tuple[str, ...]
    convert: Callable[[str], Array]
    lines: IntArray | None = None
    noun: str = "column"
    hint: str = ""

    @property
    def head(self) -> str:
        """The place of the names, for messages."""
        return self.file if self.lines is None else f"{self.file}:1"

    def row(self, k: int) -> str:
        """Name of a row."""
        return f"sample {k + 1}" if self.lines is None else f"line {self.lines[k]}"

    def place(self, k: int) -> str:
        """Place of a row, for the beginning of a message."""
        return f"{self.file}: sample {k + 1}" if self.lines is None else f"{self.file}:{self.lines[k]}"

    def numbers(self, name: str) -> Array:
        """One column."""
        if name not in self.names:
            refuse_missing(self, name)
        return self.convert(name)

    def named(self, wanted: str) -> str:
        """The column whose header is ``wanted``, with or without its unit."""
        if wanted in self.names:
            return wanted
        matching = [name for name in self.names if split_header(name)[0] == wanted]
        if len(matching) != 1:
            refuse_missing(self, wanted)
        return matching[0]

    def leaf(self, name: str) -> str:
        """A name without its unit, or without the struct that it belongs to."""
        return split_header(name)[0] if self.lines is not None else name.rpartition(".")[2]

    def lone_interval(self, name: str, value: float) -> float:
        """The one number that stands for all times."""
        if not (np.isfinite(value) and value > 0):
            raise DataError(f"{self.file}: {name!r} is {value:g}; a sampling interval must be a positive number")
        require_steps(f"{self.file}: the sampling interval {name!r}", np.array([0.0, value]))
        return value

    def require_as_many(self, name: str, values: Array, other: str, others: Array) -> None:
        """Refuse two columns of different lengths."""
        if values.size != others.size:
            sizes = f"{name!r} has {values.size} values and {other!r} has {others.size}"
            raise DataError(f"{self.file}: {sizes}; they must be equally many")

    def times(self, name: str) -> Array:
        """The column of the instants [s]."""
        return self.check_times(name, self.numbers(name))

    def check_times(self, name: str, t: Array, unit: str = "s") -> Array:
        """Refuse instants that are missing or do not increase."""
        every = "sample" if self.lines is None else "line"
        self._refuse(
            ~np.isfinite(t), f"time {name!r} is missing or not finite; every {every} needs its instant [{unit}]"
        )
        label = f"{self.file}: the time {name!r}"
        require_scale(label, t, LONGEST)
        steps = np.diff(t, prepend=-np.inf)
        k = int(np.argmax(steps <= 0))
        how = "repeats" if steps[k] == 0 else "goes back to"
        found = f"{t[k]:.12g} {unit} after {t[k - 1]:.12g} {unit} on {self.row(k - 1)}"
        self._refuse(steps <= 0, f"time {name!r} {how} {found}; times must increase strictly")
        require_steps(label, t)
        return t

    def check_input(self, name: str, u: Array, first: int = 0, role: str = "input") -> Array:
        """Refuse an input with gaps: the system answers to its input whether or not that was recorded."""
        self._refuse(~np.isfinite(u), f"{role} {name!r} is missing or not finite; only the output may have gaps", first)
        require_scale(f"{self.file}: the {role} {name!r}", u)
        return u

    def check_output(self, name: str, y: Array, first: int = 0) -> Array:
        """Refuse an output that is infinite somewhere or missing everywhere."""
        self._refuse(
            np.isinf(y), f"output {name!r} is infinite; leave the field empty where a sample is missing", first
        )
        if not np.isfinite(y).any():
            raise DataError(f"{self.place(first)}: no sample of the output {name!r} is a finite number")
        require_scale(f"{self.file}: the output {name!r}", y)
        return y

    def _refuse(self, wrong: BoolArray, message: str, first: int = 0) -> None:
        """Refuse a column that is wrong somewhere, and name the first row where it is."""
        if wrong.any():
            raise DataError(f"{self.place(first + int(np.argmax(wrong)))}: {message}")


def split_header(header: str) -> tuple[str, str | None]:
    """Name and unit in the header of a column."""
    found = re.fullmatch(r"(.*\S)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))", header)
    if found is None:
        return header, None
    name, square, round_ = found.groups()
    return name, (square or round_ or "").strip() or None


def refuse_missing(table: Table, wanted: str) -> NoReturn:
    """Say which columns there are in place of one that there is not."""
    refuse_nameless(table)
    parts = [f"{table.head}: there is no {table.noun} {wanted!r}; {listing(table)}", _header_of(table)]
    if not parts[1] and (close := closest(wanted, table.names)):
        parts.append(f"Did you mean {close!r}?")
    raise DataError(". ".join(filter(None, [*parts, table.hint])))


def refuse_nameless(table: Table) -> None:
    """Refuse a file whose first line holds numbers where names should be."""
    if table.names and all(_is_number(name) for name in table.names):
        raise DataError(f"{table.head}: the first line holds numbers; it must name the columns, for example t,u,y")


def wrong_header(names: tuple[str, ...]) -> str:
    """What is wrong with a first line that is one name: a comment, or columns that are not separated by commas."""
    if len(names) != 1:
        return ""
    if names[0].lstrip().startswith(("#", "%", "//")):
        return f"The first line must name the columns, and is {quoted(names[0])}; delete what stands before the names"
    for sign, word in ((";", "semicolons"), ("\t", "tabs"), (" ", "spaces")):
        if sign in names[0]:
            points = ", and write numbers with decimal points" if sign == ";" else ""
            return f"Its columns seem to be separated by {word}; separate them by commas{points}"
    return ""


def _header_of(table: Table) -> str:
    return wrong_header(table.names) if table.lines is not None else ""


def refuse_one_column(table: Table) -> None:
    """Refuse a file whose columns are not separated by commas."""
    if why := _header_of(table):
        raise DataError(f"{table.head}: the file has one column. {why}")


def listing(table: Table) -> str:
    """The columns of a file."""
    if not table.names:
        return f"the file has no {table.noun} of numbers"
    more = f" and {len(table.names) - MAX_NAMES} more" if len(table.names) > MAX_NAMES else ""
    return f"the file has {', '.join(map(quoted, table.names[:MAX_NAMES]))}{more}"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
