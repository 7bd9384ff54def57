from __future__ import annotations

import hashlib
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from ctid_cli.errors import RefusedError, StorageError
from ctid_cli.running import engine
from ctid_cli.running.engine import Progress, preview
from ctid_cli.running.plan import Plan, current_origin
from ctid_cli.running.states import jobs_of
from ctid_cli.storage import folder
from ctid_cli.storage.estimates import read_estimates
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.journal import read_journal
from ctid_cli.storage.manifest import slots
from ctid_cli.storage.status import experiment_status
from tests.running import run_toys
from tests.running.fakes import exported, run, toy_plan
from tests.running.toys import Toy

Start = Callable[..., subprocess.Popen[str]]
ROOT = Path(__file__).resolve().parents[2]


def snapshot(place: Path) -> dict[str, tuple[str, int]]:
    """Return content and modification time of every file."""
    return {
        str(path.relative_to(place)): (hashlib.sha256(path.read_bytes()).hexdigest(), path.stat().st_mtime_ns)
        for path in place.rglob("*")
        if path.is_file()
    }


@pytest.fixture
def start() -> Iterator[Start]:
    """Start a run of toys in a separate process group, which ends with the test."""
    with ExitStack() as stack:

        def started(place: Path, jobs: int, *more: str) -> subprocess.Popen[str]:
            command = [sys.executable, "-m", "tests.running.run_toys", str(place), str(jobs), *more]
            pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
            process = stack.enter_context(subprocess.Popen(command, cwd=ROOT, start_new_session=True, **pipes))
            stack.callback(process.kill)
            return process

        yield started


def read_ids(process: subprocess.Popen[str], lines: int) -> list[str]:
    """Return the ids of the estimates in the next lines of a run's output."""
    assert process.stdout is not None
    ids: list[str] = []
    for _ in range(lines):
        ids += [word for word in process.stdout.readline().split() if word != "ready"]
    return ids


def finish(process: subprocess.Popen[str], within: float = 300) -> tuple[list[str], str]:
    """Return the remaining ids and the error output of a run after it and its workers have ended."""
    assert process.stdout is not None
    assert process.stderr is not None
    watchdog = threading.Timer(within, os.killpg, (process.pid, signal.SIGKILL))
    watchdog.start()
    # Not communicate(), which ignores text already buffered by readline().
    output, errors = process.stdout.read(), process.stderr.read()
    process.wait()
    watchdog.cancel()
    return [word for word in output.split() if word != "ready"], errors


def stored_ids(place: Path) -> set[str]:
    with folder.lock(place), read_journal(place / "journal.sqlite") as log:
        return set() if log is None else {row.key.id for row in log.rows()}


def group_is_gone(process: subprocess.Popen[str], within: float) -> bool:
    deadline = time.monotonic() + within
    while time.monotonic() < deadline:
        alive = subprocess.run(["ps", "-o", "stat=", "-g", str(process.pid)], capture_output=True, text=True).stdout
        if not [line for line in alive.split() if not line.startswith("Z")]:
            return True
        time.sleep(0.1)
    return False


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    place = tmp_path_factory.mktemp("undisturbed") / "toys"
    run(run_toys.plan(seconds=0.02), place)
    return exported(place)


def test_exported_bytes_do_not_depend_on_jobs_or_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(toy_plan(), tmp_path / "one", jobs=1)
    run(toy_plan(), tmp_path / "two", jobs=2)

    def shuffled(*given: Any) -> Any:
        found = list(jobs_of(*given))
        random.Random(3).shuffle(found)
        return iter(found)

    monkeypatch.setattr("ctid_cli.running.engine.jobs_of", shuffled)
    run(toy_plan(), tmp_path / "shuffled", jobs=2)
    assert exported(tmp_path / "one") == exported(tmp_path / "two") == exported(tmp_path / "shuffled")


