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
from ctid_cli.signals.array_file import HDF5, MATLAB, read_array_table
from ctid_cli.signals.checks import require_choice
from ctid_cli.signals.held import HeldSignal, Hold
from ctid_cli.signals.record import Record
from ctid_cli.signals.table import USUAL_NAMES, Columns, Role, Table, split_header
from ctid_cli.signals.text_file import read_text_table
from ctid_cli.text import closest, listed

Offset = Literal["none", "remove"]


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


def open_table(path: str | os.PathLike[str]) -> Table:
    """Open a MATLAB or HDF5 file; what has another name is text."""
    return read_array_table(path) if Path(path).suffix.lower() in MATLAB + HDF5 else read_text_table(path)


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
        A text file whose first line names the columns, or a MATLAB (``.mat``) or HDF5 (``.h5``) file of vectors.
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
    require_choice("offset", offset, get_args(Offset))
    record = read_measurement(path, time=time, input=input, output=output, hold=hold, in_seconds=True).record
    if offset == "none":
        return record
    u, y = record.input.values, record.y
    return Record(record.t, y - np.nanmean(y), HeldSignal(record.t, u - u.mean(), hold), name=record.name)


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
    in_seconds: bool = False,
) -> Measurement:
    """Read a record from a file, with its units, and the reference of its loop from another column.

    A window is read as if the file had no other lines: the input before it is not used, since the state that it
    left behind is estimated with the model where that is asked for. Where times must be in seconds, a column that is
    labelled with another unit is refused unless it is named with that unit.
    """
    require_choice("hold", hold, get_args(Hold))
    table = open_table(path)
    other = None if reference is None else table.named(reference)
    chosen, assumed = _choose(table, {"time": time, "input": input, "output": output}, other)
    unit = {role: split_header(name)[1] for role, name in chosen.items()}
    if in_seconds:
        _require_seconds(table, chosen["time"], time)
    columns = table.read([*chosen.values(), *filter(None, [other])])
    notes = [*table.notes, *columns.notes, *assumed]
    label = unit["time"] or "s"
    t = _instants(columns, chosen["time"], label, chosen["output"], notes)
    columns.require_as_many(chosen["input"], columns.values[chosen["input"]], chosen["output"])
    columns.check_times(chosen["time"], t, label)
    first, last = _window(table, t, start, stop, label)
    if last - first < t.size:
        part = f"Only the {last - first} of {t.size} samples from {t[first]:.6g} to {t[last - 1]:.6g} {label} are used"
        notes.append(f"{part}; the input before them is not.")
    t = t[first:last]
    u = columns.check_input(chosen["input"], columns.values[chosen["input"]][first:last], first)
    y = columns.check_output(chosen["output"], columns.values[chosen["output"]][first:last], first)
    record = Record(t, y, HeldSignal(t, u, hold), name=table.file)
    named = (chosen["time"], chosen["input"], chosen["output"])
    r = None
    if other is not None:
        columns.require_as_many(other, columns.values[other], chosen["output"])
        r = columns.check_input(other, columns.values[other][first:last], first, "reference")
    units = unit["time"], unit["input"], unit["output"]
    return Measurement(record, *units, *named, start, stop, tuple(notes), Path(path), other, r)


def _require_seconds(table: Table, name: str, asked: str | None) -> None:
    """Refuse times that are labelled with another unit, unless the column was named with it."""
    unit = split_header(name)[1]
    if unit not in (None, "s", "sec", "seconds") and asked != name:
        wrong = f"the time {name!r} is in {unit}, and seconds are expected"
        raise DataError(f"{table.head}: {wrong}; convert the column, or name it {name!r} to count in {unit}")


def _instants(columns: Columns, name: str, unit: str, other: str, notes: list[str]) -> Array:
    """Return the instants of another column, of which one number may be there in their place: their interval."""
    t, size = columns.values[name], columns.values[other].size
    if t.size == 1 and size > 1:
        interval = columns.lone_interval(name)
        t = interval * np.arange(size, dtype=float)
        note = f"{name!r} is one number: it was taken as the sampling interval"
        notes.append(f"{note}, {interval:g} {unit}, from 0 {unit} on.")
    columns.require_as_many(name, t, other)
    return t


def _choose(
    table: Table, asked: Mapping[Role, str | None], reference: str | None = None
) -> tuple[dict[Role, str], list[str]]:
    """The column of each role that is asked for, and what was assumed."""
    chosen = {role: table.named(wanted) for role, wanted in asked.items() if wanted is not None}
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
    if unused and table.is_text:
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
    if not table.is_text or len(table.names) != len(roles) or len(left) != len(missing) or named:
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
        close = [name for name in matching if not table.is_text and name.rpartition(".")[0] in homes]
        matching = close or matching
        table.require_single(matching)
        if len(matching) > 1:
            several = listed([repr(name) for name in matching])
            raise DataError(f"{table.head}: {several} may all be the {role}; say which one (option {role})")
        if matching:
            return matching[0]
    return None


def _refuse_unrecognised(table: Table, role: Role, chosen: Mapping[Role, str], roles: tuple[Role, ...]) -> NoReturn:
    if len(table.names) < len(roles) and not table.hint:
        needs = "a record needs a time, an input and an output" if "output" in roles else "an input needs a time too"
        raise DataError(f"{table.head}: {table.listing} and nothing else; {needs}")
    usual = " or ".join(map(repr, USUAL_NAMES[role][:2]))
    other = "other " if any(table.leaf(name).lower() in USUAL_NAMES[role] for name in chosen.values()) else ""
    message = f"{table.head}: no {other}{table.noun} is called {usual}; {table.listing}"
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
    path: str | os.PathLike[str],
    *,
    time: str | None = None,
    input: str | None = None,
    hold: Hold = "zoh",
    in_seconds: bool = False,
) -> MeasuredInput:
    """Read an input to simulate with, from a file whose other columns do not matter."""
    require_choice("hold", hold, get_args(Hold))
    table = open_table(path)
    chosen, _ = _choose(table, {"time": time, "input": input})
    if in_seconds:
        _require_seconds(table, chosen["time"], time)
    columns = table.read(list(chosen.values()))
    unit = {role: split_header(name)[1] for role, name in chosen.items()}
    label = unit["time"] or "s"
    t = columns.check_times(chosen["time"], _instants(columns, chosen["time"], label, chosen["input"], []), label)
    u = columns.check_input(chosen["input"], columns.values[chosen["input"]])
    return MeasuredInput(HeldSignal(t, u, hold), unit["time"], unit["input"])


def read_held_signal(
    path: str | os.PathLike[str], *, time: str = "t", input: str = "u", hold: Hold = "zoh"
) -> HeldSignal:
    """Read an input over seconds."""
    return read_input(path, time=time, input=input, hold=hold, in_seconds=True).signal


def read_instants(path: str | os.PathLike[str], time: str = "t") -> Array:
    """Read instants in seconds, from a file whose other columns do not matter."""
    table = open_table(path)
    name = table.named(time)
    _require_seconds(table, name, time)
    columns = table.read([name])
    return columns.check_times(name, columns.values[name])
