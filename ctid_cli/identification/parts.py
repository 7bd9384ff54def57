"""Parts of long records that are used to choose settings."""

from collections.abc import Sequence

import numpy as np

from ctid_cli.estimation.optimum.best_model import most_active
from ctid_cli.inference.signal_features import input_moves
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record, beginning

#: Samples of all records to which models are fitted for the choice: what can be computed in ten seconds.
PART = 2500
#: The beginning of a record is used for the whole if input and output vary there by at least this share of all.
LIVELY = 0.5


def parts_of(records: Sequence[Record]) -> tuple[list[Record], bool]:
    """Return parts with at most ``PART`` samples in total, and whether all start at the beginning of their records."""
    found = [_part(record, PART // len(records)) for record in records]
    return [record for record, _ in found], all(from_start for _, from_start in found)


def _part(record: Record, most: int) -> tuple[Record, bool]:
    thinned = -(-record.n_samples // most)
    if thinned == 1:
        return record, True
    if record.several:
        return beginning(record, most), True
    signal = record.input
    if input_moves(record).kind in ("constant", "steps") or not np.array_equal(signal.t, record.t):
        # The input changes rarely, and all changes are needed.
        moves = np.append(True, np.diff(signal.values) != 0) | (signal.hold != "zoh")
        held = HeldSignal(signal.t[moves], signal.values[moves], signal.hold)
        return Record(record.t[::thinned], record.y[::thinned], held, name=record.name), True
    y = record.bridged_y
    if all(np.std(x[:most]) >= LIVELY * np.std(x) for x in (signal.values, y)):
        return beginning(record, most), True
    where = most_active(signal.values, y, most)
    t = record.t[where]
    held = HeldSignal(t, signal.values[where], signal.hold)
    return Record(t, record.y[where], held, name=record.name), where.start == 0
