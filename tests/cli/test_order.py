"""``ctid order``: from a file to the table of structures, or to a one-sentence error."""

import json

import numpy as np
import pytest

from ctid_cli import HeldSignal, TransferFunction, simulate
from tests.cli.records import write


def response_record(file, gain, seed=0):
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(500)
    u = np.repeat(rng.choice([-1.0, 1.0], 100), 5)
    y = gain * simulate(TransferFunction([2.0], [1.0, 1.0], 0.33), HeldSignal(t, u), t) + 0.1 * rng.standard_normal(500)
    return write(file, (t, u, y), "t [s],u [V],y [mm]")


@pytest.fixture
def record(tmp_path):
    return response_record(tmp_path / "record.csv", 1.0)


def test_table_and_files(ctid, record, tmp_path, monkeypatch, snapshot):
    monkeypatch.chdir(tmp_path)
    response_record(tmp_path / "other.csv", 1.0, 1)
    options = ("--poles", "1:2", "--zeros", "0:1", "--validate", "other.csv", "--out", "new")
    assert ctid("order", "record.csv", *options).stdout == snapshot
    content = json.loads((tmp_path / "new" / "order.json").read_text(encoding="utf-8"))
    assert content["recommended"] == {"poles": 1, "zeros": 0, "integrators": 0}
    assert json.loads(ctid("order", "record.csv", *options, "--json").stdout) == content
    assert (tmp_path / "new" / "order.svg").read_bytes().startswith(b"<?xml")


@pytest.mark.slow
def test_sums_of_submodels(ctid, tmp_path, snapshot, monkeypatch):
    """Two modes are found as two, and the recommendation is a command of ctid fit."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(3)
    t = 0.05 * np.arange(1200)
    u = np.repeat(rng.choice([-1.0, 1.0], 400), 3)
    modes = TransferFunction([1.0], [1.0, 0.25, 1.0], 0.137), TransferFunction([6.0], [1.0, 0.5, 25.0], 0.137)
    y = sum(simulate(mode, HeldSignal(t, u), t) for mode in modes) + 0.1 * rng.standard_normal(1200)
    write(tmp_path / "modes.csv", (t, u, y), "t [s],u [V],y [mm]")
    found = ctid("order", "modes.csv", "--model", "additive", "--modes", "1:3", "--validate", "modes.csv")
    assert found.stdout == snapshot
    content = json.loads((tmp_path / "order.json").read_text(encoding="utf-8"))
    assert content["recommended"]["modes"] == 2
    typed = json.loads(ctid("fit", "modes.csv", *content["command"], "--json").stdout)
    chosen = json.loads(ctid("fit", "modes.csv", "--model", "additive", "--json").stdout)
    assert typed["parameters"] == chosen["parameters"]
