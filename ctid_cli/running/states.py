"""Which estimates are stored: one table of states, from which follows what is still to be computed."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.running.job import Job
from ctid_cli.running.limits import Limits
from ctid_cli.running.plan import Plan
from ctid_cli.storage.columns import FAILURES
from ctid_cli.storage.journal import JournalReader
from ctid_cli.storage.manifest import Key

#: States of an estimate: not stored, stored, stored as a failure, and a failure that is to be computed once more.
ABSENT, STORED, FAILED, AGAIN = range(4)
_TO_COMPUTE = (ABSENT, AGAIN)
#: Data set, estimator and start of estimates that differ in the replicate only.
Place = tuple[str, str, str]


class Counts(NamedTuple):
    """Estimates of a plan."""

    planned: int
    #: Stored ones that stay as they are; failures among all stored ones, and those to be computed once more.
    reused: int
    failed: int
    again: int


class States:
    """The state of every estimate, a byte for each."""

    def __init__(self) -> None:
        self._states: dict[Place, bytearray] = defaultdict(bytearray)
        #: How many are stored.
        self.stored = 0

    @classmethod
    def read(cls, log: JournalReader, retry: Collection[str], limits: Limits) -> States:
        """Read what a journal holds; failures are unwanted of some statuses, and where a limit has risen since."""
        states, before = cls(), {session.id: Limits.of(session.info) for session in log.sessions()}
        for row in log.rows():
            states.note(row.key, row.status)
            if row.status in FAILURES and (row.status in retry or limits.rose_since(before[row.session], row.status)):
                states._set(row.key, AGAIN)
        return states

    def note(self, key: Key, status: str) -> None:
        """Note that an estimate was stored."""
        self.stored += self._set(key, FAILED if status in FAILURES else STORED) == ABSENT

    def _set(self, key: Key, state: int) -> int:
        """Set a state and return the one before."""
        known = self._states[key.data_hash, key.estimator_hash, key.start]
        if key.replicate >= len(known):
            known.extend(bytes(key.replicate + 1 - len(known)))
        before, known[key.replicate] = known[key.replicate], state
        return before

    def _get(self, key: Key) -> int:
        known = self._states.get((key.data_hash, key.estimator_hash, key.start), b"")
        return known[key.replicate] if key.replicate < len(known) else ABSENT

    def _of(self, key: Key, count: int) -> Array:
        """Return the states of the first replicates of a place."""
        known = self._states.get((key.data_hash, key.estimator_hash, key.start), bytearray())
        return np.frombuffer(known[:count].ljust(count, b"\0"), dtype=np.uint8)

    def counts(self, plan: Plan) -> Counts:
        """Count the estimates of a plan; those that two names share, once."""
        planned: dict[Place, BoolArray] = {}
        states: dict[Place, Array] = {}
        for cell in range(len(plan.data_cells)):
            asked = plan.asked(cell)
            for key in {key for key, _, _ in plan.keys(cell, 0)}:
                place = key.data_hash, key.estimator_hash, key.start
                planned[place] = asked | planned[place] if place in planned else asked
                states[place] = self._of(key, len(asked))
        found = np.zeros(4, dtype=int)
        for place, asked in planned.items():
            found += np.bincount(states[place][asked], minlength=4)
        return Counts(int(found.sum()), int(found[STORED] + found[FAILED]), int(found[2:].sum()), int(found[AGAIN]))

    def missing(self, plan: Plan) -> list[BoolArray]:
        """Return for every data cell which replicates lack an estimate; of cells that share theirs, for the first."""
        found: list[BoolArray] = []
        seen: set[str] = set()
        for cell in range(len(plan.data_cells)):
            asked = plan.asked(cell)
            lacking = np.zeros(len(asked), dtype=bool)
            for key in {key for key, _, _ in plan.keys(cell, 0) if key.data_hash not in seen}:
                lacking |= np.isin(self._of(key, len(asked)), _TO_COMPUTE)
            seen.add(plan.data_cells[cell].hash)
            found.append(lacking & asked)
        return found

    def jobs(self, plan: Plan, missing: list[BoolArray], seconds: Mapping[tuple[str, str], float]) -> Iterator[Job]:
        """Yield the jobs of a plan when they are asked for, replicate by replicate, the longest of each first.

        Replicates stay in order: a run that is stopped has as many data sets of one cell as of another. What an
        estimate takes is known from those of its data cell and estimator; unknown ones come first.
        """

        def expected(job: Job) -> float:
            return sum(seconds.get((key.data_hash, key.estimator_hash), float("inf")) for key in job.keys)

        for replicate in range(plan.runs):
            cells = [k for k, lacking in enumerate(missing) if replicate < len(lacking) and lacking[replicate]]
            jobs = [plan.job(cell, replicate) for cell in cells]
            wanted = [job.only([key for key in job.keys if self._get(key) in _TO_COMPUTE]) for job in jobs]
            yield from sorted(wanted, key=expected, reverse=True)
