"""The structure that ``ctid fit`` takes where none is given, and why."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.estimation.optimum.best_model import liveliest
from ctid_cli.estimators.order_search import recommend_order
from ctid_cli.inference.record_check import RecordReport, examine
from ctid_cli.inference.response_test import AnswerTest
from ctid_cli.reporting.order_result import spelled
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from ctid_cli.signals.treatment import InitialState, Offset

#: What is searched where nothing is given.
POLES, ZEROS = (1, 6), (0, 3)
#: The same for ctid check, and on how many samples: it is to answer at once.
FEW_POLES, MOST_SAMPLES = (1, 4), 2000
#: Where no beginning of the answer is seen, delays up to this fraction of the record are tried.
UNKNOWN_DELAY = 0.5


class Proposal(NamedTuple):
    """A structure and the range of its delay, with the line that says so."""

    poles: int
    zeros: int
    delay_bounds: tuple[float, float]
    sentence: str


def proposed_delay(records: Sequence[Record], unit: str) -> tuple[tuple[float, float], str]:
    """The range in which the first record shows the beginning of its answer, and a sentence about it."""
    suggested = examine(records[0]).report.suggested_delay
    if suggested is None:
        return (0.0, 0.0), "No beginning of the answer is seen: the delay is taken as 0 (--delay)."
    low, high = suggested
    return suggested, f"The delay is searched from {low:g} to {high:g} {unit}, as ctid check suggests (--delay)."


def proposed_by_check(record: Record, report: RecordReport) -> Proposal | None:
    """A structure to begin with, from a part of a long record; None where no model is seen."""
    if report.worst == "problem":
        return None
    bounds, seen = report.suggested_delay, None
    if bounds is not None:
        seen = AnswerTest(float("nan"), float("nan"), report.answer_p_value)
    elif report.explained > 0:
        # Something answers, and no one knows when.
        bounds = 0.0, float(f"{UNKNOWN_DELAY * report.duration:.2g}")
    else:
        return None
    part, initial_state = _part(record, bounds[1], report)
    try:
        found = recommend_order(
            *(part, FEW_POLES, ZEROS, bounds),
            initial_state=initial_state,
            offset=report.suggested_offset,
            answer=seen,
        )
    except DataError:
        return None
    if found.recommended is None:
        return None
    options = found.recommended.options
    where = "" if part is record else f" on {np.count_nonzero(part.valid)} of the {record.n_samples} samples"
    sentence = f"Proposed: {spelled(found.recommended)}, by a short search{where}. {found.reason}"
    more = "tries more poles than these" if options.poles == FEW_POLES[1] else "looks closer"
    return Proposal(options.poles, options.zeros, bounds, f"{sentence} It is a proposal: ctid order {more}.")


def _part(record: Record, latest: float, report: RecordReport) -> tuple[Record, InitialState]:
    """A few samples of a record, and how their state before the first is to be treated."""
    signal = record.input
    thinned = -(-record.n_samples // MOST_SAMPLES)
    if thinned == 1:
        return record, report.suggested_initial_state
    if report.input_kind == "steps" or not np.array_equal(signal.t, record.t):
        # Seldom does anything happen, and all of it must be seen.
        moves = np.append(True, np.diff(signal.values) != 0) | (signal.hold != "zoh")
        held = HeldSignal(signal.t[moves], signal.values[moves], signal.hold)
        y = record.y[::thinned]
        return Record(record.t[::thinned], y, held, name=record.name), report.suggested_initial_state
    before = int(np.searchsorted(record.t, record.t[0] + latest))
    where = liveliest(signal.values, np.nan_to_num(record.y, nan=report.output_mean), MOST_SAMPLES + before)
    t, y = record.t[where], record.y[where].copy()
    part = HeldSignal(t, signal.values[where], signal.hold)
    if where == slice(None) or where.start == 0:
        return Record(t, y, part, name=record.name), report.suggested_initial_state
    # The input before the part is not known to it.
    y[:before] = np.nan
    return Record(t, y, part, name=record.name), "estimate"


def propose_structure(
    records: Sequence[Record],
    zeros: int | None,
    delay_bounds: tuple[float, float] | None,
    initial_state: InitialState,
    offset: Offset,
    unit: str,
) -> Proposal:
    """Search for what is None, and for the number of poles; a DataError where there is no model."""
    bounds, said = (delay_bounds, "") if delay_bounds is not None else proposed_delay(records, unit)
    numbers = ZEROS if zeros is None else (zeros, zeros)
    # A number of zeros needs as many poles at least.
    least = 1 if zeros is None else zeros + (bounds[0] < bounds[1])
    poles = max(least, POLES[0]), max(least, POLES[1])
    found = recommend_order(records, poles, numbers, bounds, initial_state=initial_state, offset=offset)
    if found.recommended is None:
        raise DataError(f"{found.reason} Give --poles to fit a structure all the same.")
    best = found.recommended
    sentence = f"Structure by an order search, as --poles is not given: {spelled(best)}. {found.reason} {said}".rstrip()
    return Proposal(best.options.poles, best.options.zeros, bounds, sentence)
