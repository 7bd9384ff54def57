"""A plan of toy estimators that behave, raise, die or dawdle: what the engine must cope with."""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import signal
import time
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.running.job import Job, run_job
from ctid_cli.running.plan import Plan
from ctid_cli.simulation.dataset import DataSet
from ctid_cli.storage.manifest import Key, Outcome, Shard


class FakeStatus(Enum):
    CONVERGED = "All is well."


@dataclass(frozen=True)
class FakeModel:
    numerator: np.ndarray
    denominator: np.ndarray
    delay: float


@dataclass(frozen=True)
class FakeFit:
    model: FakeModel
    standard_errors: dict[str, float]
    cost: float
    status: FakeStatus = FakeStatus.CONVERGED
    fit_percent: float = 97.5
    iterations: int = 4
    condition_number: float = float("nan")
    law: None = None

    @property
    def quantiles(self) -> dict[str, float]:
        return dict.fromkeys(self.standard_errors, 2.5)


@dataclass(frozen=True)
class FakeStart:
    delay: float | None


@dataclass(frozen=True)
class FakeRecord:
    y: np.ndarray
    replicate: int


@dataclass(frozen=True)
class FakeData:
    record: FakeRecord
    validation: None = None
    true_model: None = None

    result_of = DataSet.result_of
    _fresh_record: ClassVar[None] = None


@dataclass(frozen=True)
class FakeCell:
    content: dict[str, Any]
    swept: dict[str, Any]
    measures: tuple[()] = ()

    @property
    def source(self) -> FakeCell:
        return self

    @cached_property
    def hash(self) -> str:
        return content_hash(self.content)

    def dataset(self, replicate: int) -> FakeData:
        while replicate == self.content.get("hangs_at", -1):
            time.sleep(60)
        rng = np.random.default_rng([self.content["seed"], replicate])
        return FakeData(FakeRecord(rng.standard_normal(50) * self.content["level"], replicate))


@dataclass(frozen=True)
class Toy:
    """Estimates from random numbers; `mischief` happens in replicate `at`."""

    start_from: ClassVar[str | None] = None

    mischief: str = "none"
    at: int = -1
    seconds: float = 0.0
    busy: bool = False
    order: int = 2
    marker: str = ""

    def prepare(self, record: FakeRecord) -> Prepared:
        if self.mischief == "unusable":
            raise DataError("the input is constant")
        return Prepared(self, record)


@dataclass(frozen=True)
class Prepared:
    toy: Toy
    record: FakeRecord

    def fit(self, start: FakeStart | None) -> FakeFit:
        toy, here = self.toy, self.record.replicate == self.toy.at
        until = time.perf_counter() + toy.seconds
        while toy.busy and time.perf_counter() < until:
            pass
        if toy.seconds and not toy.busy:
            time.sleep(toy.seconds)
        if here and toy.mischief == "raise":
            raise ZeroDivisionError(f"{object()} is no good")
        if here and toy.mischief == "exit":
            raise SystemExit(3)
        if here and toy.mischief == "die":
            os.kill(os.getpid(), signal.SIGSEGV)
        if here and toy.mischief == "die once" and not Path(toy.marker).exists():
            Path(toy.marker).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        shift = 0.0 if start is None or start.delay is None else start.delay
        b = self.record.y[: toy.order] / 3
        a = np.concatenate([[1.0], self.record.y[-toy.order :]])
        model = FakeModel(b, a, 8.0 + 0.1 * shift * float(self.record.y[0]))
        cost = float(self.record.y @ self.record.y) if toy.mischief != "count threads" else float(blas_threads())
        errors = {"b0": 0.1, "delay": float("nan") if here else 0.01}
        return FakeFit(model, errors, cost)


@dataclass(frozen=True)
class FakeEstimatorCell:
    name: str
    estimator: Toy
    starts: tuple[str, ...]
    swept: dict[str, Any] = field(default_factory=dict)
    kind: str = "toy"

    def only(self, start: str) -> FakeEstimatorCell:
        """The same estimator from a single start."""
        return replace(self, starts=(start,))

    @cached_property
    def content(self) -> dict[str, Any]:
        return {"kind": self.kind, **self.estimator.__dict__}

    @cached_property
    def hash(self) -> str:
        return content_hash(self.content)


