from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from ctid_cli.errors import MachineError
from ctid_cli.running import limits, workers
from ctid_cli.running.engine import Progress, preview
from ctid_cli.running.limits import StopRequest
from ctid_cli.storage.estimates import read_estimates
from tests.running.fakes import exported, run, toy_plan
from tests.running.toys import Toy

ROOT = Path(__file__).resolve().parents[2]


def toys(*hostile: Toy, runs: int = 3, **options: Any) -> Any:
    """Plan a well-behaved estimator, hostile ones and another good one, which all share data sets."""
    return toy_plan(Toy(), *hostile, Toy(order=4), levels=(5,), runs=runs, **options)


def failures(place: Path) -> dict[tuple[str, int, str], str]:
    """Return the status of estimates that did not converge, by estimator, replicate and start."""
    frame = read_estimates(place)
    bad = frame[frame["status"] != "CONVERGED"]
    return dict(zip(zip(bad["estimator"], bad["replicate"], bad["start"], strict=True), bad["status"], strict=True))


def messages(place: Path) -> set[str]:
    frame: pd.DataFrame = read_estimates(place)
    return set(frame["message"][frame["status"] != "CONVERGED"])


@pytest.mark.slow
def test_what_takes_too_long_is_ended_and_all_else_is_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "GRACE", 0.2)
    stop = Toy("stop", at=0, order=6)
    summary = run(toys(stop, limits={"wall_seconds": 2}), tmp_path)
    assert failures(tmp_path) == {("toy1", 0, "none"): "TIMEOUT"}
    assert messages(tmp_path) == {"not finished after 2 s (limits.wall_seconds)"}
    assert (summary.planned, summary.computed, summary.failed, summary.exit_code) == (15, 15, 1, 0)


@pytest.mark.slow
def test_processor_time_and_memory_are_limited_too(tmp_path: Path) -> None:
    hostile = [Toy("hang in preparation", at=1, order=5), Toy(order=6), Toy("grow", at=2, order=8)]
    run(toys(*hostile, limits={"cpu_seconds": 1.5, "memory_mb": 300}), tmp_path)
    assert failures(tmp_path) == {
        ("toy1", 1, "none"): "TIMEOUT",
        ("toy3", 2, "none"): "MEMORY",
    }
    assert messages(tmp_path) == {
        "not finished after 1.5 s of processor time (limits.cpu_seconds)",
        "needed more than 300 MB (limits.memory_mb)",
    }


def test_a_data_set_that_is_never_made_is_a_failure_of_all_its_estimates(tmp_path: Path) -> None:
    plan = toys(runs=2, limits={"wall_seconds": 1})
    (cell,) = plan.data_cells
    hanging = dataclasses.replace(cell, source=dataclasses.replace(cell.source, hangs_at=1))
    run(dataclasses.replace(plan, data_cells=(hanging,)), tmp_path)
    assert {(name, where): status for (name, where, _), status in failures(tmp_path).items()} == {
        ("toy0", 1): "TIMEOUT",
        ("toy1", 1): "TIMEOUT",
    }
    assert len(failures(tmp_path)) == 3


def test_limits_are_no_part_of_results(tmp_path: Path) -> None:
    run(toys(runs=2), tmp_path / "without")
    summary = run(toys(runs=2, limits={"wall_seconds": 600, "memory_mb": 3000}), tmp_path / "with")
    assert summary.failed == 0
    assert exported(tmp_path / "with") == exported(tmp_path / "without")
    again = run(toys(runs=2, limits={"wall_seconds": 1}), tmp_path / "with")
    assert (again.reused, again.computed) == (again.planned, 0)


def test_a_higher_limit_is_a_reason_to_try_again(tmp_path: Path) -> None:
    marker = tmp_path / "marker"

    def plan(**limits: float) -> Any:
        return toys(Toy("sleep", at=1, order=5, marker=str(marker)), limits=limits)

    place = tmp_path / "toys"
    assert run(plan(wall_seconds=1), place).failed == 1
    assert preview(plan(wall_seconds=1), place).estimates == 0
    assert preview(plan(wall_seconds=0.5, cpu_seconds=9), place).estimates == 0
    assert preview(plan(memory_mb=9000), place).again == 1
    assert preview(plan(wall_seconds=2), place).again == 1
    marker.touch()
    summary = run(plan(), place)
    assert (summary.computed, summary.failed) == (1, 0)


