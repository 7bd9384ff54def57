"""Whether records are described better with another hold of their input."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np

from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.search import local_minimum
from ctid_cli.estimators.delay_profile import MeasuredFit
from ctid_cli.inference.noise_model import fit_noise_model
from ctid_cli.inference.signal_features import input_moves
from ctid_cli.signals.held import HeldSignal, Hold, regular_interval
from ctid_cli.signals.record import Record, beginning

#: Samples of all records on which the holds are compared.
MOST = 20_000
#: Another hold is better where the cost falls by this fraction, and the logarithm of the likelihood rises by so much.
WORTHWHILE, DECISIVE = 0.02, 10.0


@dataclass(frozen=True)
class OtherHold:
    """The other hold that describes records best."""

    hold: Hold
    #: Fraction by which it lowers the cost; 0 where that is not decisive.
    fall: float
    #: The delay that goes with it less that of the fit [s].
    later: float = 0.0
    #: Whether the records tell the holds apart at all.
    told: bool = True
    #: The sampling interval [s].
    interval: float = math.nan


def best_other_hold(measured: MeasuredRecords, fit: MeasuredFit, records: Sequence[Record]) -> OtherHold | None:
    """The best other hold; None where there is none to try.

    The steps of an input that moves a few times only show their shape themselves, and an input that jumps between
    levels is not band-limited.
    """
    kinds = {input_moves(record).kind for record in records}
    if kinds <= {"constant", "steps"}:
        return None
    most = MOST // len(records)
    short = [beginning(record, most) for record in records]
    given, delay = _least(measured, fit, short)
    tried: list[Hold] = [hold for hold in get_args(Hold) if hold != records[0].input.hold]
    if kinds != {"continuous"} or any(regular_interval(record.input.t) is None for record in short):
        tried = [hold for hold in tried if hold != "band-limited"]
    found = {hold: _least(measured, fit, [_held(record, hold) for record in short]) for hold in tried}
    best = min(tried, key=lambda hold: found[hold][0])
    cost, changed = found[best]
    interval = float(np.median(np.diff(records[0].t)))
    # As much worse would be as decisive; an input that jumps shows its hold itself.
    told = kinds != {"continuous"} or max(decisive(given, cost, fit, short), decisive(cost, given, fit, short)) > 0.0
    return OtherHold(best, decisive(given, cost, fit, short), changed - delay, told, interval)


def decisive(given: float, other: float, fit: MeasuredFit, records: Sequence[Record]) -> float:
    """Fraction by which a cost falls; 0 where that is not decisive."""
    # Correlated samples count for fewer.
    count = fit_noise_model(fit.residuals).effective_count(sum(record.n_samples for record in records))
    fall = 1.0 - other / given
    return fall if fall > WORTHWHILE and -0.5 * count * np.log1p(-fall) > DECISIVE else 0.0


def _least(measured: MeasuredRecords, fit: MeasuredFit, records: Sequence[Record]) -> tuple[float, float]:
    """Least sum of squared output errors near a fit, and its delay."""
    own = MeasuredRecords(records, measured.structure, measured.treatment)
    bounds, poles = own.treatment.delay_bounds, measured.free_poles(fit.model)
    found = local_minimum(own.problem, poles, fit.model.delay, bounds, known=measured.known)
    return found.squared_error, found.point.delay.seconds


def _held(record: Record, hold: Hold) -> Record:
    return Record(record.t, record.y, HeldSignal(record.input.t, record.input.values, hold), name=record.name)
