"""Preparation of measured records: outliers, levels and means, parts, and periods."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.estimation.optimum.best_model import most_active
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.inference.signal_features import input_moves, outliers
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record, beginning, named
from ctid_cli.signals.treatment import InputBefore

#: Inputs are collinear if a combination of them, each scaled to length one, is shorter than the first number; inputs
#: with a larger share in it than the second are named.
COLLINEAR, INVOLVED = 1e-6, 1e-3
#: Samples of all records to which models are fitted for a choice: what can be computed in ten seconds.
PART = 2500
#: The beginning of a record is used for the whole if input and output vary there by at least this share of all.
LIVELY = 0.5


def without_outliers(record: Record) -> Record:
    """Return a record with outliers replaced by interpolation between their neighbours."""
    present = np.flatnonzero(record.valid)
    outlying = present[outliers(record.y[present])]
    kept = np.setdiff1d(present, outlying)
    y = record.y.copy()
    y[outlying] = np.interp(record.t[outlying], record.t[kept], record.y[kept])
    return replace(record, y=y)


def part_of_record(record: Record, part: slice) -> Record:
    """Return part of a record, with the input known at its samples."""
    t = record.t[part]
    inputs = {name: HeldSignal(t, signal.values[part], signal.hold) for name, signal in record.held.items()}
    return Record(t, record.y[part], inputs, name=record.name)


def above_level(record: Record, before: InputBefore) -> tuple[Record, list[float], float]:
    """Return a record with inputs relative to their levels before it, these levels, and zero for its output."""
    firsts = [float(signal.values[0]) for signal in record.held.values()]
    levels = firsts if before == "first" else [float(before or 0.0)] * len(firsts)
    return _lowered(record, levels), levels, 0.0


def without_means(record: Record) -> tuple[Record, list[float], float]:
    """Return a record without the mean of its output and the time averages of its inputs, and these levels."""
    y0 = float(np.nanmean(record.y))
    means = [float(np.mean(signal.at(record.t))) for signal in record.held.values()]
    loop = record.loop and replace(record.loop, reference=record.loop.reference - record.loop.reference.mean())
    return Record(record.t, record.y - y0, _lowered(record, means).inputs, name=record.name, loop=loop), means, y0


def _lowered(record: Record, levels: Sequence[float]) -> Record:
    """Return a record with levels subtracted from its inputs."""
    if not any(levels):
        return record
    pairs = zip(record.held.items(), levels, strict=True)
    return replace(
        record, inputs={name: HeldSignal(one.t, one.values - level, one.hold) for (name, one), level in pairs}
    )


def refuse_collinear(record: Record) -> None:
    """Refuse collinear inputs, whose responses cannot be distinguished."""
    u = np.column_stack([signal.at(record.t) for signal in record.held.values()])
    u = u - u.mean(axis=0)
    lengths = np.linalg.norm(u, axis=0)
    if not lengths.all():
        return
    _, values, right = np.linalg.svd(u / lengths, full_matrices=False)
    if values[-1] < COLLINEAR * values[0]:
        collinear = [name for name, weight in zip(record.held, right[-1], strict=True) if abs(weight) > INVOLVED]
        raise DataError(
            f"{named(record)}the inputs {' and '.join(collinear)} are collinear: one is a linear function of the "
            "others, and their responses cannot be told apart; drop one, or record them moving independently"
        )


def period_of(record: Record) -> float:
    """Return the period of a periodic record: its duration plus one interval."""
    return record.duration + (record.interval or float(np.median(np.diff(record.t))))


def within_one_period(data: FilterData, period: float) -> FilterData:
    """Return the record with the breaks of its input within one period."""
    data = data._replace(further=tuple(within_one_period(one, period) for one in data.further))
    within = data.tu < data.tu[0] + period * (1 - 1e-9)
    if within.all():
        return data
    # Filters for regular clocks require one break per sample.
    return data._replace(tu=data.tu[within].copy(), u=data.u[within].copy(), interval=0.0)


def parts_of(records: Sequence[Record]) -> tuple[list[Record], bool]:
    """Return parts with at most ``PART`` samples in total, and whether all start at the beginning of their records."""
    found = [_part(record, PART // len(records)) for record in records]
    return [record for record, _ in found], all(from_start for _, from_start in found)


def _part(record: Record, most: int) -> tuple[Record, bool]:
    thinned = -(-record.n_samples // most)
    if thinned > 1 and not record.several:
        signal, y = record.input, record.bridged_y
        if input_moves(record).kind in ("constant", "steps") or not np.array_equal(signal.t, record.t):
            # The input changes rarely, and all changes are needed.
            moves = np.append(True, np.diff(signal.values) != 0) | (signal.hold != "zoh")
            held = HeldSignal(signal.t[moves], signal.values[moves], signal.hold)
            return Record(record.t[::thinned], record.y[::thinned], held, name=record.name), True
        if any(np.std(x[:most]) < LIVELY * np.std(x) for x in (signal.values, y)):
            where = most_active(signal.values, y, most)
            return part_of_record(record, where), where.start == 0
    return beginning(record, most), True
