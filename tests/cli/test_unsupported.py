"""Unsupported combinations: docs/unsupported.md lists each one with the message that refuses it."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from ctid_cli.cli.main import app
from ctid_cli.errors import ExitCode
from tests.cli.records import LOOP, first_order, in_loop, write

PAGE = Path(__file__).resolve().parents[2] / "docs" / "unsupported.md"
ROWS = [
    [cell.strip() for cell in line.strip("|").split(" | ")]
    for line in PAGE.read_text(encoding="utf-8").splitlines()
    if line.startswith("| `")
]
CONTINUOUS = "loop: {controller: {continuous: {numerator: [1.5, 3.0], denominator: [0.05, 1.0]}}}\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with records of each kind, and files of loops."""
    folder = tmp_path_factory.mktemp("unsupported")
    values = first_order()
    write(folder / "record.csv", values)
    irregular = values.copy()
    irregular[1:, 0] += 0.03 * np.random.default_rng(1).uniform(-1.0, 1.0, len(values) - 1)
    write(folder / "irregular.csv", irregular)
    looped = in_loop(folder / "loop.csv")
    shutil.copy(looped, folder / "loop2.csv")
    t, u, y, r, v = np.loadtxt(looped, delimiter=",", skiprows=1, max_rows=300).T
    header = "t,u [V],y [rpm],r [rpm],v [V]"
    write(
        folder / "irregular-loop.csv", (np.concatenate((t[:1], t[1:] + 0.01 * np.sin(t[1:] * 7.0))), u, y, r, v), header
    )
    y[50:53] = np.nan
    write(folder / "missing-loop.csv", (t, u, y, r, v), header)
    times, first, output = values[:300, 0], values[:300, 1], values[:300, 2]
    second = np.roll(first, 17)
    write(folder / "inputs.csv", (times, first, second, first - second, output, output), "t,u1,u2,u3,y,y2")
    w = np.geomspace(0.1, 10.0, 40)
    response = 2.0 / (1j * w + 2.0)
    columns = (w / (2 * np.pi), response.real, response.imag)
    write(folder / "frf.csv", columns, "frequency [Hz],real,imag")
    (folder / "loop.yaml").write_text(LOOP, encoding="utf-8")
    (folder / "continuous.yaml").write_text(CONTINUOUS, encoding="utf-8")
    (folder / "relay.yaml").write_text("loop: {controller: {relay: {amplitude: 1.0}}}\n", encoding="utf-8")
    return folder


def test_the_page_has_rows():
    assert len(ROWS) > 40


@pytest.mark.parametrize(("command", "sentence"), ROWS, ids=[row[0].strip("`") for row in ROWS])
def test_each_row_is_refused_with_its_sentence(folder, monkeypatch, command, sentence):
    monkeypatch.chdir(folder)
    words = command.strip("`").split()
    done = CliRunner().invoke(app, [*words, "--out", "written"])
    assert done.exit_code == ExitCode.BAD_INPUT, done.output
    assert done.stderr.strip().removeprefix("ctid: ") == sentence.replace("\\|", "|")
    assert not (folder / "written").exists()
