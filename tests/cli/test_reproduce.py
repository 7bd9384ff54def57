"""``ctid reproduce``: what each study has, its claims, the first estimates, and what is refused to be published."""

import csv
import dataclasses
import json
from pathlib import Path

import pytest
import yaml

from ctid_cli.cli import experiment_commands
from ctid_cli.errors import RefusedError, UsageError
from ctid_cli.reporting.comparison_result import check_tables
from ctid_cli.reporting.study import load_study
from ctid_cli.studies import catalogue, claims, first_estimates, publishing
from ctid_cli.studies.catalogue import all_studies, find_study, read_study
from ctid_cli.studies.claims import Claim
from tests.reporting.frequency_results import run_here

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs" / "useful_redundancy"
STUDIES = all_studies()
SHORT = ("sampling.interval=0.01", "sampling.duration=33", "success.window=[28, 33]")


@pytest.fixture(scope="module")
def small():
    """A study of one experiment, with a single short record."""
    return dataclasses.replace(
        find_study("finite-time-frequency"),
        configs={"finite-time-frequency/two-tones": "finite_time_frequency/two_tones.yaml"},
        figures={"1": ["two-tones"]},
        texts={},
        numbers={"settling.csv": {"rows": "settling"}},
        first={"two-tones": SHORT},
    )


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    run_here("two-tones", folder, SHORT)
    return folder


@pytest.mark.parametrize("study", STUDIES.values(), ids=list(STUDIES))
def test_every_study_is_complete(study):
    shorts = {catalogue.last_part(name) for name in study.configs}
    for short in shorts:
        assert study.plan(short).experiment == study.experiment(short)
        # What ignores the loop, or the edges of the input, is there to show what that costs.
        assert all("unless that is the point" in warning for warning in study.plan(short).spec.warnings)
    functions = {
        "figures": [f"figure_{number}" for number in study.figures],
        "tables": [*study.texts.values(), *(item["rows"] for item in study.numbers.values())],
        "claims": [*study.claims],
    }
    for module, names in functions.items():
        assert all(callable(getattr(study.module(module), name)) for name in names)
    named = [*study.figures.values(), *(item.get("experiments", ()) for item in study.numbers.values())]
    named += [parts for calls in study.claims.values() for parts in calls]
    assert {part for parts in named for part in parts} <= shorts == set(study.first)
    assert (study.folder / "README.md").is_file()
    assert first_estimates.read_first(study)


