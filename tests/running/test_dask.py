"""Workers of dask: the bytes of one machine, whatever happens to them, and no worker that computes otherwise."""

from __future__ import annotations

import hashlib
import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from ctid_cli.errors import RefusedError, UsageError
from ctid_cli.running import dask_cluster
from ctid_cli.running.engine import Progress, run_experiment
from tests.running.fakes import FakePlan, Toy
from tests.running.hostile import Hostile


def plan() -> Any:
    hostile = (Hostile("leave", at=3, order=6), Hostile("grow", at=4, order=7))
    limits = {"cpu_seconds": 2, "memory_mb": 300}
    return FakePlan(Toy(seconds=0.05), *hostile, Toy("raise", at=2), levels=(5,), runs=7, limits=limits)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    from distributed import LocalCluster

    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "memory_limit": 0}
    with LocalCluster(silence_logs=60, **options) as made:
        yield made


def test_a_cluster_gives_the_bytes_of_one_machine_though_a_worker_is_killed(cluster: Any, tmp_path: Path) -> None:
    killed: list[int] = []

    def kill(progress: Progress) -> None:
        if progress.stored and not killed:
            killed.append(next(iter(cluster.workers.values())).pid)
            os.kill(killed[0], signal.SIGKILL)

    address = cluster.scheduler_address
    summary = run_experiment(plan(), tmp_path / "dask", warm=lambda plan: None, dask=address, progress=kill)
    assert killed
    assert (summary.missing, summary.failed, summary.exit_code) == (0, 4, 0)
    run_experiment(plan(), tmp_path / "here", jobs=2, warm=lambda plan: None)
    assert (tmp_path / "dask" / "runs.h5").read_bytes() == (tmp_path / "here" / "runs.h5").read_bytes()


def test_a_worker_of_another_platform_is_refused_and_named(
    cluster: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("ctid_cli.storage.identity.numeric_platform", lambda: "abacus")
    with pytest.raises(RefusedError, match=r"worker tcp://\S+ on \S+ is of other code .*platform 'abacus' here, "):
        run_experiment(plan(), tmp_path, warm=lambda plan: None, dask=cluster.scheduler_address)


def test_a_worker_of_several_threads_is_refused(tmp_path: Path) -> None:
    from distributed import LocalCluster

    options = {"n_workers": 1, "threads_per_worker": 2, "dashboard_address": None, "silence_logs": 60}
    with LocalCluster(**options) as made, pytest.raises(RefusedError, match="2 threads; start it with --nthreads 1"):
        run_experiment(plan(), tmp_path, warm=lambda plan: None, dask=made.scheduler_address)


def test_a_scheduler_that_does_not_answer_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no scheduler of dask answers at nowhere://1"):
        run_experiment(plan(), tmp_path / "toys", warm=lambda plan: None, dask="nowhere://1")
    assert not (tmp_path / "toys").exists()


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
    assert dask_cluster.files_of(source) == {digest: str(tmp_path / "here.csv")}
    assert dask_cluster.located(source, {digest: content}) is source
    (tmp_path / "here.csv").write_bytes(b"something else")
    elsewhere = dask_cluster.located(source, {digest: content})
    assert Path(elsewhere.excitation.file).read_bytes() == content
    assert (elsewhere.seed, elsewhere.excitation.sha256) == (1, digest)
