"""Comparison of estimated models on one record: fit and residual tests of each."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError, UsageError
from ctid_cli.estimation.measured_records import AppliedModel, MeasuredRecords, Treatment
from ctid_cli.estimators.identification import Identification
from ctid_cli.estimators.loop_output_error import LoopOutputError
from ctid_cli.estimators.measured_fit import MultiInputFit
from ctid_cli.inference.criteria import fit_percent, r_squared
from ctid_cli.inference.fit import Fit
from ctid_cli.inference.fitted_model import FittedModel
from ctid_cli.inference.residual_tests import FEWEST_TESTED, ResidualTests, residual_tests
from ctid_cli.inference.sensitivities import Parametric, Structure
from ctid_cli.models.several_inputs import delays_of
from ctid_cli.processors import one_thread
from ctid_cli.signals.record import Record, named, with_hold
from ctid_cli.signals.treatment import InitialState, Offset


@dataclass(frozen=True, eq=False)
class ModelOnRecord:
    """Result of an estimated model on a record, without refitting.

    Parameters
    ----------
    fit_percent : float
        ``100 (1 - ||y - x|| / ||y - mean y||)`` over the used samples [%].
    r2 : float
        ``1 - ||y - x||^2 / ||y - mean y||^2`` [-].
    rms : float
        Root mean square of the residuals [output unit].
    count : int
        Number of used samples, equal for all compared models.
    initial_state, offset : str
        Treatment of the state before the record and of a constant offset.
    t : ndarray, shape (count,)
        Instants of the used samples [s].
    measured, simulated, residuals : ndarray, shape (count,)
        Measured output, model output, and their difference [output unit].
    tests : ResidualTests or None
        Auto- and cross-correlation tests of the residuals; None for too few samples.
    """

    fit_percent: float
    r2: float
    rms: float
    count: int
    initial_state: InitialState
    offset: Offset
    t: Array = field(repr=False)
    measured: Array = field(repr=False)
    simulated: Array = field(repr=False)
    residuals: Array = field(repr=False)
    tests: ResidualTests | None = field(repr=False)


@one_thread
def compare(
    fits: Sequence[FittedModel],
    record: Record,
    *,
    initial_state: InitialState | None = None,
    offset: Offset | None = None,
) -> tuple[ModelOnRecord, ...]:
    """Compare several models on the same samples of one record, without refitting.

    Parameters
    ----------
    fits : sequence of FittedModel
        Fits or identifications, including loaded ones.
    record : Record
        Record of the same system, preferably not used for estimation.
    initial_state : {"rest", "estimate", "periodic"}, optional
        State before the record; by default for each model as in its estimation, or at rest if that is unknown.
    offset : {"none", "remove", "estimate"}, optional
        Constant offset of the output; by default as in the estimation of each model.

    Returns
    -------
    tuple of ModelOnRecord
        Results in the order of the models.

    Raises
    ------
    DataError
        If the record is too short for a model's delay or initial state.
    UsageError
        Without models.

    Notes
    -----
    The test of independence ignores the part of the residuals along the sensitivities of the output to the parameters:
    it is zero on the record of the estimation, and due to the parameters' uncertainty on another one.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli import DelayProfile, Record, compare
    >>> t = 0.1 * np.arange(300)
    >>> record = Record.from_arrays(t, np.sign(np.sin(t)), np.sin(t) + 0.1 * np.cos(9 * t))
    >>> fits = [DelayProfile(poles, 0, (0, 2)).fit(record, None) for poles in (1, 2)]
    >>> one, two = compare(fits, record)
    >>> one.fit_percent < two.fit_percent
    True
    """
    if not fits:
        raise UsageError("there is no model to compare")
    applied = [_applied(fit, record, initial_state, offset) for fit in fits]
    common = np.logical_and.reduce([each.use for each in applied])
    return tuple(_on_record(fit, record, each, common) for fit, each in zip(fits, applied, strict=True))


class _Applied(NamedTuple):
    """Model with its residuals and their derivatives by its parameters, at the samples with both."""

    initial_state: InitialState
    offset: Offset
    use: BoolArray
    residuals: Array
    slopes: Array


def _applied(fit: FittedModel, record: Record, initial_state: InitialState | None, offset: Offset | None) -> _Applied:
    """Apply a model to a record, with the given treatment or that of its estimation."""
    if isinstance(fit, Identification):
        record = fit._as_held(record)
    elif record.hold_assumed and isinstance(fit, Fit) and fit.assumed_hold is not None:
        record = with_hold(record, fit.assumed_hold.hold)
    own: tuple[InitialState, Offset] = "rest", "none"
    if isinstance(fit, Identification):
        own = fit.options.initial_state, fit.options.offset
    state, shift = initial_state or own[0], offset or own[1]
    if isinstance(fit, Identification) and isinstance(fit.fit, MultiInputFit):
        found = _treated(fit, None, record, state, shift)
        return _Applied(state, shift, found.used[0], found.residuals[0], found.sensitivities[0])
    parametric = fit._estimated().parametric
    delay, span = parametric.model.delay, float(record.t[-1] - record.input.t[0])
    if delay >= span:
        text = f"the record ends {span:.6g} after its first input, before the model's delay of {delay:.6g} has passed"
        raise DataError(f"{named(record)}{text}")
    if (state, shift) == ("rest", "none") and not _needs_loop(fit, record):
        use: BoolArray = record.valid & (record.t >= record.input.t[0])
        residuals = (record.y - parametric.simulated(record.input, record.t))[use]
        return _Applied(state, shift, use, residuals, parametric.output_slopes(record.input, record.t)[use])
    found = _treated(fit, parametric, record, state, shift)
    return _Applied(state, shift, found.used[0], found.residuals[0], found.sensitivities[0])


def _on_record(fit: FittedModel, record: Record, applied: _Applied, common: BoolArray) -> ModelOnRecord:
    """Return the result of a model at the samples common to all models."""
    kept = common[applied.use]
    residuals, slopes, measured = applied.residuals[kept], applied.slopes[kept], record.y[common]
    tests = None
    if residuals.size >= FEWEST_TESTED:
        moving = slopes[:, slopes.any(axis=0)]
        each = [
            residual_tests(
                residuals, signal.at(record.t[common] - delay), sensitivities=moving if moving.size else None
            )
            for signal, delay in zip(record.held.values(), _delays(fit), strict=True)
        ]
        # With several inputs, the one on which the residuals depend most.
        tests = min(each, key=lambda test: test.cross_p_value)
    return ModelOnRecord(
        fit_percent=fit_percent(measured, measured - residuals),
        r2=r_squared(measured, measured - residuals),
        rms=float(np.sqrt(np.mean(residuals**2))),
        count=residuals.size,
        initial_state=applied.initial_state,
        offset=applied.offset,
        t=record.t[common],
        measured=measured,
        simulated=measured - residuals,
        residuals=residuals,
        tests=tests,
    )


def _delays(fit: FittedModel) -> list[float]:
    """Return the delay of each input [s]."""
    if isinstance(fit, Identification):
        return delays_of(fit.fit.model)
    return [fit._estimated().parametric.model.delay]


def _of_loop(fit: FittedModel) -> bool:
    """Return whether a model was estimated in a loop."""
    return isinstance(fit, Identification) and isinstance(fit.options, LoopOutputError)


def _needs_loop(fit: FittedModel, record: Record) -> bool:
    """Return whether a model is compared in a loop; without one a stable plant follows the measured input."""
    if not _of_loop(fit):
        return False
    return record.loop is not None or bool(np.any(fit._estimated().parametric.model.poles.real > 0))


def _treated(
    fit: FittedModel, parametric: Parametric | None, record: Record, state: InitialState, shift: Offset
) -> AppliedModel:
    """Return the model with its best initial state and offset, by its estimator or as one fraction."""
    if isinstance(fit, Identification) and (not _of_loop(fit) or _needs_loop(fit, record)):
        treated: dict[str, Any] = {"initial_state": state, "offset": shift}
        if _of_loop(fit) and record.loop is None:
            treated["delay_bounds"] = tuple(2 * _delays(fit))
        try:
            options = replace(fit.options, **treated)
        except ValueError as error:
            raise UsageError(str(error)) from None
        return options._applied(fit.fit, options.prepare(record).laid_out)
    assert parametric is not None
    model = parametric.fraction
    structure = Structure(model.order, parametric.zeros)
    treatment = Treatment((model.delay, model.delay), state, shift, "foh")
    return MeasuredRecords([record], structure, treatment).errors_of(model)
