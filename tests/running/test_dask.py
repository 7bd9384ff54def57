"""Workers of dask: the bytes of one machine, whatever happens to them, and no worker that computes otherwise."""

from __future__ import annotations

import hashlib
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from ctid_cli.errors import RefusedError, UsageError
from ctid_cli.running import events, remote
from ctid_cli.running.dask_executor import DaskExecutor
from ctid_cli.running.engine import run_experiment
from ctid_cli.running.executor import Computed, Done, Lost, Message
from ctid_cli.running.limits import Limits
from ctid_cli.running.pool import packed
from ctid_cli.running.retry import Stock
from ctid_cli.running.todo import Todo
from ctid_cli.storage.estimates import read_estimates
from ctid_cli.storage.merge import merge
from tests.running.fakes import FakePlan, Toy
from tests.running.hostile import Hostile


def plan() -> Any:
    return FakePlan(Toy(seconds=0.05), Toy("raise", at=2), levels=(5,), runs=7)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    import dask
    from distributed import LocalCluster

    with (
        dask.config.set({"distributed.worker.daemon": False}),
        LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None, memory_limit=0, silence_logs=60
        ) as made,
    ):
        yield made


def sealed(place: Path) -> bytes:
    return (place / "runs.h5").read_bytes()


def test_one_machine_or_many_give_the_same_bytes(cluster: Any, tmp_path: Path) -> None:
    said: list[str] = []
    killed: list[int] = []

    def kill(event: events.Event) -> None:
        if isinstance(event, events.EstimatesDone) and not killed:
            killed.append(next(iter(cluster.workers.values())).pid)
            os.kill(killed[0], signal.SIGKILL)

    def executor(limits: Limits) -> DaskExecutor:
        return DaskExecutor(plan(), limits, cluster.scheduler_address, 2, said.append)

    summary = run_experiment(plan(), tmp_path / "dask", warm=lambda: 0.0, executor=executor, on_event=kill)
    assert (summary.planned, summary.computed, summary.failed, summary.exit_code) == (21, 21, 1, 0)
    assert any("is gone; others take over its" in text for text in said)
    for jobs in (1, 2):
        run_experiment(plan(), tmp_path / str(jobs), jobs=jobs, warm=lambda: 0.0)
    shards = [tmp_path / f"shard{number}" for number in (1, 2, 3)]
    for number, place in enumerate(shards, start=1):
        run_experiment(plan().part(number, 3), place, jobs=1, warm=lambda: 0.0)
    merge(shards, tmp_path / "merged")
    assert len({sealed(tmp_path / name) for name in ("dask", "1", "2", "merged")}) == 1


def test_hostile_estimates_are_named_and_all_others_are_stored(cluster: Any, tmp_path: Path) -> None:
    names = {"loop": "TIMEOUT", "grow": "MEMORY", "leave": "CRASHED", "be killed": None}
    # Estimators with one start, and with two, in turn.
    toys = [toy for k, name in enumerate(names) for toy in (Toy(order=2 + k), Hostile(name, at=1, order=6 + k))]
    hostile: Any = FakePlan(*toys, levels=(5,), runs=3, limits={"cpu_seconds": 2, "memory_mb": 300})

    def executor(limits: Limits) -> DaskExecutor:
        return DaskExecutor(hostile, limits, cluster.scheduler_address, 2, print)

    summary = run_experiment(hostile, tmp_path, warm=lambda: 0.0, executor=executor)
    assert (summary.planned, summary.computed, summary.missing, summary.failed) == (36, 35, 1, 3)
    assert "1 are missing (toy7 on replicate 1): SIGKILL" in str(summary.machine_error())
    frame = read_estimates(tmp_path)
    failed = frame[frame["status"] != "CONVERGED"]
    found = list(zip(failed["estimator"], failed["replicate"], failed["status"], strict=True))
    assert found == [("toy1", 1, "TIMEOUT"), ("toy3", 1, "MEMORY"), ("toy5", 1, "CRASHED")]


def test_what_is_finished_of_a_data_set_comes_before_the_rest(cluster: Any) -> None:
    sleeps: Any = FakePlan(Toy(), Hostile("sleep", at=0, order=5), levels=(5,), runs=1)
    executor = DaskExecutor(sleeps, Limits(), cluster.scheduler_address, 2, print)
    try:
        executor.submit(next(Todo(sleeps, Stock()).jobs()))
        messages: list[Message] = []
        deadline = time.monotonic() + 60
        while sum(len(message.outcomes) for message in messages if isinstance(message, Computed)) < 2:
            assert time.monotonic() < deadline
            messages += executor.collect(0.1)
        assert not any(isinstance(message, Done | Lost) for message in messages)
    finally:
        executor.close()


def test_a_worker_of_another_platform_is_refused_and_named(cluster: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ctid_cli.storage.identity.numeric_platform", lambda: "abacus")
    with pytest.raises(RefusedError, match=r"worker tcp://\S+ on \S+ is of other code .*platform 'abacus' here, "):
        DaskExecutor(plan(), Limits(), cluster.scheduler_address, 2, lambda text: None)


def test_a_scheduler_that_is_no_address_is_told(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no scheduler of dask answers at nowhere://1"):
        DaskExecutor(plan(), Limits(), "nowhere://1", 2, print)


@dataclass(frozen=True)
class Replayed:
    file: str
    sha256: str


@dataclass(frozen=True)
class Source:
    excitation: Replayed
    seed: int = 1


def test_data_files_come_by_content(tmp_path: Path) -> None:
    content = b"t,u\n0,1\n"
    digest = hashlib.sha256(content).hexdigest()
    (tmp_path / "here.csv").write_bytes(content)
    source = Source(Replayed(str(tmp_path / "here.csv"), digest))
    assert remote.files_of(source) == {digest: str(tmp_path / "here.csv")}
    remote.identify(packed([]), {digest: content})
    assert remote._located(source) is source
    (tmp_path / "here.csv").write_bytes(b"something else")
    elsewhere = remote._located(source)
    assert Path(elsewhere.excitation.file).read_bytes() == content
    assert (elsewhere.seed, elsewhere.excitation.sha256) == (1, digest)
