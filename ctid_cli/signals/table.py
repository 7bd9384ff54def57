"""Named columns of numbers, whatever file they come from, and the checks that make a record of three of them."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NoReturn, get_args

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError
from ctid_cli.signals.checks import LONGEST, require_scale, require_steps
from ctid_cli.signals.files import MAX_NAMES, quoted
from ctid_cli.text import closest

Role = Literal["time", "input", "output"]

ROLES: tuple[Role, ...] = get_args(Role)

#: Names by which a column is recognised when nobody says which one it is, the most telling first; case is ignored.
USUAL_NAMES: dict[Role, tuple[str, ...]] = {
    "time": ("t", "time", "times", "seconds", "timestamp", "samplinginstants", "ts", "sampletime"),
    "input": ("u", "input", "inputs", "inputdata"),
    "output": ("y", "output", "outputs", "outputdata"),
}
#: Names whose unit may stand behind a slash; elsewhere the slash is part of the name.
BEFORE_SLASH = {name for names in USUAL_NAMES.values() for name in names}


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of numbers that were read, and the lines that they come from in a text file."""

    file: str
    values: Mapping[str, Array]
    lines: Sequence[int] | None = None
    notes: tuple[str, ...] = ()

    def row(self, k: int) -> str:
        """Return the name of a row."""
        return f"sample {k + 1}" if self.lines is None else f"line {self.lines[k]}"

    def place(self, k: int) -> str:
        """Return the place of a row, for the beginning of a message."""
        return f"{self.file}: sample {k + 1}" if self.lines is None else f"{self.file}:{self.lines[k]}"

    def lone_interval(self, name: str) -> float:
        """Return the one number that stands for all times."""
        value = float(self.values[name][0])
        if not (np.isfinite(value) and value > 0):
            raise DataError(f"{self.file}: {name!r} is {value:g}; a sampling interval must be a positive number")
        require_steps(f"{self.file}: the sampling interval {name!r}", np.array([0.0, value]))
        return value

    def require_as_many(self, name: str, t: Array, other: str) -> None:
        """Refuse two columns of different lengths."""
        if t.size != self.values[other].size:
            sizes = f"{name!r} has {t.size} values and {other!r} has {self.values[other].size}"
            raise DataError(f"{self.file}: {sizes}; they must be equally many")

    def check_times(self, name: str, t: Array, unit: str = "s") -> Array:
        """Refuse instants that are missing or do not increase."""
        every = "sample" if self.lines is None else "line"
        self._refuse(
            ~np.isfinite(t), f"time {name!r} is missing or not finite; every {every} needs its instant [{unit}]"
        )
        self._require_scale(f"time {name!r}", t, 0, LONGEST)
        steps = np.diff(t)
        k = int(np.argmax(steps <= 0)) if steps.size else 0
        if steps.size and steps[k] <= 0:
            how = "repeats" if steps[k] == 0 else "goes back to"
            found = f"{t[k + 1]:.12g} {unit} after {t[k]:.12g} {unit} on {self.row(k)}"
            raise DataError(f"{self.place(k + 1)}: time {name!r} {how} {found}; times must increase strictly")
        if steps.size:
            require_steps(f"{self.place(int(np.argmin(steps)) + 1)}: time {name!r}", t)
        return t

    def check_input(self, name: str, u: Array, first: int = 0, role: str = "input") -> Array:
        """Refuse an input with gaps: the system responds to its input whether or not that was recorded."""
        self._refuse(~np.isfinite(u), f"{role} {name!r} is missing or not finite; only the output may have gaps", first)
        self._require_scale(f"{role} {name!r}", u, first)
        return u

    def check_output(self, name: str, y: Array, first: int = 0) -> Array:
        """Refuse an output that is infinite somewhere or missing everywhere."""
        self._refuse(
            np.isinf(y), f"output {name!r} is infinite; leave the field empty where a sample is missing", first
        )
        if not np.isfinite(y).any():
            raise DataError(f"{self.place(first)}: no sample of the output {name!r} is a finite number")
        self._require_scale(f"output {name!r}", y, first)
        return y

    def _refuse(self, wrong: BoolArray, message: str, first: int = 0) -> None:
        """Refuse a column that is wrong somewhere, and name the first row where it is."""
        if wrong.any():
            raise DataError(f"{self.place(first + int(np.argmax(wrong)))}: {message}")

    def _require_scale(self, what: str, values: Array, first: int, *limit: float) -> None:
        """Refuse a column in a unit in which nothing can be computed, and name the row of the largest value."""
        try:
            require_scale(f"{self.file}: {what}", values, *limit)
        except DataError:
            largest = first + int(np.nanargmax(np.abs(values)))
            require_scale(f"{self.place(largest)}: {what}", values, *limit)


@dataclass(frozen=True, eq=False)
class Table:
    """The names of the columns of a file, of which those that are asked for are read."""

    file: str
    names: tuple[str, ...]
    read: Callable[[Sequence[str]], Columns]
    #: The place of the names, for messages.
    head: str
    noun: str = "column"
    hint: str = ""
    #: Whether the columns have an order, and each line of the file a number.
    is_text: bool = False
    notes: tuple[str, ...] = ()

    def named(self, wanted: str) -> str:
        """Return the column whose header is ``wanted``, with or without its unit."""
        matching = [name for name in self.names if name == wanted]
        matching = matching or [name for name in self.names if split_header(name)[0] == wanted]
        self.require_single(matching)
        if len(matching) != 1:
            self._refuse_missing(wanted)
        return matching[0]

    def leaf(self, name: str) -> str:
        """Return a name without its unit, and without the struct that it belongs to."""
        bare = split_header(name)[0]
        return bare if self.is_text else bare.rpartition(".")[2]

    def require_single(self, names: Sequence[str]) -> None:
        """Refuse columns that have one name."""
        if len(names) > 1 and len(set(names)) == 1:
            raise DataError(f"{self.head}: {len(names)} columns are called {names[0]!r}; rename all but one")

    @property
    def listing(self) -> str:
        """The columns of the file, for messages."""
        if not self.names:
            return f"the file has no {self.noun} of numbers"
        more = f" and {len(self.names) - MAX_NAMES} more" if len(self.names) > MAX_NAMES else ""
        return f"the file has {', '.join(map(quoted, self.names[:MAX_NAMES]))}{more}"

    def _refuse_missing(self, wanted: str) -> NoReturn:
        """Say which columns there are in place of one that there is not."""
        parts = [f"{self.head}: there is no {self.noun} {wanted!r}; {self.listing}"]
        if close := closest(wanted, self.names):
            parts.append(f"Did you mean {close!r}?")
        raise DataError(". ".join(filter(None, [*parts, self.hint])))


def split_header(header: str) -> tuple[str, str | None]:
    """Return name and unit in the header of a column: ``u [V]``, ``u (V)`` or, with a usual name, ``u/V``."""
    found = re.fullmatch(r"(.*\S)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))", header)
    if found is not None:
        name, square, round_ = found.groups()
        return name, (square or round_ or "").strip() or None
    name, slash, unit = (part.strip() for part in header.partition("/"))
    return (name, unit) if slash and unit and name.lower() in BEFORE_SLASH else (header, None)
