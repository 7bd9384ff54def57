"""A measured record as it is: which columns it comes from, their units, and what was assumed in reading it."""

import itertools
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NoReturn, get_args

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.signals.checks import require_choice
from ctid_cli.signals.csv_file import read_csv_table
from ctid_cli.signals.held import HeldSignal, Hold
from ctid_cli.signals.mat_file import read_mat_table
from ctid_cli.signals.record import Record
from ctid_cli.signals.table import Table, listing, refuse_nameless, refuse_one_column, split_header
from ctid_cli.text import closest, listed

Role = Literal["time", "input", "output"]

ROLES: tuple[Role, ...] = get_args(Role)

#: Names by which a column is recognised when nobody says which one it is, the most telling first; case is ignored.
USUAL_NAMES: dict[Role, tuple[str, ...]] = {
    "time": ("t", "time", "times", "seconds", "timestamp", "samplinginstants", "ts", "sampletime"),
    "input": ("u", "input", "inputs", "inputdata"),
    "output": ("y", "output", "outputs", "outputdata"),
}
#: How the names of files that hold text end.
TEXT_EXTENSIONS = (".csv", ".txt", ".dat", "")


@dataclass(frozen=True)
class Measurement:
    """A record and what is known of the file that it comes from."""

    record: Record
    time_unit: str | None
    input_unit: str | None
    output_unit: str | None
    time: str
    input: str
    output: str
    #: The window that was asked for [time unit].
    start: float | None = None
    stop: float | None = None
    notes: tuple[str, ...] = ()
    #: Its file; None for a record that comes from none.
    path: Path | None = None
    #: Column of the reference of its loop, and its samples.
    reference: str | None = None
    reference_values: Array | None = None

    @classmethod
    def of(cls, record: Record) -> "Measurement":
        """A record of which nothing else is known."""
        return cls(record, None, None, None, "t", "u", "y")

    def label(self, role: Role, unit: str) -> str:
        """Name of a column, with a unit, whether or not its header has one too."""
        return f"{split_header(str(getattr(self, role)))[0]} [{unit}]"


def read_measurement(
    path: str | os.PathLike[str],
    *,
    time: str | None = None,
    input: str | None = None,
    output: str | None = None,
    hold: Hold = "zoh",
    start: float | None = None,
    stop: float | None = None,
    reference: str | None = None,
) -> Measurement:
    """Record from a comma-separated or MATLAB file, with its units, and the reference of its loop from another column.

    A window is read as if the file had no other lines: the input before it is not used, since the state that it
    left behind is estimated with the model where that is asked for.
    """
    require_choice("hold", hold, get_args(Hold))
    cure = "export the record as comma-separated text (.csv) whose first line names the columns, or from MATLAB as"
    table = read_table(path, f"{cure} vectors (.mat)")
    other = None if reference is None else table.named(reference)
    columns, notes = _choose(table, {"time": time, "input": input, "output": output}, other)
    unit = {role: split_header(name)[1] for role, name in columns.items()}
    u, y = table.numbers(columns["input"]), table.numbers(columns["output"])
    label = unit["time"] or "s"
    t = _instants(table, columns["time"], label, columns["output"], y, notes)
    table.require_as_many(columns["input"], u, columns["output"], y)
    table.check_times(columns["time"], t, label)
    first, last = _window(table, t, start, stop, label)
    if last - first < t.size:
        part = f"Only the {last - first} of {t.size} samples from {t[first]:.6g} to {t[last - 1]:.6g} {label} are used"
        notes.append(f"{part}; the input before them is not.")
    whole, t = y, t[first:last]
    u = table.check_input(columns["input"], u[first:last], first)
    y = table.check_output(columns["output"], y[first:last], first)
    record = Record(t, y, HeldSignal(t, u, hold), name=table.file)
    named = (columns["time"], columns["input"], columns["output"])
    r = None
    if other is not None:
        r = table.numbers(other)
        table.require_as_many(other, r, columns["output"], whole)
        r = table.check_input(other, r[first:last], first, "reference")
    units = unit["time"], unit["input"], unit["output"]
    return Measurement(record, *units, *named, start, stop, tuple(notes), Path(path), other, r)


def read_table(path: str | os.PathLike[str], otherwise: str) -> Table:
    """Columns of a comma-separated or MATLAB file; ``otherwise`` is the advice for all others."""
    extension = Path(path).suffix.lower()
    if extension == ".mat":
        return read_mat_table(path)
    if extension in TEXT_EXTENSIONS:
        return read_csv_table(path)
    raise DataError(f"{os.fspath(path)}: files ending in {extension} are not read; {otherwise}")


def _instants(table: Table, name: str, unit: str, other: str, others: Array, notes: list[str]) -> Array:
    """The instants of another column, of which one number may be there in their place: their interval."""
    t = table.numbers(name)
    if t.size == 1 and others.size > 1:
        interval = table.lone_interval(name, float(t[0]))
        t = interval * np.arange(others.size, dtype=float)
        note = f"{name!r} is one number: it was taken as the sampling interval"
        notes.append(f"{note}, {interval:g} {unit}, from 0 {unit} on.")
    table.require_as_many(name, t, other, others)
    return t


