"""Percentages over estimates, and estimates as flat tables.

An estimate has *converged* if it satisfies every condition of the specification's ``success``:

- ``delay_relative_error``: the estimated delay differs from the true one by at most this fraction of it;
- ``fit_percent``: the fit on the record it was estimated from is at least this [%];
- ``parameter_relative_error``: every parameter but the delay differs from the true one by at most this fraction;
- ``band`` [rad/s] and ``by`` [s]: every frequency of a signal came into the band around the true one to stay there,
  counted from the start, and after its last step from that.

Its status does not matter: an estimate that stopped at the iteration limit with the right delay has converged, one that
settled elsewhere has not. An estimate without a result (``FAILED``, ``CRASHED``, ``TIMEOUT``, ``MEMORY``) has not
converged and counts in every percentage. Without ``success``, or without true values to compare with, nothing is said.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.storage import columns
from ctid_cli.storage.manifest import found_values

if TYPE_CHECKING:
    import pandas as pd


def is_converged(row: Mapping[str, Any], success: Mapping[str, Any] | None, truth: Mapping[str, float]) -> bool | None:
    """Whether an estimate satisfies the success rule, from the true values by name."""
    found = {name: _array(value) for name, value in found_values(row, truth)[0].items()}
    failures = np.array([row["status"] in columns.FAILURES])
    hits = judged(success, truth, failures, found, _array(row.get("fit_percent")), [row.get("measures")])
    return None if hits is None else bool(hits[0])


def _array(value: float | None) -> Array:
    return np.array([value], dtype=np.float64)


def judged(
    success: Mapping[str, Any] | None,
    truth: Mapping[str, float],
    failures: BoolArray,
    found: Mapping[str, Array],
    fit_percent: Array,
    measures: Sequence[Mapping[str, float | None] | None] | None,
) -> BoolArray | None:
    """Which estimates satisfy the success rule: from what they found by name, NaN where there is nothing."""
    rule = success or {}
    conditions: list[BoolArray] = []
    if rule.get("delay_relative_error") is not None and "delay" in truth:
        conditions.append(_near(found["delay"], truth["delay"], rule["delay_relative_error"]))
    others = truth.keys() - {"delay"}
    if rule.get("parameter_relative_error") is not None and others:
        conditions += [_near(found[name], truth[name], rule["parameter_relative_error"]) for name in others]
    if rule.get("band") is not None and measures is not None:
        from ctid_cli.simulation.frequency_measures import is_settled

        conditions.append(np.array([is_settled(one, rule["band"], rule.get("by")) for one in measures], dtype=bool))
    if rule.get("fit_percent") is not None:
        conditions.append(fit_percent >= rule["fit_percent"])
    return np.logical_and.reduce([~failures, *conditions]) if conditions else None


def _near(values: Array, true: float, tolerance: float) -> BoolArray:
    return np.abs(values - true) <= tolerance * abs(true)


def counted(failures: BoolArray, converged: BoolArray | None, clocks: Mapping[str, Array]) -> dict[str, Any]:
    """Counts and percentages of a group of estimates, and the medians of their times."""
    n = len(failures)
    row: dict[str, Any] = dict.fromkeys(columns.COUNTS) | {"n": n, "failed": int(failures.sum())}
    for clock, times in clocks.items():
        known = times[np.isfinite(times)]
        row[f"median_{clock}"] = float(np.median(known)) if known.size else None
    if converged is not None:
        from ctid_cli.inference.monte_carlo import wilson_interval

        k = int(converged.sum())
        low, high = wilson_interval(k, n)
        row |= {"converged": k, "percent": 100 * k / n, "low": 100 * low, "high": 100 * high}
    return row


def export_rows(estimates: pd.DataFrame) -> pd.DataFrame:
    """Estimates as a flat table for other programs, with one number per cell."""
    import pandas as pd

    parts = {column.name: column for column in columns.COLUMNS if column.type in ("coefficients", "by name")}
    flat: dict[str, Any] = {}
    for name in estimates.columns:
        if name not in parts:
            flat[name] = estimates[name]
            continue
        for part, values in _parts(parts[name], estimates[name]):
            key, column = f"{parts[name].prefix}{part}", pd.Series(values, dtype="float64", index=estimates.index)
            # Parameters that make a model are its coefficients too; other names that are taken get a longer one.
            if key in estimates.columns and key != "delay":
                key = f"parameters.{key}"
            flat[key] = flat[key].combine_first(column) if key in flat else column
    return pd.DataFrame(flat)


def _parts(column: columns.Column, cells: Iterable[Any]) -> Iterator[tuple[Any, list[float | None]]]:
    """The parts of a column with several numbers in a cell, each with its values."""
    # As mappings, coefficients are numbered from 0; the first one of a denominator is 1 and left out.
    rows: list[Any] = [dict(enumerate(row)) if isinstance(row, list) else row or {} for row in cells]
    found: list[Any] = column.names(rows) if column.type == "by name" else []
    for part in found or sorted({k for row in rows for k in row if k or column.name != "denominator"}):
        yield part, [row.get(part) for row in rows]
