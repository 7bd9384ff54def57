"""Dask workers: same bytes as on one machine, failures of workers, and refusal of workers with another origin."""

from __future__ import annotations

import hashlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ctid_cli.errors import DataError, RefusedError, UsageError
from ctid_cli.running.engine import Progress
from ctid_cli.running.plan import Plan
from ctid_cli.running.workers import packed, unpacked
from ctid_cli.signals.files import COPIES
from ctid_cli.simulation.dataset import require_content
from tests.running.fakes import exported, run, toy_plan
from tests.running.toys import Toy

# As errors, warnings would end the dask threads in which they occur.
pytestmark = pytest.mark.filterwarnings("default")


def plan() -> Plan:
    hostile = (Toy("leave", at=3, order=6), Toy("grow", at=4, order=7))
    limits = {"cpu_seconds": 2, "memory_mb": 300}
    return toy_plan(Toy(seconds=0.05), *hostile, Toy("raise", at=2), levels=(5,), runs=5, limits=limits)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    from distributed import LocalCluster

    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0", "memory_limit": 0}
    with LocalCluster(silence_logs=60, **options) as made:
        yield made


@pytest.mark.slow
def test_a_cluster_gives_the_bytes_of_one_machine_though_a_worker_is_killed(cluster: Any, tmp_path: Path) -> None:
    killed: list[int] = []

    def kill(progress: Progress) -> None:
        if progress.stored and not killed:
            killed.append(next(iter(cluster.workers.values())).pid)
            os.kill(killed[0], signal.SIGKILL)

    address = cluster.scheduler_address
    summary = run(plan(), tmp_path / "dask", dask=address, progress=kill)
    assert killed
    assert (summary.missing, summary.failed, summary.exit_code) == (0, 4, 0)
    run(plan(), tmp_path / "here")
    assert exported(tmp_path / "dask") == exported(tmp_path / "here")


def test_a_worker_of_another_platform_is_refused_and_named(
    cluster: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("ctid_cli.storage.identity.numeric_platform", lambda: "abacus")
    with pytest.raises(RefusedError, match=r"worker tcp://\S+ on \S+ is of other code .*platform 'abacus' here, "):
        run(plan(), tmp_path, dask=cluster.scheduler_address)


def test_a_worker_of_several_threads_is_refused(tmp_path: Path) -> None:
    from distributed import LocalCluster

    options = {"n_workers": 1, "threads_per_worker": 2, "dashboard_address": ":0", "silence_logs": 60}
    with LocalCluster(**options) as made, pytest.raises(RefusedError, match="2 threads; start it with --nthreads 1"):
        run(plan(), tmp_path, dask=made.scheduler_address)


def test_an_unreachable_scheduler_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="there is no dask scheduler at nowhere://1"):
        run(plan(), tmp_path / "toys", dask="nowhere://1")
    assert not (tmp_path / "toys").exists()


@pytest.mark.slow
def test_data_files_come_by_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = b"t,u\n0,1\n"
    digest = hashlib.sha256(content).hexdigest()
    file = tmp_path / "here.csv"
    file.write_bytes(content)
    assert require_content(str(file), digest) == str(file)
    file.write_bytes(b"something else")
    with pytest.raises(DataError, match="differs from that of the planned"):
        require_content(str(file), digest)
    monkeypatch.setitem(COPIES, digest, "the copy")
    # Also in the separate process of a suspect.
    sent = packed()
    monkeypatch.delitem(COPIES, digest)
    unpacked(sent)
    assert require_content(str(file), digest) == "the copy"
