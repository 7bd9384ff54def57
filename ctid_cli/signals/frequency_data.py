"""Measured frequency responses as data for estimation, and reading them from tables."""

from __future__ import annotations

import math
import os
import re
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.errors import DataError
from ctid_cli.signals.checks import freeze, require_choice
from ctid_cli.signals.held import hold_factor
from ctid_cli.signals.measurement import open_table
from ctid_cli.signals.table import Table, split_header
from ctid_cli.signals.treatment import Weight

#: Column names by role; case is ignored.
NAMES: dict[str, tuple[str, ...]] = {
    "frequency": ("frequency", "frequencies", "freq", "f", "omega", "w"),
    "real": ("real", "re"),
    "imaginary": ("imaginary", "imag", "im"),
    "gain": ("gain", "magnitude", "mag", "amplitude", "gain_db", "magnitude_db", "mag_db"),
    "phase": ("phase", "angle", "phase_deg", "phase_rad"),
    "standard_error": ("standard_error", "se"),
    #: Columns of ``ctid frf``: interval of the hold that was divided out, whether lines share samples, and degrees of
    #: freedom of the standard errors.
    "hold_interval": ("hold_interval",),
    "correlated": ("correlated",),
    "freedom": ("freedom",),
}
#: Units of frequency as multiples of hertz.
HERTZ = {"hz": 1.0, "mhz": 1e-3, "khz": 1e3, "ghz": 1e9}
#: Relative tolerance by which a line may exceed half the sampling frequency.
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class FrequencyData:
    """A measured frequency response.

    Parameters
    ----------
    frequencies : array_like, shape (K,)
        Frequencies [rad/s], none below zero; lines are sorted by them.
    response : array_like of complex, shape (K,)
        Values ``G(jw)`` [output unit/input unit]; with an interval, ``Y/U`` of the sampled output and the
        sampled input, which is constant between samples.
    standard_error : array_like, shape (K,), optional
        ``sqrt(E |e|^2)`` of the error of each complex value [output unit/input unit].
    interval : float, default 0.0
        Sampling interval [s] of such values; 0 for ``G(jw)``.
    correlated : bool, default False
        Whether errors of neighbouring lines are correlated, as with local polynomials and Welch's method.
    freedom : float, default infinite
        Degrees of freedom of the complex residuals used for the standard errors, median over the lines [-];
        infinite if the standard errors are known.
    weight : {"inverse", "inverse-sqrt", "none"}, default "none"
        Factor of the errors of lines without standard errors: the reciprocal of the measured gain (relative errors),
        of its square root, or one. Weighting by a gain that is not large compared with its noise biases an
        estimate.
    name : str, default ""
        Name of the data in messages.
    units : tuple of str, default ("s", "out", "in")
        Units of time, output and input.
    notes : tuple of str, default ()
        Notes from reading the data.

    Raises
    ------
    DataError
        If the arrays differ in length or contain unusable numbers.

    Examples
    --------
    >>> import numpy as np
    >>> w = np.geomspace(0.1, 10.0, 50)
    >>> FrequencyData(w, 2.0 / (1j * w + 1.0))
    FrequencyData(50 lines from 0.1 to 10 rad/s)
    """

    frequencies: Array
    response: ComplexArray
    standard_error: Array | None = None
    interval: float = 0.0
    correlated: bool = False
    freedom: float = math.inf
    weight: Weight = "none"
    name: str = ""
    units: tuple[str, str, str] = ("s", "out", "in")
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        name = f"{self.name}: " if self.name else ""
        w, values = np.array(self.frequencies, dtype=float), np.array(self.response, dtype=complex)
        errors = None if self.standard_error is None else np.array(self.standard_error, dtype=float)
        if w.ndim != 1 or not w.size or values.shape != w.shape or (errors is not None and errors.shape != w.shape):
            raise DataError(f"{name}frequencies, values and standard errors must be lists of one length")
        rate = f"rad/{self.units[0]}"
        if not np.isfinite(w).all() or (w < 0.0).any() or not (w > 0.0).any():
            raise DataError(f"{name}frequencies must be finite numbers [{rate}], none below and some above zero")
        if not np.isfinite(values).all() or not values.any():
            raise DataError(f"{name}values must be finite complex numbers, not all zero")
        if errors is not None and not (usable := np.isfinite(errors) & (errors > 0.0)).all():
            k = int(np.argmin(usable))
            wrong = f"standard_error at {w[k]:g} {rate} is {errors[k]:g}; it must be a positive number"
            raise DataError(f"{name}{wrong}, or leave the standard errors out: lines then weigh by --weight")
        if not (np.isfinite(self.interval) and self.interval >= 0.0):
            raise DataError(f"{name}the interval must be a positive number, or 0 for G(jw); got {self.interval!r}")
        if self.interval and w.max() > (limit := np.pi / self.interval) * (1.0 + ROUNDING):
            beyond = f"{w.max():g} {rate} is beyond half the sampling frequency, {limit:g} {rate}, of values of samples"
            raise DataError(f"{name}{beyond}; leave such lines out, or correct the interval")
        require_choice("weight", self.weight, get_args(Weight))
        order = np.argsort(w, kind="stable")
        errors = None if errors is None else errors[order]
        freeze(self, frequencies=w[order], response=values[order], standard_error=errors)

    def __repr__(self) -> str:
        low, high = self.frequencies[[0, -1]]
        kind = f", sampled at intervals of {self.interval:g} {self.units[0]}" if self.interval else ""
        return f"FrequencyData({self.frequencies.size} lines from {low:g} to {high:g} rad/{self.units[0]}{kind})"


