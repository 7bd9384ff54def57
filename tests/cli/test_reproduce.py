"""``ctid reproduce``, and the tables of the published studies."""

import copy
import csv
import json
import re
from pathlib import Path

import pytest
import yaml

from ctid_cli.cli import reproduce_command
from ctid_cli.cli.experiment_commands import SpecOptions
from ctid_cli.cli.reproduce_command import PublishedSpecs
from ctid_cli.reporting.study import find_study
from ctid_cli.studies import first_estimates, publishing
from ctid_cli.studies.catalogue import read_study

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs" / "useful_redundancy"


@pytest.mark.parametrize(
    ("names", "files"),
    [
        ("coverage", [config.partition("/")[2] for config in find_study("coverage").configs.values()]),
        ("coverage/first-order useful-redundancy/case1-irregular", ["first_order.yaml", "case1_irregular.yaml"]),
    ],
)
def test_run_runs_the_specifications_of_what_is_named(ctid, tmp_path, monkeypatch, names, files):
    calls = []
    monkeypatch.setattr(
        reproduce_command, "run", lambda configs, **options: calls.append(options | {"configs": configs})
    )
    ctid(f"reproduce {names} --runs 3 --jobs 1 --out", tmp_path)
    assert [file.name for call in calls for file in call["configs"]] == files
    assert {(call["runs"], call["jobs"], call["place"].out) for call in calls} == {(3, 1, tmp_path)}


def test_warnings_about_published_specifications_are_not_printed(capsys):
    for specs, said in ((SpecOptions(), "warning: "), (PublishedSpecs(), "")):
        specs.plans([CONFIGS / "case1_irregular.yaml"])
        assert capsys.readouterr().err[:9] == said


# --- tables ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def profiled(tmp_path_factory, ctid, without_workers):
    """Return case 1 by the existing method, and by one without starts that never succeeds, at other settings."""
    folder = tmp_path_factory.mktemp("profiled")
    content = yaml.safe_load((CONFIGS / "case1_regular.yaml").read_text(encoding="utf-8"))
    blind = {"kind": "delay_profile", "poles": 2, "zeros": 0, "delay_bounds": [0, 5]}
    content["estimators"] = {"existing": content["estimators"]["existing"], "delay_profile": blind}
    content["noise"]["snr_db"] = [15]
    content["starts"]["initial_delay"] = [7, {"uniform": [0, 9]}]
    content["monte_carlo"]["runs"] = 2
    content["sampling"]["samples"] = 1000
    (folder / "case1_regular.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    ctid("run --quiet --out", folder / "results", folder / "case1_regular.yaml")
    return folder / "results"


def test_a_method_without_a_start_stands_in_both_tables_with_the_same_numbers(ctid, profiled, tmp_path, monkeypatch):
    rows = json.loads(ctid("table 1 2 --json --out", profiled).stdout)
    one, two = (row for row in rows if row["method"] == "delay_profile")
    assert (one["n"], one["percent"], one["initial_delay"]) == (2, 0, None)
    assert one | {"table": 2} == two
    text = " ".join(ctid("table 1 --out", profiled).stdout.split())
    assert "delay_profile was given no initial delay" in text
    assert "sampling.samples = 1000 (not 4000)" in text
    # Missing results are named by the specification that computes them, relative to the working directory.
    for folder, place in ((ROOT, ""), (tmp_path, f"{ROOT}/")):
        monkeypatch.chdir(folder)
        text = ctid("table 1 --out", profiled).stdout
        assert f"ctid run {place}configs/useful_redundancy/case1_irregular.yaml --out" in text


def test_claims_and_tables_are_checked(ctid, profiled, snapshot):
    done = ctid("reproduce --check useful-redundancy --json --out", profiled, code=7)
    claims, tables = map(json.loads, done.stdout.splitlines())
    assert {claim["claim"] for claim in claims["claims"]} == {"was run", "delay_profile converges"}
    assert (tables["agrees"], tables["compared"], tables["mismatches"]) == (False, 3, 1)
    assert done.stderr == snapshot


@pytest.mark.slow
def test_what_is_published_lists_every_failure(ctid, profiled):
    study = find_study("useful-redundancy")
    texts = publishing.published_texts(read_study(study, profiled))
    for style in ("md", "csv"):
        shown = ctid(f"table useful-redundancy --format {style} --out", profiled).stdout
        assert texts[f"tables.{style}"] == shown
    failures = list(csv.DictReader(texts["failures.csv"].splitlines()))
    failed = [row for row in failures if row["method"] == "delay_profile"]
    assert [row["replicate"] for row in failed] == ["0", "1"]
    for row in failed:
        shown = json.loads(ctid(f"export --id {row['id']} --json --out", profiled).stdout)
        assert (shown["status"], str(shown["seed"])) == (row["status"], row["seed"])
        assert shown["delay"] == pytest.approx(float(row["delay"]), rel=1e-5)
    (claim,) = study.module("claims").always_converges(read_study(study, profiled)["case1-regular"])
    assert (claim.claim, claim.measured, claim.holds) == ("delay_profile converges", "0.00 % of 2", False)


def test_first_estimates_are_compared_and_updated(ctid, monkeypatch, snapshot):
    found = first_estimates.read_first(find_study("coverage"))
    committed = copy.deepcopy(found)
    monkeypatch.setattr(first_estimates, "compute_first", lambda *_: found)
    monkeypatch.setattr(first_estimates, "read_first", lambda study: committed)
    monkeypatch.setattr(first_estimates, "write_first", lambda study, estimates: committed.update(estimates))
    name, other, _ = list(committed)[:3]
    committed[name]["status"] = "INVALID"
    del committed[other]
    committed["gone"] = committed[name]
    said = [ctid("reproduce coverage --first", code=7), ctid("reproduce coverage --update-first")]
    del committed["gone"]
    said.append(ctid("reproduce coverage --first"))
    assert [re.sub(r" \(\d+ s\)", "", done.stdout) + done.stderr for done in said] == snapshot
