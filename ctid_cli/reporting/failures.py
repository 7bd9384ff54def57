"""Data sets on which an estimator missed the success rule, each with what is needed to make it again."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

from ctid_cli.reporting.results import Results, lookup
from ctid_cli.reporting.rows import ALWAYS

#: Columns of the list; further swept fields follow.
FAILING_COLUMNS = (
    *("experiment", "sampling", "snr_db", "method", "initial_delay", "start_delay", "replicate", "seed"),
    *("delay", "true_delay", "status", "id"),
)


def failing_estimates(found: Iterable[Results], methods: Collection[str]) -> list[dict[str, Any]]:
    """Estimates that did not meet the success rule of their experiment.

    Parameters
    ----------
    found : iterable of Results
        Results of experiments.
    methods : collection of str
        Names of the estimators to list.

    Returns
    -------
    list of dict
        One per estimate, in the order of the specifications: ``experiment``, ``sampling``, ``snr_db`` and the other
        swept fields, ``method``, ``initial_delay`` [s] (``"random"``, or None without one) and ``start_delay``, where
        the search did start [s], ``replicate`` and ``seed``, which together make the data set, the estimated ``delay``
        and the ``true_delay`` [s], ``status``, and ``id``, with which ``ctid show ID --history`` makes data set and
        estimate again.
    """
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
