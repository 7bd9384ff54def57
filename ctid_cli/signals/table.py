"""Named columns of numbers from any kind of file, and their roles in a record or a signal."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal, NamedTuple, get_args

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.signals.data_checks import Rows, check_input, check_output, check_times
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
#: Layout of text files.
LAYOUT = "The first line that is no comment must name the columns, separated by commas, semicolons, tabs or blanks"
#: Names after which a slash precedes the unit; in other names the slash is part of the name.
BEFORE_SLASH = {name for role in ROLES for name in USUAL_NAMES[role]}


class Found(NamedTuple):
    """Columns by name, the places of their rows, and notes."""

    values: Mapping[str, Array]
    rows: Rows
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns by role."""

    rows: Rows
    values: Mapping[str, Array]
    #: Column names by role, including a time column that is not read.
    names: Mapping[str, str]
    notes: tuple[str, ...]

    def unit(self, role: str) -> str | None:
        """Return the unit in the header of a column."""
        return split_header(self.names[role])[1]

    @property
    def time_unit(self) -> str:
        """Unit of the times, seconds if it is unknown."""
        return (self.unit("time") if "time" in self.names else None) or "s"

    def timed(self) -> "Columns":
        """Return the columns with an instant for each row; a single number in the time column is the interval."""
        main = next(role for role in ("output", "signal", "input", "time") if role in self.values)
        t, size = self.values["time"], self.values[main].size
        name, unit, found = self.names["time"], self.time_unit, self
        if t.size == 1 < size:
            interval = float(t[0])
            if not (np.isfinite(interval) and interval > 0):
                raise DataError(
                    f"{self.rows.name}: {name!r} is {interval:g}; a sampling interval must be a positive number"
                )
            taken = f"{name!r} is one number: it was taken as the sampling interval"
            note = f"{taken}, {interval:g} {unit}, from 0 {unit} on."
            times = interval * np.arange(size, dtype=float)
            found = replace(self, values={**self.values, "time": times}, notes=(*self.notes, note))
        for role, values in found.values.items():
            if values.size != size:
                sizes = f"{self.names[role]!r} has {values.size} values and {self.names[main]!r} has {size}"
                raise DataError(f"{self.rows.name}: {sizes}; they must be equally many")
        check_times(found.values["time"], f"time {name!r}", self.rows, unit)
        return found

    def input(self, used: slice = slice(0, None), role: str = "input") -> Array:
        """Return the checked values of an input."""
        u = self.values[role][used]
        check_input(u, f"{role} {self.names[role]!r}", self.rows.after(used.start))
        return u

    def output(self, used: slice) -> Array:
        """Return the checked values of the output."""
        y = self.values["output"][used]
        check_output(y, f"output {self.names['output']!r}", self.rows.after(used.start))
        return y

    def window(self, t: Array, start: float | None, stop: float | None, slack: float = 0.0) -> slice:
        """Return the rows between two instants, with a tolerance."""
        low, high = -np.inf if start is None else start, np.inf if stop is None else stop
        unit, file = self.time_unit, self.rows.name
        if not low < high:
            raise DataError(f"{file}: the window from {low:g} to {high:g} {unit} ends before it begins")
        first = int(np.searchsorted(t, low - slack, side="left"))
        last = int(np.searchsorted(t, high + slack, side="right"))
        if first >= last:
            runs = f"the record runs from {t[0]:.9g} to {t[-1]:.9g} {unit}"
            where = f"between {low:g} and {high:g}" if np.isfinite([low, high]).all() else f"after {low:g}"
            where = f"before {high:g}" if np.isinf(low) else where
            raise DataError(f"{file}: no sample lies {where} {unit}; {runs}")
        return slice(first, last)


