from __future__ import annotations

import dataclasses
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
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ctid_cli.errors import RefusedError, StorageError
from ctid_cli.running import engine
from ctid_cli.running.engine import Progress, RunSummary, preview, run_experiment
from ctid_cli.running.plan import build_plan, current_origin
from ctid_cli.running.states import States
from ctid_cli.running.stopping import StopRequest
from ctid_cli.specification.load import load_spec
from ctid_cli.storage import folder
from ctid_cli.storage.estimates import read_estimates
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.journal import read_journal
from ctid_cli.storage.manifest import Key, slots
from ctid_cli.storage.status import experiment_status
from tests.running import run_toys
from tests.running.fakes import FakePlan, Toy

ROOT = Path(__file__).resolve().parents[2]


def run(plan: Any, place: Path, jobs: int = 2, **options: Any) -> RunSummary:
    return run_experiment(plan, place, jobs=jobs, warm=lambda plan: None, **options)


def exported(place: Path) -> bytes:
    return (place / "runs.h5").read_bytes()


def snapshot(place: Path) -> dict[str, tuple[str, int]]:
    """Content and modification time of every file."""
    return {
        str(path.relative_to(place)): (hashlib.sha256(path.read_bytes()).hexdigest(), path.stat().st_mtime_ns)
        for path in place.rglob("*")
        if path.is_file()
    }


def start(place: Path, jobs: int, *more: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tests.running.run_toys", str(place), str(jobs), *more]
    return subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


def read_ids(process: subprocess.Popen[str], lines: int) -> list[str]:
    """Ids of the estimates in the next lines of a run's output."""
    assert process.stdout is not None
    ids: list[str] = []
    for _ in range(lines):
        ids += [word for word in process.stdout.readline().split() if word != "ready"]
    return ids


def finish(process: subprocess.Popen[str], within: float = 300) -> tuple[list[str], str]:
    """The remaining ids and the error output of a run, once it and its workers have ended."""
    assert process.stdout is not None
    assert process.stderr is not None
    watchdog = threading.Timer(within, os.killpg, (process.pid, signal.SIGKILL))
    watchdog.start()
    # Not communicate(), which forgets what readline() has read ahead.
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
    run(FakePlan(), tmp_path / "one", jobs=1)
    run(FakePlan(), tmp_path / "two", jobs=2)
    in_order = States.jobs

    def shuffled(*given: Any) -> Any:
        found = list(in_order(*given))
        random.Random(3).shuffle(found)
        return iter(found)

    monkeypatch.setattr(States, "jobs", shuffled)
    run(FakePlan(), tmp_path / "shuffled", jobs=2)
    assert exported(tmp_path / "one") == exported(tmp_path / "two") == exported(tmp_path / "shuffled")


def test_the_longest_of_a_replicate_comes_first() -> None:
    plan: Any = FakePlan(runs=3, levels=(1, 2, 3))
    states, seconds = States(), dict[tuple[str, str], float]()
    taken: list[tuple[int, float]] = []
    for job in states.jobs(plan, states.missing(plan), seconds):
        taken.append((job.replicate, job.cell.content["level"]))
        seconds |= {(key.data_hash, key.estimator_hash): {1: 1.0, 2: 3.0, 3: 2.0}[taken[-1][1]] for key in job.keys}
    assert taken == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (1, 1), (2, 2), (2, 3), (2, 1)]


def test_every_estimate_of_the_plan_is_stored_once_in_its_order(tmp_path: Path) -> None:
    plan = FakePlan()
    summary = run(plan, tmp_path)
    expected = set(plan.all_keys())
    listed = [slot.key for slot in slots(plan.manifest())]  # type: ignore[arg-type]
    assert set(listed) == expected
    assert len(listed) == len(expected) == summary.planned == summary.computed
    assert read_estimates(tmp_path)["id"].tolist() == [key.id for key in listed]
    assert summary.exit_code == 0


