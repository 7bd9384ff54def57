"""``ctid run``: messages, exit, resuming, shards, and allowed places of files."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ctid_cli.errors import ExitCode
from ctid_cli.inference import monte_carlo
from ctid_cli.running import engine
from tests.cli.records import TINY

ROOT = Path(__file__).resolve().parents[2]
ARRAY = ROOT / "docs" / "examples" / "slurm" / "shards.sbatch"


def start(folder, words):
    """Run a command in a separate process."""
    command = [sys.executable, "-m", "ctid_cli.cli.main", *words.split()]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}, **pipes)


def untimed(text):
    """Return a text without its durations and rates."""
    return re.sub(r"[\d.]+(/s|/min| ms| min| s)\b( \d+ s)?", "(time)", text)


@pytest.mark.usefixtures("without_workers")
def test_messages_of_runs(ctid, here, snapshot):
    said = [
        ctid("run tiny.yaml --runs 1 --set noise.snr_db=20"),
        ctid("run tiny.yaml --runs 1 --set noise.snr_db=20"),
        ctid("run tiny.yaml --runs 1 --set noise.snr_db=10"),
        ctid("status tiny"),
        ctid("run tiny.yaml --runs 1 --set noise.snr_db=10 --fresh"),
    ]
    assert [re.sub(r"aside-\w+", "aside-(time)", untimed(done.stderr + done.stdout)) for done in said] == snapshot


@pytest.mark.usefixtures("without_workers")
def test_a_run_until_it_is_precise_says_how_far_it_is(ctid, here, snapshot, monkeypatch):
    monkeypatch.setattr(monte_carlo, "AT_LEAST", 4)
    until = "seed: 1, until: {percent_half_width: 49, rmse_relative: 0.45}, at_most: 200"
    Path("tiny.yaml").write_text(TINY.replace("runs: 2, seed: 1", until), encoding="utf-8")
    done = ctid("run tiny.yaml")
    assert untimed(done.stderr + done.stdout) == snapshot
    found = json.loads(ctid("status tiny --json").stdout)
    sizes = [cell["needed"] for cell in found["precision"]]
    assert min(sizes) > 4
    assert sum(group["done"] for group in found["groups"] if group["estimator"] == "known") == sum(sizes)
    assert found["precision"][0]["widest"]["half_width"] <= found["precision"][0]["widest"]["asked"]
    # A number on the command line overrides the rule in the file.
    assert "6 of 6 estimates stored" in ctid("run tiny.yaml --runs 1").stdout
    assert "precision" not in json.loads(ctid("status tiny --json").stdout)


def test_an_experiment_that_fails_wholly_does_not_stop_the_next_one(ctid, here, monkeypatch, snapshot):
    def failing(plan, folder, **_):
        failed = 3 if plan.experiment == "tiny" else 0
        return engine.RunSummary(plan.experiment, folder, 3, 0, 3, failed, 0, False, None, 1.0, None)

    monkeypatch.setattr(engine, "run_experiment", failing)
    done = ctid("run tiny.yaml measured-tiny.yaml", code=ExitCode.ALL_FAILED)
    assert done.stdout + done.stderr == snapshot


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow)]
)
def test_a_stopped_run_can_be_resumed(ctid, here, number, code):
    process = start(here, "run tiny.yaml --runs 5000 --jobs 1")
    assert any("30000 estimates of 10000 data sets to compute" in line for line in process.stderr)
    time.sleep(1.0)
    process.send_signal(number)
    begun = time.monotonic()
    output, errors = process.communicate(timeout=60)
    assert process.returncode == code, errors
    assert time.monotonic() - begun < 30
    assert f"stopping ({number.name}): running estimates have 5 s; a second signal stops at once" in errors
    assert f"stopped by {number.name}; run the same command again" in output
    assert "unfinished" in ctid("status").stdout


# --- shards -------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("without_workers")
def test_three_shards_merged_are_one_run(ctid, here, snapshot):
    for words in ("--shard 1/3", "--shard 2/3", "--shard 3/3", "--out alone"):
        ctid(f"run tiny.yaml -q {words}")
    assert ctid("merge results").stdout == snapshot
    assert (here / "results/tiny/runs.h5").read_bytes() == (here / "alone/tiny/runs.h5").read_bytes()


def test_the_tasks_of_an_array_compute_every_shard_once(tmp_path):
    # Programs of these names that only record their arguments.
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


# --- disks and links ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["csv", "json"])
def test_a_full_disk_keeps_the_old_file(ctid, home, tmp_path, monkeypatch, form):
    def full(descriptor):
        raise OSError(28, "No space left on device")

    file = tmp_path / "old"
    file.write_text("what was there")
    monkeypatch.setattr(os, "fsync", full)
    said = ctid(f"export tiny --format {form} --file", file, code=ExitCode.STORAGE).stderr
    assert said == f"ctid: {file} cannot be written: No space left on device\n"
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("old", "what was there")]


@pytest.mark.parametrize("name", ["journal.sqlite", "spec.yaml", "running.json.tmp", "figures", "report.html", "."])
def test_nothing_is_written_through_a_link_that_lies_in_the_results(ctid, used, here, name):
    shutil.copytree(used / "results" / "tiny", here / "results" / "tiny")
    command = {"figures": "figure tiny", "report.html": "report tiny"}.get(name, "run tiny.yaml")
    place, elsewhere = here / "results" / "tiny" / name, here / "elsewhere"
    if command == "run tiny.yaml":
        (here / "results" / "tiny").rename(here / "away")
        if name != ".":
            place.parent.mkdir()
    elif place.is_dir():
        shutil.rmtree(place)
    else:
        place.unlink(missing_ok=True)
    if name in (".", "figures"):
        elsewhere.mkdir()
    else:
        elsewhere.write_text("" if name == "journal.sqlite" else "mine")
    place.symlink_to(elsewhere)
    said = ctid(command, code=ExitCode.REFUSED).stderr
    assert "leads to" in said or "is a link, and results are written into their folder alone" in said
    assert list(elsewhere.iterdir()) == [] if elsewhere.is_dir() else elsewhere.read_text() in ("", "mine")
