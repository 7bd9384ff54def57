"""A run in a separate process, to be interrupted; it prints the ids of estimates reported as done."""

from __future__ import annotations

import argparse
import resource
import sys
from pathlib import Path

from ctid_cli.errors import CtidError
from ctid_cli.running.engine import Progress, run_experiment
from ctid_cli.running.plan import Plan
from tests.running.fakes import toy_plan
from tests.running.toys import Toy


def plan(seconds: float = 0.02, runs: int = 20) -> Plan:
    return toy_plan(Toy(seconds=seconds), Toy(order=3, mischief="raise", at=4), runs=runs)


def report(progress: Progress) -> None:
    if progress.message.endswith("to compute") or "already stored" in progress.message:
        print("ready", flush=True)
    if progress.stored:
        print(*[key.id for key in progress.stored], flush=True)


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("jobs", type=int)
    parser.add_argument("--file-size", type=int, help="largest file that may be written, as on a full disk")
    parser.add_argument("--open-files", type=int, help="most files that may be open")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=0.02)
    options = parser.parse_args()
    if options.file_size:
        resource.setrlimit(resource.RLIMIT_FSIZE, (options.file_size, options.file_size))
    if options.open_files:
        resource.setrlimit(resource.RLIMIT_NOFILE, (options.open_files, options.open_files))
    toys = plan(options.seconds, options.runs)
    try:
        summary = run_experiment(toys, options.folder, jobs=options.jobs, progress=report, warm=lambda plan: None)
    except CtidError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    if summary.given_up or summary.cause:
        print(summary.machine_error(), file=sys.stderr)
    return summary.exit_code


if __name__ == "__main__":
    sys.exit(main())
