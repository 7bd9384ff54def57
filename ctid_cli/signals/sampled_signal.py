"""One signal on a regular clock, from a text, MATLAB or sound file."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.signals.checks import LONGEST, require_positive, require_scale, require_steps
from ctid_cli.signals.measurement import no_sample, open_table
from ctid_cli.signals.sound import is_sound, read_sound
from ctid_cli.signals.table import USUAL_NAMES, Columns, Table, split_header

#: Names by which the signal is recognised when nobody says which column it is, the most telling first.
SIGNAL_NAMES = (
    *("y", "signal", "output", "value", "values", "x"),
    *("amplitude", "data", "audio", "sound", "wave", "voltage"),
)
#: An instant may lie so many sampling intervals beside the grid.
CLOCK_TOLERANCE = 0.01
#: A record with more samples missing between its lines than this many times those it has is not on one grid.
MOST_FILLED = 20


#: Seconds in a unit of time, by the labels that files use.
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
    """A signal on a regular clock and what is known of the file that it comes from."""

    #: Signal [signal unit]; NaN where a sample is missing, shape (N,).
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
        """The same signal with its times in seconds."""
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
    notes: list[str] = []
    if is_sound(path):
        table, rate, note = read_sound(path)
        interval = 1.0 / rate if interval is None else interval
        notes.append(note)
    else:
        table = open_table(path)
    times, column, more = _columns(table, time, signal, interval is not None)
    name, unit = split_header(column)
    clocked = interval is None and times is not None
    try:
        columns = table.read([column, *filter(None, [times if clocked else None])])
    except DataError as error:
        if not clocked:
            raise
        table.read([column])  # says what is wrong with the signal itself
        raise DataError(f"{error}; or give the clock (--interval SECONDS or --rate HERTZ)") from None
    notes += [*table.notes, *columns.notes, *more]
    values = columns.values[column]
    infinite = np.isinf(values)
    if infinite.any():
        values = np.where(infinite, np.nan, values)
    time_unit: str | None = "s"
    if interval is None and times is not None:
        time_unit = split_header(times)[1]
        clock = columns.values[times]
        if clock.size == 1 and values.size > 1:
            interval, first, time_unit = columns.lone_interval(times), 0.0, time_unit or "s"
            notes.append(f"{times!r} is one number and was taken as the sampling interval.")
        else:
            columns.require_as_many(times, clock, column)
            values, interval, note = _on_grid(columns, times, clock, values, time_unit or "s")
            first = float(clock[0])
            notes += [note] if note else []
    else:
        first = 0.0
        if times is not None:
            notes.append(f"The times {times!r} are not used, since the sampling interval was given.")
            times = None
    assert interval is not None  # every way above has set it
    require_steps(f"{table.file}: the clock", np.array([0.0, interval]))
    require_scale(f"{table.file}: the clock", np.array([interval]), LONGEST)
    low, high = _window(table, first, interval, values.size, start, stop, time_unit or "s")
    values = values[low:high]
    if not np.isfinite(values).any():
        raise DataError(f"{table.file}: no sample of {column!r} is a finite number")
    require_scale(f"{table.file}: the signal {column!r}", values)
    begin = first + low * interval
    return SampledSignal(values, interval, begin, table.file, name, times, time_unit, unit, tuple(notes))


def _columns(table: Table, time: str | None, signal: str | None, clocked: bool) -> tuple[str | None, str, list[str]]:
    """Columns of the times and of the signal, and what was assumed."""
    times = table.named(time) if time is not None else _usual(table, USUAL_NAMES["time"], signal)
    if times is None and not clocked:
        ways = "Say which one holds the times (--time), or give the clock (--interval SECONDS or --rate HERTZ)"
        raise DataError(f"{table.head}: no {table.noun} is called 't' or 'time'; {table.listing}. {ways}")
    column = table.named(signal) if signal is not None else _usual(table, SIGNAL_NAMES, times)
    left = [name for name in table.names if name != times]
    notes = []
    if column is None:
        if len(left) != 1 and table.noun != "channel":
            which = f"{table.listing}. Say which one is the signal (--signal)"
            raise DataError(f"{table.head}: no {table.noun} is called 'y' or 'signal'; {which}")
        column = left[0]
    if column == times:
        raise DataError(f"{table.head}: {column!r} cannot be both the time and the signal")
    unused = [name for name in left if name != column]
    if unused and table.is_text:
        notes.append(f"Not used: {', '.join(map(repr, unused))}.")
    return times, column, notes


def _usual(table: Table, usual: tuple[str, ...], taken: str | None) -> str | None:
    found = [name for word in usual for name in table.names if table.leaf(name).lower() == word]
    return next((name for name in found if taken not in (name, table.leaf(name))), None)


def _on_grid(columns: Columns, name: str, t: Array, values: Array, unit: str) -> tuple[Array, float, str]:
    """Samples at all instants of the grid that the times lie on, its interval, and a note on what is missing."""
    columns.check_times(name, t, unit)
    if t.size < 2:
        raise DataError(f"{columns.file}: one sample has no frequency")
    steps = np.diff(t)
    places, interval, stray = _nearest_grid(t, float(np.median(steps)))
    tolerance = 4 * np.finfo(float).eps * float(np.abs(t).max())
    worst = int(np.argmax(stray))
    if stray[worst] > CLOCK_TOLERANCE * interval + tolerance:
        # Where most neighbours of a sample are missing, the median is a multiple of the interval.
        beside = f"{t[worst]:.9g} {unit} lies {stray[worst]:.3g} {unit} beside a grid of {interval:.6g} {unit}"
        places, interval, stray = _nearest_grid(t, float(steps.min()))
        if not stray.max() <= CLOCK_TOLERANCE * interval + tolerance:
            ways = "Resample the record, or give its clock (--interval or --rate) if its times are only rounded"
            raise DataError(f"{columns.place(worst)}: the clock is not regular: {beside}. {ways}")
    if places[-1] > MOST_FILLED * t.size:
        some = f"of {places[-1] + 1:.6g} instants of a clock of {interval:.6g} {unit} the file has only {t.size}"
        raise DataError(f"{columns.file}: {some}; use a part with fewer gaps (--from, --to), or resample the record")
    if places[-1] + 1 == t.size:
        return values, interval, ""
    filled = np.full(int(places[-1]) + 1, np.nan)
    filled[places.astype(np.int64)] = values
    return filled, interval, f"The times leave out {filled.size - t.size} instants of the clock; they count as missing."


def _nearest_grid(t: Array, usual: float) -> tuple[Array, float, Array]:
    """Place of each instant on a grid of about this interval, its interval, and how far each lies beside it."""
    places = np.concatenate(([0.0], np.cumsum(np.maximum(1.0, np.round(np.diff(t) / usual)))))
    # The grid that fits all instants best in the sense of its two ends.
    interval = float((t[-1] - t[0]) / places[-1])
    return places, interval, np.abs(t - (t[0] + places * interval))


def _window(
    table: Table, first: float, interval: float, count: int, start: float | None, stop: float | None, unit: str
) -> tuple[int, int]:
    low = 0 if start is None else int(np.ceil(np.clip((start - first) / interval - 1e-6, 0.0, count)))
    high = count if stop is None else int(np.floor(np.clip((stop - first) / interval + 1e-6, -1.0, count - 1))) + 1
    if low >= high:
        window = (-np.inf if start is None else start, np.inf if stop is None else stop)
        raise no_sample(table, *window, first, first + (count - 1) * interval, unit)
    return low, high
