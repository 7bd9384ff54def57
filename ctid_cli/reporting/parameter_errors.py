"""Errors of the parameters of simulated systems over the data sets, and the variances that theory gives them.

Every estimate with a value for each parameter of the system counts, whether its iterations converged or not. An
estimate that failed, or cannot be written in these parameters, has no error.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce
from typing import Any

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IndexArray
from ctid_cli.errors import CtidError, DataError
from ctid_cli.inference import monte_carlo
from ctid_cli.inference.monte_carlo import Sample
from ctid_cli.reporting.expected_accuracy import expected_accuracy
from ctid_cli.reporting.results import Group, Results
from ctid_cli.running.plan import Plan, build_plan
from ctid_cli.simulation.dataset import SimulatedSource
from ctid_cli.specification.load import spec_from_canonical
from ctid_cli.storage.manifest import true_values


@dataclass(frozen=True, eq=False)
class ParameterEstimates:
    """What one estimator found on the data sets of one data cell."""

    group: Group
    names: tuple[str, ...]
    #: Their true values, shape (p,).
    truth: Array
    #: Estimates by replicate; NaN throughout where one of them is missing, shape (R, p).
    values: Array
    #: Standard errors; NaN where there is none, shape (R, p).
    standard_errors: Array
    #: Standard errors to each side of the 95 % intervals [-], shape (R, p).
    quantiles: Array
    replicates: IndexArray
    #: Whether each estimate failed, and whether one that did not fail did not converge either, shape (R,).
    failures: BoolArray
    unconverged: BoolArray

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
        """How many estimates failed."""
        return int(self.failures.sum())

    @property
    def not_converged(self) -> int:
        """How many ended without convergence, but did not fail."""
        return int(self.unconverged.sum())

    def sample(self, k: int, bound: float = np.nan) -> Sample:
        """Errors of one of the parameters, where it has a value."""
        errors = self.errors[:, k]
        counted = np.isfinite(errors)
        return Sample(errors[counted], self.standard_errors[counted, k], bound, self.quantiles[counted, k])


@lru_cache(maxsize=2)
def estimates_by_group(results: Results) -> list[ParameterEstimates]:
    """Return the estimates of the parameters of simulated systems, by estimator, data cell and start."""
    truths = {cell["hash"]: true_values(cell) for cell in results.manifest["data_cells"]}
    found = {group: rows.found(tuple(truths[group.cell])) for group, rows in results.groups().items()}
    given = _given_delays(found, truths)
    estimates = []
    for group, rows in results.groups().items():
        true = truths[group.cell]
        kept = [name != "delay" or group[1:3] not in given for name in true]
        values, errors, quantiles = (side[:, kept] for side in found.pop(group))
        values[~monte_carlo.complete(values)] = np.nan
        # Results of before quantiles were stored, and estimators that give none.
        quantiles = np.where(np.isnan(quantiles), monte_carlo.QUANTILE, quantiles)
        names = tuple(name for name, keep in zip(true, kept, strict=True) if keep)
        unconverged = (rows.column("status") != b"CONVERGED") & ~rows.failures
        replicates, truth = rows.column("replicate"), np.array([true[name] for name in names])
        estimates.append(
            ParameterEstimates(group, names, truth, values, errors, quantiles, replicates, rows.failures, unconverged)
        )
    return estimates


def _given_delays(found: Mapping[Group, Any], truths: Mapping[str, Mapping[str, float]]) -> set[Any]:
    """Return the estimators, with their options, whose delay is no estimate: always the same, without an error."""
    delays: dict[Any, list[Array]] = {}
    for group, (values, errors, _) in found.items():
        if "delay" in truths[group.cell]:
            k = list(truths[group.cell]).index("delay")
            delays.setdefault(group[1:3], []).append(np.array([values[:, k], errors[:, k]]))
    given = set()
    for estimator, parts in delays.items():
        values, errors = np.hstack(parts)
        known = values[np.isfinite(values)]
        if np.isnan(errors).all() and (known == known[:1]).all():
            given.add(estimator)
    return given


def common_places(*replicates: IndexArray) -> list[IndexArray]:
    """Return the places of the data sets that all sides have, by ascending number, in each of them."""
    common = reduce(np.intersect1d, replicates)
    return [np.flatnonzero(np.isin(own, common)) for own in replicates]


# --- theory ---------------------------------------------------------------------------------------------------------


def least_variances(results: Results) -> dict[Group, dict[str, float]]:
    """Return the variances that theory gives the estimates of each group at their number of samples, where it does."""
    plan = readable_plan(results)
    if plan is None:
        return {}
    truths = [tuple(true_values(cell)) for cell in results.manifest["data_cells"]]
    places = {group: place_of(results, group) for group in results.groups()}
    return {group: _variances(plan, *place, truths[place[0]]) for group, place in places.items()}


@lru_cache(maxsize=2)
def readable_plan(results: Results) -> Plan | None:
    """Return the plan, unless it names code, which is not run to read results, or is of another version."""
    try:
        # Custom measures are stored, and no part of the theory.
        return build_plan(spec_from_canonical({**results.settings, "measures": None}))
    except (CtidError, ValueError):
        return None


def place_of(results: Results, group: Group) -> tuple[int, int]:
    """Return the places of the data cell and of the estimator in the plan.

    Not by hash: a later version may write the same specification with more defaults.
    """
    manifest, options = results.manifest, results.swept("estimators")
    cells = [cell["hash"] for cell in manifest["data_cells"]]
    parts = [(part["name"], tuple(part["swept"].get(name) for name in options)) for part in manifest["estimators"]]
    return cells.index(group.cell), parts.index((group.estimator, group.options))


# Tables, sentences and figures of one page ask for the same; theory for coloured noise takes a second.
@lru_cache(maxsize=1024)
def _variances(plan: Plan, k: int, j: int, truth: tuple[str, ...]) -> dict[str, float]:
    """Return the variances of the parameters in one cell by theory, under their true names; empty without a theory."""
    source = plan.data_cells[k].source
    if not isinstance(source, SimulatedSource):
        return {}
    try:
        expected = expected_accuracy(source, plan.estimators[j].estimator, plan.terms).parameters
    except DataError:
        return {}
    names = _true_names(expected.names, truth)
    return {name: v for name, v in zip(names, expected.covariance.diagonal().tolist(), strict=True) if name is not None}


def _true_names(estimated: Sequence[str], true: Iterable[str]) -> list[str | None]:
    """Return the names that parameters have in the true system, None of those that it lacks.

    Where the estimated numerator is longer than the true one, coefficients go together by their power.
    """
    true = list(true)
    shift = sum(re.fullmatch(r"b\d+", name) is not None for name in estimated)
    shift -= sum(re.fullmatch(r"b\d+", name) is not None for name in true)
    moved = (f"b{int(name[1:]) - shift}" if re.fullmatch(r"b\d+", name) else name for name in estimated)
    return [name if name in true else None for name in moved]
