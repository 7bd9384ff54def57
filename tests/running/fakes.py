"""Plans of toy estimators, for tests of the engine."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ctid_cli.canonical import content_hash
from ctid_cli.running.engine import RunSummary, run_experiment
from ctid_cli.running.job import DataCell, EstimatorCell, Job, run_job
from ctid_cli.running.plan import Plan
from ctid_cli.simulation.start_points import NO_START, StartPoint
from ctid_cli.storage.manifest import Outcome
from tests.running.toys import Toy, ToySource

STARTS = (
    StartPoint("3", "delay", 3.0),
    StartPoint("uniform(0, 9)", "delay", "random", (0.0, 9.0)),
    NO_START,
)


@dataclass(frozen=True)
class ToySpec:
    """The attributes of a specification used by a plan."""

    experiment: str
    content: dict[str, Any]
    text: str
    folder: Path = Path()
    data: None = None
    sampling: None = None
    generators: dict[str, Any] = field(default_factory=dict)
    monte_carlo: None = None

    def canonical(self) -> dict[str, Any]:
        return self.content


def toy_plan(
    *estimators: Toy,
    runs: int = 6,
    levels: tuple[float, ...] = (5, 15.5),
    experiment: str = "toys",
    text: str = "# toys\n",
    precision: dict[str, Any] | None = None,
    limits: dict[str, float] | None = None,
) -> Plan:
    """Plan toys on noise of several levels; every second toy takes no start, the others take two."""
    seed = 7
    system = {"numerator": [2.0], "denominator": [1.0, 1.0], "delay": 8.0}
    contents = [{"system": system, "level": level, "seed": seed} for level in levels]
    cells = []
    for k, toy in enumerate(estimators or (Toy(), Toy(order=3))):
        toy = replace(toy, start_from=None if k % 2 else "delay")
        content = {"kind": "toy", **vars(toy)}
        cells.append(EstimatorCell(f"toy{k}", "toy", toy, content, content_hash(content), {"order": toy.order}))
    spec = {
        "experiment": experiment,
        "monte_carlo": {"seed": seed, **(precision or {"runs": runs})},
        "success": {"delay_relative_error": 0.01},
    }
    return Plan(
        spec=ToySpec(experiment, spec | ({"limits": limits} if limits else {}), text),
        data_cells=tuple(
            DataCell(content, content_hash(content), {"level": level}, ToySource(level, seed))
            for level, content in zip(levels, contents, strict=True)
        ),
        estimators=tuple(cells),
        starts=STARTS,
        replicates=(runs,) * len(levels),
        spec_hash=content_hash(spec),
    )


def run(plan: Plan, place: Path, jobs: int | None = 2, **options: Any) -> RunSummary:
    """Run toys, which need no compiled kernels."""
    return run_experiment(plan, place, jobs=jobs, **{"warm": lambda plan: None, **options})


def exported(place: Path) -> bytes:
    return (place / "runs.h5").read_bytes()


def outcomes_of(job: Job) -> list[Outcome]:
    """Return the outcomes of a job computed in this process."""
    return [entry for entry in run_job(job) if isinstance(entry, Outcome)]
