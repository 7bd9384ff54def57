"""The plan of one shard: all of the experiment, of which it computes its own data sets."""

from __future__ import annotations

from dataclasses import dataclass, fields

from ctid_cli.errors import UsageError
from ctid_cli.running.cells import Plan, Task
from ctid_cli.storage.manifest import Manifest
from ctid_cli.storage.shards import Shard


@dataclass(frozen=True, eq=False)
class ShardPlan(Plan):
    """A plan whose data sets are dealt to several runs."""

    shard: Shard

    def tasks(self) -> list[Task]:
        """The data sets of this shard."""
        cells = len(self.data_cells)
        return [task for task in super().tasks() if self.shard.has(task.cell, task.replicate, cells)]

    @property
    def data_sets(self) -> int:
        """Number of data sets of this shard."""
        return len(self.tasks())

    def manifest(self) -> Manifest:
        """The plan as plain data."""
        return super().manifest() | {"shard": [self.shard.number, self.shard.of]}


def shard_plan(plan: Plan, shard: Shard) -> ShardPlan:
    """The part of a plan that one shard computes."""
    section = plan.spec.monte_carlo
    if section is not None and section.until is not None:
        raise UsageError(
            f"{plan.experiment}: monte_carlo.until decides on all data sets together, and no shard sees those of the "
            f"others; give their number, for example --runs {section.most}. After the merge, ctid run without --shard "
            "and --runs takes as many of them as the precision needs"
        )
    return ShardPlan(**{part.name: getattr(plan, part.name) for part in fields(plan)}, shard=shard)
