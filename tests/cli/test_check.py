"""``ctid check``: from a file to facts and the command to run."""

import json

import numpy as np
import pytest

from ctid_cli import HeldSignal, TransferFunction, simulate
from tests.cli.records import write

NAMED = ("--input", "valve", "--output", "level")


pytestmark = pytest.mark.usefixtures("few_candidates")


@pytest.fixture
def arrays():
    rng = np.random.default_rng(0)
    t = 0.1 * np.arange(2000)
    u = np.repeat(rng.choice([1.0, 3.0], 200), 10)
    y = simulate(TransferFunction([2], [1, 1], delay=1.3), HeldSignal(t, u - 2), t) + 7
    return t, u, y + 0.05 * rng.standard_normal(t.size)


@pytest.fixture
def rig(tmp_path, arrays, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rows = "".join(f"{t:.1f},{u:g},{y:.6f},x\n" for t, u, y in zip(*arrays, strict=True))
    (tmp_path / "rig.csv").write_text("time [h],valve (%),level [mm],remark\n" + rows, encoding="utf-8")
    return "rig.csv"


def test_printed(ctid, rig, snapshot):
    """Facts with the worst first, numbers, and the command to run."""
    assert ctid("check", rig, *NAMED).stdout == snapshot


def test_json(ctid, rig):
    done = ctid("check", rig, *NAMED, "--json", "--strict")  # a warning is no problem
    content = json.loads(done.stdout)
    assert content["columns"]["time"] == {"column": "time [h]", "unit": "h"}
    assert (content["file"], content["worst"], content["n_samples"]) == (rig, "warning", 2000)
    assert (content["findings"][0]["topic"], content["offset"]["detected"]) == ("start", True)
    assert content["delay_early"] <= 1.3 <= content["delay_late"]
    assert content["snr_db_low"] < content["snr_db"] < content["snr_db_high"]
    assert (content["input_levels"], content["output_quantum"]) == ([1.0, 3.0], None)
    assert content["command"].startswith("ctid fit rig.csv --input valve --output level --poles ")


def test_a_window_and_a_hold(ctid, rig):
    text = ctid("check", rig, *NAMED, "--from", 50, "--to", "99.9", "--hold", "foh").stdout
    assert "Only the 500 of 2000 samples from 50 to 99.9 h are used" in text
    assert "--hold foh --from 50 --to 99.9" in text.splitlines()[-1]


def test_a_record_that_shows_nothing(ctid, tmp_path, monkeypatch, snapshot):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "idle.csv", (np.arange(200), np.zeros(200), np.arange(200) % 7))
    done = ctid("check", "idle.csv", "--strict", code=7)
    assert done.stdout == snapshot
    assert done.stderr.count("\n") == 1