def test_every_estimate_of_the_plan_is_stored_once_in_its_order_and_then_reported(tmp_path: Path) -> None:
    plan, seen, unsafe = toy_plan(runs=3), list[Progress](), set[str]()

    def check(progress: Progress) -> None:
        seen.append(progress)
        copy = shutil.copytree(tmp_path / "toys", tmp_path / f"copy {len(seen)}")
        unsafe.update({key.id for key in progress.stored} - stored_ids(copy))

    summary = run(plan, tmp_path / "toys", progress=check)
    assert not unsafe
    listed = [slot.key for slot in slots(plan.manifest())]
    places = [(cell, replicate) for cell in range(2) for replicate in range(3)]
    assert set(listed) == {key for where in places for key, _, _ in plan.keys(*where)}
    assert len(listed) == len(set(listed)) == summary.planned == summary.computed == 18
    assert read_estimates(tmp_path / "toys")["id"].tolist() == [key.id for key in listed]
    assert sorted(key for each in seen for key in each.stored) == sorted(listed)
    assert summary.exit_code == 0
    # The workload comes first; data sets are counted.
    assert seen[0] == Progress(0, 6, 0, message="18 estimates of 6 data sets to compute")
    assert [each.done for each in seen] == sorted(each.done for each in seen)
    assert (seen[-1].done, seen[-1].failed) == (6, 0)


def test_only_what_is_new_is_computed(tmp_path: Path) -> None:
    run(toy_plan(Toy(), runs=2), tmp_path)
    more_runs = run(toy_plan(Toy(), runs=3), tmp_path)
    assert (more_runs.reused, more_runs.computed) == (8, 4)
    more_estimators = run(toy_plan(Toy(), Toy(order=3), runs=3), tmp_path)
    assert (more_estimators.reused, more_estimators.computed) == (12, 6)
    fewer = run(toy_plan(Toy(), runs=2), tmp_path)
    assert (fewer.reused, fewer.computed, fewer.left_aside) == (8, 0, 10)
    assert len(read_estimates(tmp_path)) == 8
    status = experiment_status(tmp_path)
    assert (status.planned, status.done, status.left_aside) == (8, 8, 10)
    run(toy_plan(Toy(), runs=2), tmp_path / "alone")
    assert exported(tmp_path) == exported(tmp_path / "alone")


# Misbehaving estimators


def test_an_estimator_that_raises_is_recorded_with_the_place(tmp_path: Path) -> None:
    summary = run(toy_plan(Toy("raise", at=1), Toy("exit", at=2)), tmp_path)
    frame = read_estimates(tmp_path).set_index("replicate")
    failed = frame[frame["status"] == "FAILED"]
    assert sorted(failed.index) == [1, 1, 1, 1, 2, 2]
    assert summary.failed == 6
    message = failed["message"].iloc[0]
    assert message.startswith("ZeroDivisionError: <object object at 0x…> is no good\n")
    assert "toys.py:" in message
    assert str(ROOT) not in message
    assert failed["delay"].isna().all()
    assert not failed["converged"].any()
    assert set(frame[frame["status"] != "FAILED"]["status"]) == {"CONVERGED"}


@pytest.mark.parametrize(
    ("jobs", "mischief", "said"),
    [(1, "die", "SIGSEGV"), (2, "die", "SIGSEGV"), (2, "leave", "the last time alone (exit code 3)")],
)
def test_a_deadly_estimate_is_found_and_all_others_survive(tmp_path: Path, jobs: int, mischief: str, said: str) -> None:
    seen: list[Progress] = []
    plan = toy_plan(Toy(), Toy(mischief, at=2), levels=(5,), runs=7)
    summary = run(plan, tmp_path, jobs=jobs, progress=seen.append)
    frame = read_estimates(tmp_path)
    crashed = frame[frame["status"] == "CRASHED"]
    assert crashed[["estimator", "replicate"]].to_numpy().tolist() == [["toy1", 2]]
    assert said in crashed["message"].iloc[0]
    assert len(frame) == summary.computed == 21
    assert summary.exit_code == 0
    assert any(each.message.startswith("a worker process died; computing") for each in seen)
    assert seen[-1].done == 7


