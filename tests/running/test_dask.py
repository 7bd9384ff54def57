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
from ctid_cli.running.engine import _jobs, run_experiment
from ctid_cli.running.executor import Lost, Message
from ctid_cli.running.limits import Limits
from ctid_cli.running.pool import packed
from ctid_cli.storage.merge import merge, read_source
from tests.running.fakes import FakePlan, Toy


def plan() -> Any:
    return FakePlan(Toy(seconds=0.05), Toy("die", at=2), levels=(5,), runs=9)


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
    assert (summary.planned, summary.computed, summary.failed, summary.exit_code) == (27, 27, 1, 0)
    assert any("is gone; others take over its" in text for text in said)
    for jobs in (1, 2):
        run_experiment(plan(), tmp_path / str(jobs), jobs=jobs, warm=lambda: 0.0)
    shards = [tmp_path / f"shard{number}" for number in (1, 2, 3)]
    for number, place in enumerate(shards, start=1):
        run_experiment(plan().part(number, 3), place, jobs=1, warm=lambda: 0.0)
    merge(map(read_source, shards), tmp_path / "merged")
    assert len({sealed(tmp_path / name) for name in ("dask", "1", "2", "merged")}) == 1


def test_limits_hold(cluster: Any) -> None:
    slow: Any = FakePlan(Toy(seconds=60.0), levels=(5,), runs=1)
    executor = DaskExecutor(slow, Limits(wall_seconds=0.3), cluster.scheduler_address, 2, print)
    try:
        executor.submit(_jobs(slow, set())[0])
        messages: list[Message] = []
        deadline = time.monotonic() + 60
        while not messages and time.monotonic() < deadline:
            messages = executor.collect(0.1)
        (lost,) = (message for message in messages if isinstance(message, Lost))
        assert (lost.cause, lost.reason) == ("time", "not finished after 0.3 s (limits.wall_seconds)")
        assert len(lost.keys) == 1
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
