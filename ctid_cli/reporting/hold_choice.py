"""The hold of the input that ``ctid fit`` takes where none is given, and why."""

from collections.abc import Sequence

from ctid_cli.errors import DataError
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.hold_comparison import MOST, best_other_hold
from ctid_cli.inference.record_check import RecordReport
from ctid_cli.inference.signal_features import input_moves
from ctid_cli.reporting.order_proposal import proposed_delay
from ctid_cli.signals.record import Record, beginning
from ctid_cli.signals.treatment import Hold, InitialState, Offset
from ctid_cli.text import count

#: What the holds are compared with where the number of poles is not given either.
POLES, ZEROS = 2, 1


def chosen_hold(
    records: Sequence[Record],
    poles: int | None,
    zeros: int | None,
    delay_bounds: tuple[float, float] | None,
    initial_state: InitialState,
    offset: Offset,
) -> tuple[Hold, str]:
    """The hold that describes records best, and a sentence; records are as read with their values held.

    An input that jumps between levels shows that it is held. Where the records do not tell, it is taken as held.
    """
    if {input_moves(record).kind for record in records} != {"continuous"}:
        return "zoh", ""
    short = [beginning(record, MOST // len(records)) for record in records]
    structure = (POLES, ZEROS) if poles is None else (poles, zeros or 0)
    if delay_bounds is None:
        delay_bounds = proposed_delay(short, "")[0] if poles is None else (0.0, 0.0)
    try:
        prepared = DelayProfile(
            *structure, delay_bounds, initial_state=initial_state, offset=offset, nested=True
        ).prepare(short)
        found = best_other_hold(prepared.laid_out, prepared.fit(), short)
    except DataError:
        # The fit itself will say why.
        return "zoh", ""
    if found is None:
        return "zoh", ""
    if found.fall > 0:
        fall = f"with {count(structure[0], 'pole')} it lowers the squared error by {100 * found.fall:.2g} % against zoh"
        return found.hold, f"Hold: {found.hold}, as --hold is not given: {fall}."
    if found.told:
        return "zoh", "Hold: zoh, as --hold is not given: of the three it describes the record best."
    return "zoh", "Hold: zoh, as --hold is not given and the record does not tell how its input was made."


def hold_for_check(record: Record, report: RecordReport) -> tuple[Hold, str]:
    """The hold under which ``ctid check`` looks for a structure, as ``ctid fit`` does, and a sentence."""
    bounds = report.suggested_delay or (0.0, 0.0)
    return chosen_hold([record], None, None, bounds, report.suggested_initial_state, report.suggested_offset)