@dataclass(frozen=True)
class FakeStartPoint:
    label: str
    initial_delay: float | str | None

    def draw(self, seed: int, replicate: int, true_model: object = None) -> FakeStart | None:
        if self.initial_delay == "random":
            return FakeStart(float(np.random.default_rng([seed, 3, replicate]).uniform(0, 9)))
        return None if self.initial_delay is None else FakeStart(float(self.initial_delay))


STARTS = {
    "3": FakeStartPoint("3", 3.0),
    "uniform(0, 9)": FakeStartPoint("uniform(0, 9)", "random"),
    "none": FakeStartPoint("none", None),
}


@dataclass(frozen=True)
class FakeSpec:
    content: dict[str, Any]
    text: str
    folder: Path = Path()

    def canonical(self) -> dict[str, Any]:
        return self.content


class FakePlan:
    """Same surface as the real plan: cells of several noise levels, estimators, starts, runs."""

    terms, files = None, ()
    shard: Shard | None = None
    manifest, runs, job, asked = Plan.manifest, Plan.runs, Plan.job, Plan.asked
    data_sets, monte_carlo = Plan.data_sets, Plan.monte_carlo

    def __init__(
        self,
        *estimators: Toy,
        runs: int = 6,
        levels: tuple[float, ...] = (5, 15.5),
        seed: int = 7,
        experiment: str = "toys",
        names: tuple[str, ...] | None = None,
        text: str = "# toys\n",
        precision: dict[str, Any] | None = None,
        limits: dict[str, float] | None = None,
    ) -> None:
        toys = estimators or (Toy(), Toy(order=3))
        names = names or tuple(f"toy{k}" for k in range(len(toys)))
        self.experiment, self.replicates = experiment, (runs,) * len(levels)
        system = {"numerator": [2.0], "denominator": [1.0, 1.0], "delay": 8.0}
        self.data_cells = tuple(
            FakeCell({"system": system, "level": level, "seed": seed}, {"level": level}) for level in levels
        )
        labels = (("3", "uniform(0, 9)"), ("none",))
        self.estimators = tuple(
            FakeEstimatorCell(name, toy, labels[k % 2], {"order": toy.order})
            for k, (name, toy) in enumerate(zip(names, toys, strict=True))
        )
        self.starts = tuple(STARTS.values())
        content = {
            "experiment": experiment,
            "monte_carlo": {"seed": seed, **(precision or {"runs": runs})},
            "success": {"delay_relative_error": 0.01},
        }
        self.spec_hash = content_hash(content)
        self.spec = FakeSpec(content | ({"limits": limits} if limits else {}), text)

    def with_replicates(self, replicates: Sequence[int]) -> FakePlan:
        other = copy(self)
        other.replicates = tuple(replicates)
        return other

    def part(self, number: int, of: int) -> FakePlan:
        """One of several shards."""
        other = copy(self)
        other.shard = Shard(number, of)
        return other

    def keys(self, cell: int, replicate: int) -> list[tuple[Key, FakeEstimatorCell, FakeStartPoint]]:
        data_hash = self.data_cells[cell].hash
        return [
            (Key(data_hash, replicate, part.hash, label), part, STARTS[label])
            for part in self.estimators
            for label in part.starts
        ]

    def all_keys(self) -> list[Key]:
        """Every estimate that is asked for."""
        places = [(cell, replicate) for cell in range(len(self.data_cells)) for replicate in range(self.runs)]
        return [key for place in places for key, _, _ in self.keys(*place)]


def outcomes_of(job: Job) -> list[Outcome]:
    """What comes of a job in this process."""
    return [entry for entry in run_job(job) if isinstance(entry, Outcome)]


def blas_threads() -> int:
    """Most threads that any OpenBLAS in this process would use."""
    import scipy.linalg  # noqa: F401  (loads a BLAS of its own)

    counts = []
    for name in {line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines() if "openblas" in line}:
        library = ctypes.CDLL(name)
        for function in ("scipy_openblas_get_num_threads64_", "scipy_openblas_get_num_threads"):
            if hasattr(library, function):
                counts.append(getattr(library, function)())
    return max(counts)


def content_hash(content: dict[str, Any]) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]
