"""What the tables and the claims of the study share: errors, their ratios, and which standard errors are misused.

Attributes of ``ParameterErrors``
---------------------------------
- ``experiment``, ``estimator``, ``start``, ``samples``, ``settings``; ``parameter`` and its ``true`` value; ``runs``,
  ``failed``, ``not_converged``; ``counted``: those with a value. Errors are in the unit of the parameter.
- ``mse``; ``n_mse``: times the number of samples; ``theory``: what that approaches; ``ratio`` of the two with its
  standard error ``ratio_error`` for so many data sets [-].
- ``bias``; ``deviation``, the standard deviation of one estimate; ``bias_per_deviation``; ``bias_per_error``: in
  standard errors of the mean, whether there is a bias at all.
- ``with_error``: estimates with a standard error; ``covered``: those whose 95 % interval holds the true value;
  ``coverage`` of the counted ones with its 95 % Wilson interval ``low`` and ``high`` [%]; ``error_ratio``: root mean
  square of the standard errors over the standard deviation of the estimates.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import UsageError
from ctid_cli.inference import monte_carlo
from ctid_cli.inference.monte_carlo import Measured
from ctid_cli.reporting.expected_accuracy import long_record_variances
from ctid_cli.reporting.parameter_errors import ParameterEstimates, common_places, estimates_by_group, place_of
from ctid_cli.reporting.results import Results, lookup
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import spec_from_canonical

#: Errors of one parameter over the data sets of one cell.
ParameterErrors = SimpleNamespace


@dataclass(frozen=True, eq=False)
class StudyEstimates(ParameterEstimates):
    """What one estimator found on the data sets of one data cell, beside theory."""

    experiment: str
    #: Number of samples, and the other swept fields with their values.
    samples: int
    settings: Mapping[str, Any]
    #: N times the variance that theory predicts for long records; None where there is no theory, shape (p,).
    theory: Array | None

    @property
    def estimator(self) -> str:
        """Name of the estimator."""
        return self.group.estimator


@cache
def estimates_of(results: Results) -> list[StudyEstimates]:
    """Estimates of an experiment on a sum of submodels, by estimator, data cell and start."""
    manifest = results.manifest
    if len(results.rows) and "additive" not in (manifest["data_cells"][0]["content"].get("system") or {}):
        wanted = "errors of parameters need data that are simulated from a sum of submodels (system: additive)"
        raise UsageError(f"{results.experiment}: {wanted}")
    groups = estimates_by_group(results)
    variances = long_record_variances(build_plan(spec_from_canonical(results.settings))) if groups else {}
    cells = {cell["hash"]: cell for cell in manifest["data_cells"]}
    found = []
    for one in groups:
        cell, theory = cells[one.group.cell], variances.get(place_of(results, one.group))
        options = zip(results.swept("estimators"), one.group.options, strict=True)
        swept = {name: value for name, value in cell["swept"].items() if name != "samples"}
        found.append(
            StudyEstimates(
                **{field.name: getattr(one, field.name) for field in fields(ParameterEstimates)},
                experiment=results.experiment,
                samples=int(lookup(cell["content"], "sampling.samples") or 0),
                settings=swept | {name: value for name, value in options if value is not None},
                theory=None if theory is None else np.array([theory[name] for name in one.names]),
            )
        )
    return found


@cache
def errors_of(results: Results) -> list[ParameterErrors]:
    """Errors of every parameter."""
    return [_errors_of(group, k) for group in estimates_of(results) for k in range(len(group.names))]


def _errors_of(group: StudyEstimates, k: int) -> ParameterErrors:
    """Errors of one of the parameters."""
    shared = ("experiment", "estimator", "samples", "settings", "runs", "failed", "not_converged")
    theory = None if group.theory is None else float(group.theory[k])
    sample = group.sample(k)
    mse, bias, deviation = monte_carlo.mean_square(sample), monte_carlo.bias(sample), monte_carlo.deviation(sample)
    coverage = monte_carlo.coverage(sample)
    n_mse, n_mse_error = (None if part is None else group.samples * part for part in mse[:2])
    return ParameterErrors(
        **{name: getattr(group, name) for name in shared},
        start=group.group.start,
        parameter=group.names[k],
        true=float(group.truth[k]),
        counted=sample.errors.size,
        mse=mse.value,
        n_mse=n_mse,
        theory=theory,
        ratio=_quotient(n_mse, theory),
        ratio_error=_quotient(n_mse_error, theory),
        bias=bias.value,
        deviation=deviation.value,
        bias_per_deviation=_quotient(bias.value, deviation.value),
        bias_per_error=_quotient(bias.value, bias.error),
        with_error=int(np.isfinite(sample.widths).sum()),
        covered=int(monte_carlo.covered(sample).sum()),
        coverage=coverage.value,
        low=coverage.low,
        high=coverage.high,
        error_ratio=monte_carlo.error_ratio(sample).value,
    )


def _quotient(one: float | None, other: float | None) -> float | None:
    return float(one / other) if one is not None and other else None


def mse_ratio(one: Sequence[StudyEstimates], other: Sequence[StudyEstimates], parameter: str) -> tuple[Measured, int]:
    """Mean-square error of one estimator over that of another, and the number of data sets of both.

    Both estimators see the same noise, so their errors go together, and the ratio is known better than either error.
    Longer records begin with the shorter ones of the same data set, so that their errors go together too: a data set,
    at all its lengths, is what the jackknife leaves out.
    """
    if not one or [(g.experiment, g.samples) for g in one] != [(g.experiment, g.samples) for g in other]:
        raise ValueError("a ratio needs estimates of one experiment at the same numbers of samples")
    groups = [*one, *other]
    for group in groups:
        if parameter not in group.names:
            raise UsageError(f"the system has no parameter {parameter!r}; it has {', '.join(group.names)}")
    places = common_places(*(group.replicates for group in groups))
    squares = np.array(
        [g.samples * g.errors[at, g.names.index(parameter)] ** 2 for g, at in zip(groups, places, strict=True)]
    )
    # N times the squared error by data set, summed over its lengths, where all of them have one.
    parts = squares[:, np.isfinite(squares).all(axis=0)].reshape(2, len(one), -1).sum(axis=1).T
    if len(parts) < 2:
        both = f"{one[0].experiment}: {one[0].estimator} and {other[0].estimator}"
        raise UsageError(f"{both} have {len(parts)} estimates on the same data sets, too few for a ratio")
    ratio = monte_carlo.of_means(lambda one, other, _: one / other, *parts.T)
    return ratio, len(parts)


def parameters(results: Results) -> list[str]:
    """Names of the parameters."""
    return list(dict.fromkeys(row.parameter for row in errors_of(results)))


def by_estimator(results: Results, least: int = 0) -> dict[str, list[StudyEstimates]]:
    """Estimates of each estimator by rising number of samples."""
    groups: dict[str, list[StudyEstimates]] = {}
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
                    ratio, pairs = mse_ratio([other], [own], parameter)
                except UsageError:
                    continue
                yield {
                    "experiment": results.experiment,
                    "estimator": estimator,
                    "samples": own.samples,
                    "parameter": parameter,
                    "pairs": pairs,
                    "ratio": ratio.value,
                    "standard_error": ratio.error or 0.0,
                    "theory": float(other.theory[k] / own.theory[k]),
                }
