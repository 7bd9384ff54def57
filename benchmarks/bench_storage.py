"""Cost of reading many stored estimates and of writing runs.h5: processor time and memory of every command.

    python benchmarks/bench_storage.py [ESTIMATES] [--only write,table,...] [--keep FOLDER]

Makes the results of an experiment with the given number of estimates (100,000 by default; two estimators from two
starts at ten noise levels, rows as in quickstart, one failure in a thousand), through the same journal as a run, and
then runs each command in its own process. Nothing is estimated. `write` is a run that finds everything done but not
exported, so that it writes runs.h5; `run` is one that finds it exported too.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import _timing  # noqa: F401

import h5py
import numpy as np
import yaml

from ctid_cli.running.job import run_job
from ctid_cli.running.plan import build_plan, current_origin
from ctid_cli.specification.load import load_spec
from ctid_cli.storage import journal, sqlite_file
from ctid_cli.storage.columns import failed
from ctid_cli.storage.identity import now
from ctid_cli.storage.manifest import Key, Outcome

ROOT = Path(__file__).resolve().parents[1]
NAME = "many"
LEVELS = 10
#: Estimates of a data cell and replicate.
EACH = 4
FAILURES = 0.001
BATCH = 1000
COMMANDS = ("status", "write", "run", "status", "table", "show", "figure", "export", "verify", "report")


def specification(estimates: int) -> dict[str, Any]:
    """Return quickstart with the number of data sets for a number of estimates."""
    spec: dict[str, Any] = yaml.safe_load((ROOT / "configs" / "quickstart.yaml").read_text(encoding="utf-8"))
    spec["experiment"] = NAME
    spec["noise"]["snr_db"] = [float(k) for k in range(LEVELS)]
    spec["monte_carlo"] = {"runs": max(1, estimates // (LEVELS * EACH)), "seed": 1}
    return spec


def outcomes(plan: Any, manifest: dict[str, Any]) -> Iterator[Outcome]:
    """Yield an outcome for every place: the real ones of the first data set with other last digits."""
    rng = np.random.default_rng(1)
    real = {o.key[2:]: o for o in run_job(plan.job(0, 0)) if isinstance(o, Outcome)}
    for key in _in_order(manifest):
        of = real[key[2:]]
        factors = iter((1.0 + 1e-3 * rng.standard_normal(32)).tolist())
        result = failed("ValueError: singular\n  svf.py:3 in fit", "FAILED")
        if rng.random() > FAILURES:
            result = {name: _other(value, factors) for name, value in of.result.items()}
        yield Outcome(key, result, 1e-3 * next(factors), 1e-3 * next(factors))


def _in_order(manifest: dict[str, Any]) -> Iterator[Key]:
    """Yield all estimates in the order of the journal, which is the quickest to write."""
    for cell in sorted(manifest["data_cells"], key=lambda cell: str(cell["hash"])):
        for replicate in range(cell["replicates"]):
            for part in sorted(manifest["estimators"], key=lambda part: str(part["hash"])):
                for start in sorted(part["starts"]):
                    yield Key(cell["hash"], replicate, part["hash"], start)


def _other(value: Any, factors: Iterator[float]) -> Any:
    if isinstance(value, float):
        return value * next(factors)
    if isinstance(value, list):
        return [_other(item, factors) if item != 1.0 else item for item in value]
    return {name: _other(item, factors) for name, item in value.items()} if isinstance(value, dict) else value


def fill(folder: Path, spec: Path) -> None:
    """Write a journal like that of a run that was killed before it wrote runs.h5."""
    plan = build_plan(load_spec(spec))
    manifest = plan.manifest()
    (folder / NAME).mkdir(parents=True)
    log = journal.open_journal(folder / NAME / sqlite_file.FILE_NAME)
    session = log.begin(manifest, current_origin(plan), now(), {"limits": {}})
    batch: list[Outcome] = []
    for outcome in outcomes(plan, manifest):
        batch.append(outcome)
        if len(batch) == BATCH:
            log.add(batch, session)
            batch = []
    if batch:
        log.add(batch, session)
    log.close()


def measure(name: str, folder: Path, spec: Path) -> None:
    """Run one command and print its cost."""
    results = ["--out", str(folder)]
    some = ""
    if name == "show":
        with h5py.File(folder / NAME / "runs.h5") as file:
            some = file["estimates/id"][-1].decode()
    arguments = {
        "write": ["run", str(spec), "--jobs", "1", *results],
        "run": ["run", str(spec), "--jobs", "1", *results],
        "show": ["export", "--id", some, *results],
        "export": ["export", NAME, *results, "--file", str(folder / "all.csv")],
    }.get(name, [name, NAME, *results])
    began = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "ctid_cli.cli.main", *arguments], stdout=subprocess.DEVNULL, cwd=ROOT
    )
    _, code, used = os.wait4(process.pid, 0)
    took = time.perf_counter() - began
    cpu, size = used.ru_utime + used.ru_stime, used.ru_maxrss / 1024
    code = os.waitstatus_to_exitcode(code)
    print(f"{name:8} {cpu:9.2f} {took:9.2f} {size:9.0f}" + (f"  exit code {code}" if code else ""), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("estimates", type=int, nargs="?", default=100_000)
    parser.add_argument("--only", default=",".join(COMMANDS))
    parser.add_argument("--keep", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.keep or Path(scratch)
        spec, results = folder / "many.yaml", folder / "results"
        if not results.exists():
            folder.mkdir(parents=True, exist_ok=True)
            spec.write_text(yaml.safe_dump(specification(given.estimates)), encoding="utf-8")
            began = time.process_time()
            fill(results, spec)
            print(f"filled in {time.process_time() - began:.1f} CPU s")
        stored = results / NAME / sqlite_file.FILE_NAME
        print(f"{given.estimates} estimates, {stored.stat().st_size / given.estimates:.0f} bytes each in the journal")
        print(f"{'command':8} {'CPU s':>9} {'wall s':>9} {'MB':>9}")
        for name in given.only.split(","):
            measure(name, results, spec)
        shutil.rmtree(results / NAME / "figures", ignore_errors=True)


if __name__ == "__main__":
    main()
