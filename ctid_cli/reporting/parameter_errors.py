"""Errors of the parameters of submodels over the data sets of an experiment, beside what theory predicts.

Every estimate with a value for each parameter of the system counts, whether its iterations converged or not. An
estimate that failed, or cannot be written as a sum of such submodels, has no error; how many these are, and how many
did not converge, stands beside every number.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
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

    def column(self, parameter: str) -> int:
        """Place of a parameter."""
        if parameter not in self.names:
            raise UsageError(f"the system has no parameter {parameter!r}; it has {', '.join(self.names)}")
        return self.names.index(parameter)


@dataclass(frozen=True)
class ParameterErrors:
    """Errors of one parameter over the data sets of one cell, in the units of the parameter."""

    experiment: str
    estimator: str
    start: str
    samples: int
    settings: Mapping[str, Any]
    parameter: str
    true: float
    runs: int
    failed: int
    not_converged: int
    counted: int
    mse: float | None
    n_mse: float | None
    theory: float | None
    #: ``n_mse / theory`` [-].
    ratio: float | None
    #: Standard error of the ratio for so many data sets [-].
    ratio_error: float | None
    bias: float | None
    deviation: float | None
    #: ``bias / deviation`` [-]: the bias of one estimate against its scatter.
    bias_per_deviation: float | None
    #: ``bias / (deviation / sqrt(counted))`` [-]: whether there is one at all.
    bias_per_error: float | None
    with_error: int
    covered: int
    #: Percentage of the counted ones that are covered, and its 95 % Wilson interval [%].
    coverage: float | None
    low: float | None
    high: float | None
    #: Root mean square of the standard errors over the standard deviation of the estimates [-].
    error_ratio: float | None

    def as_dict(self) -> dict[str, Any]:
        """Plain data, with a key for every swept field."""
        content = dict(vars(self))
        return {"experiment": content.pop("experiment"), **content.pop("settings"), **content}


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
    cells = {cell["hash"]: (k, cell, true_parameters(cell)) for k, cell in enumerate(manifest["data_cells"])}
    places = {(part["name"], *part["swept"].items()): k for k, part in enumerate(manifest["estimators"])}
    across = results.swept("estimators")
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in results.rows:
        own = ((name, row[name]) for name in across if row.get(name) is not None)
        groups.setdefault((row["cell"], row["start"], row["estimator"], *own), []).append(row)
    variances = None
    found = []
    for (cell_hash, start, *part), rows in groups.items():
        place, cell, truth = cells[cell_hash]
        if truth is None:
            raise UsageError(
                f"{results.experiment}: errors of parameters need their true values, and the data are not simulated "
                "from a sum of submodels (system: additive)"
            )
        if variances is None:
            variances = long_record_variances(build_plan(spec_from_canonical(results.settings)))
        names = tuple(truth)
        theory = variances.get((place, places[tuple(part)]))
        values = _matrix([row["parameters"] for row in rows], names)
        # All parameters count the same data sets.
        values[~np.isfinite(values).all(axis=1)] = np.nan
        failed = sum(row["status"] in FAILURES for row in rows)
        found.append(
            ParameterEstimates(
                experiment=results.experiment,
                estimator=part[0],
                start=start,
                settings={name: value for name, value in cell["swept"].items() if name != "samples"} | dict(part[1:]),
                samples=int(lookup(cell["content"], "sampling.samples")),
                names=names,
                truth=np.array([*truth.values()]),
                values=values,
                standard_errors=_matrix([row["standard_errors"] for row in rows], names),
                failed=failed,
                not_converged=sum(row["status"] != "CONVERGED" for row in rows) - failed,
                replicates=tuple(row["replicate"] for row in rows),
                theory=None if theory is None else np.array([theory[name] for name in names]),
            )
        )
    return found


def parameter_errors(estimates: Iterable[ParameterEstimates]) -> list[ParameterErrors]:
    """Errors of every parameter."""
    return [_errors_of(group, k) for group in estimates for k in range(len(group.names))]


def _errors_of(group: ParameterEstimates, k: int) -> ParameterErrors:
    """Errors of one of the parameters."""
    complete = np.isfinite(group.values[:, k])
    error, width = group.values[complete, k] - group.truth[k], group.standard_errors[complete, k]
    counted, with_error = len(error), int(np.isfinite(width).sum())
    theory = None if group.theory is None else float(group.theory[k])
    mse, scatter, bias, deviation = _mean(error**2), _deviation(error**2), _mean(error), _deviation(error)
    n_mse = None if mse is None else group.samples * mse
    covered = int((np.abs(error) <= QUANTILE * width).sum())
    shares = (covered / counted, *wilson_interval(covered, counted)) if with_error else ()
    coverage, low, high = (100.0 * share for share in shares) if shares else (None, None, None)
    shared = ("experiment", "estimator", "start", "samples", "settings", "runs", "failed", "not_converged")
    return ParameterErrors(
        **{name: getattr(group, name) for name in shared},
        parameter=group.names[k],
        true=float(group.truth[k]),
        counted=counted,
        mse=mse,
        n_mse=n_mse,
        theory=theory,
        ratio=_quotient(n_mse, theory),
        ratio_error=_quotient(None if scatter is None else group.samples * scatter / np.sqrt(counted), theory),
        bias=bias,
        deviation=deviation,
        bias_per_deviation=_quotient(bias, deviation),
        bias_per_error=_quotient(bias, None if deviation is None else deviation / np.sqrt(counted)),
        with_error=with_error,
        covered=covered,
        coverage=coverage,
        low=low,
        high=high,
        error_ratio=_quotient(float(np.sqrt(np.nanmean(width**2))) if with_error else None, deviation),
    )


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
        raise ValueError(
            "a ratio on the same data sets needs estimates of one experiment at the same numbers of samples"
        )

    def squares(group: ParameterEstimates) -> pd.Series[float]:
        k = group.column(parameter)
        return pd.Series(group.samples * (group.values[:, k] - group.truth[k]) ** 2, list(group.replicates))

    # N times the squared error by data set, summed over its lengths, where all of them have one.
    sides = [reduce(operator.add, map(squares, side)) for side in (one, other)]
    parts = pd.concat(sides, axis=1).dropna().sort_index().to_numpy()
    n = len(parts)
    if n < 2:
        raise UsageError(
            f"{one[0].experiment}: {one[0].estimator} and {other[0].estimator} have {n} estimates on the same data "
            "sets, too few for a ratio"
        )
    above, below = parts.sum(axis=0)
    without = (above - parts[:, 0]) / (below - parts[:, 1])
    error = float(np.sqrt((n - 1) / n * np.sum((without - without.mean()) ** 2)))
    return PairedRatio(parameter, tuple(group.samples for group in one), float(above / below), error, n)


def _mean(values: Array) -> float | None:
    return float(values.mean()) if values.size else None


def _deviation(values: Array) -> float | None:
    return float(np.std(values, ddof=1)) if values.size > 1 else None


def _quotient(one: float | None, other: float | None) -> float | None:
    return float(one / other) if one is not None and other else None


def _matrix(rows: Iterable[Mapping[str, float | None] | None], names: Sequence[str]) -> Array:
    """Values by row and name; NaN where there is none."""
    return np.array([[(row or {}).get(name) for name in names] for row in rows], dtype=float).reshape(-1, len(names))