def test_progress_begins_with_the_workload_and_counts_data_sets(tmp_path: Path) -> None:
    seen: list[Progress] = []
    run(FakePlan(runs=3), tmp_path, progress=seen.append)
    assert seen[0] == Progress(0, 6, 0, message="18 estimates of 6 data sets to compute")
    assert [each.done for each in seen] == sorted(each.done for each in seen)
    assert (seen[-1].done, seen[-1].failed) == (6, 0)
    stored = [key for each in seen for key in each.stored]
    assert len(set(stored)) == len(stored) == 18


def test_an_estimate_is_reported_only_after_it_is_stored(tmp_path: Path) -> None:
    unsafe: list[str] = []

    def check(progress: Progress) -> None:
        copy = tmp_path / "copy"
        shutil.copytree(tmp_path / "toys", copy)
        unsafe.extend({key.id for key in progress.stored} - stored_ids(copy))
        shutil.rmtree(copy)

    run(FakePlan(runs=3), tmp_path / "toys", progress=check)
    assert unsafe == []


def test_a_finished_experiment_is_left_as_it_is(tmp_path: Path) -> None:
    run(FakePlan(), tmp_path)
    before = exported(tmp_path)
    summary = run_experiment(FakePlan(), tmp_path, warm=lambda plan: pytest.fail("nothing is to be compiled"))  # type: ignore[arg-type]
    assert (summary.computed, summary.reused, summary.missing) == (0, 36, 0)
    assert exported(tmp_path) == before


def test_only_what_is_new_is_computed(tmp_path: Path) -> None:
    run(FakePlan(Toy(), runs=2), tmp_path)
    more_runs = run(FakePlan(Toy(), runs=3), tmp_path)
    assert (more_runs.reused, more_runs.computed) == (8, 4)
    more_estimators = run(FakePlan(Toy(), Toy(order=3), runs=3), tmp_path)
    assert (more_estimators.reused, more_estimators.computed) == (12, 6)
    fewer = run(FakePlan(Toy(), runs=2), tmp_path)
    assert (fewer.reused, fewer.computed, fewer.left_aside) == (8, 0, 10)
    assert len(read_estimates(tmp_path)) == 8
    status = experiment_status(tmp_path)
    assert (status.planned, status.done, status.left_aside) == (8, 8, 10)
    run(FakePlan(Toy(), runs=2), tmp_path / "alone")
    assert exported(tmp_path) == exported(tmp_path / "alone")


def test_two_names_of_one_estimator_share_its_estimates(tmp_path: Path) -> None:
    plan = FakePlan(Toy(), names=("left",), runs=2)
    twin = dataclasses.replace(plan.estimators[0], name="right")
    plan.estimators = (*plan.estimators, twin)
    summary = run(plan, tmp_path)
    frame = read_estimates(tmp_path)
    assert summary.planned == summary.computed == 8
    assert frame["estimator"].value_counts().to_dict() == {"left": 8, "right": 8}


def test_the_spec_lies_beside_the_results_and_the_journal_says_where_they_come_from(tmp_path: Path) -> None:
    run(FakePlan(text="# as the user wrote it\n"), tmp_path)
    assert (tmp_path / "spec.yaml").read_text() == "# as the user wrote it\n"
    assert '"experiment": "toys"' in (tmp_path / "spec.canonical.json").read_text()
    with read_journal(tmp_path / "journal.sqlite") as log:
        assert log is not None
        assert {"host", "argv", "packages", "limits"} <= set(log.sessions()[0].info)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"spec.yaml", "spec.canonical.json", "journal.sqlite", "runs.h5"}


# Misbehaving estimators