def test_studies_are_never_loaded_from_the_working_directory(monkeypatch, tmp_path):
    folder = tmp_path / "experiments" / "additive"
    folder.mkdir(parents=True)
    (folder / "claims.py").write_text("raise SystemExit", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert find_study("additive").module("claims").__file__.startswith(str(find_study("additive").folder))


def test_run_runs_every_specification(ctid, tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(
        experiment_commands, "run", lambda configs, **options: calls.append(options | {"configs": configs})
    )
    ctid("reproduce coverage --runs 3 --jobs 1 --out", tmp_path)
    (call,) = calls
    names = [config.partition("/")[2] for config in find_study("coverage").configs.values()]
    assert [file.name for file in call["configs"]] == names
    assert (call["runs"], call["jobs"], call["place"].out) == (3, 1, tmp_path)


# --- tables ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def profiled(tmp_path_factory, ctid, without_workers):
    """Case 1 by the existing method, and by one that takes no start and never succeeds, at other settings."""
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


@pytest.mark.parametrize(("case", "tables"), [("case1_regular", "1 2"), ("case2_irregular", "3 4")])
@pytest.mark.usefixtures("without_workers")
def test_one_data_set_fills_its_cells(ctid, tmp_path, case, tables):
    plan = find_study("useful-redundancy").plan(case.replace("_", "-"))
    overrides = ("--set", "noise.snr_db=15", "--set", "starts.initial_delay=[0, {uniform: [0, 9]}]")
    ctid("run --runs 1 --quiet --out", tmp_path, CONFIGS / f"{case}.yaml", *overrides)
    rows = json.loads(ctid(f"table {tables} --json --out", tmp_path).stdout)
    starts = {cell.name: cell.estimator.start_from == "delay" for cell in plan.estimators}
    methods = sorted(starts, key=list(load_study().methods).index)
    mine = [row for row in rows if row["sampling"] == case.partition("_")[2] and row["n"]]
    assert [(row["table"], row["snr_db"], row["initial_delay"], row["method"]) for row in mine] == [
        (int(table), 15, delay if starts[method] else None, method)
        for table, delay in zip(tables.split(), (0, "random"), strict=True)
        for method in methods
    ]
    for row in mine:
        # The existing method gets there from some starts, the others from everywhere.
        assert row["percent"] == 100 or row["method"] == "existing"
        assert (row["published_percent"] is not None) == (row["method"] in ("existing", "redundancy"))
    # Neither the committed tables nor the paper are contradicted.
    assert check_tables(tables.split(), tmp_path).mismatches.empty


def test_a_method_without_a_start_stands_in_both_tables_with_the_same_numbers(ctid, profiled, tmp_path, monkeypatch):
    rows = json.loads(ctid("table 1 2 --json --out", profiled).stdout)
    one, two = (row for row in rows if row["method"] == "delay_profile")
    assert (one["n"], one["percent"], one["initial_delay"]) == (2, 0, None)
    assert one | {"table": 2} == two
    text = " ".join(ctid("table 1 --out", profiled).stdout.split())
    assert "delay_profile was given no initial delay" in text
    assert "sampling.samples = 1000 (not 4000)" in text
    # What is missing is named by the specification that would compute it, as it is found from here.
    for folder, place in ((ROOT, ""), (tmp_path, f"{ROOT}/")):
        monkeypatch.chdir(folder)
        text = ctid("table 1 --out", profiled).stdout
        assert f"ctid run {place}configs/useful_redundancy/case1_irregular.yaml --out" in text


def test_claims_and_tables_are_checked(ctid, profiled, snapshot):
    done = ctid("reproduce --check useful-redundancy --out", profiled, code=7)
    places = {f"{ROOT}/": "", str(profiled): "OUT"}
    text = done.stdout + done.stderr
    for place, name in places.items():
        text = text.replace(place, name)
    assert text == snapshot


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


# --- first estimates ------------------------------------------------------------------------------------


def test_first_estimates_are_those_that_are_stored_and_a_difference_is_seen(
    ctid, small, tmp_path, monkeypatch, snapshot
):
    found = first_estimates.compute_first(small, tmp_path, jobs=1)
    assert len(found) == 10
    committed = json.loads(json.dumps(found))
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
    assert [done.stdout.partition(" (")[0] + done.stderr for done in said] == snapshot


FIRST = {"parameters.g1_a1": 2.0, "standard_errors.g1_a1": 0.1, "delay": 8.0, "standard_errors.delay": 0.01}
FIRST |= {"denominator.1": -3.0, "numerator.0": 5.0, "standard_errors.a1": 0.1, "cost": 0.5}
FIRST |= {"measures.omega_1": 2.0, "measures.valid_share": 97.0}


@pytest.mark.parametrize(
    ("quantity", "allowed", "unit"),
    [
        ("parameters.g1_a1", 2e-4 * 0.1, "standard errors"),
        ("denominator.1", 2e-4 * 0.1, "standard errors"),
        ("delay", 2e-4 * 0.01, "standard errors"),
        ("numerator.0", 2e-5 * 5.0, "of its value"),  # known: it has no standard error
        ("standard_errors.a1", 2e-5 * 0.1, "of its value"),
        ("cost", 2e-5 * 0.5, "of its value"),
        ("measures.omega_1", 1e-9, "rad/s or s"),
        ("measures.valid_share", 0.1, "% of the samples"),
    ],
)
def test_first_estimates_may_differ_by_a_stated_tolerance(quantity, allowed, unit):
    committed = {"e 0": {"status": "CONVERGED", "values": FIRST}}

    def compared(value):
        found = {"e 0": {"status": "CONVERGED", "values": {**FIRST, quantity: value}}}
        return first_estimates.compare(found, committed)

    for by in (-allowed, allowed):
        inside = compared(FIRST[quantity] + 0.9 * by)
        assert inside.wrong == []
        (line,) = inside.largest
        assert f" {unit} (allowed: " in line
        (line,) = compared(FIRST[quantity] + 1.1 * by).wrong
        assert line.startswith(f"e 0: {quantity} {FIRST[quantity] + 1.1 * by!r} (not {FIRST[quantity]!r}, ")
    assert compared(float("nan")).wrong[0].startswith(f"e 0: {quantity} nan")


def test_a_chaotic_iteration_is_compared_over_one_step():
    study = find_study("useful-redundancy")
    for short, overrides in study.first.items():
        plan = study.plan(short, overrides)
        plain = {cell.name for cell in plan.estimators if cell.content.get("variant") == "plain"}
        assert first_estimates._single_steps(plan) == plain
    committed = first_estimates.read_first(study)
    assert all(found["values"] for name, found in committed.items() if " existing " in name)


# --- publishing -----------------------------------------------------------------------------------------


@pytest.fixture
def clean(monkeypatch, tmp_path):
    """A checkout without changes, whose code computed the results, and a folder that everything is published in."""
    answers = {"status": "", "rev-parse": "1234abcd"}
    monkeypatch.setattr(publishing, "_git", lambda *arguments: answers[arguments[0]])
    monkeypatch.setattr(publishing, "spec_from_canonical", lambda content: content)
    monkeypatch.setattr(publishing, "build_plan", lambda spec: spec)
    monkeypatch.setattr(publishing, "current_version", lambda plan: answers.get("version", "c"))
    for module in (publishing, claims):
        monkeypatch.setattr(module, "published_folder", lambda study: tmp_path / "published")
    return answers


def checked(small, out, *found):
    return claims.CheckedClaims(read_study(small, out), found)


def test_everything_is_published_with_its_commit(small, out, tmp_path, clean):
    target = tmp_path / "published"
    (target / "figures").mkdir(parents=True)
    (target / "figures" / "figure_9.svg").write_text("old", encoding="utf-8")
    first = Claim("one", "1", "at most 2", True, "two-tones")
    other = Claim("other", "3", "at most 2", False, "two-tones")
    assert checked(small, out, first).changed == []
    publishing.publish(checked(small, out, first, other), out)
    names = {"settling.csv", "claims.md", "claims.csv", "environment.json", "figures/figure_1.svg"}
    assert {file.relative_to(target).as_posix() for file in target.rglob("*.*")} == names
    environment = json.loads((target / "environment.json").read_text(encoding="utf-8"))
    assert environment == {"commit": "1234abcd", "sessions": {"two-tones": []}}
    text = (target / "claims.md").read_text(encoding="utf-8")
    assert "| two-tones | other | 3 | at most 2 | NO |" in text
    assert "1 of 2 hold" in text
    assert checked(small, out, dataclasses.replace(other, holds=True), first).changed == [other]


@pytest.mark.parametrize(
    ("state", "said"),
    [
        ({"status": " M ctid_cli/signals/record.py"}, r"not committed:\n M ctid_cli/signals/record\.py"),
        ({"version": "d"}, "was not computed by the code that is checked out"),
        ({"mixed": True}, "mixes results"),
    ],
)
def test_what_is_not_of_one_commit_is_not_published(small, out, clean, state, said):
    clean |= state
    found = read_study(small, out)
    if "mixed" in state:
        (results,) = found.experiments.values()
        (origin,) = results.stored.origins
        results.stored.export.origins = (origin, origin._replace(code_version="d"))
    with pytest.raises(RefusedError, match=said):
        publishing.publish(claims.CheckedClaims(found, []), out)


def test_an_installed_package_publishes_nothing(small, out, tmp_path, monkeypatch):
    monkeypatch.setattr(publishing, "DATA", tmp_path / "package" / "_data")
    with pytest.raises(UsageError, match="from a checkout of the repository"):
        publishing.publish(checked(small, out), out)
