"""Errors of the parameters of submodels over the data sets of an experiment, beside what theory predicts.

Every estimate with a value for each parameter of the system counts, whether its iterations converged or not. An
estimate that failed, or cannot be written as a sum of such submodels, has no error; how many these are, and how many
did not converge, stands beside every number.

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

import operator
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from types import SimpleNamespace
from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import UsageError
from ctid_cli.inference.quantile import normal_quantile
from ctid_cli.reporting.expected_accuracy import long_record_variances
from ctid_cli.reporting.results import Results, lookup
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import spec_from_canonical
from ctid_cli.storage.columns import FAILURES
from ctid_cli.storage.manifest import true_parameters
from ctid_cli.storage.summary import wilson_interval

#: Standard errors on either side of an estimate that make a 95 % interval.
QUANTILE = normal_quantile()

#: Errors of one parameter over the data sets of one cell.
ParameterErrors = SimpleNamespace


@dataclass(frozen=True, eq=False)
class ParameterEstimates:
    """What one estimator found on the data sets of one data cell."""

    experiment: str
    estimator: str
    start: str
    settings: Mapping[str, Any]
    samples: int
    names: tuple[str, ...]
    #: Their true values, shape (p,).
    truth: Array
    #: Estimates by replicate; NaN throughout where one of them is missing, shape (R, p).
    values: Array
    #: Standard errors; NaN where there is none, shape (R, p).
    standard_errors: Array
    failed: int
    not_converged: int
    replicates: tuple[int, ...]
    #: N times the variance that theory predicts for long records; None where there is no theory, shape (p,).
    theory: Array | None

    @property
    def runs(self) -> int:
        """Data sets that were computed, R."""
        return len(self.replicates)


@dataclass(frozen=True)
class PairedRatio:
    """Mean-square error of one estimator over that of another on the same data sets."""

    parameter: str
    samples: tuple[int, ...]
    #: The ratio [-].
    ratio: float
    #: Its standard error by the jack-knife [-].
    standard_error: float
    pairs: int


def parameter_estimates(results: Results) -> list[ParameterEstimates]:
    """Sort the estimates of an experiment by estimator, data cell and start."""
    manifest = results.manifest
    # By place, not by hash: a later version may write the same specification with more defaults.
    cells = {cell["hash"]: k for k, cell in enumerate(manifest["data_cells"])}
    places = {(part["name"], *part["swept"].items()): k for k, part in enumerate(manifest["estimators"])}
    across = results.swept("estimators")
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in results.rows:
        own = ((name, row[name]) for name in across if row.get(name) is not None)
        groups.setdefault((row["cell"], row["start"], row["estimator"], *own), []).append(row)
    if groups and any(true_parameters(cell) is None for cell in manifest["data_cells"]):
        wanted = "errors of parameters need data that are simulated from a sum of submodels (system: additive)"
        raise UsageError(f"{results.experiment}: {wanted}")
    variances = long_record_variances(build_plan(spec_from_canonical(results.settings))) if groups else {}
    return [
        _estimates(results, cells[cell], start, part, variances.get((cells[cell], places[tuple(part)])), rows)
        for (cell, start, *part), rows in groups.items()
    ]


def _estimates(
    results: Results, place: int, start: str, part: list[Any], theory: dict[str, float] | None, rows: list[Any]
) -> ParameterEstimates:
    """What an estimator, its name and swept options in ``part``, found in a data cell."""
    cell = results.manifest["data_cells"][place]
    truth = true_parameters(cell) or {}
    values = _matrix([row["parameters"] for row in rows], truth)
    # All parameters count the same data sets.
    values[~np.isfinite(values).all(axis=1)] = np.nan
    failed = sum(row["status"] in FAILURES for row in rows)
    return ParameterEstimates(
        experiment=results.experiment,
        estimator=part[0],
        start=start,
        settings={name: value for name, value in cell["swept"].items() if name != "samples"} | dict(part[1:]),
        samples=int(lookup(cell["content"], "sampling.samples")),
        names=tuple(truth),
        truth=np.array([*truth.values()]),
        values=values,
        standard_errors=_matrix([row["standard_errors"] for row in rows], truth),
        failed=failed,
        not_converged=sum(row["status"] != "CONVERGED" for row in rows) - failed,
        replicates=tuple(row["replicate"] for row in rows),
        theory=None if theory is None else np.array([theory[name] for name in truth]),
    )


def parameter_errors(estimates: Iterable[ParameterEstimates]) -> list[ParameterErrors]:
    """Errors of every parameter."""
    return [_errors_of(group, k) for group in estimates for k in range(len(group.names))]


def _errors_of(group: ParameterEstimates, k: int) -> ParameterErrors:
    """Errors of one of the parameters."""
    shared = ("experiment", "estimator", "start", "samples", "settings", "runs", "failed", "not_converged")
    theory = None if group.theory is None else float(group.theory[k])
    found = error_statistics(group.values[:, k] - group.truth[k], group.standard_errors[:, k])
    mse, mse_error = (None if found[name] is None else group.samples * found[name] for name in ("mse", "mse_error"))
    return ParameterErrors(
        **{name: getattr(group, name) for name in shared},
        parameter=group.names[k],
        true=float(group.truth[k]),
        n_mse=mse,
        theory=theory,
        ratio=_quotient(mse, theory),
        ratio_error=_quotient(mse_error, theory),
        **found,
    )


def error_statistics(errors: Array, widths: Array) -> dict[str, Any]:
    """What the errors of estimates and their standard errors tell, shapes (R,); NaN where there is none."""
    complete = np.isfinite(errors)
    error, width = errors[complete], widths[complete]
    counted, with_error = len(error), int(np.isfinite(width).sum())
    (mse, scatter), (bias, deviation) = _mean_and_deviation(error**2), _mean_and_deviation(error)
    # A standard error that could not be computed covers nothing.
    covered = int((np.abs(error) <= QUANTILE * width).sum())
    shares = (covered / counted, *wilson_interval(covered, counted)) if with_error else ()
    coverage, low, high = (100.0 * share for share in shares) if shares else (None, None, None)
    return {
        "counted": counted,
        "mse": mse,
        "mse_error": None if scatter is None else scatter / np.sqrt(counted),
        "bias": bias,
        "deviation": deviation,
        "bias_per_deviation": _quotient(bias, deviation),
        "bias_per_error": _quotient(bias, None if deviation is None else deviation / np.sqrt(counted)),
        "with_error": with_error,
        "covered": covered,
        "coverage": coverage,
        "low": low,
        "high": high,
        "error_ratio": _quotient(float(np.sqrt(np.nanmean(width**2))) if with_error else None, deviation),
    }


def mse_ratio(one: Sequence[ParameterEstimates], other: Sequence[ParameterEstimates], parameter: str) -> PairedRatio:
    r"""Mean-square error of one estimator over that of another.

    Both estimators see the same noise, so their errors go together, and the ratio is known better than either error.
    Longer records begin with the shorter ones of the same data set, so that their errors go together too: a data set,
    at all its lengths, is what the jack-knife leaves out. With the ratio r of all n data sets and ``r_(i)`` that of all
    but data set i,

    .. math:: s^2 = \frac{n-1}{n} \sum_i \left(r_{(i)} - \frac1n \sum_j r_{(j)}\right)^2.
    """
    import pandas as pd

    if not one or [(g.experiment, g.samples) for g in one] != [(g.experiment, g.samples) for g in other]:
        raise ValueError("a ratio needs estimates of one experiment at the same numbers of samples")

    def squares(group: ParameterEstimates) -> "pd.Series[float]":
        if parameter not in group.names:
            raise UsageError(f"the system has no parameter {parameter!r}; it has {', '.join(group.names)}")
        k = group.names.index(parameter)
        return pd.Series(group.samples * (group.values[:, k] - group.truth[k]) ** 2, list(group.replicates))

    # N times the squared error by data set, summed over its lengths, where all of them have one.
    sides = [reduce(operator.add, map(squares, side)) for side in (one, other)]
    parts = pd.concat(sides, axis=1).dropna().sort_index().to_numpy()
    n = len(parts)
    if n < 2:
        both = f"{one[0].experiment}: {one[0].estimator} and {other[0].estimator}"
        raise UsageError(f"{both} have {n} estimates on the same data sets, too few for a ratio")
    above, below = parts.sum(axis=0)
    without = (above - parts[:, 0]) / (below - parts[:, 1])
    error = float(np.sqrt((n - 1) / n * np.sum((without - without.mean()) ** 2)))
    return PairedRatio(parameter, tuple(group.samples for group in one), float(above / below), error, n)


def _mean_and_deviation(values: Array) -> tuple[float | None, float | None]:
    n = values.size
    return float(values.mean()) if n else None, float(np.std(values, ddof=1)) if n > 1 else None


def _quotient(one: float | None, other: float | None) -> float | None:
    return float(one / other) if one is not None and other else None


def _matrix(rows: Iterable[Mapping[str, float | None] | None], names: Collection[str]) -> Array:
    """Values by row and name; NaN where there is none."""
    return np.array([[(row or {}).get(name) for name in names] for row in rows], dtype=float).reshape(-1, len(names))
