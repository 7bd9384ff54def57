"""Data sets on which an estimator missed the success rule, each with what is needed to make it again."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

from ctid_cli.reporting.percentages import ALWAYS
from ctid_cli.reporting.results import Results, lookup

#: Columns of the list; further swept fields follow.
FAILING_COLUMNS = (
    *("experiment", "sampling", "snr_db", "method", "initial_delay", "start_delay", "replicate", "seed"),
    *("delay", "true_delay", "status", "id"),
)


def failing_estimates(found: Iterable[Results], methods: Collection[str]) -> list[dict[str, Any]]:
    """Estimates that did not meet the success rule of their experiment."""
    failing = []
    for results in found:
        swept = dict.fromkeys(
            name for part in ("data_cells", "estimators") for item in results.manifest[part] for name in item["swept"]
        )
        constant = {name: lookup(results.settings, path) for name, path in ALWAYS.items()}
        for row in results.rows:
            if row["converged"] is not False or row["estimator"] not in methods:
                continue
            content = constant | {name: row.get(name) for name in swept} | row
            content |= {"method": row["estimator"], "sampling": results.sampling, "seed": results.manifest["seed"]}
            failing.append({name: content[name] for name in dict.fromkeys([*FAILING_COLUMNS, *swept])})
    return failing