def test_an_estimator_that_raises_is_recorded_with_the_place(tmp_path: Path) -> None:
    summary = run(FakePlan(Toy("raise", at=1), Toy("exit", at=2)), tmp_path)
    frame = read_estimates(tmp_path).set_index("replicate")
    failed = frame[frame["status"] == "FAILED"]
    assert sorted(failed.index) == [1, 1, 1, 1, 2, 2]
    assert summary.failed == 6
    message = failed["message"].iloc[0]
    assert message.startswith("ZeroDivisionError: <object object at 0x…> is no good\n")
    assert "fakes.py:" in message
    assert str(ROOT) not in message
    assert failed["delay"].isna().all()
    assert not failed["converged"].any()
    assert set(frame[frame["status"] != "FAILED"]["status"]) == {"CONVERGED"}


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_deadly_estimate_is_found_and_all_others_survive(tmp_path: Path, jobs: int) -> None:
    seen: list[Progress] = []
    plan = FakePlan(Toy(), Toy("die", at=2), levels=(5,), runs=7)
    summary = run(plan, tmp_path, jobs=jobs, progress=seen.append)
    frame = read_estimates(tmp_path)
    crashed = frame[frame["status"] == "CRASHED"]
    assert crashed[["estimator", "replicate"]].to_numpy().tolist() == [["toy1", 2]]
    assert "SIGSEGV" in crashed["message"].iloc[0]
    assert len(frame) == summary.computed == 21
    assert summary.exit_code == 0
    assert any(each.message.startswith("a worker process died; computing") for each in seen)
    assert seen[-1].done == 7


def test_a_worker_that_dies_once_costs_nothing(tmp_path: Path) -> None:
    plan = FakePlan(Toy("die once", at=3, marker=str(tmp_path / "marker")), levels=(5,))
    summary = run(plan, tmp_path / "toys")
    assert (tmp_path / "marker").exists()
    assert (summary.computed, summary.failed) == (12, 0)