def _choose(
    table: Table, asked: Mapping[Role, str | None], reference: str | None = None
) -> tuple[dict[Role, str], list[str]]:
    """The column of each role that is asked for, and what was assumed."""
    chosen = {role: table.named(wanted) for role, wanted in asked.items() if wanted is not None}
    refuse_nameless(table)
    for role in asked:
        if role not in chosen and (found := _recognised(table, role, chosen)) is not None:
            chosen[role] = found
    notes = _take_by_position(table, chosen, tuple(asked))
    for one, other in itertools.combinations(asked, 2):
        if chosen[one] == chosen[other]:
            raise DataError(f"{table.head}: {chosen[one]!r} cannot be both the {one} and the {other}")
    for role, name in chosen.items():
        if name == reference:
            raise DataError(f"{table.head}: {name!r} cannot be both the {role} and the reference")
    unused = [repr(name) for name in table.names if name not in (*chosen.values(), reference)]
    if unused and table.lines is not None:
        words = ("Column", "is") if len(unused) == 1 else ("Columns", "are")
        notes.append(f"{words[0]} {listed(unused)} {words[1]} not used.")
    return chosen, notes


def _take_by_position(table: Table, chosen: dict[Role, str], roles: tuple[Role, ...]) -> list[str]:
    """Take the columns of the roles that are still open in their order, where no name contradicts; say so."""
    missing = [role for role in roles if role not in chosen]
    if not missing:
        return []
    left = [name for name in table.names if name not in chosen.values()]
    # A column with a usual name is not put in another place than its name says.
    named = any(table.leaf(name).lower() in USUAL_NAMES[role] for name in left for role in roles)
    if table.lines is None or len(table.names) != len(roles) or len(left) != len(missing) or named:
        _refuse_unrecognised(table, missing[0], chosen, roles)
    chosen.update(zip(missing, left, strict=True))
    taken = [f"{chosen[role]!r} as the {role}" for role in missing]
    return [f"Columns were taken by their position: {listed(taken)}."]


def _recognised(table: Table, role: Role, chosen: Mapping[Role, str]) -> str | None:
    """The column with the most telling of the usual names of a role."""
    homes = {name.rpartition(".")[0] for name in chosen.values()}
    candidates = [name for name in table.names if name not in chosen.values()]
    for usual in USUAL_NAMES[role]:
        matching = [name for name in candidates if table.leaf(name).lower() == usual]
        # What lies in the same struct as the columns that are known belongs to them.
        close = [name for name in matching if table.lines is None and name.rpartition(".")[0] in homes]
        matching = close or matching
        if len(matching) > 1:
            several = listed([repr(name) for name in matching])
            raise DataError(f"{table.head}: {several} may all be the {role}; say which one (option {role})")
        if matching:
            return matching[0]
    return None


def _refuse_unrecognised(table: Table, role: Role, chosen: Mapping[Role, str], roles: tuple[Role, ...]) -> NoReturn:
    refuse_one_column(table)
    if len(table.names) < len(roles) and not table.hint:
        needs = "a record needs a time, an input and an output" if "output" in roles else "an input needs a time too"
        raise DataError(f"{table.head}: {listing(table)} and nothing else; {needs}")
    usual = " or ".join(map(repr, USUAL_NAMES[role][:2]))
    other = "other " if any(table.leaf(name).lower() in USUAL_NAMES[role] for name in chosen.values()) else ""
    message = f"{table.head}: no {other}{table.noun} is called {usual}; {listing(table)}"
    close = next((match for name in USUAL_NAMES[role][1:] if (match := closest(name, table.names))), None)
    meant = f"; did you mean {close!r}?" if close else ""
    parts = [message, f"Say which one is the {role} (option {role}){meant}", table.hint]
    raise DataError(". ".join(filter(None, parts)))


def _window(table: Table, t: Array, start: float | None, stop: float | None, unit: str) -> tuple[int, int]:
    """First row of the window and the first after it."""
    low = -np.inf if start is None else start
    high = np.inf if stop is None else stop
    if not low < high:
        raise DataError(f"{table.file}: the window from {low:g} to {high:g} {unit} ends before it begins")
    first = int(np.searchsorted(t, low, side="left"))
    last = int(np.searchsorted(t, high, side="right"))
    if first >= last:
        raise no_sample(table, low, high, float(t[0]), float(t[-1]), unit)
    return first, last


def no_sample(table: Table, low: float, high: float, begin: float, end: float, unit: str) -> DataError:
    """The error for a window without a sample."""
    where = f"between {low:g} and {high:g} {unit}"
    if np.isinf(high):
        where = f"after {low:g} {unit}"
    elif np.isinf(low):
        where = f"before {high:g} {unit}"
    runs = f"the record runs from {begin:.9g} to {end:.9g} {unit}"
    return DataError(f"{table.file}: no sample lies {where}; {runs}")


@dataclass(frozen=True)
class MeasuredInput:
    """An input without an output, and the units of its file."""

    signal: HeldSignal
    time_unit: str | None
    input_unit: str | None


def read_input(
    path: str | os.PathLike[str], *, time: str | None = None, input: str | None = None, hold: Hold = "zoh"
) -> MeasuredInput:
    """An input to simulate with, from a file whose other columns do not matter."""
    require_choice("hold", hold, get_args(Hold))
    table = read_table(path, "export the input as comma-separated text (.csv) whose first line names the columns")
    chosen, _ = _choose(table, {"time": time, "input": input})
    unit = {role: split_header(name)[1] for role, name in chosen.items()}
    u, label = table.numbers(chosen["input"]), unit["time"] or "s"
    t = table.check_times(chosen["time"], _instants(table, chosen["time"], label, chosen["input"], u, []), label)
    return MeasuredInput(HeldSignal(t, table.check_input(chosen["input"], u), hold), unit["time"], unit["input"])
