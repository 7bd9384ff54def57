"""Assumed states before records, and the samples on which they are compared."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ctid_cli.estimation.optimum.best_model import most_active
from ctid_cli.estimation.record_preparation import part_of_record, period_of
from ctid_cli.identification.candidates import Setting
from ctid_cli.identification.choice import Given
from ctid_cli.identification.criterion import Candidate
from ctid_cli.inference.input_response import analyse_response
from ctid_cli.inference.noise_model import NoiseModel
from ctid_cli.inference.repetition import range_of, repetitions_of, without_level
from ctid_cli.inference.residual_tests import chi_square_tail
from ctid_cli.inference.signal_features import FEW_CHANGES, input_moves
from ctid_cli.models.several_inputs import AnyModel, fractions_of
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record, beginning, with_hold
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
#: Greatest delay that is tried, as a share of the record; with a later response it is this multiple of its latest
#: beginning plus this number of sampling intervals, at most this share of the time after the first change of the input.
LATEST, LATE, FURTHER, REMAINING = 0.1, 1.5, 3, 0.9
#: A response is seen where the output is this many deviations away from its level in a quiet beginning.
ONSET = 5.0
#: Longest range of the delay within one interval of a repeating input, as a share of the record: for a periodic state,
#: and for others.
WHOLE, SHARE = 0.999, 0.4
#: Least time before the first of many changes of an input that shows rest, relative to the longest between two of them.
LONGER = 1.2
#: Blocks of the output before the first change of the input, and their least size. The output is constant if their
#: means differ by less than this number of standard errors, or by less than this share of its deviation.
QUIET_BLOCKS, QUIET_SIZE, QUIET_ERRORS, QUIET_SHARE = 5, 2, 4.5, 0.05

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


def with_offsets(settings: Sequence[Setting], records: Sequence[Record]) -> list[Setting]:
    """Return settings with an estimated offset, and those with none or a drift that are compared with them.

    An estimated state without an offset fits a step response with a slow free response and a gain of either sign, and
    rest at a level other than zero has the offset of the response to it.
    """
    firsts = [float(signal.values[0]) for record in records for signal in record.held.values()]
    found = list(settings)
    for each in settings:
        at_zero = each.input_before in (None, 0.0) or (each.input_before == "first" and not any(firsts))
        if each.initial_state != "estimate" and at_zero:
            found.append(each._replace(offset="none"))
        if each.initial_state != "periodic":
            found.append(each._replace(offset="drift"))
    return found


def greatest_delay(records: Sequence[Record]) -> float:
    """Return the greatest delay that is tried [s]: a share of the record, or beyond the beginning of the response."""
    interval = max(float(np.median(np.diff(record.t))) for record in records)
    hints = [analyse_response(each).delay for record in records for each in record.each_input]
    lates = [hint.late for hint in hints if hint is not None] + [_onset(record) for record in records]
    late = max(LATE * late + FURTHER * interval for late in lates)
    remaining = min(record.t[-1] - _first_change(record) for record in records)
    return float(min(max(LATEST * min(record.duration for record in records), late), REMAINING * remaining))


def _onset(record: Record) -> float:
    """Return the time from the first change of an input to the first response after a quiet beginning; 0 without."""
    if not _is_quiet(record):
        return 0.0
    t, y = record.t[record.valid], record.y[record.valid]
    first = min(float(input_moves(each).changes.min(initial=np.inf)) for each in record.each_input)
    before = y[t < first]
    away = np.abs(y - before.mean()) > max(ONSET * float(before.std()), QUIET_SHARE * float(y.std()))
    # Two samples in a row: one may be an outlier.
    both = np.flatnonzero(away[:-1] & away[1:] & (t[:-1] >= first))
    return float(t[both[0]] - first) if both.size else 0.0


def _first_change(record: Record) -> float:
    """Return the first instant at which an input changes within a record [s]."""
    moving = [signal.t[1:][np.diff(signal.values) != 0.0] for signal in record.held.values()]
    inside = [float(t[t > record.t[0]].min(initial=np.inf)) for t in moving]
    first = min(inside)
    return first if first < record.t[-1] else float(record.t[0])


def distinguishable_delays(records: Sequence[Record], given: Given) -> float:
    """Return the length of the range of delays that the input can tell apart [s]; infinite if it does not repeat."""
    if isinstance(given.input_before, float | int):
        return float("inf")
    periodic = given.initial_state == "periodic"
    shortest, each = min(record.duration for record in records), []
    for record in records:
        found = repetitions_of(record.input, record.t, period_of(record) if periodic else None)
        each.append(range_of(without_level(found, record.input) if given.offset == "none" else found))
    longest = max(each)
    # With an estimated state the range of the delay costs as many samples.
    if not np.isfinite(longest) or (longest > SHARE * shortest and not periodic):
        return float("inf")
    return min(longest, WHOLE * shortest)


def is_slow(model: AnyModel, records: Sequence[Record]) -> bool:
    """Return whether a model has a pole slower than the records, other than an integrator."""
    poles = np.abs(np.concatenate([each.poles for each in fractions_of(model)]))
    return bool(np.any(poles[poles > 0.0] * max(record.duration for record in records) < 1.0))


def begins_quietly(records: Sequence[Record]) -> bool:
    """Return whether records begin at rest: with constant inputs, longer than they are later, and constant outputs."""
    return all(_is_quiet(record) for record in records)


def _is_quiet(record: Record) -> bool:
    moves = [input_moves(each) for each in record.each_input]
    changes = np.concatenate([one.changes for one in moves])
    if any(one.kind == "continuous" for one in moves) or not changes.size:
        return False
    times = np.sort(changes)
    if changes.size > FEW_CHANGES and times[0] - record.t[0] < LONGER * np.diff(times).max():
        return False
    y = record.y[record.valid]
    before = y[record.t[record.valid] < changes.min()]
    size = before.size // QUIET_BLOCKS
    if size < QUIET_SIZE:
        return False
    blocks = before[before.size - size * QUIET_BLOCKS :].reshape(QUIET_BLOCKS, size)
    means, inner = blocks.mean(axis=1), blocks - blocks.mean(axis=1, keepdims=True)
    if np.ptp(means) < QUIET_SHARE * float(y.std()):
        return True
    variance = float(np.sum(inner**2)) / (QUIET_BLOCKS * (size - 1))
    # The variance of a mean of autoregressive noise of order 1 is (1 + r)/(1 - r) times that of white noise.
    together = float(np.sum(inner[:, 1:] * inner[:, :-1])) / max(float(np.sum(inner**2)), np.finfo(float).tiny)
    factor = (1.0 + max(together, 0.0)) / max(1.0 - together, 0.05)
    return bool(np.ptp(means) < QUIET_ERRORS * np.sqrt(factor * variance / size))


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
