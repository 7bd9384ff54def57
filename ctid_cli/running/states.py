"""States of estimates, number of data sets needed, and estimates to compute."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ctid_cli.arrays import BoolArray, IndexArray
from ctid_cli.inference.monte_carlo import CellPrecision, Replications, Until, decide
from ctid_cli.running.job import Job
from ctid_cli.running.limits import Limits
from ctid_cli.running.plan import Plan
from ctid_cli.storage.columns import FAILURES
from ctid_cli.storage.journal import JournalReader
from ctid_cli.storage.manifest import Key, Manifest, true_values
from ctid_cli.storage.truth import arrays_of_rows, found_under, satisfied
from ctid_cli.text import count

#: States of an estimate: not stored, stored, stored as a failure, and a failure to compute again.
ABSENT, STORED, FAILED, AGAIN = range(4)
_TO_COMPUTE = (ABSENT, AGAIN)
#: Data set, estimator and start, shared by estimates that differ only in the replicate.
Place = tuple[str, str, str]


class Workload(NamedTuple):
    """Numbers of stored estimates and of those to compute."""

    data_sets: int
    estimates: int
    #: Stored estimates that are kept; failures among all stored; failures to compute again; estimates of other plans.
    reused: int
    failed: int
    again: int
    left_aside: int
    #: Maximum number of data sets of a data cell, if a precision determines their number.
    at_most: int | None = None

    def __str__(self) -> str:
        text = f"{count(self.estimates, 'estimate')} of {count(self.data_sets, 'data set')} to compute"
        text += f", {self.again} of them once more" if self.again else ""
        text += f", {self.reused} already stored" if self.reused else ""
        text += f", {self.left_aside} stored ones set aside" if self.left_aside else ""
        more = f", then in blocks until they are enough, {self.at_most} data sets of a cell at most"
        return text + more if self.at_most is not None and self.estimates else text


class States:
    """State of every estimate, one byte each."""

    def __init__(self) -> None:
        self._states: dict[Place, bytearray] = defaultdict(bytearray)
        #: Number of stored estimates.
        self.stored = 0

    @classmethod
    def read(cls, log: JournalReader | None, retry: Collection[str], limits: Limits) -> States:
        """Read a journal; failures with a status in `retry`, or under a limit since increased, are computed again."""
        states = cls()
        if log is None:
            return states
        before = {session.id: Limits.of(session.info) for session in log.sessions()}
        for row in log.rows():
            states.note(row.key, row.status)
            if row.status in FAILURES and (row.status in retry or limits.rose_since(before[row.session], row.status)):
                states._of(row.key)[row.replicate] = AGAIN
        return states

    def note(self, key: Key, status: str) -> None:
        """Record that an estimate was stored."""
        known = self._of(key)
        known.extend(bytes(max(0, key.replicate + 1 - len(known))))
        self.stored += known[key.replicate] == ABSENT
        known[key.replicate] = FAILED if status in FAILURES else STORED

    def _of(self, key: Key) -> bytearray:
        """Return the states of an estimate for all replicates."""
        return self._states[key.data_hash, key.estimator_hash, key.start]

    def _table(self, plan: Plan, cell: int) -> IndexArray:
        """Return the states of the estimates of a data cell, shape (estimates of a data set, replicates)."""
        own = plan.replicates[cell]
        rows = [bytes(self._of(key)[:own]).ljust(own, b"\0") for key, _, _ in plan.keys(cell, 0)]
        return np.frombuffer(b"".join(rows), dtype=np.uint8).reshape(len(rows), own).astype(int)

    def missing(self, plan: Plan) -> list[BoolArray]:
        """Return the mask of estimates to compute for every data cell, shape (estimates, replicates)."""
        cells = range(len(plan.data_cells))
        return [np.isin(self._table(plan, cell), _TO_COMPUTE) & plan.requested(cell) for cell in cells]

    def workload(self, plan: Plan) -> Workload:
        """Return the numbers of stored estimates of a plan and of those to compute."""
        found = np.zeros(4, dtype=int)
        for cell in range(len(plan.data_cells)):
            found += np.bincount(self._table(plan, cell)[:, plan.requested(cell)].ravel(), minlength=4)
        absent, stored, failed, again = found.tolist()
        return Workload(
            data_sets=data_sets(self.missing(plan)),
            estimates=absent + again,
            reused=stored + failed,
            failed=failed + again,
            again=again,
            left_aside=self.stored - stored - failed - again,
            at_most=plan.monte_carlo.get("at_most"),
        )


def data_sets(missing: list[BoolArray]) -> int:
    """Return the number of data sets with missing estimates."""
    return sum(int(lacking.any(axis=0).sum()) for lacking in missing)


def jobs_of(plan: Plan, missing: list[BoolArray]) -> Iterator[Job]:
    """Yield the jobs of a plan lazily, replicate by replicate.

    Thus a stopped run has about the same number of data sets in every cell.
    """
    for replicate in range(plan.runs):
        for cell, lacking in enumerate(missing):
            if replicate < lacking.shape[1] and lacking[:, replicate].any():
                yield plan.job(cell, replicate, lacking[:, replicate])


# --- number of data sets needed ---------------------------------------------------------------------------------------
#
# The decision depends only on the stored estimates of the data sets before the end of each block. It is therefore the
# same after an interruption, with other workers, and if there are more estimates than needed from an earlier plan.

#: Stored results by estimate.
Found = Mapping[Key, Mapping[str, Any]]


def cell_precisions(manifest: Manifest, found: Found) -> tuple[CellPrecision, ...]:
    """Return the precision of every data cell; empty if the number of data sets is given."""
    section = _precision_section(manifest)
    return () if section is None else tuple(_cell(manifest, cell, section, found) for cell in manifest["data_cells"])


def stored_precisions(manifest: Manifest, log: JournalReader) -> tuple[CellPrecision, ...]:
    """Return the precision of every data cell from a journal."""
    if _precision_section(manifest) is None:
        return ()
    return cell_precisions(manifest, {row.key: row.content for row in log.rows()})


def as_needed(plan: Plan, log: JournalReader | None) -> Plan:
    """Return the plan with the number of data sets known to be needed."""
    cells = () if log is None else stored_precisions(plan.manifest(), log)
    return replace(plan, replicates=tuple(cell.needed for cell in cells)) if cells else plan


def _precision_section(manifest: Manifest) -> Mapping[str, Any] | None:
    """Return the section with the required precision."""
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
    """Return the results of an estimator from the first data set to the last before a missing one."""
    keys = (Key(data, replicate, part["hash"], start) for replicate in itertools.count())
    results = [found[key] for key in itertools.takewhile(found.__contains__, keys)]
    arrays = arrays_of_rows(results)
    values = found_under(tuple(truth), arrays, len(results)).values
    # Without a rule or true values, convergence is undefined.
    hits = satisfied(success, truth, arrays, values, [row.get("measures") for row in results])
    errors = values - np.array([*truth.values()], dtype=float)
    return Replications(hits, errors, tuple(truth), part["name"], part["swept"], start)
