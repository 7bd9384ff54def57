"""Models on another record, with its own state and offset, and diagnostics of the candidates of a choice."""

from dataclasses import dataclass, replace

import numpy as np

from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimators.identification import Validation, laid_out_validation, tests_of, validated
from ctid_cli.estimators.measured_fit import MeasuredFit
from ctid_cli.identification.choice import Candidate, Choice, Given, Searched
from ctid_cli.identification.choose import states_of
from ctid_cli.identification.criterion import criteria_of
from ctid_cli.inference import criteria
from ctid_cli.inference.residual_tests import ResidualTests
from ctid_cli.progress import reported
from ctid_cli.signals.record import Record, with_hold
from ctid_cli.signals.treatment import Offset


@dataclass(frozen=True, eq=False)
class CandidateDiagnostics:
    """A candidate with its diagnostics."""

    candidate: Candidate
    #: Young's criterion [-].
    yic: float
    #: Fit of each tenth of each record with the parameters of the rest, linearised [%].
    cross_validated_percent: float
    tests: tuple[ResidualTests, ...]
    #: Fit on the validation record [%].
    validation_percent: float | None


def diagnosed(choice: Choice, given: Given, validation: Record | None) -> list[CandidateDiagnostics]:
    """Compute the diagnostics of all candidates of a choice, the best first."""
    other = None if validation is None else with_hold(validation, choice.taken.hold)
    return [_diagnosed(each, choice, given, other) for each in choice.ranking.candidates]


def _diagnosed(candidate: Candidate, choice: Choice, given: Given, other: Record | None) -> CandidateDiagnostics:
    fit, options = candidate.fit, candidate.options
    outputs = [record.y[use] for record, use in zip(choice.fitted, fit.used, strict=True)]
    total = np.concatenate([y - y.mean() for y in outputs])
    left = criteria.cross_validated_errors(fit.residuals, [psi @ fit.tangent for psi in fit.sensitivities])
    free = np.flatnonzero(fit.tangent.any(axis=1))
    covariance = fit.uncertainty("white").covariance[np.ix_(free, free)]
    residuals = np.concatenate(fit.residuals)
    return CandidateDiagnostics(
        candidate,
        criteria.young_information_criterion(residuals, np.concatenate(outputs), fit.theta[free], covariance),
        criteria.fit_percent(total, total - np.concatenate(left)),
        tests_of(options, fit, choice.fitted),
        None if other is None else validated_on(other, options, fit, given).fit_percent,
    )


def laid_out_for(record: Record, options: Searched, given: Given) -> list[tuple[Searched, MeasuredRecords]]:
    """Prepare a record in all treatments of state and offset to compare; a DataError if it cannot be used."""
    offsets: list[Offset] = ["estimate", "none"] if given.offset is None else [given.offset]
    tried = [
        replace(options, initial_state=state, input_before=before, offset=offset)
        for state, before in states_of([record], given)
        for offset in offsets
    ]
    pairs = ((each, laid_out_validation(each, record)) for each in tried)
    return [(each, laid_out) for each, laid_out in pairs if isinstance(laid_out, MeasuredRecords)]


@reported("validation")
def validated_on(record: Record, options: Searched, fit: MeasuredFit, given: Given) -> Validation:
    """Assess a fixed model on a record, in the treatment that the criterion prefers."""
    tried = laid_out_for(record, options, given)
    applied = [own._applied(fit, laid_out) for own, laid_out in tried]
    models = [each.residuals for each in applied]
    sizes = [laid_out.layout.own for _, laid_out in tried]
    best = int(np.argmin(criteria_of(models, [each.used for each in applied], sizes)))
    return replace(validated(applied[best], record), options=tried[best][0])