def held_data(
    frequencies: Array, response: ComplexArray, standard_error: Array, interval: float, **others: Any
) -> FrequencyData:
    """Return the values for the sampled output from a response that was divided by that of a zero-order hold."""
    factor = hold_factor("zoh", frequencies, interval)
    return FrequencyData(frequencies, response * factor, standard_error * np.abs(factor), interval, **others)


# --- reading -------------------------------------------------------------------------------------------


def is_frequency_table(path: str | os.PathLike[str]) -> bool:
    """Return whether the header of a file names columns of frequencies and complex values."""
    found = _named(open_table(path))
    return "frequency" in found and ({"real", "imaginary"} <= found.keys() or {"gain", "phase"} <= found.keys())


def read_frequency_data(
    path: str | os.PathLike[str], low: float | None = None, high: float | None = None
) -> FrequencyData:
    """Read a frequency response from a table.

    Parameters
    ----------
    path : path
        A text, MATLAB or HDF5 file with columns ``frequency`` [Hz or rad/s], and ``real`` and ``imaginary``, or
        ``gain`` [- or dB] and ``phase`` [deg or rad]; optional ``standard_error`` is the square root of ``E |e|^2`` of
        the complex value. Comments ``# hold: zoh`` and ``# interval: 0.05`` mark values of the sampled output.
    low, high : float, optional
        First and last frequency to use [unit of the file].

    Returns
    -------
    FrequencyData
        The lines; lines without a value are left out, with a note.

    Raises
    ------
    DataError
        If the file is not such a table.
    """
    table = open_table(path)
    names = _named(table)
    pair = ("real", "imaginary") if {"real", "imaginary"} <= names.keys() else ("gain", "phase")
    for role in ("frequency", *pair):
        if role not in names:
            needed = "frequency [Hz or rad/s] and real and imaginary, or gain [- or dB] and phase [deg or rad]"
            raise DataError(f"{table.head}: there is no column {role!r}; a frequency response needs {needed}")
    found = table.read(list(names.values()))
    values = {role: found.values[name] for role, name in names.items()}
    scale, time_unit = _rate(table, names["frequency"])
    w, response = values["frequency"] * scale, _complex(table, names, values, pair)
    used = np.isfinite(w) & np.isfinite(response)
    notes = [*table.notes, *found.notes]
    if lost := int(np.count_nonzero(~used)):
        notes.append(f"{lost} of {w.size} lines have no value and are left out.")
    used &= ~(values["frequency"] < (-np.inf if low is None else low))
    used &= ~(values["frequency"] > (np.inf if high is None else high))
    if not used.any():
        raise DataError(f"{table.file}: no line with a value lies between the frequencies that are given")
    output, slash, input_ = (split_header(names[pair[0]])[1] or "").rpartition("/")
    units = (time_unit, output, input_) if slash and output and input_ else (time_unit, "out", "in")
    others: dict[str, Any] = {"name": table.file, "units": units, "notes": tuple(notes)}
    others["correlated"] = bool(np.any(values.get("correlated", np.zeros(1)) == 1.0))
    others["freedom"] = float(np.median(values.get("freedom", np.full(1, np.inf))))
    interval, errors = _sampled(table, time_unit), values.get("standard_error")
    held = values.get("hold_interval", np.full(1, np.nan))
    if interval is None and errors is not None and np.isfinite(held).all():
        return held_data(w[used], response[used], errors[used], float(held[0]), **others)
    return FrequencyData(w[used], response[used], None if errors is None else errors[used], interval or 0.0, **others)


