"""One cell of each published table, from one data set, through the whole program."""

import json
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs" / "useful_redundancy"


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return tmp_path_factory.mktemp("study")


@pytest.mark.parametrize(("case", "tables"), [("case1", ["1", "2"]), ("case2", ["3", "4"])])
@pytest.mark.parametrize("sampling", ["regular", "irregular"])
def test_one_data_set_fills_its_cells(ctid, out, case, sampling, tables):
    ctid(
        *("run", CONFIGS / f"{case}_{sampling}.yaml", "--runs", 1, "--jobs", 1, "--quiet", "--out", out),
        *("--set", "noise.snr_db=15", "--set", "starts.initial_delay=[7, {uniform: [0, 9]}]"),
    )
    rows = json.loads(ctid("table", *tables, "--format", "json", "--out", out).stdout)
    mine = [row for row in rows if row["sampling"] == sampling and row["n"]]
    assert [(row["table"], row["snr_db"], row["initial_delay"], row["method"]) for row in mine] == [
        (int(tables[0]), 15, 7, "existing"),
        (int(tables[1]), 15, "random", "existing"),
    ]
    for row in mine:
        assert row["n"] == 1
        assert row["percent"] in (0, 100)
        assert 0 <= row["published_percent"] <= 100
        assert row["median_seconds"] > 0
    text = ctid("table", *tables, "--out", out).stdout
    assert "other settings than the published ones" not in text
    assert max(map(len, text.split("Estimates that failed")[0].splitlines())) <= 100


def test_a_table_names_the_specification_that_would_fill_it(ctid, tmp_path, monkeypatch):
    command = "ctid run {}configs/useful_redundancy/case1_regular.yaml --out"
    monkeypatch.chdir(ROOT)
    assert command.format("") in ctid("table", "1", "--out", tmp_path).stdout
    monkeypatch.chdir(tmp_path)
    assert command.format(f"{ROOT}/") in ctid("table", "1", "--out", tmp_path).stdout


def test_settings_that_differ_from_the_published_ones_are_noted(ctid, tmp_path):
    ctid(
        *("run", CONFIGS / "case1_regular.yaml", "--runs", 1, "--jobs", 1, "--quiet", "--out", tmp_path),
        *("--set", "noise.snr_db=15", "--set", "starts.initial_delay=[7]", "--set", "sampling.samples=1000"),
    )
    text = ctid("table", "1", "--out", tmp_path).stdout
    assert "sampling.samples = 1000 (not 4000)" in text
