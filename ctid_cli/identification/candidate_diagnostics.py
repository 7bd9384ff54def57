"""Diagnostics of the candidates of a choice."""

from dataclasses import dataclass

import numpy as np

from ctid_cli.estimators.identification import tests_of
from ctid_cli.identification.candidates import with_hold
from ctid_cli.identification.choice import Choice, Given
from ctid_cli.identification.criterion import Candidate
from ctid_cli.identification.validation import validated_on
from ctid_cli.inference import criteria
from ctid_cli.inference.residual_tests import ResidualTests
from ctid_cli.signals.record import Record


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
    other = None if validation is None else with_hold(validation, choice.ranking.best.hold)
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