def _named(table: Table) -> dict[str, str]:
    """Return the first matching column of each role."""
    found: dict[str, str] = {}
    for name in table.names:
        bare = split_header(name)[0]
        bare = bare if table.is_text else bare.rpartition(".")[2]
        for role, usual in NAMES.items():
            if bare.strip().lower() in usual:
                found.setdefault(role, name)
    return found


def _rate(table: Table, name: str) -> tuple[float, str]:
    """Return the factor from a frequency unit to rad per unit of time, and that unit of time."""
    bare, unit = split_header(name)
    unit = (unit or "").strip()
    if unit.lower() in HERTZ:
        # Millihertz and megahertz differ only in case.
        return 2.0 * math.pi * (1e6 if unit.startswith("MH") else HERTZ[unit.lower()]), "s"
    found = re.fullmatch(r"rad(?:ians?)?\s*(?:/|per)\s*(\S+)", unit)
    if found is None:
        example = f"[Hz] or [rad/s]; write for example '{bare} [rad/s]'"
        raise DataError(f"{table.head}: the column {name!r} must have a unit, {example}")
    return 1.0, found[1]


def _complex(table: Table, names: dict[str, str], values: dict[str, Array], pair: tuple[str, str]) -> ComplexArray:
    """Return complex values from real and imaginary part, or from gain and phase with their units."""
    first, second = (values[role] for role in pair)
    if pair == ("real", "imaginary"):
        return np.asarray(first + 1j * second)
    (name, unit), (phase_name, phase_unit) = (split_header(names[role]) for role in pair)
    if name.lower().endswith("_db") or (unit or "").lower().startswith("db"):
        first = 10.0 ** (first / 20.0)
    angle = (phase_unit or phase_name.rpartition("_")[2]).lower()
    if angle.startswith(("deg", "°")):
        second = np.deg2rad(second)
    elif not angle.startswith("rad"):
        raise DataError(f"{table.head}: the column {names['phase']!r} must have a unit, [deg] or [rad]")
    return np.asarray(first * np.exp(1j * second))


def _sampled(table: Table, time_unit: str) -> float | None:
    """Return the sampling interval from the comments of a file; 0 for G(jw), None if not stated."""
    comments: dict[str, tuple[str, str]] = {}
    for line, text in table.comments:
        found = re.fullmatch(r"\s*(?:#|%|//)\s*(hold|interval)\s*[:=]\s*(.*?)\s*", text, re.IGNORECASE)
        if found:
            comments[found[1].lower()] = f"{table.file}:{line}", found[2]
    if not comments:
        return None
    place, hold = comments.get("hold", (comments.get("interval", ("",))[0], ""))
    if not hold:
        raise DataError(f"{place}: an interval needs the hold of the input too; add the line '# hold: zoh'")
    if hold.lower() in ("none", "band-limited"):
        return 0.0
    if hold.lower() != "zoh":
        raise DataError(f"{place}: hold must be zoh or none, not {hold!r}")
    if "interval" not in comments:
        raise DataError(f"{place}: hold zoh needs the sampling interval; add a line '# interval: 0.05'")
    place, text = comments["interval"]
    try:
        interval = float(text.removesuffix(time_unit))
    except ValueError:
        interval = math.nan
    if not 0.0 < interval < math.inf:
        raise DataError(f"{place}: interval must be a positive number [{time_unit}], not {text!r}")
    return interval
