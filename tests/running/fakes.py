"""Plans of toy estimators that work, raise, end their process or hang, for tests of the engine."""

from __future__ import annotations

import ctypes
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from ctid_cli.canonical import content_hash
from ctid_cli.errors import DataError
from ctid_cli.estimation.common import Start
from ctid_cli.inference.fit import Status
from ctid_cli.running.engine import RunSummary, run_experiment
from ctid_cli.running.job import DataCell, EstimatorCell, Job, run_job
from ctid_cli.running.plan import Plan
from ctid_cli.simulation.dataset import DataSet
from ctid_cli.simulation.start_points import NO_START, StartPoint
from ctid_cli.storage.manifest import Outcome
from tests.running.hostile import for_ever, misbehave


@dataclass(frozen=True)
class FakeFit:
    model: Any
    standard_errors: dict[str, float]
    cost: float
    status: Status = Status.CONVERGED
    fit_percent: float = 97.5
    iterations: int = 4
    condition_number: float = float("nan")
    law: None = None

    @property
    def quantiles(self) -> dict[str, float]:
        return dict.fromkeys(self.standard_errors, 2.5)


@dataclass(frozen=True)
class FakeRecord:
    y: np.ndarray
    replicate: int


@dataclass(frozen=True)
class ToySource:
    """Source of noise data sets at some level; that of replicate `hangs_at` is never finished."""

    level: float
    seed: int
    hangs_at: int = -1

    def dataset(self, replicate: int) -> DataSet:
        while replicate == self.hangs_at:
            time.sleep(60)
        rng = np.random.default_rng([self.seed, replicate])
        return DataSet(FakeRecord(rng.standard_normal(50) * self.level, replicate))


@dataclass(frozen=True)
class Toy:
    """Estimator by random numbers; it misbehaves in replicate `at`, until the file `marker` exists."""

    mischief: str = "none"
    at: int = -1
    seconds: float = 0.0
    busy: bool = False
    order: int = 2
    marker: str = ""
    start_from: str | None = None

    def prepare(self, record: FakeRecord) -> Prepared:
        if self.mischief == "hang in preparation" and record.replicate == self.at:
            for_ever(1.0)
        if self.mischief == "unusable":
            raise DataError("the input is constant")
        return Prepared(self, record)


@dataclass(frozen=True)
class Prepared:
    toy: Toy
    record: FakeRecord

    def fit(self, start: Start | None) -> FakeFit:
        toy, y, here = self.toy, self.record.y, self.record.replicate == self.toy.at
        until = time.perf_counter() + toy.seconds
        while toy.busy and time.perf_counter() < until:
            pass
        if toy.seconds and not toy.busy:
            time.sleep(toy.seconds)
        if here and not (toy.marker and Path(toy.marker).exists()):
            misbehave(toy.mischief, toy.marker)
        shift = 0.0 if start is None or start.delay is None else start.delay
        model = SimpleNamespace(
            numerator=y[: toy.order] / 3,
            denominator=np.concatenate([[1.0], y[-toy.order :]]),
            delay=8.0 + 0.1 * shift * float(y[0]),
        )
        cost = float(blas_threads()) if toy.mischief == "count threads" else float(y @ y)
        return FakeFit(model, {"b0": 0.1, "delay": float("nan") if here else 0.01}, cost)


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


def blas_threads() -> int:
    """Return the maximum number of threads of any OpenBLAS in this process."""
    import scipy.linalg  # noqa: F401  (loads a BLAS of its own)

    counts = []
    for name in {line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines() if "openblas" in line}:
        library = ctypes.CDLL(name)
        for function in ("scipy_openblas_get_num_threads64_", "scipy_openblas_get_num_threads"):
            if hasattr(library, function):
                counts.append(getattr(library, function)())
    return max(counts)
