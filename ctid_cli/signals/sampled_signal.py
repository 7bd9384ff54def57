"""A signal on a regular clock, from a text, MATLAB or sound file."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.signals.checks import require_positive
from ctid_cli.signals.data_checks import LONGEST, Rows, check_output, require_scale
from ctid_cli.signals.measurement import open_table
from ctid_cli.signals.sound import is_sound, read_sound
from ctid_cli.signals.table import Columns, Table, split_header

#: Largest distance of an instant from the grid, in sampling intervals.
CLOCK_TOLERANCE = 0.01
#: Largest ratio of the number of grid instants to the number of samples in the file.
MOST_FILLED = 20


#: Seconds per unit of time, by the unit labels in files.
SECONDS = {
    **dict.fromkeys(("s", "sec", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "μs", "microsecond", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nanosecond", "nanoseconds"), 1e-9),
    **dict.fromkeys(("min", "minute", "minutes"), 60.0),
    **dict.fromkeys(("h", "hr", "hour", "hours"), 3600.0),
    **dict.fromkeys(("d", "day", "days"), 86400.0),
}


@dataclass(frozen=True, eq=False)
class SampledSignal:
    """A signal on a regular clock with metadata of its file."""

    #: Signal [signal unit]; NaN for missing samples, shape (N,).
    samples: Array
    #: Sampling interval [time unit].
    interval: float
    #: Instant of the first sample [time unit].
    start: float
    file: str
    column: str
    time: str | None
    time_unit: str | None
    unit: str | None
    notes: tuple[str, ...] = ()

    @property
    def missing(self) -> int:
        """Number of missing samples."""
        return int(np.count_nonzero(~np.isfinite(self.samples)))

    def in_seconds(self) -> SampledSignal:
        """Return the signal with its times in seconds."""
        unit = self.time_unit or "s"
        if unit not in SECONDS:
            unknown = f"{self.file}: the unit of time, {unit!r}, is not known, so there is no frequency in Hz"
            raise DataError(f"{unknown}; give the clock with --interval SECONDS or --rate HERTZ")
        factor = SECONDS[unit]
        return replace(self, interval=factor * self.interval, start=factor * self.start, time_unit="s")


def read_sampled_signal(
    path: str | os.PathLike[str],
    *,
    time: str | None = None,
    signal: str | None = None,
    interval: float | None = None,
    start: float | None = None,
    stop: float | None = None,
) -> SampledSignal:
    """Read a signal from a text, MATLAB, HDF5 or sound file."""
    if interval is not None:
        require_positive("interval", interval, "s")
    if is_sound(path):
        table, rate = read_sound(path)
        interval, signal = interval or 1.0 / rate, signal or table.names[0]
    else:
        table = open_table(path)
    columns = _selected(table, {"time": time, "signal": signal}, without_times=interval is not None)
    values, notes, first = columns.values["signal"], list(columns.notes), 0.0
    times: str | None = columns.names.get("time")
    time_unit: str | None = "s"
    if interval is None:
        time_unit, first = columns.unit("time"), float(columns.values["time"][0])
        values, interval, missing = _on_grid(columns, values)
        notes += missing
    elif times is not None:
        notes.append(f"The times {times!r} are not used, since the sampling interval was given.")
        times = None
    require_scale(np.array([interval]), "the clock", Rows(table.file), LONGEST)
    used = slice(0, values.size)
    if start is not None or stop is not None:
        instants = first + interval * np.arange(values.size, dtype=float)
        used = columns.window(instants, start, stop, 1e-6 * interval)
    values = np.where(np.isinf(values), np.nan, values)[used]
    column = columns.names["signal"]
    check_output(values, f"signal {column!r}", Rows(table.file, before=used.start))
    name, unit = split_header(column)
    begin = first + used.start * interval
    return SampledSignal(values, interval, begin, table.file, name, times, time_unit, unit, tuple(notes))


def _selected(table: Table, wanted: dict[str, str | None], *, without_times: bool) -> Columns:
    """Read the signal, and its times unless they are given otherwise."""
    try:
        return table.select(wanted, without_times=without_times)
    except DataError as error:
        if without_times:
            raise
        table.select({**wanted, "time": None}, without_times=True)  # raises if the signal itself is wrong
        raise DataError(f"{error}; or give the clock (--interval SECONDS or --rate HERTZ)") from None


def _on_grid(columns: Columns, values: Array) -> tuple[Array, float, list[str]]:
    """Return samples at all instants of the grid of the times, its interval, and notes on missing samples."""
    t, unit, file = columns.values["time"], columns.time_unit, columns.rows.name
    if t.size < 2:
        raise DataError(f"{file}: one sample has no frequency")
    steps = np.diff(t)
    places, interval, distance = _nearest_grid(t, float(np.median(steps)))
    tolerance = 4 * np.finfo(float).eps * float(np.abs(t).max())
    worst = int(np.argmax(distance))
    if distance[worst] > CLOCK_TOLERANCE * interval + tolerance:
        off = f"{t[worst]:.9g} {unit} is {distance[worst]:.3g} {unit} off a grid of {interval:.6g} {unit}"
        # If most neighbours of a sample are missing, the median is a multiple of the interval.
        places, interval, distance = _nearest_grid(t, float(steps.min()))
        if not distance.max() <= CLOCK_TOLERANCE * interval + tolerance:
            ways = "Resample the record, or give its clock (--interval or --rate) if its times are only rounded"
            raise DataError(f"{columns.rows.at(worst)}the clock is not regular: {off}. {ways}")
    count = int(places[-1]) + 1
    if count > MOST_FILLED * t.size:
        some = f"of {count} instants of a clock of {interval:.6g} {unit} the file has only {t.size}"
        raise DataError(f"{file}: {some}; use a part with fewer gaps (--from, --to), or resample the record")
    if count == t.size:
        return values, interval, []
    filled = np.full(count, np.nan)
    filled[places.astype(np.int64)] = values
    return filled, interval, [f"The times leave out {count - t.size} instants of the clock; they count as missing."]


def _nearest_grid(t: Array, usual: float) -> tuple[Array, float, Array]:
    """Return grid places of the instants, the grid interval near a given one, and distances from the grid."""
    places = np.concatenate(([0.0], np.cumsum(np.maximum(1.0, np.round(np.diff(t) / usual)))))
    # This grid contains the first and the last instant.
    interval = float((t[-1] - t[0]) / places[-1])
    return places, interval, np.abs(t - (t[0] + places * interval))