@pytest.mark.parametrize("jobs", [1, 2])
def test_workers_use_one_blas_thread(tmp_path: Path, jobs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    run(FakePlan(Toy("count threads")), tmp_path, jobs=jobs)
    frame = read_estimates(tmp_path)
    assert set(frame["cost"]) == {1.0}


# Interruptions


def test_killed_three_times_and_resumed_gives_the_same_bytes(tmp_path: Path, undisturbed: bytes) -> None:
    place = tmp_path / "toys"
    acknowledged: set[str] = set()
    draw = random.Random()
    for _ in range(3):
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


def test_workers_die_with_a_parent_that_was_killed(tmp_path: Path) -> None:
    process = start(tmp_path / "toys", 2)
    read_ids(process, 3)
    process.kill()
    process.wait()
    assert group_is_gone(process, within=15)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_exports_what_is_finished(tmp_path: Path, undisturbed: bytes, number: int, code: int) -> None:
    place = tmp_path / "toys"
    process = start(place, 2)
    reported = read_ids(process, 4)
    os.killpg(process.pid, number)
    rest, errors = finish(process, within=20)
    assert process.returncode == code, errors
    assert errors == ""
    assert group_is_gone(process, within=5)
    frame = read_estimates(place)
    assert set(frame["id"]) == {*reported, *rest}
    assert 0 < len(frame) < 120
    assert set(frame["status"]) <= {"CONVERGED", "FAILED"}
    run(run_toys.plan(), place)
    assert exported(place) == undisturbed


def test_a_second_interrupt_ends_the_run_at_once(tmp_path: Path) -> None:
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


def test_the_callers_event_stops_a_run(tmp_path: Path) -> None:
    stop = threading.Event()
    seen: list[Progress] = []

    def stop_soon(progress: Progress) -> None:
        seen.append(progress)
        if progress.stored:
            stop.set()

    summary = run(FakePlan(Toy(seconds=0.05), runs=40), tmp_path, progress=stop_soon, stop=StopRequest(stop))
    assert summary.stopped_by == "stop"
    assert summary.exit_code == 5
    assert 0 < summary.computed < summary.planned
    assert len(read_estimates(tmp_path)) == summary.computed
    assert sum(each.message.startswith("stopping (stop)") for each in seen) == 1


# Refusals


def change_origin(monkeypatch: pytest.MonkeyPatch, **changes: str) -> None:
    def other(plan: Any) -> Origin:
        return current_origin(plan)._replace(**changes)  # type: ignore[arg-type]

    monkeypatch.setattr(engine, "current_origin", other)


def newer_format(place: Path) -> None:
    with sqlite3.connect(place / "journal.sqlite") as connection:
        connection.execute("PRAGMA user_version=99")
    connection.close()


@pytest.mark.parametrize("killed", [False, True], ids=["complete", "killed"])
@pytest.mark.parametrize(
    ("plan", "prepare", "message"),
    [
        (FakePlan(experiment="other"), None, "holds the experiment 'toys', not 'other'"),
        (FakePlan(runs=9), {"code_version": "feedfacefeedface"}, "code version"),
        (FakePlan(runs=9), {"platform": "abacus"}, "numeric platform .* 'abacus' now"),
        (FakePlan(), {"platform": "abacus"}, "--allow-mixed"),
        (FakePlan(runs=9), newer_format, "format 99"),
    ],
)
def test_refused_folders_stay_as_they_are(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    plan: FakePlan,
    prepare: dict[str, str] | Callable[[Path], None] | None,
    message: str,
    killed: bool,
) -> None:
    place = tmp_path / "toys"
    if killed:
        process = start(place, 2)
        read_ids(process, 3)
        os.killpg(process.pid, signal.SIGKILL)
        finish(process)
        assert (place / "journal.sqlite-wal").stat().st_size
    else:
        run(FakePlan(), place)
    if isinstance(prepare, dict):
        change_origin(monkeypatch, **prepare)
    elif prepare:
        prepare(place)
    before = snapshot(tmp_path)
    with pytest.raises(RefusedError, match=message):
        run(plan, place)
    with pytest.raises(RefusedError, match=message):
        preview(plan, place)  # type: ignore[arg-type]
    assert snapshot(tmp_path) == before


def test_a_second_run_is_refused_and_told_who_runs(tmp_path: Path) -> None:
    place = tmp_path / "toys"
    process = start(place, 2, "--runs=500")
    read_ids(process, 2)
    with pytest.raises(RefusedError, match=f"in use by process {process.pid} on "):
        run(run_toys.plan(), place)
    status = experiment_status(place)
    assert status.running is not None
    assert status.running["pid"] == process.pid
    # Others see what is stored, and more of it a little later.
    first = now = len(read_estimates(place))
    while now == first:
        # A line for each data set; a data set may have been stored before its line was read here.
        read_ids(process, 3)
        now = len(read_estimates(place))
    assert now < 3000
    assert 0 < status.done < status.planned == 3000
    os.killpg(process.pid, signal.SIGKILL)
    finish(process)


def test_exported_results_without_their_journal_are_not_overwritten(tmp_path: Path) -> None:
    run(FakePlan(), tmp_path)
    (tmp_path / "journal.sqlite").unlink()
    before = snapshot(tmp_path)
    with pytest.raises(RefusedError, match="without the journal"):
        run(FakePlan(), tmp_path)
    assert snapshot(tmp_path) == before
    assert len(read_estimates(tmp_path)) == 36


def test_fresh_moves_the_old_folder_aside(tmp_path: Path) -> None:
    place = tmp_path / "toys"
    run(FakePlan(experiment="other"), place)
    before = exported(place)
    summary = run(FakePlan(), place, fresh=True)
    assert summary.reused == 0
    assert summary.moved_aside is not None
    assert exported(summary.moved_aside) == before
    assert folder.experiment_folders(tmp_path) == [place]


def test_fresh_does_not_carry_other_experiments_away(tmp_path: Path) -> None:
    run(FakePlan(), tmp_path / "toys")
    run(FakePlan(experiment="toys/inner"), tmp_path / "toys" / "inner")
    before = snapshot(tmp_path)
    with pytest.raises(RefusedError, match="inner"):
        run(FakePlan(), tmp_path / "toys", fresh=True)
    assert snapshot(tmp_path) == before


def test_mixing_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(FakePlan(runs=2), tmp_path)
    change_origin(monkeypatch, code_version="feedfacefeedface")
    summary = run(FakePlan(runs=3), tmp_path, allow_mixed=True)
    assert summary.mixed
    assert read_estimates(tmp_path).attrs["mixed"]
    assert experiment_status(tmp_path).mixed
    with pytest.raises(RefusedError, match="allow-mixed"):
        run(FakePlan(runs=4), tmp_path)


# Storage


def test_a_full_disk_loses_nothing_that_was_reported(tmp_path: Path, undisturbed: bytes) -> None:
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


def test_a_full_disk_while_exporting_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(FakePlan(runs=2), tmp_path)
    before = exported(tmp_path)

    def full(descriptor: int) -> None:
        if "runs.h5" in os.readlink(f"/proc/self/fd/{descriptor}"):
            raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(StorageError, match="all 18 estimates are safe"):
            run(FakePlan(runs=3), tmp_path)
    assert exported(tmp_path) == before
    assert not list(tmp_path.glob("*.tmp"))
    assert len(read_estimates(tmp_path)) == 18


@pytest.mark.parametrize("change", ["rename", "delete", "replace"])
def test_a_folder_that_is_gone_ends_the_run_before_anything_is_reported(
    tmp_path: Path, change: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Each data set in a commit of its own, however slow the machine is.
    monkeypatch.setattr(engine, "COMMIT_SECONDS", 0.0)
    place, elsewhere = tmp_path / "toys", tmp_path / "elsewhere"
    reported: list[str] = []
    gone: list[int] = []

    def lose_it(progress: Progress) -> None:
        if progress.stored:
            reported.extend(key.id for key in progress.stored)
            if len(reported) > 10 and not gone:
                gone.append(len(reported))
                shutil.rmtree(place) if change == "delete" else place.rename(elsewhere)
                if change == "replace":
                    run(FakePlan(runs=1), place)

    with pytest.raises(StorageError, match="while a run wrote to it"):
        run(FakePlan(Toy(seconds=0.02), runs=20), place, progress=lose_it)
    assert len(reported) == gone[0]
    if change == "replace":
        assert len(read_estimates(place)) == 6
    if change != "delete":
        assert set(reported) <= stored_ids(elsewhere)
    else:
        assert not place.exists()


def test_a_damaged_journal_is_reported_and_not_touched(tmp_path: Path) -> None:
    run(FakePlan(), tmp_path)
    path = tmp_path / "journal.sqlite"
    data = bytearray(path.read_bytes())
    data[4096:] = bytes(len(data) - 4096)
    path.write_bytes(data)
    before = snapshot(tmp_path)
    with pytest.raises(StorageError, match=r"is damaged.*--fresh --keep-readable"):
        run(FakePlan(), tmp_path)
    assert snapshot(tmp_path) == before


def test_the_shipped_quickstart_gives_the_same_bytes_from_any_number_of_jobs(tmp_path: Path) -> None:
    plan = build_plan(load_spec(ROOT / "configs" / "quickstart.yaml"), runs=2)
    for jobs in (1, 2):
        summary = run_experiment(plan, tmp_path / str(jobs), jobs=jobs)
        assert (summary.missing, summary.failed) == (0, 0)
    assert exported(tmp_path / "1") == exported(tmp_path / "2")
    keys = [key for cell in range(2) for replicate in range(2) for key in plan.job(cell, replicate).keys]
    assert {key.id for key in keys} == set(read_estimates(tmp_path / "1")["id"])
    assert (tmp_path / "1" / "spec.yaml").read_text() == (ROOT / "configs" / "quickstart.yaml").read_text()


def test_preview_counts_without_writing(tmp_path: Path) -> None:
    place = tmp_path / "toys"
    first = preview(FakePlan(), place)  # type: ignore[arg-type]
    assert (first.data_sets, first.estimates, first.reused) == (12, 36, 0)
    assert not place.exists()
    run(FakePlan(runs=2), place)
    before = snapshot(place)
    second = preview(FakePlan(), place)  # type: ignore[arg-type]
    assert (second.data_sets, second.estimates, second.reused) == (8, 24, 12)
    assert snapshot(place) == before


def test_keys_have_short_names_from_their_content() -> None:
    key = Key("aa", 3, "bb", "none")
    assert key.id == hashlib.sha256(b"aa/3/bb/none").hexdigest()[:12]
