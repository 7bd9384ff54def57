"""How many data sets every data cell needs for the precision that a specification asks for.

What is decided follows from the stored estimates alone, from those of the data sets before the end of each block. So a
run that was interrupted, or that has other workers, decides the same; so does one that finds more estimates than it
needs, of an earlier plan.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import count, takewhile
from typing import Any

import numpy as np

from ctid_cli.inference.monte_carlo import CellPrecision, Replications, Until, decide
from ctid_cli.running.plan import Plan
from ctid_cli.storage.journal import JournalReader
from ctid_cli.storage.manifest import Key, Manifest, true_values
from ctid_cli.storage.truth import arrays_of_rows, found_under, judged

#: Stored results by estimate.
Found = Mapping[Key, Mapping[str, Any]]


def cell_precisions(manifest: Manifest, found: Found) -> tuple[CellPrecision, ...]:
    """How well every data cell is known; nothing where the number of data sets is given."""
    section = _asked(manifest)
    return () if section is None else tuple(_cell(manifest, cell, section, found) for cell in manifest["data_cells"])


def stored_precisions(manifest: Manifest, log: JournalReader) -> tuple[CellPrecision, ...]:
    """The same from what a journal holds."""
    if _asked(manifest) is None:
        return ()
    return cell_precisions(manifest, {row.key: row.content for row in log.rows()})


def as_needed(plan: Plan, log: JournalReader | None) -> Plan:
    """The plan with as many data sets as are known to be needed."""
    cells = () if log is None else stored_precisions(plan.manifest(), log)
    return replace(plan, replicates=tuple(cell.needed for cell in cells)) if cells else plan


def _asked(manifest: Manifest) -> Mapping[str, Any] | None:
    """The section that asks for a precision."""
    section: Mapping[str, Any] = manifest["spec"].get("monte_carlo") or {}
    return section if section.get("until") else None


def _cell(manifest: Manifest, cell: Mapping[str, Any], section: Mapping[str, Any], found: Found) -> CellPrecision:
    truth = true_values(cell)
    replications = [
        _replications(found, cell["hash"], part, start, manifest["success"], truth)
        for part in manifest["estimators"]
        for start in part["starts"]
    ]
    return decide(Until(**section["until"]), replications, section["at_most"], cell["hash"], cell["swept"])


def _replications(
    found: Found,
    data: str,
    part: Mapping[str, Any],
    start: str,
    success: Mapping[str, Any] | None,
    truth: Mapping[str, float],
) -> Replications:
    """Return what an estimator gave, from the first data set to the last before one that is missing."""
    keys = (Key(data, replicate, part["hash"], start) for replicate in count())
    results = [found[key] for key in takewhile(found.__contains__, keys)]
    arrays = arrays_of_rows(results)
    values = found_under(tuple(truth), arrays, len(results)).values
    # Without a rule, or without true values to compare with, an estimate neither converges nor fails to.
    hits = judged(success, truth, arrays, values, [row.get("measures") for row in results])
    errors = values - np.array([*truth.values()], dtype=float)
    return Replications(hits, errors, tuple(truth), part["name"], part["swept"], start)
