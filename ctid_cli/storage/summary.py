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

from ctid_cli.inference.monte_carlo import wilson_interval
from ctid_cli.simulation.frequency_measures import is_settled
from ctid_cli.storage import columns
from ctid_cli.storage.manifest import found_values

if TYPE_CHECKING:
    import pandas as pd


def is_converged(row: Mapping[str, Any], success: Mapping[str, Any] | None, truth: Mapping[str, float]) -> bool | None:
    """Whether an estimate satisfies the success rule, from the true values by name."""
    rule = success or {}
    conditions = []
    if rule.get("delay_relative_error") is not None and "delay" in truth:
        conditions.append(_near(row["delay"], truth["delay"], rule["delay_relative_error"]))
    others = truth.keys() - {"delay"}
    if rule.get("parameter_relative_error") is not None and others:
        found, tolerance = found_values(row, truth)[0], rule["parameter_relative_error"]
        conditions.append(all(_near(found[name], truth[name], tolerance) for name in others))
    if rule.get("band") is not None:
        conditions.append(is_settled(row.get("measures"), rule["band"], rule.get("by")))
    if rule.get("fit_percent") is not None:
        conditions.append(row["fit_percent"] is not None and row["fit_percent"] >= rule["fit_percent"])
    if not conditions:
        return None
    return row["status"] not in columns.FAILURES and all(conditions)


def _near(value: float | None, true: float, tolerance: float) -> bool:
    return value is not None and abs(value - true) <= tolerance * abs(true)


def summarise(estimates: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """Count estimates in groups."""
    import pandas as pd

    keys = estimates[list(by)].astype(object).where(estimates[list(by)].notna(), None)
    # Without anything to group by, all rows are one group.
    numbers = keys.groupby(list(by) or (lambda _: 0), sort=False, dropna=False).ngroup().to_numpy()
    rows = []
    for number, group in estimates.groupby(numbers):
        n, row = len(group), keys.iloc[int((numbers == number).argmax())].to_dict()
        row |= {"n": n, "failed": int(group["status"].isin(columns.FAILURES).sum())}
        row |= {f"median_{clock}": float(group[clock].median()) for clock in ("seconds", "cpu_seconds")}
        if group["converged"].notna().all():
            k = int(group["converged"].sum())
            low, high = wilson_interval(k, n)
            row |= {"converged": k, "percent": 100 * k / n, "low": 100 * low, "high": 100 * high}
        rows.append(row)
    types = dict.fromkeys(by, "object") | columns.COUNTS
    return pd.DataFrame({name: pd.Series([row.get(name) for row in rows], dtype=kind) for name, kind in types.items()})


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
