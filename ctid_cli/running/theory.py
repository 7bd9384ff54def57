"""Theoretical variances and standard errors of the estimates of a plan."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from ctid_cli import progress
from ctid_cli.canonical import content_hash
from ctid_cli.errors import BiasedError, CtidError, DataError, UsageError
from ctid_cli.inference.intervals import normal_quantile
from ctid_cli.models.additive import Term
from ctid_cli.running.job import DataCell, EstimatorCell
from ctid_cli.running.plan import Plan, build_plan
from ctid_cli.signals.sampling import RegularSampling
from ctid_cli.simulation.dataset import SimulatedSource
from ctid_cli.simulation.expected_accuracy import LONG, expected_accuracy
from ctid_cli.specification.load import spec_from_canonical
from ctid_cli.storage.manifest import true_values


def readable_plan(settings: Mapping[str, Any]) -> Plan | None:
    """Return the plan of stored results; None if it names custom code, which is not run, or is of another version."""
    try:
        # Custom measures are stored, and not part of the theory.
        return build_plan(spec_from_canonical({**settings, "measures": None}))
    except (CtidError, ValueError):
        return None


# Tables, sentences and figures of one page use the same values; theory for coloured noise takes a second.
@lru_cache(maxsize=1024)
def least_variances(plan: Plan, cell: int, estimator: int) -> dict[str, float]:
    """Return the theoretical variances of the parameters under their true names; empty without a theory."""
    source = plan.data_cells[cell].source
    if not isinstance(source, SimulatedSource):
        return {}
    try:
        expected = expected_accuracy(source, plan.estimators[estimator].estimator, plan.terms).parameters
    except DataError:
        return {}
    names = _true_names(expected.names, true_values({"content": plan.data_cells[cell].content}))
    return {name: v for name, v in zip(names, expected.covariance.diagonal().tolist(), strict=True) if name is not None}


def _true_names(estimated: Sequence[str], true: Iterable[str]) -> list[str | None]:
    """Return the names of parameters in the true system, None for those not in it.

    If the estimated numerator is longer than the true one, coefficients are matched by their power.
    """
    true = list(true)
    shift = sum(re.fullmatch(r"b\d+", name) is not None for name in estimated)
    shift -= sum(re.fullmatch(r"b\d+", name) is not None for name in true)
    moved = (f"b{int(name[1:]) - shift}" if re.fullmatch(r"b\d+", name) else name for name in estimated)
    return [name if name in true else None for name in moved]


def long_record_variances(plan: Plan) -> dict[tuple[int, int], dict[str, float]]:
    """Return N times the asymptotic variances of submodel parameters, by place of data cell and estimator.

    The limit is independent of the cell's number of samples: short records do not reach it.
    """
    found: dict[tuple[int, int], dict[str, float]] = {}
    # Cells that differ in the number of samples or the seed have the same limit.
    known: dict[str, dict[str, float]] = {}
    for (k, cell), (j, part) in itertools.product(enumerate(plan.data_cells), enumerate(plan.estimators)):
        sampling = {key: value for key, value in (cell.content.get("sampling") or {}).items() if key != "samples"}
        content = {key: value for key, value in cell.content.items() if key != "seed"} | {"sampling": sampling}
        same = content_hash([content, part.content])
        if same not in known:
            known[same] = _limit(cell.source, part.estimator, plan.terms)
        if known[same]:
            found[k, j] = known[same]
    return found


def _limit(source: Any, estimator: Any, terms: tuple[Term, ...] | None) -> dict[str, float]:
    if not isinstance(source, SimulatedSource) or not isinstance(source.sampling, RegularSampling):
        return {}
    try:
        expected = expected_accuracy(replace(source, sampling=replace(source.sampling, samples=LONG)), estimator, terms)
    except DataError:
        return {}
    variances = (LONG * expected.parameters.covariance).diagonal()
    return dict(zip(expected.parameters.names, variances.tolist(), strict=True)) if expected.limit else {}


# --- attainable accuracy in some settings -----------------------------------------------------------------------------

#: Number of shown record lengths, if the number of samples is swept.
SIZES = 4
#: Number of shown combinations of the other swept settings.
SETTINGS = 6


def expectations(plan: Plan) -> tuple[list[dict[str, Any]], int]:
    """Return the attainable accuracy of every estimator in some settings, and the number of other settings."""
    cells = [(cell, cell.source) for cell in plan.data_cells if isinstance(cell.source, SimulatedSource)]
    if not cells:
        text = f"{plan.experiment} is about a measured record, whose true system is not known; "
        raise UsageError(f"{text}its estimates carry their standard errors: ctid fit, or ctid run and ctid table")
    shown = _shown(cells)
    pairs = [(*one, each) for one in shown for each in plan.estimators]
    estimates = [_expectation(*one, plan) for one in progress.each("standard errors", pairs)]
    return estimates, len(cells) - len(shown)


def _own(cell: DataCell) -> dict[str, Any]:
    """Return the swept settings other than the number of samples."""
    return {name: value for name, value in cell.swept.items() if name.split(".")[-1] != "samples"}


def _shown(cells: list[tuple[DataCell, SimulatedSource]]) -> list[tuple[DataCell, SimulatedSource]]:
    """Return data cells of the first settings, each at a few numbers of samples from the smallest to the largest."""
    by_settings: dict[str, dict[int, int]] = {}
    for k, (cell, source) in enumerate(cells):
        by_settings.setdefault(repr(_own(cell)), {})[source.sampling.length] = k
    shown: list[int] = []
    for places in list(by_settings.values())[:SETTINGS]:
        some = np.unique(np.linspace(0, len(places) - 1, SIZES).round().astype(int))
        shown += (places[sorted(places)[k]] for k in some)
    return [cells[k] for k in sorted(shown)]


def _expectation(cell: DataCell, source: SimulatedSource, estimator: EstimatorCell, plan: Plan) -> dict[str, Any]:
    """Return the standard errors of one estimator on one kind of data, or the reason for none."""
    about = {"settings": _own(cell), "samples": source.sampling.length, "estimator": estimator.name}
    about |= {"options": dict(estimator.swept), "kind": estimator.kind}
    try:
        expected = expected_accuracy(source, estimator.estimator, plan.terms)
    except BiasedError as error:
        return about | {"scales": False, "reason": f"the estimate is biased, as {error}", "parameters": []}
    except DataError as error:
        return about | {"scales": False, "reason": str(error), "parameters": []}
    of = expected.parameters
    rows = [
        {
            "name": name,
            "value": value,
            "standard_error": error,
            "relative_percent": 100 * error / abs(value) if value else None,
            "half_width_95": normal_quantile() * error,
        }
        for name, value, error in zip(of.names, of.values.tolist(), of.standard_errors.tolist(), strict=True)
    ]
    return about | {"scales": expected.limit, "formula": expected.formula, "parameters": rows}
