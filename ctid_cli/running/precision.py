"""How many data sets every data cell needs for the precision that a specification asks for.

What is decided follows from the stored estimates alone, from those of the data sets before the end of each block. So a
run that was interrupted, or that has other workers, decides the same; so does one that finds more estimates than it
needs, of an earlier plan.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import count, takewhile
from typing import Any

import numpy as np

from ctid_cli.inference.monte_carlo import Replications, Until, decide
from ctid_cli.running.plan import Plan
from ctid_cli.storage.estimates import is_converged
from ctid_cli.storage.journal import JournalReader
from ctid_cli.storage.manifest import Key, Manifest, found_values, true_values

#: Stored results by estimate.
Found = Mapping[Key, Mapping[str, Any]]


@dataclass(frozen=True)
class Widest:
    """The measure of a data cell whose interval is farthest from what is asked for."""

    estimator: str
    #: Its swept options.
    options: Mapping[str, Any]
    start: str
    #: ``percent`` or ``rmse``.
    measure: str
    parameter: str | None
    #: Half-width of the 95 % interval, [percentage points] or as a fraction [-]; None where it is not known.
    half_width: float | None
    asked: float


@dataclass(frozen=True)
class CellPrecision:
    """How well a data cell is known."""

    cell: str
    swept: Mapping[str, Any]
    #: ``enough``, ``open`` or ``at_most``, as in a `Decision`.
    state: str
    #: Data sets at the end of the last finished block, and those that are needed as far as is known.
    finished: int
    needed: int
    #: None before the end of the first block, and where there is nothing to measure.
    widest: Widest | None


def cell_precisions(manifest: Manifest, found: Found) -> tuple[CellPrecision, ...]:
    """How well every data cell is known; nothing where the number of data sets is given."""
    section = _asked(manifest)
    return () if section is None else tuple(_cell(manifest, cell, section, found) for cell in manifest["data_cells"])


def stored_precisions(manifest: Manifest, log: JournalReader) -> tuple[CellPrecision, ...]:
    """The same from what a journal holds."""
    if _asked(manifest) is None:
        return ()
    return cell_precisions(manifest, {row.key: row.content for row in log.rows()})


def as_needed(plan: Plan, log: JournalReader) -> Plan:
    """The plan with as many data sets as are known to be needed."""
    cells = stored_precisions(plan.manifest(), log)
    return plan.with_replicates([cell.needed for cell in cells]) if cells else plan


def _asked(manifest: Manifest) -> Mapping[str, Any] | None:
    """The section that asks for a precision."""
    section: Mapping[str, Any] = manifest["spec"].get("monte_carlo") or {}
    return section if section.get("until") else None


def _cell(manifest: Manifest, cell: Mapping[str, Any], section: Mapping[str, Any], found: Found) -> CellPrecision:
    truth = true_values(cell)
    parts = [(part, start) for part in manifest["estimators"] for start in part["starts"]]
    estimates = [_results(found, cell["hash"], part["hash"], start) for part, start in parts]
    replications = [_replications(results, manifest["success"], truth) for results in estimates]
    decision = decide(Until(**section["until"]), replications, section["at_most"])
    widest = None
    if decision.widest is not None:
        (part, start), column = parts[decision.widest.estimator], decision.widest.parameter
        measure, parameter = ("percent", None) if column is None else ("rmse", list(truth)[column])
        of = (part["name"], part["swept"], start, measure, parameter)
        widest = Widest(*of, decision.widest.value, decision.widest.asked)
    return CellPrecision(cell["hash"], cell["swept"], decision.state, decision.finished, decision.needed, widest)


def _results(found: Found, *of: str) -> list[Mapping[str, Any]]:
    """Results of an estimator on a data cell, from the first data set to the last before one that is missing."""
    data, estimator, start = of
    keys = (Key(data, replicate, estimator, start) for replicate in count())
    return [found[key] for key in takewhile(found.__contains__, keys)]


def _replications(
    results: list[Mapping[str, Any]], success: Mapping[str, Any] | None, truth: Mapping[str, float]
) -> Replications:
    hits = [is_converged(row, success, truth) for row in results]
    values = [[found_values(row, truth)[0][name] for name in truth] for row in results]
    errors = np.array(values, dtype=float).reshape(len(results), len(truth)) - np.array([*truth.values()], dtype=float)
    # Without a rule, or without true values to compare with, an estimate neither converges nor fails to.
    return Replications(None if None in hits else np.array(hits, dtype=bool), errors)
