"""Named columns of numbers from any kind of file, and checks for use as a record or a signal."""

import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NoReturn, get_args

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError
from ctid_cli.signals.checks import LONGEST, require_scale, require_steps
from ctid_cli.signals.files import MAX_NAMES, quoted
from ctid_cli.text import closest, listed

Role = Literal["time", "input", "output"]

#: Roles of the columns of a record. A signal has a time and a signal; a record of a loop also has a reference.
ROLES: tuple[Role, ...] = get_args(Role)

#: Default column names of each role, the most specific first; case is ignored.
USUAL_NAMES: dict[str, tuple[str, ...]] = {
    "time": ("t", "time", "times", "seconds", "timestamp", "samplinginstants", "ts", "sampletime"),
    "input": ("u", "input", "inputs", "inputdata"),
    "output": ("y", "output", "outputs", "outputdata"),
    "signal": (
        *("y", "signal", "output", "value", "values", "x"),
        *("amplitude", "data", "audio", "sound", "wave", "voltage"),
    ),
}
#: Names after which a slash precedes the unit; in other names the slash is part of the name.
BEFORE_SLASH = {name for role in ROLES for name in USUAL_NAMES[role]}


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns that were read, with their line numbers in a text file."""

    file: str
    #: Numbers by column name, or by role once roles are known.
    values: Mapping[str, Array]
    lines: Sequence[int] | None = None
    notes: tuple[str, ...] = ()
    #: Column names by role, including a time column that is not read.
    names: Mapping[str, str] = field(default_factory=dict)

    def unit(self, role: str) -> str | None:
        """Return the unit in the header of a column."""
        return split_header(self.names[role])[1]

    def place(self, k: int) -> str:
        """Return the place of a row, as the beginning of a message."""
        return f"{self.file}: sample {k + 1}" if self.lines is None else f"{self.file}:{self.lines[k]}"

    def timed(self) -> "Columns":
        """Return the columns with an instant for each row; a single number in the time column is the interval."""
        main = next(role for role in ("output", "signal", "input", "time") if role in self.values)
        t, size = self.values["time"], self.values[main].size
        name, unit = self.names["time"], self.unit("time") or "s"
        found = self
        if t.size == 1 < size:
            interval = float(t[0])
            if not (np.isfinite(interval) and interval > 0):
                raise DataError(f"{self.file}: {name!r} is {interval:g}; a sampling interval must be a positive number")
            require_steps(f"{self.file}: the sampling interval {name!r}", np.array([0.0, interval]))
            taken = f"{name!r} is one number: it was taken as the sampling interval"
            note = f"{taken}, {interval:g} {unit}, from 0 {unit} on."
            times = {"time": interval * np.arange(size, dtype=float)}
            found = replace(self, values={**self.values, **times}, notes=(*self.notes, note))
        for role, values in found.values.items():
            if values.size != size:
                sizes = f"{self.names[role]!r} has {values.size} values and {self.names[main]!r} has {size}"
                raise DataError(f"{self.file}: {sizes}; they must be equally many")
        found._check_times(f"time {name!r}", unit)
        return found

    def _check_times(self, what: str, unit: str) -> None:
        """Refuse instants that are missing or do not increase."""
        t, every = self.values["time"], "sample" if self.lines is None else "line"
        self._refuse(~np.isfinite(t), f"{what} is missing or not finite; every {every} needs its instant [{unit}]")
        self._require_scale(what, t, 0, LONGEST)
        steps = np.diff(t)
        if not steps.size:
            return
        k = int(np.argmax(steps <= 0))
        if steps[k] <= 0:
            row = f"sample {k + 1}" if self.lines is None else f"line {self.lines[k]}"
            how = "repeats" if steps[k] == 0 else "goes back to"
            found = f"{how} {t[k + 1]:.12g} {unit} after {t[k]:.12g} {unit} on {row}"
            raise DataError(f"{self.place(k + 1)}: {what} {found}; times must increase strictly")
        require_steps(f"{self.place(int(np.argmin(steps)) + 1)}: {what}", t)

    def input(self, used: slice = slice(0, None), role: str = "input") -> Array:
        """Return an input; refuse missing values, since the system also responds to values that were not recorded."""
        u, what = self.values[role][used], f"{role} {self.names[role]!r}"
        self._refuse(~np.isfinite(u), f"{what} is missing or not finite; only the output may have gaps", used.start)
        self._require_scale(what, u, used.start)
        return u

    def output(self, used: slice) -> Array:
        """Return an output; refuse infinite values and a column without any value."""
        y, what = self.values["output"][used], f"output {self.names['output']!r}"
        self._refuse(np.isinf(y), f"{what} is infinite; leave the field empty where a sample is missing", used.start)
        if not np.isfinite(y).any():
            raise DataError(f"{self.place(used.start)}: no sample of the {what} is a finite number")
        self._require_scale(what, y, used.start)
        return y

    def window(self, t: Array, start: float | None, stop: float | None, slack: float = 0.0) -> slice:
        """Return the rows between two instants, with a tolerance."""
        unit = (self.unit("time") if "time" in self.values else None) or "s"
        low, high = -np.inf if start is None else start, np.inf if stop is None else stop
        if not low < high:
            raise DataError(f"{self.file}: the window from {low:g} to {high:g} {unit} ends before it begins")
        first = int(np.searchsorted(t, low - slack, side="left"))
        last = int(np.searchsorted(t, high + slack, side="right"))
        if first >= last:
            where = f"between {low:g} and {high:g}" if np.isfinite([low, high]).all() else f"after {low:g}"
            where = f"before {high:g}" if np.isinf(low) else where
            runs = f"the record runs from {t[0]:.9g} to {t[-1]:.9g} {unit}"
            raise DataError(f"{self.file}: no sample lies {where} {unit}; {runs}")
        return slice(first, last)

    def _refuse(self, wrong: BoolArray, message: str, first: int = 0) -> None:
        """Refuse a column with wrong values, naming the first row that has one."""
        if wrong.any():
            raise DataError(f"{self.place(first + int(np.argmax(wrong)))}: {message}")

    def _require_scale(self, what: str, values: Array, first: int, *limit: float) -> None:
        """Refuse a column with a unit unsuitable for computation, naming the row of the largest value."""
        largest = first + int(np.nanargmax(np.abs(values)))
        require_scale(f"{self.place(largest)}: {what}", values, *limit)


@dataclass(frozen=True, eq=False)
class Table:
    """Column names of a file, of which selected columns are read."""

    file: str
    names: tuple[str, ...]
    read: Callable[[Sequence[str]], Columns]
    #: Place of the names, for messages.
    head: str
    noun: str = "column"
    hint: str = ""
    #: Whether the columns have an order, and the lines numbers.
    is_text: bool = False
    notes: tuple[str, ...] = ()
    #: Comments before the data with their line numbers.
    comments: tuple[tuple[int, str], ...] = ()

    def select(
        self, asked: Mapping[str, str | None], *, without_times: bool = False, in_seconds: bool = False
    ) -> Columns:
        """Read the column of each role: the named one, or one recognised by its name or position.

        If times must be in seconds, a time column labelled with another unit is refused unless it is selected by its
        name and unit. Without times, their column is identified but not read, and may be absent.
        """
        chosen, notes = self._choose(asked, ("time",) if without_times else ())
        if in_seconds:
            self._require_seconds(chosen["time"], asked["time"])
        read = {role: name for role, name in chosen.items() if not (without_times and role == "time")}
        columns = self.read(list(read.values()))
        values = {role: columns.values[name] for role, name in read.items()}
        columns = replace(columns, values=values, names=chosen, notes=(*self.notes, *columns.notes, *notes))
        return columns if without_times else columns.timed()

    def _choose(self, asked: Mapping[str, str | None], optional: Sequence[str]) -> tuple[dict[str, str], list[str]]:
        """Return the column of each role, and the assumptions made."""
        # A reference has no usual names: it is used only if it is named.
        roles = [role for role in asked if role in USUAL_NAMES]
        chosen = {role: self.named(wanted) for role in roles if (wanted := asked[role]) is not None}
        for role in roles:
            if role not in chosen and (name := self._recognised(role, chosen, sure=role not in optional)):
                chosen[role] = name
        notes = self._take_by_position(chosen, [role for role in roles if role in chosen or role not in optional])
        chosen |= {role: self.named(wanted) for role, wanted in asked.items() if role not in roles and wanted}
        for one, other in itertools.combinations(filter(chosen.get, asked), 2):
            if chosen[one] == chosen[other]:
                raise DataError(f"{self.head}: {chosen[one]!r} cannot be both the {one} and the {other}")
        unused = [repr(name) for name in self.names if name not in chosen.values()]
        if unused and self.is_text:
            words = ("Column", "is") if len(unused) == 1 else ("Columns", "are")
            notes.append(f"{words[0]} {listed(unused)} {words[1]} not used.")
        return chosen, notes

    def named(self, wanted: str) -> str:
        """Return the column whose header is ``wanted``, with or without its unit."""
        matching = [name for name in self.names if name == wanted]
        matching = matching or [name for name in self.names if split_header(name)[0] == wanted]
        self._require_single(matching)
        if len(matching) == 1:
            return matching[0]
        parts = [f"{self.head}: there is no {self.noun} {wanted!r}; {self._listing}"]
        if close := closest(wanted, self.names):
            parts.append(f"Did you mean {close!r}?")
        raise DataError(". ".join(filter(None, [*parts, self.hint])))

    def _recognised(self, role: str, chosen: Mapping[str, str], *, sure: bool) -> str | None:
        """Return the column with the most specific usual name of a role; if several match, the first, unless sure."""
        for usual in USUAL_NAMES[role]:
            matching = self._called((usual,), chosen)
            # Columns in the same struct as the known columns are preferred.
            homes = {name.rpartition(".")[0] for name in chosen.values()}
            close = [name for name in matching if not self.is_text and name.rpartition(".")[0] in homes]
            matching = close or matching
            self._require_single(matching if sure else ())
            if len(matching) > 1 and sure:
                several = listed(map(repr, matching))
                raise DataError(f"{self.head}: {several} may all be the {role}; say which one (option {role})")
            if matching:
                return matching[0]
        return None

    def _called(self, usual: Sequence[str], chosen: Mapping[str, str]) -> list[str]:
        """Return the unused columns with a usual name, ignoring unit and struct."""
        bare = {name: split_header(name)[0] for name in self.names if name not in chosen.values()}
        leaves = {name: text if self.is_text else text.rpartition(".")[2] for name, text in bare.items()}
        return [name for name in self.names if leaves.get(name, "").lower() in usual]

    def _take_by_position(self, chosen: dict[str, str], roles: Sequence[str]) -> list[str]:
        """Assign the remaining roles in column order, unless names contradict; return a note."""
        missing = [role for role in roles if role not in chosen]
        if not missing:
            return []
        left = [name for name in self.names if name not in chosen.values()]
        # A column with a usual name is never assigned to another role.
        contradicts = any(self._called(USUAL_NAMES[role], chosen) for role in roles)
        ordered = self.is_text or missing == ["signal"]
        if not ordered or len(self.names) != len(roles) or len(left) != len(missing) or contradicts:
            self._refuse_unrecognised(missing[0], chosen, roles)
        chosen.update(zip(missing, left, strict=True))
        taken = [f"{chosen[role]!r} as the {role}" for role in missing]
        return [f"Columns were taken by their position: {listed(taken)}."]

    def _refuse_unrecognised(self, role: str, chosen: Mapping[str, str], roles: Sequence[str]) -> NoReturn:
        if len(self.names) < len(roles) and not self.hint:
            needs = "a record needs a time, an input and an output" if "output" in roles else "a signal needs its times"
            raise DataError(f"{self.head}: {self._listing} and nothing else; {needs}")
        left = [name for name in self.names if name not in chosen.values()]
        usual = " or ".join(map(repr, USUAL_NAMES[role][:2]))
        other = "other " if self._called(USUAL_NAMES[role], {}) else ""
        close = next((match for name in USUAL_NAMES[role][1:] if (match := closest(name, left))), None)
        meant = f"; did you mean {close!r}?" if close else ""
        message = f"{self.head}: no {other}{self.noun} is called {usual}; {self._listing}"
        parts = [message, f"Say which one is the {role} (option {role}){meant}", self.hint]
        raise DataError(". ".join(filter(None, parts)))

    def _require_seconds(self, name: str, asked: str | None) -> None:
        unit = split_header(name)[1]
        if unit not in (None, "s", "sec", "seconds") and asked != name:
            wrong = f"the time {name!r} is in {unit}, and seconds are expected"
            raise DataError(f"{self.head}: {wrong}; convert the column, or name it {name!r} to count in {unit}")

    def _require_single(self, names: Sequence[str]) -> None:
        """Refuse several columns with the same name."""
        if len(names) > 1 and len(set(names)) == 1:
            raise DataError(f"{self.head}: {len(names)} columns are called {names[0]!r}; rename all but one")

    @property
    def _listing(self) -> str:
        """List of the columns of the file, for messages."""
        if not self.names:
            return f"the file has no {self.noun} of numbers"
        more = f" and {len(self.names) - MAX_NAMES} more" if len(self.names) > MAX_NAMES else ""
        return f"the file has {', '.join(map(quoted, self.names[:MAX_NAMES]))}{more}"


def split_header(header: str) -> tuple[str, str | None]:
    """Return name and unit in the header of a column: ``u [V]``, ``u (V)`` or, with a usual name, ``u/V``."""
    found = re.fullmatch(r"(.*\S)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))", header)
    if found is not None:
        name, square, round_ = found.groups()
        return name, (square or round_ or "").strip() or None
    name, slash, unit = (part.strip() for part in header.partition("/"))
    return (name, unit) if slash and unit and name.lower() in BEFORE_SLASH else (header, None)
