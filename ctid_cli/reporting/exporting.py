"""Every estimate of an experiment for other programs, written piece by piece, however many there are."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from textwrap import indent
from typing import TYPE_CHECKING, Any

from ctid_cli.reporting.estimate import as_object
from ctid_cli.storage import columns
from ctid_cli.storage.manifest import swept_names
from ctid_cli.storage.pieces import ranges
from ctid_cli.storage.store import estimates_table
from ctid_cli.storage.stored import Stored
from ctid_cli.storage.summary import export_rows

if TYPE_CHECKING:
    import pandas as pd


def csv_lines(stored: Stored) -> Iterator[str]:
    """The estimates as CSV, the head first."""
    head, swept, rows = _head(stored), _types(stored), stored.every()
    yield _written(head)
    for start, stop in ranges(len(rows)):
        flat = export_rows(estimates_table(stored, list(rows[start:stop]), swept))
        yield _written(flat.reindex(columns=head.columns), header=False)


def _written(frame: pd.DataFrame, *, header: bool = True) -> str:
    return str(frame.to_csv(index=False, lineterminator="\n", header=header))


def _head(stored: Stored) -> pd.DataFrame:
    """A table without rows, with all columns that any of the estimates needs."""
    some: dict[str, Any] = {"replicate": 0}
    for column in columns.COLUMNS:
        if column.type == "by name" and stored.table.has(column.name):
            there: Any = stored.column(f"{column.name}_present").any(axis=0).tolist()
            some[column.name] = {n: 0.0 for n, one in zip(stored.table.parts(column.name), there, strict=True) if one}
        elif column.type == "coefficients" and stored.table.has(column.name):
            some[column.name] = [0.0] * max(0, int(stored.column(f"{column.name}_length").max(initial=0)))
    return export_rows(estimates_table(stored, [some], dict.fromkeys(swept_names(stored.manifest), "object"))).iloc[:0]


def _types(stored: Stored) -> dict[str, Any]:
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


def with_list(content: Mapping[str, Any], name: str, rows: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    """An object as JSON whose last value is a list of estimates."""
    yield json.dumps(content).removesuffix("}") + f", {json.dumps(name)}: ["
    before = ""
    for row in rows:
        yield before + json.dumps(as_object(row))
        before = ", "
    yield "]}\n"
