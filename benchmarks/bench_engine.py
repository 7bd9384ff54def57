"""What the engine costs on top of the estimates, in wall time, since what is measured is waiting.

    PYTHONPATH=. python benchmarks/bench_engine.py [DATA_SETS [JOBS...]]

Every data set takes 50 ms. The ideal is their sum divided by the number of jobs. The measured time is that of the whole
command: looking at the folder, starting workers, journal with full synchronisation, sealing and reading back. The start
of the workers, paid once however long the run, is also shown apart, by repeating the run in another folder with the
workers that are there.

Two ways to spend 50 ms are measured. Asleep, a worker leaves the processor free, so that only waiting for the engine
shows. Busy, the engine and whatever else runs on the machine compete with the workers for processors.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

import _timing  # noqa: F401

from ctid_cli.running.engine import run_experiment, usable_processors
from ctid_cli.running.pool import end_idle_workers
from tests.running.fakes import FakePlan, Toy

TASK = 0.05
TARGET = 0.10


def measure(data_sets: int, jobs: int, busy: bool, folder: Path) -> float:
    """Duration of the whole run [s]."""
    plan = FakePlan(Toy(seconds=TASK, busy=busy, order=3), runs=data_sets, levels=(5.0,))
    # One estimate per data set, so that a data set takes TASK.
    plan.estimators = (plan.estimators[0].only("3"),)
    began = time.perf_counter()
    summary = run_experiment(plan, folder, jobs=jobs, warm=lambda: 0.0)  # type: ignore[arg-type]
    total = time.perf_counter() - began
    if summary.computed != data_sets or summary.failed:
        raise SystemExit(f"the run went wrong: {summary}")
    return total


def main() -> None:
    data_sets = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    all_jobs = [int(text) for text in sys.argv[2:]] or sorted({1, usable_processors()})
    machine = f"{usable_processors()} processors, load {os.getloadavg()[0]:.1f}"
    print(f"{data_sets} data sets of {1000 * TASK:.0f} ms; {machine}")
    print("work    jobs  workers   ideal   measured  overhead")
    worst = 0.0
    with tempfile.TemporaryDirectory() as scratch:
        for busy in (False, True):
            for jobs in all_jobs:
                ideal = data_sets * TASK / jobs
                end_idle_workers()
                for started in ("started", "there"):
                    name = f"{busy}-{jobs}-{started}"
                    total = measure(data_sets, jobs, busy, Path(scratch) / name)
                    overhead = total / ideal - 1
                    worst = max(worst, overhead)
                    work = "busy" if busy else "asleep"
                    print(f"{work:<7} {jobs:>4}  {started:<7} {ideal:>6.2f} s {total:>8.2f} s {100 * overhead:>8.1f} %")
    verdict = "reached" if worst < TARGET else "MISSED"
    print(f"worst overhead {100 * worst:.1f} %; target below {100 * TARGET:.0f} %: {verdict}")


if __name__ == "__main__":
    main()
