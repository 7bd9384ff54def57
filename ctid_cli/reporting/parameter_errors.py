"""Errors of the parameters of submodels over the data sets of an experiment, beside what theory predicts.

Every estimate with a value for each parameter of the system counts, whether its iterations converged or not. An
estimate that failed, or cannot be written as a sum of such submodels, has no error; how many these are, and how many
did not converge, stands beside every number.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import UsageError
from ctid_cli.inference.quantile import normal_quantile
from ctid_cli.reporting.parameter_theory import long_record_variances
from ctid_cli.reporting.results import Results, lookup
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import spec_from_canonical
from ctid_cli.storage.manifest import FAILURES, true_parameters
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
        content = {item.name: getattr(self, item.name) for item in dataclasses.fields(self)}
        settings = content.pop("settings")
        return {"experiment": content.pop("experiment"), **settings, **content}


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
    cells = {cell["hash"]: cell for cell in manifest["data_cells"]}
    truths = {key: true_parameters(cell) for key, cell in cells.items()}
    if any(truth is None for truth in truths.values()):
        raise UsageError(
            f"{results.experiment}: errors of parameters need their true values, and the data are not simulated from "
            "a sum of submodels (system: additive)"
        )
    # By place, not by hash: a later version may write the same specification with more defaults.
    cell_places = {cell["hash"]: k for k, cell in enumerate(manifest["data_cells"])}
    places = {(part["name"], *_items(part["swept"])): k for k, part in enumerate(manifest["estimators"])}
    across = list(dict.fromkeys(name for part in manifest["estimators"] for name in part["swept"]))
    variances = long_record_variances(build_plan(spec_from_canonical(results.settings)))
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in results.rows:
        swept = tuple(row.get(name) for name in across)
        groups.setdefault((row["estimator"], swept, row["cell"], row["start"]), []).append(row)
    found = []
    for (estimator, swept, cell_hash, start), rows in groups.items():
        own = {name: value for name, value in zip(across, swept, strict=True) if value is not None}
        cell, truth = cells[cell_hash], truths[cell_hash]
        assert truth is not None
        names = tuple(truth)
        theory = variances.get((cell_places[cell_hash], places[estimator, *_items(own)]))
        samples = lookup(cell["content"], "sampling.samples")
        failed = sum(row["status"] in FAILURES for row in rows)
        found.append(
            ParameterEstimates(
                experiment=results.experiment,
                estimator=estimator,
                start=start,
                settings={name: value for name, value in cell["swept"].items() if name != "samples"} | own,
                samples=int(samples),
                names=names,
                truth=np.array([truth[name] for name in names]),
                values=_complete([row["parameters"] for row in rows], names),
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
    return [row for group in estimates for row in _errors_of(group)]


def _errors_of(group: ParameterEstimates) -> list[ParameterErrors]:
    complete = np.isfinite(group.values).all(axis=1)
    errors = group.values[complete] - group.truth
    widths = group.standard_errors[complete]
    counted = len(errors)
    rows = []
    for k, name in enumerate(group.names):
        error, width = errors[:, k], widths[:, k]
        theory = None if group.theory is None else float(group.theory[k])
        mse, scatter = _mean(error**2), _deviation(error**2)
        bias, deviation = _mean(error), _deviation(error)
        n_mse = None if mse is None else group.samples * mse
        n_error = None if scatter is None else group.samples * scatter / np.sqrt(counted)
        with_error = int(np.isfinite(width).sum())
        covered = int((np.abs(error) <= QUANTILE * width).sum())
        low, high = wilson_interval(covered, counted)
        typical = float(np.sqrt(np.nanmean(width**2))) if with_error else None
        rows.append(
            ParameterErrors(
                experiment=group.experiment,
                estimator=group.estimator,
                start=group.start,
                samples=group.samples,
                settings=group.settings,
                parameter=name,
                true=float(group.truth[k]),
                runs=group.runs,
                failed=group.failed,
                not_converged=group.not_converged,
                counted=counted,
                mse=mse,
                n_mse=n_mse,
                theory=theory,
                ratio=_quotient(n_mse, theory),
                ratio_error=_quotient(n_error, theory),
                bias=bias,
                deviation=deviation,
                bias_per_deviation=_quotient(bias, deviation),
                bias_per_error=_quotient(bias, None if deviation is None else deviation / np.sqrt(counted)),
                with_error=with_error,
                covered=covered,
                coverage=100.0 * covered / counted if with_error else None,
                low=100.0 * low if with_error else None,
                high=100.0 * high if with_error else None,
                error_ratio=_quotient(typical, deviation),
            )
        )
    return rows


def mse_ratio(one: Sequence[ParameterEstimates], other: Sequence[ParameterEstimates], parameter: str) -> PairedRatio:
    r"""Mean-square error of one estimator over that of another.

    Both estimators see the same noise, so their errors go together, and the ratio is known better than either error.
    Longer records begin with the shorter ones of the same data set, so that their errors go together too: a data set,
    at all its lengths, is what the jack-knife leaves out. With the ratio r of all n data sets and ``r_(i)`` that of all
    but data set i,

    .. math:: s^2 = \frac{n-1}{n} \sum_i \left(r_{(i)} - \frac1n \sum_j r_{(j)}\right)^2.
    """
    if not one or [(g.experiment, g.samples) for g in one] != [(g.experiment, g.samples) for g in other]:
        raise ValueError(
            "a ratio on the same data sets needs estimates of one experiment at the same numbers of samples"
        )
    sums: list[dict[int, float]] = []
    for side in (one, other):
        squares = [_squares(group, parameter) for group in side]
        complete = set.intersection(*(set(found) for found in squares))
        sums.append({replicate: sum(found[replicate] for found in squares) for replicate in complete})
    pairs = sorted(sums[0].keys() & sums[1].keys())
    n = len(pairs)
    if n < 2:
        raise UsageError(
            f"{one[0].experiment}: {one[0].estimator} and {other[0].estimator} have {n} estimates on the same data "
            "sets, too few for a ratio"
        )
    parts = np.array([[side[replicate] for side in sums] for replicate in pairs])
    above, below = parts.sum(axis=0)
    without = (above - parts[:, 0]) / (below - parts[:, 1])
    error = float(np.sqrt((n - 1) / n * np.sum((without - without.mean()) ** 2)))
    return PairedRatio(parameter, tuple(group.samples for group in one), float(above / below), error, n)


def _squares(group: ParameterEstimates, parameter: str) -> dict[int, float]:
    """N times the squared error by replicate."""
    k = group.column(parameter)
    squares = group.samples * (group.values[:, k] - group.truth[k]) ** 2
    return {
        replicate: float(square)
        for replicate, square in zip(group.replicates, squares, strict=True)
        if np.isfinite(square)
    }


def _mean(values: Array) -> float | None:
    return float(values.mean()) if values.size else None


def _deviation(values: Array) -> float | None:
    return float(np.std(values, ddof=1)) if values.size > 1 else None


def _quotient(one: float | None, other: float | None) -> float | None:
    return float(one / other) if one is not None and other else None


def _items(swept: Mapping[str, Any]) -> list[tuple[str, Any]]:
    return list(swept.items())


def _matrix(rows: Sequence[Mapping[str, float | None] | None], names: Sequence[str]) -> Array:
    """Values by row and name; NaN where there is none."""
    return np.array([[(row or {}).get(name) for name in names] for row in rows], dtype=float).reshape(-1, len(names))


def _complete(rows: Sequence[Mapping[str, float | None] | None], names: Sequence[str]) -> Array:
    """The same with NaN throughout a row that lacks a value, so that all parameters count the same data sets."""
    values = _matrix(rows, names)
    values[~np.isfinite(values).all(axis=1)] = np.nan
    return values
