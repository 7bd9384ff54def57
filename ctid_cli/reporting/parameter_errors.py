"""Errors of parameters over the data sets of an experiment; of submodels, beside what theory predicts.

Every estimate with a value for each parameter of the system counts, whether its iterations converged or not. An
estimate that failed, or cannot be written in these parameters, has no error; how many these are, and how many did not
converge, stands beside every number.

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

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, reduce
from types import SimpleNamespace
from typing import Any

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IndexArray
from ctid_cli.errors import CtidError, DataError, UsageError
from ctid_cli.inference import monte_carlo
from ctid_cli.inference.monte_carlo import Sample
from ctid_cli.reporting.expected_accuracy import expected_accuracy, long_record_variances
from ctid_cli.reporting.results import Group, Results, lookup
from ctid_cli.running.plan import Plan, build_plan
from ctid_cli.simulation.dataset import SimulatedSource
from ctid_cli.specification.load import spec_from_canonical
from ctid_cli.storage.estimates import Estimates
from ctid_cli.storage.manifest import true_values

#: Errors of one parameter over the data sets of one cell.
ParameterErrors = SimpleNamespace


@dataclass(frozen=True, eq=False)
class ParameterEstimates:
    """What one estimator found on the data sets of one data cell."""

    experiment: str
    group: Group
    settings: Mapping[str, Any]
    samples: int
    names: tuple[str, ...]
    #: Their true values, shape (p,).
    truth: Array
    #: Estimates by replicate; NaN throughout where one of them is missing, shape (R, p).
    values: Array
    #: Standard errors; NaN where there is none, shape (R, p).
    standard_errors: Array
    #: Standard errors to each side of the 95 % intervals [-], shape (R, p).
    quantiles: Array
    #: Whether each estimate failed, and whether one that did not fail did not converge either, shape (R,).
    failures: BoolArray
    unconverged: BoolArray
    replicates: IndexArray
    #: N times the variance that theory predicts for long records; None where there is no theory, shape (p,).
    theory: Array | None = None

    @property
    def estimator(self) -> str:
        """Name of the estimator."""
        return self.group.estimator

    @property
    def start(self) -> str:
        """Label of the start."""
        return self.group.start

    def sample(self, k: int, bound: float = np.nan) -> Sample:
        """Errors of one of the parameters, where it has a value."""
        errors = self.errors[:, k]
        counted = np.isfinite(errors)
        return Sample(errors[counted], self.standard_errors[counted, k], bound, self.quantiles[counted, k])

    @property
    def errors(self) -> Array:
        """Estimates minus true values, shape (R, p)."""
        return self.values - self.truth

    @property
    def runs(self) -> int:
        """Data sets that were computed, R."""
        return len(self.replicates)

    @property
    def failed(self) -> int:
        """How many failed."""
        return int(self.failures.sum())

    @property
    def not_converged(self) -> int:
        """How many ended without convergence, but did not fail."""
        return int(self.unconverged.sum())

    def first(self, n: int) -> "ParameterEstimates":
        """Those of the first data sets only."""
        kept = self.replicates < n
        arrays = ("values", "standard_errors", "quantiles", "failures", "unconverged", "replicates")
        return replace(self, **{name: getattr(self, name)[kept] for name in arrays})


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
    """The estimates of an experiment on a sum of submodels, by estimator, data cell and start, beside theory."""
    manifest = results.manifest
    if results.rows and "additive" not in (manifest["data_cells"][0]["content"].get("system") or {}):
        wanted = "errors of parameters need data that are simulated from a sum of submodels (system: additive)"
        raise UsageError(f"{results.experiment}: {wanted}")
    groups = estimates_by_group(results)
    variances = long_record_variances(build_plan(spec_from_canonical(results.settings))) if groups else {}
    found = []
    for one in groups:
        theory = variances.get(place_of(results, one.group))
        found.append(replace(one, theory=None if theory is None else np.array([theory[name] for name in one.names])))
    return found


def least_variances(results: Results) -> dict[Group, dict[str, float]]:
    """Variances that theory gives the estimates of each group at their number of samples, where there is a theory."""
    covariances = least_covariances(results, results.groups())
    return {
        group: dict(zip(names, covariance.diagonal().tolist(), strict=True))
        for group, (names, covariance) in covariances.items()
    }


def least_covariances(results: Results, groups: Iterable[Group]) -> dict[Group, tuple[tuple[str, ...], Array]]:
    """Names of parameters and the covariance that theory gives their estimates, for those groups that have a theory."""
    plan = readable_plan(results)
    if plan is None:
        return {}
    places = {group: place_of(results, group) for group in groups}
    truths = [tuple(true_values(cell)) for cell in results.manifest["data_cells"]]
    known = {place: _covariance(plan, *place, truths[place[0]]) for place in set(places.values())}
    return {group: found for group, place in places.items() if (found := known[place])}


@lru_cache(maxsize=2)
def readable_plan(results: Results) -> Plan | None:
    """The plan, unless it names code, which is not run to read results, or is of another version."""
    try:
        # Custom measures are stored, and no part of the theory.
        return build_plan(spec_from_canonical({**results.settings, "measures": None}))
    except (CtidError, ValueError):
        return None


# Tables, sentences and figures of one page ask for the same; theory for coloured noise takes a second.
@lru_cache(maxsize=1024)
def _covariance(plan: Plan, k: int, j: int, truth: tuple[str, ...]) -> tuple[tuple[str, ...], Array] | None:
    """Names of the parameters in one cell and their covariance by theory; None where there is no theory."""
    source = plan.data_cells[k].source
    if not isinstance(source, SimulatedSource):
        return None
    try:
        expected = expected_accuracy(source, plan.estimators[j].estimator, plan.terms).parameters
    except DataError:
        return None
    names = _true_names(expected.names, truth)
    kept = np.flatnonzero([name is not None for name in names])
    return tuple(name for name in names if name is not None), expected.covariance[np.ix_(kept, kept)]


def _true_names(estimated: Sequence[str], true: Iterable[str]) -> list[str | None]:
    """Names that parameters have in the true system, None of those that it lacks.

    Where the estimated numerator is longer than the true one, coefficients go together by their power.
    """
    true = list(true)
    shift = sum(re.fullmatch(r"b\d+", name) is not None for name in estimated)
    shift -= sum(re.fullmatch(r"b\d+", name) is not None for name in true)
    moved = (f"b{int(name[1:]) - shift}" if re.fullmatch(r"b\d+", name) else name for name in estimated)
    return [name if name in true else None for name in moved]


def place_of(results: Results, group: Group) -> tuple[int, int]:
    """Places of the data cell and of the estimator in the plan.

    Not by hash: a later version may write the same specification with more defaults.
    """
    manifest, options = results.manifest, results.swept("estimators")
    cells = [cell["hash"] for cell in manifest["data_cells"]]
    parts = [(part["name"], tuple(part["swept"].get(name) for name in options)) for part in manifest["estimators"]]
    return cells.index(group.cell), parts.index((group.estimator, group.options))


@lru_cache(maxsize=2)
def estimates_by_group(results: Results) -> list[ParameterEstimates]:
    """Estimates of the parameters of simulated systems, by estimator, data cell and start."""
    groups = results.groups()
    cells = {cell["hash"]: cell for cell in results.manifest["data_cells"]}
    truths = {name: true_values(cell) for name, cell in cells.items()}
    found = {group: rows.found(tuple(truths[group.cell])) for group, rows in groups.items()}
    delays: dict[tuple[Any, ...], list[Array]] = {}
    for group, (values, errors, _) in found.items():
        names = list(truths[group.cell])
        if "delay" in names:
            k = names.index("delay")
            delays.setdefault((group.estimator, group.options), []).append(np.array([values[:, k], errors[:, k]]))
    given = {part for part, parts in delays.items() if _is_given(np.hstack(parts))}
    estimates = []
    for group, rows in groups.items():
        true = truths[group.cell]
        kept = [name != "delay" or (group.estimator, group.options) not in given for name in true]
        known = {name: value for (name, value), keep in zip(true.items(), kept, strict=True) if keep}
        numbers = (side[:, kept] for side in found.pop(group))
        estimates.append(_estimates(results, cells[group.cell], group, rows, known, *numbers))
    return estimates


def _is_given(delays: Array) -> bool:
    """Whether a delay is no estimate: the same in all data sets, and without a standard error, shape (2, n)."""
    values, errors = delays
    known = values[np.isfinite(values)]
    return bool(np.isnan(errors).all() and (known == known[:1]).all())


def _estimates(
    results: Results,
    cell: Mapping[str, Any],
    group: Group,
    rows: Estimates,
    true: Mapping[str, float],
    values: Array,
    errors: Array,
    quantiles: Array,
) -> ParameterEstimates:
    """What an estimator found in a data cell."""
    values[~monte_carlo.complete(values)] = np.nan
    failures = rows.failures
    options = dict(zip(results.swept("estimators"), group.options, strict=True))
    swept = {name: value for name, value in cell["swept"].items() if name != "samples"}
    return ParameterEstimates(
        experiment=results.experiment,
        group=group,
        settings=swept | {name: value for name, value in options.items() if value is not None},
        samples=int(lookup(cell["content"], "sampling.samples") or 0),
        names=tuple(true),
        truth=np.array([*true.values()]),
        values=values,
        standard_errors=errors,
        # Results of before quantiles were stored, and estimators that give none.
        quantiles=np.where(np.isnan(quantiles), monte_carlo.QUANTILE, quantiles),
        failures=failures,
        unconverged=(rows.column("status") != b"CONVERGED") & ~failures,
        replicates=rows.column("replicate"),
    )


def parameter_errors(estimates: Iterable[ParameterEstimates]) -> list[ParameterErrors]:
    """Errors of every parameter."""
    return [_errors_of(group, k) for group in estimates for k in range(len(group.names))]


def _errors_of(group: ParameterEstimates, k: int) -> ParameterErrors:
    """Errors of one of the parameters."""
    shared = ("experiment", "estimator", "start", "samples", "settings", "runs", "failed", "not_converged")
    theory = None if group.theory is None else float(group.theory[k])
    sample = group.sample(k)
    mse, bias, deviation = monte_carlo.mean_square(sample), monte_carlo.bias(sample), monte_carlo.deviation(sample)
    coverage = monte_carlo.coverage(sample)
    n_mse, n_mse_error = (None if part is None else group.samples * part for part in mse[:2])
    return ParameterErrors(
        **{name: getattr(group, name) for name in shared},
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


def mse_ratio(one: Sequence[ParameterEstimates], other: Sequence[ParameterEstimates], parameter: str) -> PairedRatio:
    """Mean-square error of one estimator over that of another.

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
    assert ratio.value is not None
    return PairedRatio(parameter, tuple(group.samples for group in one), ratio.value, ratio.error or 0.0, len(parts))


def common_places(*replicates: IndexArray) -> list[IndexArray]:
    """Return the places of the data sets that all sides have, by ascending number, in each of them."""
    common = reduce(np.intersect1d, replicates)
    return [np.flatnonzero(np.isin(own, common)) for own in replicates]


def _quotient(one: float | None, other: float | None) -> float | None:
    return float(one / other) if one is not None and other else None
