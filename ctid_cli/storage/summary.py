"""Percentages over estimates, and estimates as flat tables.

An estimate has *converged* if it satisfies every condition of the specification's ``success``:

- ``delay_relative_error``: the estimated delay differs from the true one by at most this fraction of it;
- ``fit_percent``: the fit on the record it was estimated from is at least this [%];
- ``parameter_relative_error``: every parameter of the submodels differs from the true one by at most this fraction;
- ``band`` [rad/s] and ``by`` [s]: every frequency of a signal came into the band around the true one to stay there,
  counted from the start, and after its last step from that.

Its status does not matter: an estimate that stopped at the iteration limit with the right delay has converged, one that
settled elsewhere has not. An estimate without a result (``FAILED``, ``CRASHED``, ``TIMEOUT``) has not converged and
counts in every percentage. Without ``success``, or without true values to compare with, nothing is said.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ctid_cli.simulation.frequency_measures import is_settled
from ctid_cli.storage import columns

if TYPE_CHECKING:
    import pandas as pd


def is_converged(
    row: Mapping[str, Any],
    success: Mapping[str, Any] | None,
    true_delay: float | None,
    true_parameters: Mapping[str, float] | None = None,
) -> bool | None:
    """Whether an estimate satisfies the success rule."""
    rule = success or {}
    conditions = []
    if rule.get("delay_relative_error") is not None and true_delay is not None:
        conditions.append(_near(row["delay"], true_delay, rule["delay_relative_error"]))
    if rule.get("parameter_relative_error") is not None and true_parameters is not None:
        found, tolerance = row.get("parameters") or {}, rule["parameter_relative_error"]
        conditions.append(all(_near(found.get(name), true, tolerance) for name, true in true_parameters.items()))
    if rule.get("band") is not None:
        conditions.append(is_settled(row.get("measures"), rule["band"], rule.get("by")))
    if rule.get("fit_percent") is not None:
        conditions.append(row["fit_percent"] is not None and row["fit_percent"] >= rule["fit_percent"])
    if not conditions:
        return None
    return row["status"] not in columns.FAILURES and all(conditions)


def _near(value: float | None, true: float, tolerance: float) -> bool:
    return value is not None and abs(value - true) <= tolerance * abs(true)


def wilson_interval(k: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval for a proportion.

    With z the normal quantile and p = k / n, the limits are
    ``(p + z^2 / 2n -+ z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)``. They stay inside [0, 1] and are useful for
    few trials and for proportions of 0 and 1.
    """
    if not 0 <= k <= n:
        raise ValueError(f"successes must lie between 0 and the number of trials; got {k} of {n}")
    if n == 0:
        return math.nan, math.nan
    # SciPy is slow to load, and most who read results need no interval.
    from ctid_cli.inference.quantile import normal_quantile

    z = normal_quantile(level)
    p = k / n
    centre = p + z**2 / (2 * n)
    half = z * math.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    scale = 1 + z**2 / n
    # Rounding would otherwise leave 0 or 1 by a hair.
    low = 0.0 if k == 0 else (centre - half) / scale
    high = 1.0 if k == n else (centre + half) / scale
    return low, high


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
        row["median_seconds"] = float(group["seconds"].median())
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
        # As mappings, coefficients are numbered from 0; the first one of a denominator is 1 and left out.
        rows: list[Any] = [dict(enumerate(row)) if isinstance(row, list) else row or {} for row in estimates[name]]
        found: list[Any] = parts[name].names(rows) if parts[name].type == "by name" else []
        found = found or sorted({k for row in rows for k in row if k or name != "denominator"})
        for part in found:
            values = [row.get(part) for row in rows]
            flat[f"{parts[name].prefix}{part}"] = pd.Series(values, dtype="float64", index=estimates.index)
    return pd.DataFrame(flat)
