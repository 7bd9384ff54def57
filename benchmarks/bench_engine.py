"""Overhead of the engine on top of the estimates, in wall time, since it consists of waiting.

    PYTHONPATH=. python benchmarks/bench_engine.py [DATA_SETS [JOBS...]]

Every data set takes 50 ms. The ideal is their sum divided by the number of jobs. The measured time is that of the whole
command with workers that are already running: checking the folder, journal with full synchronisation, writing runs.h5
and reading it. The start of the workers, which does not depend on the length of the run, is reported separately.

Two ways to spend 50 ms are measured. A sleeping worker leaves the processor free, so that only the waiting for the
engine shows. With busy ones, the engine and other processes compete with the workers for processors.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import _timing  # noqa: F401

from joblib.externals.loky import get_reusable_executor

from ctid_cli.processors import usable_processors
from ctid_cli.running.engine import run_experiment
from tests.running.fakes import Toy, toy_plan

TASK = 0.05
TARGET, SPEED_UP = 0.05, 0.95


def measure(data_sets: int, jobs: int, busy: bool, folder: Path) -> float:
    """Return the duration of the whole run [s]."""
    plan = toy_plan(Toy(seconds=TASK, busy=busy, order=3), runs=data_sets, levels=(5.0,))
    # One estimate per data set, so that a data set takes TASK.
    plan = replace(plan, starts=plan.starts[:1])
    began = time.perf_counter()
    summary = run_experiment(plan, folder, jobs=jobs, warm=lambda plan: None)
    total = time.perf_counter() - began
    if summary.computed != data_sets or summary.failed:
        raise SystemExit(f"the run went wrong: {summary}")
    return total


def main() -> None:
    data_sets = int(sys.argv[1]) if len(sys.argv) > 1 else 400
    all_jobs = [int(text) for text in sys.argv[2:]] or sorted({1, usable_processors()})
    machine = f"{usable_processors()} processors, load {os.getloadavg()[0]:.1f}"
    print(f"{data_sets} data sets of {1000 * TASK:.0f} ms; {machine}")
    print("work    jobs    ideal  measured  overhead  run's CPU per estimate  start of workers  times 1 job")
    worst, least = 0.0, float("inf")
    with tempfile.TemporaryDirectory() as scratch:
        for busy in (False, True):
            one = 0.0
            for jobs in all_jobs:
                ideal = data_sets * TASK / jobs
                name = f"{busy}-{jobs}"
                # A run this short consists of its start; the second one has running workers.
                get_reusable_executor().shutdown()
                started = measure(jobs, jobs, busy, Path(scratch) / f"{name}-started")
                there = measure(jobs, jobs, busy, Path(scratch) / f"{name}-short")
                used = time.process_time()
                total = measure(data_sets, jobs, busy, Path(scratch) / name)
                used = (time.process_time() - used) / data_sets
                one = one or total * jobs
                overhead, ratio = total / ideal - 1, one / total
                worst, least = max(worst, overhead), min(least, ratio / jobs)
                work = "busy" if busy else "asleep"
                print(
                    f"{work:<7} {jobs:>4} {ideal:>6.2f} s {total:>7.2f} s {100 * overhead:>7.1f} %"
                    f" {1000 * used:>20.2f} ms {started - there:>15.2f} s {ratio:>12.2f}"
                )
    verdict = "reached" if worst < TARGET and least > SPEED_UP else "MISSED"
    print(f"worst overhead {100 * worst:.1f} %, least speed-up {least:.3f} a job")
    print(f"targets below {100 * TARGET:.0f} %, above {SPEED_UP:g}: {verdict}")


if __name__ == "__main__":
    main()
