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
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ctid_cli.inference.quantile import normal_quantile
from ctid_cli.simulation.frequency_measures import is_settled, measure_names
from ctid_cli.storage.manifest import FAILURES

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
    return row["status"] not in FAILURES and all(conditions)


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

    groups: dict[tuple[Any, ...], list[int]] = {}
    columns = [estimates[name].astype(object).where(estimates[name].notna(), None).tolist() for name in by]
    for position in range(len(estimates)):
        groups.setdefault(tuple(column[position] for column in columns), []).append(position)
    rows = []
    for values, positions in groups.items():
        group = estimates.iloc[positions]
        n = len(group)
        row: dict[str, Any] = dict(zip(by, values, strict=True)) | {"n": n}
        row["failed"] = int(group["status"].isin(FAILURES).sum())
        judged = bool(group["converged"].notna().all())
        converged = int(group["converged"].sum()) if judged else None
        low, high = wilson_interval(converged, n) if converged is not None else (math.nan, math.nan)
        row |= {"converged": converged, "percent": math.nan if converged is None else 100 * converged / n}
        row |= {"low": 100 * low, "high": 100 * high, "median_seconds": float(group["seconds"].median())}
        rows.append(row)
    names = [*by, "n", "failed", "converged", "percent", "low", "high", "median_seconds"]
    return pd.DataFrame({name: pd.Series([row[name] for row in rows], dtype=_dtype(name, by)) for name in names})


def _dtype(name: str, by: Sequence[str]) -> Any:
    if name in by:
        return "object"
    return {"n": "int64", "failed": "int64", "converged": "Int64"}.get(name, "float64")


def export_rows(estimates: pd.DataFrame) -> pd.DataFrame:
    """Estimates as a flat table for other programs."""
    import pandas as pd

    if "measures" in estimates:
        return _flat_measures(estimates)
    numerators, denominators = estimates["numerator"].tolist(), estimates["denominator"].tolist()
    errors = estimates["standard_errors"].tolist()
    flat: dict[str, list[Any]] = {}
    for k in range(max((len(row) for row in numerators if row), default=0)):
        flat[f"b{k}"] = [row[k] if row and k < len(row) else None for row in numerators]
    for k in range(1, max((len(row) for row in denominators if row), default=0)):
        flat[f"a{k}"] = [row[k] if row and k < len(row) else None for row in denominators]
    parameters = estimates["parameters"].tolist() if "parameters" in estimates else []
    for name in parameter_names(parameters):
        flat[name] = [row.get(name) if row else None for row in parameters]
    present = {name for row in errors if row for name in row}
    order = [name for name in (*flat, "delay") if name in present]
    for name in (*order, *sorted(present.difference(order))):
        flat[f"se_{name}"] = [row.get(name) if row else None for row in errors]
    columns: dict[str, Any] = {}
    for name in estimates.columns:
        if name == "numerator":
            columns |= {key: pd.Series(values, dtype="float64", index=estimates.index) for key, values in flat.items()}
        elif name not in ("denominator", "parameters", "standard_errors"):
            columns[name] = estimates[name]
    return pd.DataFrame(columns)


def _flat_measures(estimates: pd.DataFrame) -> pd.DataFrame:
    import pandas as pd

    rows = estimates["measures"].tolist()
    columns: dict[str, Any] = {}
    for name in estimates.columns:
        if name != "measures":
            columns[name] = estimates[name]
            continue
        for measure in measure_names(rows):
            values = [(row or {}).get(measure) for row in rows]
            columns[measure] = pd.Series(values, dtype="float64", index=estimates.index)
    return pd.DataFrame(columns)


def parameter_names(rows: Iterable[Mapping[str, float | None] | None]) -> list[str]:
    """Names of the parameters of submodels that any estimate has."""

    def place(name: str) -> tuple[int, str, int]:
        submodel, coefficient = name.split("_")
        return int(submodel[1:]), coefficient[0], int(coefficient[1:])

    return sorted({name for row in rows if row for name in row}, key=place)
