"""``ctid check``: from a file to findings that one can act on."""

import json
import re

import numpy as np
import pytest
import scipy.io

from ctid_cli import HeldSignal, TransferFunction, simulate


@pytest.fixture
def arrays():
    rng = np.random.default_rng(0)
    t = 0.1 * np.arange(2000)
    u = np.repeat(rng.choice([1.0, 3.0], 200), 10)
    y = simulate(TransferFunction([2], [1, 1], delay=1.3), HeldSignal(t, u - 2), t) + 7
    return t, u, y + 0.05 * rng.standard_normal(t.size)


@pytest.fixture
def rig(tmp_path, arrays):
    path = tmp_path / "rig.csv"
    rows = "".join(f"{t:.1f},{u:g},{y:.6f},x\n" for t, u, y in zip(*arrays, strict=True))
    path.write_text("time [h],valve (%),level [mm],remark\n" + rows, encoding="utf-8")
    return path


NAMED = ("--input", "valve", "--output", "level")


def test_text(ctid, rig):
    done = ctid("check", rig, *NAMED)
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert lines[0] == f"{rig}: 2000 samples in 199.9 h (time 'time [h]', input 'valve (%)', output 'level [mm]')"
    assert lines[1] == "Usable, with 1 warning."
    assert lines[2] == "Column 'remark' is not used."
    assert lines[4].startswith("warning  offset    The output varies by ")
    assert "about 7" in done.stdout
    assert re.search(r"begins to answer between 1\.\d+ h and 1\.\d+ h after a change", " ".join(done.stdout.split()))
    assert re.search(
        r"^bandwidth of the answer  [\d.]+ rad/h +Nyquist frequency 31.4 rad/h$", done.stdout, re.MULTILINE
    )
    # worst first, and nothing wider than a page but the names of files
    levels = re.findall(r"^(PROBLEM|warning|note|ok) ", done.stdout, re.MULTILINE)
    assert levels == sorted(levels, key=["PROBLEM", "warning", "note", "ok"].index)
    assert max(map(len, lines[1:-1])) <= 100


def test_the_command_to_go_on_with_can_be_run(ctid, rig, tmp_path):
    *_, command = ctid("check", rig, *NAMED, "--to", 150).stdout.splitlines()
    words = command.removeprefix("next: ctid ").replace("'", "").split(" ")
    assert words[:2] == ["fit", str(rig)]
    assert "--offset remove" in command
    assert "--to 150" in command
    assert "--delay 0:5" in command
    assert "--input valve --output level" in command
    assert "--time" not in command


def test_a_structure_is_proposed_with_its_reason(ctid, rig):
    done = ctid("check", rig, *NAMED)
    assert "--poles 1 --zeros 0 " in done.stdout.splitlines()[-1]
    said = " ".join(done.stdout.split())
    assert re.search(r"Proposed: 1 pole, no zero, by a short search\. A further \w+ \(2/[01]\) would", said)
    assert "It is a proposal: ctid order looks closer." in said


def test_a_part_of_a_long_record_is_enough(ctid, tmp_path):
    rng = np.random.default_rng(1)
    t = 0.1 * np.arange(6000)
    # At rest for long, then two modes: what is first in the file tells nothing.
    u = np.where(t < 200, 0.0, np.repeat(rng.choice([-1.0, 1.0], 1200), 5))
    y = simulate(TransferFunction([6, 1.6, 14], [1, 0.8, 10.12, 2.4, 9]), HeldSignal(t, u), t)
    path = tmp_path / "long.csv"
    noisy = y + 0.1 * rng.standard_normal(t.size)
    path.write_text("t,u,y\n" + "".join(f"{a:.1f},{b:g},{c:.6f}\n" for a, b, c in zip(t, u, noisy, strict=True)))
    content = json.loads(ctid("check", path, "--json").stdout)
    assert (content["proposed"]["poles"], content["proposed"]["zeros"]) == (4, 2)
    assert "of the 6000 samples" in content["proposed"]["reason"]
    assert "ctid order tries more poles" in content["proposed"]["reason"]


def test_json_holds_the_same(ctid, rig):
    content = json.loads(ctid("check", rig, *NAMED, "--json").stdout)
    assert content["file"] == str(rig)
    assert content["columns"]["time"] == {"column": "time [h]", "unit": "h"}
    assert content["columns"]["output"] == {"column": "level [mm]", "unit": "mm"}
    assert content["worst"] == "warning"
    assert content["findings"][0]["topic"] == "offset"
    assert content["n_samples"] == 2000
    assert content["delay_early"] <= 1.3 <= content["delay_late"]
    assert content["input_levels"] == [1.0, 3.0]
    assert content["output_quantum"] is None
    assert json.loads(ctid("check", rig, *NAMED, "--json", "--strict").stdout) == content  # a warning is no problem


def test_a_window_and_a_hold(ctid, rig):
    text = ctid("check", rig, *NAMED, "--from", 50, "--to", "99.9", "--hold", "foh").stdout
    assert "500 samples in 49.9 h" in text
    assert "Only the 500 of 2000 samples from 50 to 99.9 h are used" in text
    assert "--hold foh" in text.splitlines()[-1]
    assert "--from 50 --to 99.9" in text.splitlines()[-1]


def test_a_matlab_file(ctid, tmp_path, arrays):
    path = tmp_path / "rig.mat"
    scipy.io.savemat(path, dict(zip(("t", "u", "y"), arrays, strict=True)))
    assert "2000 samples in 199.9 s (time 't', input 'u', output 'y')" in ctid("check", path).stdout


def test_a_record_that_shows_nothing(ctid, tmp_path):
    path = tmp_path / "idle.csv"
    path.write_text("t,u,y\n" + "".join(f"{k},0,{k % 7}\n" for k in range(200)), encoding="utf-8")
    lines = ctid("check", path).stdout.splitlines()
    assert lines[1] == "No model can be identified from this record as it is: 1 problem."
    assert lines[3].startswith("PROBLEM  input   ")
    assert not lines[-1].startswith("next:")
    assert not any(line.startswith("Proposed") for line in lines)
    strict = ctid("check", path, "--strict", code=7)
    assert strict.stdout.splitlines() == lines
    assert strict.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "rig.csv:1: the file is empty"),
        ("t\n1\n", "rig.csv:1: the file has 't' and nothing else"),
        ("t,u,y\n0,1,2\n1,a,3\n", "rig.csv:3: column 'u' holds 'a'"),
        ("t,u,y\n0,1,\n1,1,nan\n", "rig.csv:2: no sample of the output 'y' is a finite number"),
        ("t,u,y\n0,1,2\n0,1,2\n", "rig.csv:3: time 't' repeats 0 s"),
    ],
)
def test_unusable_files(ctid, tmp_path, text, message):
    path = tmp_path / "rig.csv"
    path.write_text(text, encoding="utf-8")
    done = ctid("check", path, code=2)
    assert done.stdout == ""
    assert done.stderr.startswith("ctid: ")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