@dataclass(frozen=True, eq=False)
class Table:
    """Column names of a file, of which selected columns are read."""

    file: str
    names: tuple[str, ...]
    read: Callable[[Sequence[str]], Found]
    #: Place of the names, for messages.
    head: str
    noun: str = "column"
    #: Advice if a column is not found.
    hint: str = ""
    #: Whether the columns have an order, and the lines numbers.
    is_text: bool = False
    notes: tuple[str, ...] = ()
    #: Comments before the data with their line numbers.
    comments: tuple[tuple[int, str], ...] = ()

    def select(
        self, wanted: Mapping[str, str | None], *, without_times: bool = False, in_seconds: bool = False
    ) -> Columns:
        """Read the column of each role: the named one, or one recognised by its name or position.

        If times must be in seconds, a time column labelled with another unit is refused unless it is selected by its
        name and unit. Without times, their column is identified but not read, and may be absent.
        """
        chosen, notes = self._choose(wanted, "time" if without_times else "")
        if in_seconds:
            self._require_seconds(chosen["time"], wanted["time"])
        used = {role: name for role, name in chosen.items() if not (without_times and role == "time")}
        for one, other in combinations(chosen, 2):
            if chosen[one] == chosen[other]:
                raise DataError(f"{self.head}: {chosen[one]!r} cannot be both the {one} and the {other}")
        for name in used.values():
            if self.names.count(name) > 1:
                raise DataError(
                    f"{self.head}: {self.names.count(name)} columns are called {name!r}; rename all but one"
                )
        found = self.read(list(used.values()))
        values = {role: found.values[name] for role, name in used.items()}
        columns = Columns(found.rows, values, chosen, (*self.notes, *found.notes, *notes))
        if without_times:
            return columns
        try:
            return columns.timed()
        except DataError as error:
            if wanted["time"] is not None or self._called(USUAL_NAMES["time"], {}):
                raise
            guess = f"{chosen['time']!r} was taken as the time by its position"
            raise DataError(f"{error}. {guess}; if it is not, name the right one (option time, --time NAME)") from None

    def _choose(self, wanted: Mapping[str, str | None], optional: str) -> tuple[dict[str, str], list[str]]:
        """Return the column of each role, and the assumptions made."""
        named = {role: self.named(name) for role, name in wanted.items() if name is not None}
        # Other roles, such as a reference, have no usual names.
        roles = [role for role in wanted if role in USUAL_NAMES]
        chosen, notes = {role: named[role] for role in roles if role in named}, []
        for role in roles:
            if role in chosen:
                continue
            matching = self._called(USUAL_NAMES[role], chosen)
            if len(matching) > 1 and role != optional:
                several = listed(map(repr, matching))
                raise DataError(
                    f"{self.head}: {several} may all be the {role}; say which one (option {role}, --{role} NAME)"
                )
            if matching:
                chosen[role] = matching[0]
        if missing := [role for role in roles if role not in chosen and role != optional]:
            left = [name for name in self.names if name not in chosen.values()]
            known = len([role for role in roles if role in chosen or role != optional])
            # A column with a usual name is never assigned to another role.
            contradicts = any(self._called(USUAL_NAMES[role], chosen) for role in roles)
            ordered = self.is_text or missing == ["signal"]
            if not ordered or len(self.names) != known or len(left) != len(missing) or contradicts:
                raise self._unrecognised(missing[0], left, roles)
            chosen.update(zip(missing, left, strict=True))
            taken = listed(f"{chosen[role]!r} as the {role}" for role in missing)
            notes.append(f"Columns were taken by their position: {taken}.")
        chosen |= named
        unused = [repr(name) for name in self.names if name not in chosen.values()]
        if unused and self.is_text:
            what, verb = ("Column", "is") if len(unused) == 1 else ("Columns", "are")
            notes.append(f"{what} {listed(unused)} {verb} not used.")
        return chosen, notes

    def named(self, wanted: str) -> str:
        """Return the column whose header is ``wanted``, with or without its unit."""
        if wanted in self.names:
            return wanted
        matching = list(dict.fromkeys(name for name in self.names if split_header(name)[0] == wanted))
        if len(matching) == 1:
            return matching[0]
        if matching:
            several = listed(map(repr, matching))
            raise DataError(f"{self.head}: {several} are all called {wanted!r}; give the name with its unit")
        raise self._error(f"there is no {self.noun} {wanted!r}; {self._listing}", closest(wanted, self.names))

    def _called(self, usual: Sequence[str], chosen: Mapping[str, str]) -> list[str]:
        """Return the unused columns with the most specific of some names, ignoring case, unit and struct."""
        structs = {name.rpartition(".")[0] for name in chosen.values()}
        bare = {name: split_header(name)[0] for name in self.names}
        if not self.is_text:
            bare = {name: text.rpartition(".")[2] for name, text in bare.items()}
        for wanted in usual:
            matching = [name for name in bare if name not in chosen.values() and bare[name].lower() == wanted]
            # Columns in the same struct as the known columns are preferred.
            near = [name for name in matching if not self.is_text and name.rpartition(".")[0] in structs]
            if matching:
                return near or matching
        return []

    def _unrecognised(self, role: str, left: Sequence[str], roles: Sequence[str]) -> DataError:
        """Return the error about a role without a column."""
        if len(self.names) < len(roles):
            needs = "a record needs a time, an input and an output" if "output" in roles else "a signal needs its times"
            layout = f". {LAYOUT}" if self.is_text else ""
            return self._error(f"{self._listing} and nothing else; {needs}{layout}", None)
        usual = " or ".join(map(repr, USUAL_NAMES[role][:2]))
        other = "other " if self._called(USUAL_NAMES[role], {}) else ""
        close = next((match for name in USUAL_NAMES[role][1:] if (match := closest(name, left))), None)
        found = f"no {other}{self.noun} is called {usual}; {self._listing}"
        return self._error(f"{found}. Say which one is the {role} (option {role}, --{role} NAME)", close)

    def _error(self, problem: str, close: str | None) -> DataError:
        """Return the error about a column that is not found."""
        suggestion = f"Did you mean {close!r}?" if close else ""
        return DataError(". ".join(filter(None, [f"{self.head}: {problem}", suggestion, self.hint])))

    def _require_seconds(self, name: str, wanted: str | None) -> None:
        unit = split_header(name)[1]
        if unit not in (None, "s", "sec", "seconds") and wanted != name:
            wrong = f"the time {name!r} is in {unit}, and seconds are expected"
            raise DataError(f"{self.head}: {wrong}; convert the column, or name it {name!r} to count in {unit}")

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
