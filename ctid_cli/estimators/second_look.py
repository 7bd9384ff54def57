"""What a fit and its records show that the estimate takes for granted."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimators.delay_profile import MeasuredFit
from ctid_cli.estimators.hold_comparison import OtherHold
from ctid_cli.estimators.residual_causes import Clock, Richer, clock_evidence
from ctid_cli.inference.noise_model import fit_noise_model
from ctid_cli.inference.record_check import SIGNIFICANT, Examined, examine
from ctid_cli.inference.residual_tests import (
    InputDependence,
    SideBySide,
    constant,
    dependence,
    input_dependence,
    rest_of,
)
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.inference.signal_features import growth_time, residual_outliers, stood_still
from ctid_cli.models.factoring import pole_jacobian
from ctid_cli.signals.record import Record

#: A drift of the residuals counts from this many of their standard deviations on.
DRIFT = 0.7
#: A real pole seems to be an integrator where its time constant exceeds this fraction of the record.
INTEGRATES = 0.6
#: Standard errors within which a pole is at the origin.
REACHED = 2.0


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
    #: The hold that lowers the cost most; None where there is none to compare with.
    held: OtherHold | None
    #: Time constant of a pole that seems to be an integrator [s], nan for none; whether the records tell them apart.
    integrator: float
    indistinguishable: bool
    #: Errors that go with the speed of the output.
    clock: Clock
    #: The fit with one more pole, and with a delay outside the range; None where that was not tried.
    richer: Richer | None = None
    elsewhere: Richer | None = None


def look_again(
    fit: MeasuredFit,
    records: Sequence[Record],
    held: OtherHold | None,
    richer: Richer | None = None,
    elsewhere: Richer | None = None,
) -> SecondLook:
    """Look at the records, and at what the fit leaves of them."""
    looks = tuple(_look(record, fit, k) for k, record in enumerate(records))
    clock = clock_evidence(fit, records)
    slow = _integrator(fit, records)
    return SecondLook(looks, held.fall if held else 0.0, held, *slow, clock, richer, elsewhere)


def _look(record: Record, fit: MeasuredFit, k: int) -> RecordLook:
    e, psi, use = fit.residuals[k], fit.sensitivities[k], fit.used[k]
    t, y = record.t[use], record.y[use]
    found, off = residual_outliers(e)
    return RecordLook(
        examine(record),
        np.column_stack((t[found], np.abs(off))),
        t[stood_still(y)],
        growth_time(t, y, record.input.at(t)),
        _drift(e, psi, t),
        input_dependence(e, y - e, psi, t, record, fit.model.delay),
    )


def _drift(e: Array, psi: Array, t: Array) -> float:
    """Change along a straight line over the record [standard deviations of the rest]; 0 where that may be chance.

    What the parameters can have taken of the line is allowed for: it is freed of their sensitivities.
    """
    beside = SideBySide((constant(t.size), psi))
    line = ((t - t.mean()) / float(t[-1] - t[0]))[:, None]
    rest = rest_of(e, SideBySide((beside, line)))
    noise = fit_noise_model([rest])
    if not noise.innovation_variance > 0:
        return 0.0
    own = rest_of(line[:, 0], beside)
    drift = float(own @ e / (own @ own) / rest.std())
    significant = dependence(e, line, noise, beside).statistic > SIGNIFICANT**2
    return drift if significant and abs(drift) > DRIFT else 0.0


def _integrator(fit: MeasuredFit, records: Sequence[Record]) -> tuple[float, bool]:
    """Time constant of a pole that is slow for the records, nan for none, and whether it may as well be at the origin.

    It may where it is held at the least that is admissible, or two of its standard errors reach the origin.
    """
    poles = fit.model.poles
    # Poles at the origin were asked for.
    slow = np.flatnonzero((poles.imag == 0.0) & (poles.real != 0.0))
    longest = max(record.duration for record in records)
    if not slow.size or np.abs(poles[slow]).min() * longest >= 1 / INTEGRATES:
        return float("nan"), False
    k, n = int(slow[np.argmin(np.abs(poles[slow]))]), poles.size
    size = float(abs(poles[k]))
    if fit.box is not None and any("slowest" in fit.box.met_by(pole) for pole in fit.held_poles):
        return 1 / size, True
    if fit.parameter_names[:n] != Structure(n, 0).names[:n]:
        # The coefficients of submodels are others.
        return 1 / size, False
    slope = pole_jacobian(fit.model.denominator, poles)[k].real
    variance = float(slope @ fit.uncertainty("white").covariance[:n, :n] @ slope)
    return 1 / size, not size > REACHED * np.sqrt(variance)
