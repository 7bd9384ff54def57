"""Shards from the command line, and the job array that computes them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

SPEC = """\
experiment: sharded
system:      {numerator: [2], denominator: [1, 2]}
excitation:  {kind: prbs, stages: 6, clock_period: 0.2, amplitude: 1.0}
sampling:    {kind: regular, interval: 0.1, samples: 200}
noise:       {kind: white, snr_db: [5, 15]}
estimators:  {svf: {kind: svf, poles: 1, zeros: 0}}
monte_carlo: {runs: 5, seed: 1}
"""
ROOT = Path(__file__).resolve().parents[2]
ARRAY = ROOT / "docs" / "examples" / "slurm" / "shards.sbatch"


def start(folder: Path, *words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "ctid_cli.cli.main", *words]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, cwd=folder, env=environment, text=True, **pipes)  # type: ignore[call-overload, no-any-return]


def ctid(folder: Path, *words: str) -> tuple[int, str, str]:
    process = start(folder, *words)
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "spec.yaml").write_text(SPEC, encoding="utf-8")
    return tmp_path


def test_three_processes_merged_are_one_run(folder: Path) -> None:
    words = ("run", "spec.yaml", "-j", "1", "-q")
    processes = [start(folder, *words, "--shard", f"{number}/3") for number in (1, 2, 3)]
    alone = start(folder, *words, "--out", "alone")
    for process in (*processes, alone):
        _, err = process.communicate(timeout=300)
        assert (process.returncode, err) == (0, "")
    code, out, err = ctid(folder, "merge", "results")
    assert (code, err) == (0, "")
    assert out.startswith("sharded: 10 of 10 estimates in results/sharded (10 new, from 3 folders)\n")
    assert (folder / "results/sharded/runs.h5").read_bytes() == (folder / "alone/sharded/runs.h5").read_bytes()


def test_a_plan_of_a_shard_is_told_and_a_wrong_one_refused(folder: Path) -> None:
    code, out, _ = ctid(folder, "run", "spec.yaml", "--shard", "2/3", "--dry-run")
    assert code == 0
    assert out.startswith("sharded: would compute 4 estimates of 4 data sets into results/sharded.shard-2-of-3;")
    assert ctid(folder, "run", "spec.yaml", "--shard", "4/3")[::2] == (
        2,
        "ctid: --shard 4/3: write k/n, for example 2/3 for the second of three, with k from 1 to n\n",
    )
    code, _, err = ctid(folder, "merge", "nowhere")
    assert (code, err.startswith("ctid: there are no results of shards in nowhere")) == (2, True)


def test_the_tasks_of_an_array_compute_every_shard_once(tmp_path: Path) -> None:
    # Programs of these names that only note what they are asked.
    for name, text in {"srun": 'exec "$@"', "ctid": f'echo "$@" >> {tmp_path}/calls'}.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
        (tmp_path / name).chmod(0o755)
    variables = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "SPEC": "a b.yaml", "SHARDS": "7", "TASKS": "3"}
    for task in ("1", "2", "3"):
        subprocess.run(["bash", str(ARRAY)], env=variables | {"SLURM_ARRAY_TASK_ID": task}, check=True)
    calls = (tmp_path / "calls").read_text().splitlines()
    numbers = sorted(line.split(" --shard ")[1].split("/")[0] for line in calls)
    assert numbers == list("1234567")
    assert calls[0] == "run a b.yaml --shard 1/7 --jobs 1 --out results --quiet"
