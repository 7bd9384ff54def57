"""One cell of each published table, from one data set, through the whole program."""

import csv
import json
from pathlib import Path

import pytest
import yaml

from ctid_cli.reporting.comparison_result import check_tables
from ctid_cli.reporting.study import load_study
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import load_spec
from ctid_cli.studies.catalogue import find_study, read_study
from ctid_cli.studies.publishing import published_texts

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
        *("--set", "noise.snr_db=15", "--set", "starts.initial_delay=[0, {uniform: [0, 9]}]"),
    )
    rows = json.loads(ctid("table", *tables, "--format", "json", "--out", out).stdout)
    mine = [row for row in rows if row["sampling"] == sampling and row["n"]]
    plan = build_plan(load_spec(CONFIGS / f"{case}_{sampling}.yaml"))
    starts = {cell.name: cell.estimator.start_from == "delay" for cell in plan.estimators}
    methods = sorted(starts, key=list(load_study().methods).index)
    assert [(row["table"], row["snr_db"], row["initial_delay"], row["method"]) for row in mine] == [
        (int(table), 15, delay if starts[method] else None, method)
        for table, delay in zip(tables, (0, "random"), strict=True)
        for method in methods
    ]
    published = [method for method in methods if method in ("existing", "redundancy")]
    assert "existing" in published
    for row in mine:
        assert row["n"] == 1
        # The existing method gets there from some starts, the others from everywhere.
        assert row["percent"] == 100 or row["method"] == "existing"
        assert row["median_seconds"] > 0
        assert (row["published_percent"] is not None) == (row["method"] in published)
    text = ctid("table", *tables, "--out", out).stdout
    assert "other settings than the published ones" not in text
    # Neither the committed tables nor the paper are contradicted.
    assert check_tables(tables, out).mismatches.empty
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


@pytest.fixture(scope="module")
def profiled(tmp_path_factory, ctid):
    """Results of one experiment of the study: the existing method, and one that takes no start and never succeeds."""
    folder = tmp_path_factory.mktemp("profiled")
    content = yaml.safe_load((CONFIGS / "case1_regular.yaml").read_text(encoding="utf-8"))
    blind = {"kind": "delay_profile", "poles": 2, "zeros": 0, "delay_bounds": [0, 5]}
    content["estimators"] = {"existing": content["estimators"]["existing"], "delay_profile": blind}
    content["noise"]["snr_db"] = [15]
    content["starts"]["initial_delay"] = [7, {"uniform": [0, 9]}]
    content["monte_carlo"]["runs"] = 2
    file = folder / "case1_regular.yaml"
    file.write_text(yaml.safe_dump(content), encoding="utf-8")
    results = folder / "results"
    ctid("run", file, "--jobs", 1, "--quiet", "--out", results)
    return results


def test_a_method_without_a_start_stands_in_both_tables_with_the_same_numbers(ctid, profiled):
    rows = json.loads(ctid("table", "1", "2", "--format", "json", "--out", profiled).stdout)
    mine = [row for row in rows if row["method"] == "delay_profile"]
    assert [(row["table"], row["initial_delay"], row["n"], row["percent"]) for row in mine] == [
        (1, None, 2, 0),
        (2, None, 2, 0),
    ]
    assert {key: value for key, value in mine[0].items() if key != "table"} == {
        key: value for key, value in mine[1].items() if key != "table"
    }
    for number in ("1", "2"):
        text = ctid("table", number, "--out", profiled).stdout
        assert "delay_profile was given no initial delay" in " ".join(text.split())
        assert max(map(len, text.split("Estimates that failed")[0].splitlines())) <= 100


def test_what_is_published_lists_every_failure(ctid, profiled):
    study = find_study("useful-redundancy")
    found = read_study(study, profiled)
    texts = published_texts(found)
    for style in ("md", "csv"):
        shown = ctid("table", "useful-redundancy", "--format", style, "--out", profiled).stdout
        assert texts[f"tables.{style}"] == shown
    failures = list(csv.DictReader(texts["failures.csv"].splitlines()))
    assert [(row["method"], row["snr_db"], row["initial_delay"], row["replicate"]) for row in failures] == [
        ("delay_profile", "15.0", "", "0"),
        ("delay_profile", "15.0", "", "1"),
    ]
    for row in failures:
        shown = json.loads(ctid("export", "--id", row["id"], "--json", "--out", profiled).stdout)
        assert (shown["delay"], shown["status"]) == (float(row["delay"]), row["status"])
        assert (shown["replicate"], shown["seed"]) == (int(row["replicate"]), int(row["seed"]))


def test_a_method_that_always_fails_is_claimed_to(profiled):
    study = find_study("useful-redundancy")
    results = read_study(study, profiled)["case1-regular"]
    (claim,) = study.module("claims").always_converges(results)
    assert (claim.claim, claim.measured, claim.holds) == ("delay_profile converges", "0.00 % of 2", False)
    assert list(study.module("claims").reaches_the_paper(results)) == []
