"""A plan: the data sets of an experiment, and the estimates that are wanted of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from ctid_cli.errors import UsageError
from ctid_cli.storage.manifest import Key, Manifest, Shard

if TYPE_CHECKING:
    from ctid_cli.models.additive import Term
    from ctid_cli.simulation.dataset import Source, StartPoint
    from ctid_cli.simulation.frequency_measures import SignalSource
    from ctid_cli.specification.spec import Spec


@dataclass(frozen=True, eq=False)
class DataCell:
    """One combination of system, excitation or loop, sampling, noise and seed, or one measured record."""

    content: dict[str, Any]
    hash: str
    swept: dict[str, Any]
    source: Source | SignalSource

    def dataset(self, replicate: int) -> Any:
        """One data set."""
        return self.source.dataset(replicate)


class DataCells(Sequence[DataCell]):
    """The data cells of a plan; very many of them are made when they are asked for."""

    #: So many are made at once, so that what is wrong with any of them is said at once.
    FEW = 1000

    def __init__(self, count: int, make: Callable[[int], DataCell]) -> None:
        self._make = make
        self._made: list[DataCell | None] = [None] * count
        for number in range(count if count <= self.FEW else 1):
            self._made[number] = make(number)

    def __len__(self) -> int:
        return len(self._made)

    def __getitem__(self, item: int) -> DataCell:  # type: ignore[override]  # nobody takes a part of them
        found = self._made[item]
        if found is None:
            found = self._made[item] = self._make(item % len(self))
        return found


@dataclass(frozen=True, eq=False)
class EstimatorCell:
    """One estimator with one combination of its swept options."""

    name: str
    kind: str
    estimator: Any
    content: dict[str, Any]
    hash: str
    swept: dict[str, Any]


@dataclass(frozen=True)
class Task:
    """One data set."""

    cell: int
    replicate: int


@dataclass(frozen=True, eq=False)
class Plan:
    """All data sets and estimates of an experiment."""

    spec: Spec
    data_cells: Sequence[DataCell]
    estimators: tuple[EstimatorCell, ...]
    starts: tuple[StartPoint, ...]
    #: Number of data sets of each data cell.
    replicates: tuple[int, ...]
    spec_hash: str
    #: Whose data sets are computed; None for all.
    shard: Shard | None = None

    @property
    def experiment(self) -> str:
        """Name of the experiment."""
        return self.spec.experiment

    @property
    def monte_carlo(self) -> Mapping[str, Any]:
        """The section on the number of data sets and their seed; empty where nothing is random."""
        return self.spec.canonical().get("monte_carlo") or {}

    @property
    def runs(self) -> int:
        """Number of data sets of the data cell that has most."""
        return max(self.replicates)

    def tasks(self) -> list[Task]:
        """The data sets, those of the shard if it is one."""
        shard, cells = self.shard, len(self.data_cells)
        return [
            Task(cell, replicate)
            for replicate in range(self.runs)
            for cell, own in enumerate(self.replicates)
            if replicate < own and (shard is None or shard.has(cell, replicate, cells))
        ]

    @property
    def data_sets(self) -> int:
        """Number of data sets."""
        return sum(self.replicates) if self.shard is None else len(self.tasks())

    @property
    def estimates_each(self) -> int:
        """Number of estimates of every data set."""
        return len(self.keys(Task(0, 0)))

    @property
    def distinct_each(self) -> int:
        """The same, where two names of the same estimator share their estimates."""
        return len({key for key, _, _ in self.keys(Task(0, 0))})

    def with_replicates(self, replicates: Sequence[int]) -> Plan:
        """The plan with other numbers of data sets."""
        return replace(self, replicates=tuple(replicates))

    def part(self, shard: Shard) -> Plan:
        """The part of the plan that one shard computes."""
        section = self.spec.monte_carlo
        if section is not None and section.until is not None:
            raise UsageError(
                f"{self.experiment}: monte_carlo.until decides on all data sets together, and no shard sees those of "
                f"the others; give their number, for example --runs {section.most}. After the merge, ctid run without "
                "--shard and --runs takes as many of them as the precision needs"
            )
        return replace(self, shard=shard)

    def keys(self, task: Task) -> list[tuple[Key, EstimatorCell, StartPoint]]:
        """The estimates wanted of a data set."""
        data_hash = self.data_cells[task.cell].hash
        return [
            (Key(data_hash, task.replicate, cell.hash, start.label), cell, start)
            for cell in self.estimators
            for start in starts_of(cell.estimator.start_from, self.starts)
        ]

    @property
    def terms(self) -> tuple[Term, ...] | None:
        """Structure of the submodels that estimates of one fraction are also given as; None for none.

        That of the simulated system, by rising natural frequency, or else of the first estimator of submodels.
        """
        from ctid_cli.models.additive import AdditiveModel
        from ctid_cli.simulation.dataset import SimulatedSource

        cell = self.data_cells[0].source
        if isinstance(cell, SimulatedSource) and isinstance(cell.system, AdditiveModel):
            return cell.system.sorted().terms
        found = (getattr(cell.estimator, "terms", None) for cell in self.estimators)
        return next((tuple(terms) for terms in found if terms is not None), None)

    def manifest(self) -> Manifest:
        """The plan as plain data."""
        canonical, wanted = dict(self.spec.canonical()), self.keys(Task(0, 0))
        # Limits end estimates; they are no part of what the results are of.
        canonical.pop("limits", None)
        return {
            "experiment": self.experiment,
            "runs": self.runs,
            "seed": self.monte_carlo.get("seed"),
            "spec_hash": self.spec_hash,
            "spec": canonical,
            "success": canonical.get("success"),
            "data_cells": [
                {"hash": cell.hash, "replicates": own, "swept": dict(cell.swept), "content": cell.content}
                for cell, own in zip(self.data_cells, self.replicates, strict=True)
            ],
            "estimators": [
                {
                    "name": cell.name,
                    "kind": cell.kind,
                    "hash": cell.hash,
                    "swept": dict(cell.swept),
                    "content": cell.content,
                    "starts": [start.label for _, other, start in wanted if other is cell],
                }
                for cell in self.estimators
            ],
            "starts": {start.label: start.initial_delay for start in self.starts},
            **({} if self.shard is None else {"shard": [self.shard.number, self.shard.of]}),
        }


def starts_of(kind: str | None, starts: tuple[StartPoint, ...]) -> tuple[StartPoint, ...]:
    """The starts that an estimator which takes one of a kind begins from."""
    from ctid_cli.simulation.dataset import NO_START

    return tuple(start for start in starts if start.of == kind) or (NO_START,)
