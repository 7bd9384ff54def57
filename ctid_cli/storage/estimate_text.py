"""Estimates as CSV and JSON for other programs, some at a time: what ``ctid export`` writes."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from textwrap import indent
from typing import TYPE_CHECKING, Any

from ctid_cli.storage import columns
from ctid_cli.storage.column_arrays import ROWS
from ctid_cli.storage.estimates import Estimates, export_rows
from ctid_cli.storage.manifest import swept_names

if TYPE_CHECKING:
    import pandas as pd

#: Keys that every estimate carries in machine-readable output, in this order.
ESTIMATE_KEYS = (
    *("id", "experiment", "estimator", "cell", "replicate", "start", "status"),
    *("delay", "numerator", "denominator", "standard_errors", "cost", "fit_percent", "iterations", "seconds"),
)


def as_object(estimate: Mapping[str, Any]) -> dict[str, Any]:
    """An estimate for JSON: the documented keys first, then what else is stored."""
    keys = list(ESTIMATE_KEYS)
    if "parameters" in estimate:
        keys.insert(keys.index("standard_errors"), "parameters")
    return {key: estimate.get(key) for key in keys} | {key: item for key, item in estimate.items() if key not in keys}


def csv_lines(stored: Estimates) -> Iterator[str]:
    """The estimates as CSV, the head first."""
    types = _types(stored)
    head = _head(stored, types)
    yield str(head.to_csv(index=False, lineterminator="\n"))
    for start in range(0, len(stored), ROWS):
        flat = export_rows(stored.part(start, start + ROWS).frame(types=types))
        yield str(flat.reindex(columns=head.columns).to_csv(index=False, lineterminator="\n", header=False))


def _head(stored: Estimates, types: Mapping[str, Any]) -> pd.DataFrame:
    """A table without rows, with the columns of an estimate that has all that any of them has."""
    import pandas as pd

    some: dict[str, Any] = dict.fromkeys(map(str, stored.part(0, 0).frame(types=types)))
    for column in columns.COLUMNS:
        if column.name not in some:
            continue
        if column.type == "by name" and stored.has(column.name):
            there: Any = stored.column(f"{column.name}_present").any(axis=0).tolist()
            parts = zip(stored.export.parts(column.name), there, strict=True)
            some[column.name] = {name: 0.0 for name, one in parts if one}
        elif column.type == "coefficients" and stored.has(column.name):
            some[column.name] = [0.0] * max(0, int(stored.column(f"{column.name}_length").max(initial=0)))
    whole = pd.DataFrame({name: pd.Series([value], dtype="object") for name, value in some.items()})
    return export_rows(whole).iloc[:0]


def _types(stored: Estimates) -> dict[str, Any]:
    """Types that columns of swept fields have over all estimates."""
    import pandas as pd

    swept = [{**block.cell["swept"], **block.estimator["swept"]} for block in stored.blocks]
    return {name: pd.Series([part.get(name) for part in swept]).dtype for name in swept_names(stored.manifest)}


def json_lines(rows: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    """The estimates as one list of objects."""
    before = "[\n"
    for row in rows:
        yield before + indent(json.dumps(as_object(row), indent=1, allow_nan=False), " ")
        before = ",\n"
    yield "[]\n" if before == "[\n" else "\n]\n"