def test_failures_are_computed_again_on_request(tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    hostile = [Toy("speak in halves", at=1, order=5, marker=str(marker)), Toy(order=6), Toy("die", at=0, order=7)]
    place, plan = tmp_path / "toys", toys(*hostile)
    assert run(plan, place).failed == 2
    assert set(failures(place).values()) == {"FAILED", "CRASHED"}
    marker.touch()
    assert preview(plan, place).estimates == 0
    assert preview(plan, place, retry=["CRASHED"]).again == 1
    summary = run(plan, place, retry=["FAILED"])
    assert (summary.computed, summary.reused, summary.failed, summary.missing) == (1, 23, 1, 0)
    assert set(failures(place).values()) == {"CRASHED"}


def test_texts_that_no_file_can_hold_are_stored_readably(tmp_path: Path) -> None:
    run(toys(Toy("speak in halves", at=0, order=5), Toy("be speechless", at=1, order=6)), tmp_path)
    texts = {message.partition("\n")[0] for message in messages(tmp_path)}
    assert texts == {
        r"ValueError: half a character: \ud83d, a \x00 and\x1b[31m red",
        "SpeechlessError: (its text cannot be made)",
    }
    assert len(read_estimates(tmp_path)) == 18


@pytest.mark.parametrize(
    ("mischief", "said", "advice"),
    [
        ("be killed", "SIGKILL", "memory_mb"),
        ("ask for too much", "out of memory: Unable to allocate", "memory_mb"),
        ("open files", "[Errno 24]", "ulimit -n"),
        ("fill the disk", "[Errno 28]", "TMPDIR"),
    ],
)
def test_failures_of_the_machine_are_reported_and_not_stored(
    tmp_path: Path, mischief: str, said: str, advice: str
) -> None:
    marker, seen = tmp_path / "marker", list[Progress]()
    place, plan = tmp_path / "toys", toys(Toy(mischief, at=1, order=5, marker=str(marker)))
    summary = run(plan, place, progress=seen.append)
    assert (summary.missing, summary.failed, summary.stopped_by) == (1, 0, "machine")
    assert summary.exit_code == MachineError.exit_code == 8
    assert f"1 are missing (toy1 on replicate 1): {said}" in str(summary.machine_error())
    assert advice in str(summary.machine_error())
    assert any(each.message.startswith("1 estimate given up, not stored (toy1 on replicate 1)") for each in seen)
    assert failures(place) == {}
    marker.touch()
    again = run(plan, place)
    assert (again.computed, again.missing, again.exit_code) == (1, 0, 0)


@pytest.mark.slow
def test_without_descriptors_nothing_is_stored_and_the_run_says_what_to_do(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.running.run_toys", str(tmp_path / "toys"), "2", "--runs=1"]
    done = subprocess.run([*command, "--open-files=14"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 8, done.stderr
    assert done.stdout == "ready\n"
    assert "6 are missing" in done.stderr
    assert "Too many open files. What helps: raise the number of open files ('ulimit -n" in done.stderr
    assert len(read_estimates(tmp_path / "toys")) == 0
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, len(read_estimates(tmp_path / "toys"))) == (0, 6)


def test_a_stop_ends_what_takes_long_and_keeps_what_is_finished_of_its_data_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "PATIENCE", 2.0)
    request = StopRequest()

    def listen(progress: Progress) -> None:
        if progress.stored:
            request.request("a test")

    summary = run(toys(Toy("sleep", at=0), runs=2), tmp_path, stop=request, progress=listen)
    assert (summary.stopped_by, summary.computed, summary.given_up) == ("a test", 7, ())
    assert set(read_estimates(tmp_path)["status"]) == {"CONVERGED"}


@pytest.mark.parametrize("at_most", [1, 3])
def test_a_run_stops_after_so_many_failures(tmp_path: Path, at_most: int) -> None:
    plan = toy_plan(*[Toy("raise", at=k, order=2 + k) for k in range(8)], Toy(seconds=0.3, order=12), runs=20)
    seen: list[Progress] = []
    summary = run(plan, tmp_path, stop=StopRequest(failures=at_most), progress=seen.append)
    assert (summary.stopped_by, summary.exit_code) == ("failures", 5)
    assert summary.failed >= at_most
    assert 0 < summary.computed < summary.planned
    assert len(read_estimates(tmp_path)) == summary.computed
    assert sum(each.message.startswith("stopping (failures)") for each in seen) == 1
