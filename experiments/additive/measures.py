"""What the tables and the claims of the study share: errors, their ratios, and which standard errors are misused."""

from collections.abc import Iterator
from functools import cache
from typing import Any

from ctid_cli.errors import UsageError
from ctid_cli.reporting.parameter_errors import (
    ParameterErrors,
    ParameterEstimates,
    mse_ratio,
    parameter_errors,
    parameter_estimates,
)
from ctid_cli.reporting.results import Results


@cache
def estimates_of(results: Results) -> list[ParameterEstimates]:
    """Estimates by estimator and number of samples."""
    return parameter_estimates(results)


@cache
def errors_of(results: Results) -> list[ParameterErrors]:
    """Errors of these."""
    return parameter_errors(estimates_of(results))


def parameters(results: Results) -> list[str]:
    """Names of the parameters."""
    return list(dict.fromkeys(row.parameter for row in errors_of(results)))


def by_estimator(results: Results, least: int = 0) -> dict[str, list[ParameterEstimates]]:
    """Estimates of each estimator by rising number of samples."""
    groups: dict[str, list[ParameterEstimates]] = {}
    for group in sorted(estimates_of(results), key=lambda group: group.samples):
        if group.samples >= least:
            groups.setdefault(group.estimator, []).append(group)
    return groups


def is_misused(results: Results, estimator: str) -> bool:
    """Whether an estimator takes coloured noise for white."""
    settings = results.settings
    return bool(settings["noise"]["kind"] != "white" and settings["estimators"][estimator]["covariance"] == "white")


def ratios(results: Results) -> Iterator[dict[str, Any]]:
    """Mean-square errors of other estimators over those of the sum of submodels, where both are consistent."""
    groups = by_estimator(results)
    reference = groups.pop("additive", [])
    for estimator, others in groups.items():
        for other, own in zip(others, reference, strict=False):
            if other.theory is None or own.theory is None:
                continue
            for k, parameter in enumerate(own.names):
                try:
                    ratio = mse_ratio([other], [own], parameter)
                except UsageError:
                    continue
                yield {
                    "experiment": results.experiment,
                    "estimator": estimator,
                    "samples": own.samples,
                    "parameter": parameter,
                    "pairs": ratio.pairs,
                    "ratio": ratio.ratio,
                    "standard_error": ratio.standard_error,
                    "theory": float(other.theory[k] / own.theory[k]),
                }
