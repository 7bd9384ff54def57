"""The variances that theory predicts on long records for the parameters of a Monte Carlo experiment."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from ctid_cli.canonical import content_hash
from ctid_cli.errors import DataError
from ctid_cli.reporting.expected_accuracy import LONG, expected_accuracy
from ctid_cli.running.plan import Plan
from ctid_cli.signals.sampling import RegularSampling
from ctid_cli.simulation.dataset import SimulatedSource


def long_record_variances(plan: Plan) -> dict[tuple[int, int], dict[str, float]]:
    """Variances of the parameters of submodels that estimates approach on long records.

    The limit is taken whatever the number of samples of the cell: short records do not reach it.
    """
    found: dict[tuple[int, int], dict[str, float]] = {}
    # Cells that differ in the number of samples have the same limit.
    known: dict[str, dict[str, float] | None] = {}
    for k, cell in enumerate(plan.data_cells):
        for j, part in enumerate(plan.estimators):
            same = content_hash([_without_length(cell.content), part.content])
            if same not in known:
                known[same] = _variances(cell.source, part.estimator, plan)
            variances = known[same]
            if variances is not None:
                found[k, j] = variances
    return found


def _without_length(content: Mapping[str, Any]) -> dict[str, Any]:
    sampling = {key: value for key, value in (content.get("sampling") or {}).items() if key != "samples"}
    return {key: value for key, value in content.items() if key != "seed"} | {"sampling": sampling}


def _variances(source: Any, estimator: Any, plan: Plan) -> dict[str, float] | None:
    if not isinstance(source, SimulatedSource) or not isinstance(source.sampling, RegularSampling):
        return None
    long = dataclasses.replace(source, sampling=dataclasses.replace(source.sampling, samples=LONG))
    try:
        expected = expected_accuracy(long, estimator, plan.terms)
    except DataError:
        return None
    if not expected.limit:
        return None
    covariance = expected.samples * expected.parameters.covariance
    return dict(zip(expected.parameters.names, covariance.diagonal().tolist(), strict=True))
