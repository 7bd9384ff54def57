"""Assumed states before records, and the samples on which they are compared."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ctid_cli.estimation.optimum.best_model import most_active
from ctid_cli.estimation.record_preparation import part_of_record
from ctid_cli.identification.candidates import with_hold
from ctid_cli.identification.choice import Given
from ctid_cli.identification.criterion import Candidate
from ctid_cli.inference.noise_model import NoiseModel
from ctid_cli.inference.residual_tests import chi_square_tail
from ctid_cli.inference.signal_features import FEW_CHANGES, input_moves
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record, beginning
from ctid_cli.signals.treatment import InitialState, InputBefore

#: Share of its range that the input must cross after the greatest delay, so that an estimated state leaves the gain
#: determined.
EXCITED = 0.5
#: With an input that changes only a few times, a state is estimated if the first change comes after at least this
#: number of samples and after the greatest delay. With a lead of 10 samples an estimated state had 30 times the error
#: of rest, with a lead of 1 a hundred thousand times.
LEAD = 10
#: Rest is rejected if its first samples are less likely than this: an unneeded estimated state costs little.
UNLIKELY = 1e-2
#: Samples of all records to which models are fitted for the choice: what can be computed in ten seconds.
PART = 2500
#: The beginning of a record is used for the whole if input and output vary there by at least this share of all.
LIVELY = 0.5


#: State before the records, and the input before them.
State = tuple[InitialState, InputBefore]


def states_of(records: Sequence[Record], given: Given) -> list[State]:
    """Return the states before the records to compare.

    Rest is equilibrium with a constant input: the first value, or zero.
    """
    state, before = given.initial_state, given.input_before
    if state is not None and state != "rest":
        return [(state, None)]
    if given.offset == "remove":
        both: list[State] = [("rest", None), ("estimate", None)]
        return both if state is None else both[:1]
    signals = [signal for record in records for signal in record.held.values()]
    first = [float(signal.values[0]) for signal in signals]
    varies = all(np.ptp(signal.values) > 0.0 for signal in signals)
    levels: list[InputBefore] = ["first"] if before is None else [before]
    if before is None and varies and any(first):
        levels.append(None)
    found: list[tuple[InitialState, InputBefore]] = [("rest", level) for level in levels]
    return found + [("estimate", None)] * (state is None and before is None and varies)


def excited_after(records: Sequence[Record], delay: float) -> bool:
    """Return whether inputs change enough after a delay [s] to separate the gain from an estimated state.

    A state explains most of the response to a single step soon after the first sample.
    """
    for record in (each for whole in records for each in whole.each_input):
        later = record.t >= record.t[0] + delay
        u, whole = record.input.at(record.t[later]), record.input.at(record.t)
        if u.size < 2 or np.ptp(u) <= EXCITED * np.ptp(whole):
            return False
        changes = np.flatnonzero(np.diff(u))
        if changes.size <= FEW_CHANGES and changes[0] < max(LEAD, np.count_nonzero(~later)):
            return False
    return True


def changes_at_the_beginning_only(records: Sequence[Record]) -> bool:
    """Return whether all inputs are constant after the first samples: an integrator then responds like a drift."""
    long = [record for record in records if record.t.size > LEAD]
    return all(np.ptp(signal.at(record.t[LEAD:])) == 0.0 for record in long for signal in record.held.values())


def without_beginning(records: Sequence[Record], length: float) -> list[Record]:
    """Return records whose first samples, up to a length [s], are marked as missing."""
    return [
        replace(record, y=np.where(record.t < record.t[0] + length * (1 - 1e-9), np.nan, record.y), noise_free=None)
        for record in records
    ]


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


def beginning_is_likely(best: Candidate, noise: NoiseModel, records: Sequence[Record], length: float) -> bool:
    """Return whether a model from rest, fitted to later samples, also explains the first samples of the records.

    Their squared innovations over the variance, and the first error over that of the noise, are chi-square.
    """
    held = [with_hold(record, best.hold) for record in records]
    errors = best.options.prepare(held).laid_out.errors_of(best.fit.model).residuals
    later = np.concatenate([noise.innovations(e)[noise.order :] for e in best.fit.residuals])
    deviation, power = float(later.std()), max(float(noise.first_autocovariances[0]), np.finfo(float).tiny)
    squared, count = 0.0, 0
    for record, e in zip(records, errors, strict=True):
        first = int(np.count_nonzero(record.valid & (record.t < record.t[0] + length * (1 - 1e-9))))
        new = noise.innovations(e)[max(noise.order, 1) : first] / deviation
        squared, count = squared + float(new @ new) + float(e[0] ** 2) / power, count + new.size + 1
    return chi_square_tail(count, squared) > UNLIKELY
