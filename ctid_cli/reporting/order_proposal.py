"""The structure that ``ctid fit`` takes where none is given, and why."""

from collections.abc import Sequence
from typing import NamedTuple

from ctid_cli.errors import DataError
from ctid_cli.estimators.order_search import recommend_order
from ctid_cli.reporting.order_report import spelled
from ctid_cli.reporting.record_findings import check_record_quality
from ctid_cli.signals.record import Record
from ctid_cli.signals.treatment import InitialState, Offset

#: What is searched where nothing is given.
POLES, ZEROS = (1, 6), (0, 3)


class Proposal(NamedTuple):
    """A structure and the range of its delay, with the line that says so."""

    poles: int
    zeros: int
    delay_bounds: tuple[float, float]
    sentence: str


def proposed_delay(records: Sequence[Record], unit: str) -> tuple[tuple[float, float], str]:
    """The range in which the first record shows the beginning of its answer, and a sentence about it."""
    suggested = check_record_quality(records[0]).suggested_delay
    if suggested is None:
        return (0.0, 0.0), "No beginning of the answer is seen: the delay is taken as 0 (--delay)."
    low, high = suggested
    return suggested, f"The delay is searched from {low:g} to {high:g} {unit}, as ctid check suggests (--delay)."


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
