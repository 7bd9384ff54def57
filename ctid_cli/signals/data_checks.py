"""Checks of times, inputs and outputs; messages name the line of the file, or the sample."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError

#: Largest magnitude of a signal; its reciprocal is the smallest. Fourth powers of it do not overflow.
LARGEST = 1e60
#: Largest magnitude of times and of steps between them [s]; high powers of poles do not overflow.
LONGEST = 1e24


@dataclass(frozen=True)
class Rows:
    """Rows of data, whose places are named in messages: lines of a file, or samples."""

    name: str = ""
    lines: Sequence[int] | None = None
    #: Number of rows before the first one.
    before: int = 0

    def row(self, k: int) -> str:
        """Return the number of a row."""
        return f"sample {self.before + k + 1}" if self.lines is None else f"line {self.lines[self.before + k]}"

    def at(self, k: int) -> str:
        """Return the place of a row, as the beginning of a message."""
        if self.lines is not None:
            return f"{self.name}:{self.lines[self.before + k]}: "
        return f"{self.name}: {self.row(k)}: " if self.name else f"{self.row(k)}: "

    def after(self, count: int) -> "Rows":
        """Return the rows without the first ones."""
        return replace(self, before=self.before + count)


def check_times(t: Array, what: str, rows: Rows, unit: str = "s") -> None:
    """Refuse instants that are missing, do not increase, or are unsuitable for computation."""
    _refuse(~np.isfinite(t), f"{what} is missing or not finite; every sample needs its instant [{unit}]", rows)
    require_scale(t, what, rows, LONGEST)
    steps = np.diff(t)
    if not steps.size:
        return
    k = int(np.argmax(steps <= 0))
    if steps[k] <= 0:
        how = "repeats" if steps[k] == 0 else "goes back to"
        found = f"{how} {t[k + 1]:.12g} {unit} after {t[k]:.12g} {unit} on {rows.row(k)}"
        raise DataError(f"{rows.at(k + 1)}{what} {found}; times must increase strictly")
    k = int(np.argmin(steps))
    if steps[k] < 1.0 / LONGEST:
        least = f"give it in a unit in which it is at least {1 / LONGEST:g}"
        raise DataError(f"{rows.at(k + 1)}{what} advances by {steps[k]:.3g}; {least}")


def check_input(u: Array, what: str, rows: Rows) -> None:
    """Refuse missing values, since the system also responds to values that were not recorded."""
    _refuse(~np.isfinite(u), f"{what} is missing or not finite; only the output may have gaps", rows)
    require_scale(u, what, rows)


def check_output(y: Array, what: str, rows: Rows) -> None:
    """Refuse infinite values, and an output without any value."""
    _refuse(np.isinf(y), f"{what} is infinite; missing samples are NaN, or empty fields of a file", rows)
    if not np.isfinite(y).any():
        raise DataError(f"{rows.at(0)}no sample of {what} is a finite number")
    require_scale(y, what, rows)


def _refuse(wrong: BoolArray, message: str, rows: Rows) -> None:
    """Refuse wrong values, naming the first row that has one."""
    if wrong.any():
        raise DataError(f"{rows.at(int(np.argmax(wrong)))}{message}")


def require_scale(values: Array, what: str, rows: Rows, largest: float = LARGEST) -> None:
    """Refuse a signal whose unit makes it too small or too large for computation; zeros are allowed."""
    sizes = np.abs(values)
    found = float(np.nanmax(sizes))
    if found > largest or 0.0 < found < 1.0 / largest:
        side = f"reaches {found:.3g}" if found > largest else f"is at most {found:.3g}"
        between = f"give it in a unit in which it is between {1 / largest:g} and {largest:g}"
        raise DataError(f"{rows.at(int(np.nanargmax(sizes)))}{what} {side}; {between}")
