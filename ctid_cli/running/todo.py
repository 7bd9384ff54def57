"""What of a plan is still to be computed, made into jobs when they are asked for."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import numpy as np

from ctid_cli.arrays import BoolArray
from ctid_cli.running.cells import Plan, Task
from ctid_cli.running.job import Job
from ctid_cli.running.retry import Stock


class Todo:
    """The data sets of which estimates are missing, in the order of the plan."""

    def __init__(self, plan: Plan, stock: Stock) -> None:
        self._plan, self._stock = plan, stock

    @cached_property
    def _missing(self) -> list[BoolArray]:
        """Of every data cell, the replicates that lack an estimate."""
        keys, again, missing = self._stock.keys, self._stock.again, []
        for cell, count in enumerate(self._plan.replicates):
            lacking = np.zeros(count, dtype=bool)
            for key in {key for key, _, _ in self._plan.keys(Task(cell, 0))} if count else ():
                of = (key.data_hash, key.estimator_hash, key.start, count)
                lacking |= ~keys.flags(*of) | again.flags(*of)
            missing.append(lacking)
        return missing

    @cached_property
    def data_sets(self) -> int:
        """How many there are."""
        return sum(bool(self._missing[task.cell][task.replicate]) for task in self._plan.tasks())

    def jobs(self) -> Iterator[Job]:
        """Their jobs."""
        plan = self._plan
        seed, terms = plan.monte_carlo.get("seed"), plan.terms
        for task in plan.tasks():
            if not self._missing[task.cell][task.replicate]:
                continue
            wanted = {}
            for key, estimator, start in plan.keys(task):
                # Two names for the same estimator share their estimates.
                if key not in self._stock and key not in wanted:
                    wanted[key] = (key, estimator, start)
            if wanted:
                yield Job(plan.data_cells[task.cell], task.replicate, seed, tuple(wanted.values()), terms)
