"""Whether records are described better with the other hold of their input."""

from collections.abc import Sequence

import numpy as np

from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.search import local_minimum
from ctid_cli.estimation.profile_refinement import Refinement
from ctid_cli.estimators.delay_profile import MeasuredFit
from ctid_cli.inference.input_moves import input_moves
from ctid_cli.inference.noise_model import fit_noise_model
from ctid_cli.signals.held import HeldSignal, Hold
from ctid_cli.signals.record import Record

#: Samples of all records on which the holds are compared.
MOST = 20_000
#: The other hold is better where the cost falls by this fraction, and the logarithm of the likelihood rises by so much.
WORTHWHILE, DECISIVE = 0.02, 10.0


def fall_with_other_hold(refinement: Refinement, fit: MeasuredFit, records: Sequence[Record]) -> float:
    """Fraction by which the other hold lowers the cost; 0 where that is not decisive.

    The steps of an input that moves a few times only show their shape themselves.
    """
    if all(input_moves(record).kind in ("constant", "steps") for record in records):
        return 0.0
    most = MOST // len(records)
    short = [_beginning(record, most) for record in records]
    given, other = (
        _least(refinement, fit, [otherwise_held(record) if swap else record for record in short])
        for swap in (False, True)
    )
    return decisive(given, other, fit, short)


def decisive(given: float, other: float, fit: MeasuredFit, records: Sequence[Record]) -> float:
    """Fraction by which a cost falls; 0 where that is not decisive."""
    # Correlated samples count for fewer.
    count = fit_noise_model(fit.residuals).effective_count(sum(record.n_samples for record in records))
    fall = 1.0 - other / given
    return fall if fall > WORTHWHILE and -0.5 * count * np.log1p(-fall) > DECISIVE else 0.0


def _least(refinement: Refinement, fit: MeasuredFit, records: Sequence[Record]) -> float:
    """Least sum of squared output errors near a fit."""
    measured = MeasuredRecords(records, refinement.structure, refinement.measured.treatment)
    return local_minimum(
        measured.problem, fit.model.poles, fit.model.delay, measured.treatment.delay_bounds
    ).squared_error


def _beginning(record: Record, samples: int) -> Record:
    """The first samples, with the input until then."""
    if record.n_samples <= samples:
        return record
    t = record.t[:samples]
    known = record.input.t <= t[-1]
    signal = HeldSignal(record.input.t[known], record.input.values[known], record.input.hold)
    return Record(t, record.y[:samples], signal, name=record.name)


def otherwise_held(record: Record) -> Record:
    """The record with the other hold of its input."""
    hold: Hold = "foh" if record.input.hold == "zoh" else "zoh"
    return Record(record.t, record.y, HeldSignal(record.input.t, record.input.values, hold), name=record.name)
