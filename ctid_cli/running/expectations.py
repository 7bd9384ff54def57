"""Standard errors that the estimators of a plan can reach, by theory."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctid_cli.errors import BiasedError, DataError, UsageError
from ctid_cli.inference.intervals import normal_quantile
from ctid_cli.running.job import DataCell, EstimatorCell
from ctid_cli.running.plan import Plan
from ctid_cli.simulation.dataset import SimulatedSource
from ctid_cli.simulation.expected_accuracy import expected_accuracy

#: Different numbers of samples that are shown, of all that are swept.
SIZES = 4
#: Combinations of the other swept settings that are shown.
SETTINGS = 6


def expectations(plan: Plan) -> tuple[list[dict[str, Any]], int]:
    """Return what every estimator can reach in some settings, as data, and how many other settings there are."""
    cells = [(cell, cell.source) for cell in plan.data_cells if isinstance(cell.source, SimulatedSource)]
    if not cells:
        text = f"{plan.experiment} is about a measured record, whose true system is not known; "
        raise UsageError(f"{text}its estimates carry their standard errors: ctid fit, or ctid run and ctid table")
    shown = _shown(cells)
    estimates = [_expectation(cell, source, each, plan) for cell, source in shown for each in plan.estimators]
    return estimates, len(cells) - len(shown)


def _own(cell: DataCell) -> dict[str, Any]:
    """Return swept settings besides the number of samples."""
    return {name: value for name, value in cell.swept.items() if name.split(".")[-1] != "samples"}


def _shown(cells: list[tuple[DataCell, SimulatedSource]]) -> list[tuple[DataCell, SimulatedSource]]:
    """Return data cells of the first settings, each at a few numbers of samples from the least to the greatest."""
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
