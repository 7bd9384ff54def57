"""What a fit is judged by beside its residuals, in the way of its estimator: other holds, and what was left out."""

from collections.abc import Sequence

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.estimation.common import Start
from ctid_cli.estimation.profile_refinement import AppliedModel, Refinement
from ctid_cli.estimators.delay_profile import DelayProfile, FittedSamples, MeasuredFit, samples_at
from ctid_cli.estimators.hold_comparison import OtherHold, best_other_hold, decisive, otherwise_held
from ctid_cli.estimators.measured_submodels import LaidOutSubmodels, MeasuredSubmodels, SubmodelsFit
from ctid_cli.inference.derived import additive_derived, derived_parameters
from ctid_cli.inference.intervals import UncertainValue
from ctid_cli.inference.uncertainty import Uncertainty
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

#: Estimators of measured records, and records as each of them lays them out.
Options = DelayProfile | MeasuredSubmodels
LaidOut = Refinement | LaidOutSubmodels


def laid_out_validation(options: Options, validation: Record) -> LaidOut:
    """A record that the model is to be judged on."""
    try:
        found: LaidOut = options.prepare(validation).laid_out
        return found
    except DataError as error:
        raise DataError(f"validation record: {error}") from None


def acting(options: Options, record: Record) -> Record:
    """The record with what acts on the output from outside: in a loop the reference, for the input answers to noise."""
    if record.loop is None or not (isinstance(options, MeasuredSubmodels) and options.closed):
        return record
    return Record(record.t, record.y, HeldSignal(record.t, record.loop.reference), name=record.name)


def answering(options: Options, laid_out: LaidOut) -> list[Record]:
    """Records whose outputs are to answer to their inputs, without the means that were subtracted."""
    records = [laid_out.record] if isinstance(laid_out, LaidOutSubmodels) else laid_out.measured.records
    return [acting(options, record) for record in records]


def applied(fit: MeasuredFit, options: Options, laid_out: LaidOut) -> AppliedModel:
    """The model on another record."""
    if isinstance(laid_out, Refinement):
        return laid_out.errors_of(fit.model)
    own, submodels = _of_submodels(options, fit)
    return own._apply(submodels, laid_out)


def samples(fit: MeasuredFit, options: Options, laid_out: LaidOut) -> FittedSamples:
    """What a fit says of each used sample, from its parameters."""
    if isinstance(laid_out, Refinement):
        losses = None if fit.weighting is None else fit.weighting.losses
        return samples_at(laid_out, fit.model, fit.theta, losses)
    own, submodels = _of_submodels(options, fit)
    return own._samples_of(submodels, laid_out)


def lowered(options: Options, laid_out: LaidOut, fit: MeasuredFit) -> dict[str, float]:
    """Sums of squared errors if what was taken as zero were estimated too."""
    if isinstance(laid_out, LaidOutSubmodels):
        own, submodels = _of_submodels(options, fit)
        return own._lowered(submodels, laid_out)
    found: dict[str, float] = {}
    if options.initial_state == "rest":
        found["initial_state"] = laid_out.squared_error_with(fit.model, initial_state=True)
    if options.offset == "none":
        found["offset"] = laid_out.squared_error_with(fit.model, offset=True)
    return found


def other_hold(options: Options, laid_out: LaidOut, fit: MeasuredFit, records: Sequence[Record]) -> OtherHold | None:
    """The best other hold of the input; None where the holds cannot be compared."""
    if isinstance(laid_out, Refinement):
        return best_other_hold(laid_out, fit, records) if options.loss == "squares" else None
    own, submodels = _of_submodels(options, fit)
    if own.closed:
        # A discrete controller holds its input.
        return None
    try:
        held = otherwise_held(records[0])
        other = own.prepare(held).fit(Start(model=own._factors(submodels)))
    except DataError:
        return None
    return OtherHold(held.input.hold, decisive(fit.cost, other.cost, fit, records))


def _of_submodels(options: Options, fit: MeasuredFit) -> tuple[MeasuredSubmodels, SubmodelsFit]:
    assert isinstance(options, MeasuredSubmodels)
    assert isinstance(fit, SubmodelsFit)
    return options, fit


def derived(fit: MeasuredFit, uncertainty: Uncertainty, seen: bool) -> tuple[UncertainValue, ...]:
    """Poles, time constants, frequencies, damping and gain; without errors where the answer is not seen."""
    covariance = uncertainty.covariance if seen else np.full_like(uncertainty.covariance, np.nan)
    # What is known has no variance.
    known = np.isin(fit.parameter_names, fit.known)
    covariance[known] = covariance[:, known] = 0.0
    if not isinstance(fit, SubmodelsFit) or fit.additive is None:
        size = fit.model.denominator.size + sum(name.startswith("b") for name in fit.parameter_names) - 1
        held = fit.tangent[:size] if fit.held_poles else None
        return derived_parameters(fit.model, covariance[:size, :size], uncertainty.quantile, held)
    return additive_derived(fit.additive, covariance, uncertainty.quantile)
