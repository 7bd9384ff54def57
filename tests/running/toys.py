"""Toy estimators that work, raise, end their process or hang: workers import nothing else of the tests."""

from __future__ import annotations

import ctypes
import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.estimation.common import Start
from ctid_cli.inference.fit import Status
from ctid_cli.simulation.dataset import DataSet
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
            for_ever()
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
