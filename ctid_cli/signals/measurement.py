"""Measured records with the source columns, their units, and the assumptions made in reading them."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.signals.array_file import HDF5, MATLAB, read_array_table
from ctid_cli.signals.checks import require_choice
from ctid_cli.signals.held import HeldSignal, Hold
from ctid_cli.signals.record import Record
from ctid_cli.signals.table import ROLES, Table, split_header
from ctid_cli.signals.text_file import read_text_table

Offset = Literal["none", "remove"]
#: Separator between the units of several inputs.
SEPARATOR = ", "


@dataclass(frozen=True)
class Measurement:
    """A record with metadata of its file."""

    record: Record
    time_unit: str | None
    input_unit: str | None
    output_unit: str | None
    time: str
    input: str
    output: str
    #: Requested window [time unit].
    start: float | None = None
    stop: float | None = None
    notes: tuple[str, ...] = ()
    #: File of the record; None if it is not from a file.
    path: Path | None = None
    #: Reference column of its loop, and its samples.
    reference: str | None = None
    reference_values: Array | None = None
    #: Columns of all inputs if there are several; then ``input_unit`` has their units separated by commas.
    inputs: tuple[str, ...] = ()

    @classmethod
    def of(cls, record: Record) -> "Measurement":
        """Return a measurement of a record without metadata."""
        several = tuple(record.held) if record.several else ()
        return cls(record, None, None, None, "t", next(iter(record.held)), "y", inputs=several)

    @property
    def columns(self) -> str | list[str]:
        """Column of the input, or of each of several."""
        return list(self.inputs) or self.input


def open_table(path: str | os.PathLike[str]) -> Table:
    """Open a MATLAB or HDF5 file by its suffix; any other file as text."""
    return read_array_table(path) if Path(path).suffix.lower() in MATLAB + HDF5 else read_text_table(path)


def read_record(
    path: str | os.PathLike[str],
    *,
    time: str = "t",
    input: str = "u",
    output: str = "y",
    hold: Hold | None = None,
    offset: Offset = "none",
) -> Record:
    """Read a record from a file with one line per instant.

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
    hold : {"zoh", "foh", "band-limited"}, optional
        Interpolation of the input between its samples; as in :meth:`Record.from_arrays` if it is not given.
    offset : {"none", "remove"}, default "none"
        ``remove`` subtracts the means of the input and of the present output samples.

    Returns
    -------
    Record
        The record; its name is `path`.

    Raises
    ------
    DataError
        If the file cannot be used; the message names the file, the line and the remedy.
    """
    require_choice("offset", offset, get_args(Offset))
    record = read_measurement(path, time=time, input=input, output=output, hold=hold, in_seconds=True).record
    if offset == "none":
        return record
    u, y = record.input.values, record.y
    return Record(record.t, y - np.nanmean(y), replace(record.input, values=u - u.mean()), name=record.name)


def read_measurement(
    path: str | os.PathLike[str],
    *,
    time: str | None = None,
    input: str | Sequence[str] | None = None,
    output: str | None = None,
    hold: Hold | Sequence[Hold] | None = None,
    start: float | None = None,
    stop: float | None = None,
    reference: str | None = None,
    in_seconds: bool = False,
) -> Measurement:
    """Read a record from a file with its units, and optionally the reference of its loop.

    Lines outside a window are ignored, including the earlier input, whose effect is an initial state that can be
    estimated with the model. If times must be in seconds, a time column labelled with another unit is refused unless
    it is selected by its name including the unit. Several inputs are named by their columns, and may have different
    holds.
    """
    several = [input] if input is None or isinstance(input, str) else list(input)
    holds = [hold or "zoh"] * len(several) if isinstance(hold, str | None) else hold
    for one in holds:
        require_choice("hold", one, get_args(Hold))
    roles = ["input", *(f"input {k}" for k in range(2, len(several) + 1))]
    wanted = {"time": time, "input": several[0], "output": output, **dict(zip(roles, several, strict=True))}
    columns = open_table(path).select({**wanted, "reference": reference}, in_seconds=in_seconds)
    t, file, notes = columns.values["time"], columns.rows.name, columns.notes
    used = columns.window(t, start, stop)
    if (count := used.stop - used.start) < t.size:
        span = f"from {t[used.start]:.6g} to {t[used.stop - 1]:.6g} {columns.time_unit}"
        part = f"Only the {count} of {t.size} samples {span} are used; the input before them is not."
        notes = (*notes, part)
    names = [split_header(columns.names[role])[0] for role in roles]
    if len(set(names)) < len(names):
        raise DataError(f"{file}: each input needs a name of its own; these are {', '.join(names)}")
    inputs: dict[str, Any] = {
        name: HeldSignal(t[used], columns.input(used, role), own, assumed=hold is None)
        for name, role, own in zip(names, roles, holds, strict=True)
    }
    only_one = len(inputs) == 1
    record = Record(t[used], columns.output(used), inputs[names[0]] if only_one else inputs, name=file)
    known: dict[str, Any] = {role: columns.names[role] for role in ROLES}
    known |= {f"{role}_unit": columns.unit(role) for role in ROLES}
    if not only_one:
        units = [columns.unit(role) for role in roles]
        known["input_unit"] = SEPARATOR.join(unit or "in" for unit in units) if any(units) else None
        known["inputs"] = tuple(columns.names[role] for role in roles)
    if reference is not None:
        known |= {"reference": columns.names["reference"], "reference_values": columns.input(used, "reference")}
    return Measurement(record, **known, start=start, stop=stop, notes=notes, path=Path(path))


def read_held_signal(
    path: str | os.PathLike[str], *, time: str = "t", input: str = "u", hold: Hold = "zoh"
) -> HeldSignal:
    """Read an input, with times in seconds, ignoring the other columns of a file."""
    require_choice("hold", hold, get_args(Hold))
    columns = open_table(path).select({"time": time, "input": input}, in_seconds=True)
    return HeldSignal(columns.values["time"], columns.input(), hold)


def read_instants(path: str | os.PathLike[str], time: str = "t") -> Array:
    """Read instants in seconds, ignoring the other columns of a file."""
    return open_table(path).select({"time": time}, in_seconds=True).values["time"]
