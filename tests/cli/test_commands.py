"""What people see: help, progress, summaries, warnings, and errors that nobody expected."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import pytest

from ctid_cli.inference import monte_carlo

COMMANDS = ["init", "run", "status", "table", "export", "reproduce", "compare", "accuracy", "validate", "schema"]


def test_help_names_every_command(ctid):
    text = ctid("--help").stdout
    for command in COMMANDS:
        assert re.search(rf"^  {command} +[A-Z].*\.$", text, re.MULTILINE), command


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself_and_its_options(ctid, command):
    text = ctid(command, "--help").stdout
    assert text.startswith(f"Usage: root {command}") or f" {command} " in text.splitlines()[0]
    if command not in ("init", "validate", "schema", "accuracy"):
        assert "--out DIR" in text
    for line in text.splitlines():
        option = re.match(r"^  (-\w, )?--[\w-]+(  +(\S.*))?$", line)
        assert option is None or option.group(2) is None or option.group(3)


def test_version(ctid):
    import ctid_cli

    assert ctid("--version").stdout == f"ctid {ctid_cli.__version__}\n"


def test_help_imports_nothing_slow():
    code = (
        "import sys; from ctid_cli.cli.main import app\n"
        "try: app(['--help'])\n"
        "except SystemExit: pass\n"
        "slow = {'numpy', 'scipy', 'pandas', 'numba', 'h5py', 'joblib', 'pydantic', 'rich'} & set(sys.modules)\n"
        "assert not slow, slow"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, timeout=60)


def test_workers_import_nothing_slow():
    # What a worker process is sent, and every estimator: half a second of imports each would be longer than the work.
    code = (
        "import importlib, pkgutil, sys, ctid_cli.estimators as package\n"
        "import ctid_cli.running.job, ctid_cli.running.workers, ctid_cli.simulation.dataset\n"
        "for module in pkgutil.iter_modules(package.__path__, 'ctid_cli.estimators.'):\n"
        "    importlib.import_module(module.name)\n"
        "slow = {'scipy.' + name for name in ('signal', 'stats', 'optimize', 'special', 'fft', 'linalg', 'io')}\n"
        "slow |= {'pandas', 'h5py', 'pydantic', 'typer', 'rich', 'matplotlib'}\n"
        "assert not slow & set(sys.modules), slow & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_validate_counts_the_work(ctid, tiny):
    done = ctid("validate", tiny, "--set", "monte_carlo.runs=5")
    assert "ok, tiny: 10 data sets (2 data cells), 30 estimates" in done.stdout
    assert done.stderr == ""


def test_a_run_until_it_is_precise_says_how_far_it_is(ctid, tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(monte_carlo, "AT_LEAST", 4)
    until = "seed: 1, until: {percent_half_width: 49, rmse_relative: 0.45}, at_most: 200"
    tiny.write_text(tiny.read_text(encoding="utf-8").replace("runs: 2, seed: 1", until), encoding="utf-8")
    option = ("--out", tmp_path / "results")
    assert "8 data sets (2 data cells), 24 estimates; at most 200 data sets of a cell" in ctid("validate", tiny).stdout
    assert "then in blocks until they are enough" in ctid("run", tiny, "--dry-run", *option).stdout
    # Of few data sets nobody knows much.
    done = ctid("run", tiny, "--jobs", 1, *option)
    assert "data cells need more data sets, up to 5; widest interval: snr_db = " in done.stderr
    assert "data sets in each data cell: all intervals are as narrow as asked for" in done.stdout
    status = ctid("status", "tiny", *option).stdout
    assert status.count("precise enough") == 2
    found = json.loads(ctid("status", "tiny", "--json", *option).stdout)
    sizes = [cell["needed"] for cell in found["precision"]]
    assert min(sizes) > 4
    assert sum(group["done"] for group in found["groups"] if group["estimator"] == "known") == sum(sizes)
    assert found["precision"][0]["widest"]["half_width"] <= found["precision"][0]["widest"]["asked"]
    # A number on the command line comes before the rule of the file.
    assert "6 of 6 estimates stored" in ctid("run", tiny, "--runs", 1, *option).stdout
    assert "precision" not in json.loads(ctid("status", "tiny", "--json", *option).stdout)


def test_run_tells_what_it_does_and_what_to_do_next(ctid, tiny, tmp_path):
    out = tmp_path / "results"
    done = ctid("run", tiny, "--runs", 1, "--jobs", 1, "--set", "noise.snr_db=20", "--out", out)
    assert "tiny: 3 estimates of 1 data set to compute" in done.stderr
    assert re.search(r"tiny: 1/1 data sets, .*/(s|min), 0 failed$", done.stderr, re.MULTILINE)
    assert "tiny: 3 of 3 estimates stored" in done.stdout
    assert f"next: ctid table tiny --out {out}" in done.stdout
    # another setting leaves the old estimates aside and says so
    done = ctid("run", tiny, "--runs", 1, "--jobs", 1, "--set", "noise.snr_db=10", "--out", out)
    assert "3 stored ones set aside" in done.stderr
    assert "3 stored estimates are set aside: " in ctid("status", "tiny", "--out", out).stdout
    done = ctid("run", tiny, "--runs", 1, "--set", "noise.snr_db=30", "--dry-run", "--out", out)
    assert "would compute 3 estimates of 1 data set" in done.stdout
    assert "6 stored ones set aside" in done.stdout


def test_an_experiment_that_fails_wholly_does_not_stop_the_next_one(ctid, tiny, measured, tmp_path, monkeypatch):
    from ctid_cli.running import engine

    ran = []

    def failing(plan, folder, **_):
        ran.append(plan.experiment)
        failed = 3 if plan.experiment == "tiny" else 0
        return engine.RunSummary(plan.experiment, folder, 3, 0, 3, failed, 0, False, None, 1.0, None)

    monkeypatch.setattr(engine, "run_experiment", failing)
    done = ctid("run", tiny, measured, "--out", tmp_path / "results", code=4)
    assert ran == ["tiny", "measured-tiny"]
    assert done.stderr.endswith("ctid: tiny: all 3 estimates failed\n")


def test_warnings_are_printed_and_the_run_goes_on(ctid, tiny, tmp_path):
    done = ctid(
        *("run", tiny, "--runs", 1, "--jobs", 1, "--quiet", "--out", tmp_path / "results"),
        *("--set", "system.denominator=[1, 80]", "--set", "noise.snr_db=20"),
    )
    assert "warning" in done.stderr


def test_the_table_of_an_experiment(ctid, done):
    text = ctid("table", "tiny", "--out", done).stdout
    assert "within 20 % of the true delay" in text
    assert "count as not converged" in text
    assert re.search(r"^10 dB +0.3 s +\d+ +\[\d+, \d+\] +2 +\S+ m?s", text, re.MULTILINE)
    assert re.search(r"^20 dB +random ", text, re.MULTILINE)
    assert max(map(len, text.splitlines())) <= 100
    assert "|:--|" in ctid("table", "tiny", "--format", "md", "--out", done).stdout


def test_an_unexpected_error_is_one_line_and_a_file(ctid, done, monkeypatch):
    from ctid_cli.reporting import study_table

    def broken(*_, **__):
        raise ZeroDivisionError("nobody expected this")

    monkeypatch.setattr(study_table, "build_tables", broken)
    message = ctid("table", "tiny", "--out", done, code=1).stderr
    assert message.count("\n") == 1
    file = re.search(r"report it with (\S+)$", message.strip()).group(1)
    with open(file, encoding="utf-8") as lines:
        text = lines.read()
    os.unlink(file)
    assert "ZeroDivisionError: nobody expected this" in text
    assert "Traceback" in text


def test_ctrl_c_outside_a_run(ctid, done, monkeypatch):
    from ctid_cli.reporting import study_table

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(study_table, "build_tables", interrupted)
    ctid("table", "tiny", "--out", done, code=130)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_run_can_be_resumed(ctid, tiny, tmp_path, number, code):
    command = [sys.executable, "-m", "ctid_cli.cli.main", "run", str(tiny), "--runs", "5000", "--jobs", "1"]
    command += ["--out", str(tmp_path / "results")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert "30000 estimates of 10000 data sets to compute" in process.stderr.readline()
    time.sleep(1.0)
    process.send_signal(number)
    begun = time.monotonic()
    output, errors = process.communicate(timeout=60)
    assert process.returncode == code, errors
    assert time.monotonic() - begun < 30
    assert f"stopping ({number.name}): waiting for what is in work; once more to stop at once" in errors
    assert f"stopped by {number.name}; run the same command again" in output
    assert "unfinished" in ctid("status", "--out", tmp_path / "results").stdout


def test_the_schema_as_text(ctid):
    assert ctid("schema", "--text", "noise").stdout.startswith("noise: mapping; optional\n")
    assert "write: ctid schema --text noise" in ctid("schema", "noise", code=2).stderr
