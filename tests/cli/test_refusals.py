"""Refusals: exit code, one message with the error, its place and what is allowed, and no files written."""

import re
import shutil
import sqlite3

import pytest
from typer.testing import CliRunner

from ctid_cli.cli.main import app
from ctid_cli.errors import ExitCode
from tests.cli.conftest import contents
from tests.cli.records import COMMANDS, LOOP, TINY, in_loop

MISSPELT = TINY.replace("clock_period", "clok_period").replace("interval: 0.1", "interval: -1")
FILES = {
    "misspelt.yaml": MISSPELT,
    "second.yaml": TINY.replace("seed: 1", "seed: one"),
    "copy.yaml": TINY,
    "broken.yaml": "experiment: [",
    "colours.yaml": '"\\e[2J": 1\n"\\u202e": 2\n',
    "constant.csv": "t,y\n" + "".join(f"{0.1 * k:.1f},4\n" for k in range(50)),
    "weeks.csv": "t [fortnights],y\n0,1\n1,2\n",
    "short.csv": "t [s],u [V],y [mm]\n0,1,0\n0.1,1,1\n0.2,0,1\n",
    "inputs.csv": "t,u1,u2,u3,y\n" + "".join(f"{k},{k % 3},{k % 7},{1 - k % 3},{k % 5}\n" for k in range(50)),
    "frf.csv": "frequency [rad/s],real,imaginary,standard_error\n" + "".join(f"{k},1,{-k},1\n" for k in range(1, 30)),
    "empty.csv": "",
    "letters.csv": "t,u,y\n0,1,2\n1,a,3\n",
    "ms.csv": "t [ms],u [V],y [mm]\n" + "".join(f"{k},{k % 3},{k % 5}\n" for k in range(50)),
    "order.json": '{"kind": "ctid order"}',
    "newer.json": '{"kind": "ctid fit", "format": 99, "ctid": "9.0"}',
    "controller.yaml": LOOP,
    "sign.yaml": LOOP.replace("0.8", "-0.8"),
    "nokey.yaml": "loop:\n  control: {}\n",
    "changed.json": '{"kind": "ctid fit", "format": 2, "checksum": "0"}',
}

CASES = [(command, code) for code, commands in COMMANDS["refused"].items() for command in commands]


@pytest.fixture(scope="module")
def prepared(used):
    """Add bad files to the used folder, and results of another experiment, of a newer format, and damaged ones."""
    for name, text in FILES.items():
        (used / name).write_text(text, encoding="utf-8")
    (used / "modes.yaml").write_text("mine", encoding="utf-8")
    in_loop(used / "closed.csv")
    shutil.copy(used / "other.csv", used / "p1" / "comparison.csv")
    shutil.copytree(used / "results" / "measured-tiny", used / "taken" / "tiny")
    for name in ("newer", "damaged"):
        shutil.copytree(used / "results" / "tiny", used / name / "tiny")
    with sqlite3.connect(used / "newer" / "tiny" / "journal.sqlite") as connection:
        connection.execute("PRAGMA user_version = 99")
    connection.close()
    (used / "damaged" / "tiny" / "runs.h5").write_bytes(b"no file of HDF5")
    return used


@pytest.mark.parametrize(("command", "code"), CASES, ids=[command for command, _ in CASES])
def test_one_message_and_nothing_is_written(prepared, monkeypatch, snapshot, command, code):
    monkeypatch.chdir(prepared)
    before = contents(prepared)
    done = CliRunner().invoke(app, command.split())
    assert done.exit_code == code, done.output
    assert contents(prepared) == before
    assert done.stdout == "" or code == ExitCode.DIFFERENCE
    assert (done.stdout + done.stderr).replace(str(prepared), "HERE") == snapshot
    assert done.stderr.isprintable() or re.fullmatch(r"[^\x00-\x09\x0b-\x1f\u202e]*", done.stderr)