def test_a_worker_that_dies_once_costs_nothing(tmp_path: Path) -> None:
    plan = toy_plan(Toy("be killed once", at=3, marker=str(tmp_path / "marker")), levels=(5,))
    summary = run(plan, tmp_path / "toys")
    assert (tmp_path / "marker").exists()
    assert (summary.computed, summary.failed) == (12, 0)


@pytest.mark.parametrize("jobs", [1, 2])
def test_workers_use_one_blas_thread(tmp_path: Path, jobs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    run(toy_plan(Toy("count threads")), tmp_path, jobs=jobs)
    frame = read_estimates(tmp_path)
    assert set(frame["cost"]) == {1.0}


# Interruptions


def test_killed_twice_and_resumed_gives_the_same_bytes(tmp_path: Path, undisturbed: bytes, start: Start) -> None:
    place = tmp_path / "toys"
    acknowledged: set[str] = set()
    draw = random.Random()
    for _ in range(2):
        process = start(place, 2)
        acknowledged |= set(read_ids(process, draw.randint(1, 10)))
        time.sleep(draw.uniform(0, 0.05))
        os.killpg(process.pid, signal.SIGKILL)
        acknowledged |= set(finish(process)[0])
        assert acknowledged <= stored_ids(place)
    last = start(place, 1)
    finish(last)
    assert last.returncode == 0
    assert exported(place) == undisturbed


def test_workers_die_with_a_parent_that_was_killed(tmp_path: Path, start: Start) -> None:
    process = start(tmp_path / "toys", 2)
    read_ids(process, 3)
    process.kill()
    process.wait()
    assert group_is_gone(process, within=15)


def test_a_signal_exports_what_is_finished(tmp_path: Path, undisturbed: bytes, start: Start) -> None:
    place = tmp_path / "toys"
    process = start(place, 2)
    reported = read_ids(process, 4)
    os.killpg(process.pid, signal.SIGINT)
    rest, errors = finish(process, within=20)
    assert process.returncode == 130, errors
    assert errors == ""
    assert group_is_gone(process, within=5)
    frame = read_estimates(place)
    assert set(frame["id"]) == {*reported, *rest}
    assert 0 < len(frame) < 120
    assert set(frame["status"]) <= {"CONVERGED", "FAILED"}
    run(run_toys.plan(), place)
    assert exported(place) == undisturbed


def test_a_second_interrupt_ends_the_run_at_once(tmp_path: Path, start: Start) -> None:
    process = start(tmp_path / "toys", 2, "--seconds=30")
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.5)
    began = time.monotonic()
    for _ in range(2):
        os.kill(process.pid, signal.SIGINT)
        time.sleep(0.3)
    process.wait(timeout=10)
    assert time.monotonic() - began < 10
    assert process.returncode == -signal.SIGINT
    assert group_is_gone(process, within=15)


# Refusals


def change_origin(monkeypatch: pytest.MonkeyPatch, **changes: str) -> None:
    def other(plan: Any) -> Origin:
        return current_origin(plan)._replace(**changes)  # type: ignore[arg-type]

    monkeypatch.setattr(engine, "current_origin", other)


def no_journal(place: Path) -> None:
    (place / "journal.sqlite").unlink()


def damaged_journal(place: Path) -> None:
    os.truncate(place / "journal.sqlite", 4096)


def newer_format(place: Path) -> None:
    with sqlite3.connect(place / "journal.sqlite") as connection:
        connection.execute("PRAGMA user_version=99")
    connection.close()


