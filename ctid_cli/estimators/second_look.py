"""What a fit and its records show that the estimate takes for granted."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.profile_refinement import Refinement
from ctid_cli.estimators.delay_profile import MeasuredFit
from ctid_cli.estimators.hold_comparison import fall_with_other_hold
from ctid_cli.inference import faults
from ctid_cli.inference.input_dependence import InputDependence, input_dependence
from ctid_cli.inference.record_check import SIGNIFICANT, Examined, examine, trend
from ctid_cli.signals.record import Record

#: A drift of the residuals counts from this many of their standard deviations on.
DRIFT = 0.7
#: A real pole seems to be an integrator where its time constant exceeds this fraction of the record.
INTEGRATES = 0.6


@dataclass(frozen=True, eq=False)
class RecordLook:
    """What is odd about one record, seen with its residuals."""

    examined: Examined
    #: Instants of residuals far from their neighbours [s], and how far [output unit], shape (k, 2).
    outliers: Array
    #: First and last instant of each stretch in which the output stood still [s], shape (k, 2).
    stood_still: Array
    #: Time in which the output grows by the factor e, if it diverges [s].
    growth_time: float
    #: Change of the residuals along a straight line over the record [their standard deviations]; 0 for none.
    drift: float
    #: None in a record too short to tell.
    dependence: InputDependence | None


@dataclass(frozen=True, eq=False)
class SecondLook:
    """What is odd about a fit."""

    records: tuple[RecordLook, ...]
    #: Fraction by which the other hold of the input lowers the cost; 0 where that is not decisive.
    other_hold: float
    #: Time constant of a pole too slow to be told from an integrator [s]; nan for none.
    integrator: float


def look_again(refinement: Refinement, fit: MeasuredFit, records: Sequence[Record], *, holds: bool) -> SecondLook:
    """Look at the records, at what the fit leaves of them, and if wanted at what it does with the other hold."""
    looks = tuple(_look(record, fit, k) for k, record in enumerate(records))
    other_hold = fall_with_other_hold(refinement, fit, records) if holds else 0.0
    return SecondLook(looks, other_hold, _integrator(fit, records))


def _look(record: Record, fit: MeasuredFit, k: int) -> RecordLook:
    e, psi, use = fit.residuals[k], fit.sensitivities[k], fit.used[k]
    t, y = record.t[use], record.y[use]
    found, off = faults.residual_outliers(e)
    slope, error, _ = trend(t, e)
    drift = slope * float(t[-1] - t[0]) / float(e.std() or 1.0)
    drifts = abs(slope) > SIGNIFICANT * error and abs(drift) > DRIFT
    return RecordLook(
        examine(record),
        np.column_stack((t[found], np.abs(off))),
        t[faults.stood_still(y)],
        faults.growth_time(t, y, record.input.at(t)),
        drift if drifts else 0.0,
        input_dependence(e, y - e, psi, t, record, fit.model.delay),
    )


def _integrator(fit: MeasuredFit, records: Sequence[Record]) -> float:
    poles = fit.model.poles
    slow = np.abs(poles[poles.imag == 0.0])
    longest = max(record.duration for record in records)
    return float(1 / slow.min()) if slow.size and slow.min() * longest < 1 / INTEGRATES else float("nan")