@pytest.mark.parametrize(
    ("plan", "prepare", "message"),
    [
        (toy_plan(experiment="other"), None, "holds the experiment 'toys', not 'other'"),
        (toy_plan(runs=9), {"code_version": "feedfacefeedface"}, "code version"),
        (toy_plan(runs=9), {"platform": "abacus"}, "numeric platform .* 'abacus' now"),
        (toy_plan(), {"platform": "abacus"}, "--allow-mixed"),
        (toy_plan(runs=9), newer_format, "format 99"),
        (toy_plan(), no_journal, "without the journal"),
        (toy_plan(), damaged_journal, "is damaged.*--fresh --keep-readable"),
    ],
)
def test_refused_folders_stay_as_they_are(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    plan: Plan,
    prepare: dict[str, str] | Callable[[Path], None] | None,
    message: str,
) -> None:
    place = tmp_path / "toys"
    run(toy_plan(), place)
    if isinstance(prepare, dict):
        change_origin(monkeypatch, **prepare)
    elif prepare:
        prepare(place)
    before = snapshot(tmp_path)
    with pytest.raises((RefusedError, StorageError), match=message):
        run(plan, place)
    with pytest.raises((RefusedError, StorageError), match=message):
        preview(plan, place)
    assert snapshot(tmp_path) == before


def test_a_second_run_is_refused_and_the_running_process_is_named(tmp_path: Path, start: Start) -> None:
    place = tmp_path / "toys"
    process = start(place, 2, "--runs=500")
    read_ids(process, 2)
    with pytest.raises(RefusedError, match=f"in use by process {process.pid} on "):
        run(run_toys.plan(), place)
    status = experiment_status(place)
    assert status.running is not None
    assert status.running["pid"] == process.pid
    # Other processes see the stored estimates, and more of them later.
    first = now = len(read_estimates(place))
    while now == first:
        # One line per data set; a data set may be stored before its line is read here.
        read_ids(process, 3)
        now = len(read_estimates(place))
    assert now < 3000
    assert 0 < status.done < status.planned == 3000
    os.killpg(process.pid, signal.SIGKILL)
    finish(process)


def test_fresh_moves_the_old_folder_aside(tmp_path: Path) -> None:
    place = tmp_path / "toys"
    run(toy_plan(experiment="other"), place)
    before = exported(place)
    summary = run(toy_plan(), place, fresh=True)
    assert summary.reused == 0
    assert summary.moved_aside is not None
    assert exported(summary.moved_aside) == before
    assert folder.experiment_folders(tmp_path) == [place]


def test_fresh_does_not_carry_other_experiments_away(tmp_path: Path) -> None:
    run(toy_plan(), tmp_path / "toys")
    run(toy_plan(experiment="toys/inner"), tmp_path / "toys" / "inner")
    before = snapshot(tmp_path)
    with pytest.raises(RefusedError, match="inner"):
        run(toy_plan(), tmp_path / "toys", fresh=True)
    assert snapshot(tmp_path) == before


def test_mixing_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(toy_plan(runs=2), tmp_path)
    change_origin(monkeypatch, code_version="feedfacefeedface")
    summary = run(toy_plan(runs=3), tmp_path, allow_mixed=True)
    assert summary.mixed
    assert read_estimates(tmp_path).attrs["mixed"]
    assert experiment_status(tmp_path).mixed
    with pytest.raises(RefusedError, match="allow-mixed"):
        run(toy_plan(runs=4), tmp_path)


# Storage


def test_a_full_disk_loses_nothing_that_was_reported(tmp_path: Path, undisturbed: bytes, start: Start) -> None:
    place = tmp_path / "toys"
    process = start(place, 2, "--file-size=90000")
    ids, errors = finish(process)
    reported = set(ids)
    assert process.returncode == StorageError.exit_code, errors
    assert "safe" in errors
    assert "Traceback" not in errors
    assert reported
    assert reported <= stored_ids(place)
    assert group_is_gone(process, within=5)
    run(run_toys.plan(), place)
    assert exported(place) == undisturbed
