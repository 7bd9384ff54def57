"""``ctid reproduce``: what each study has, its claims, the first estimates, and what is refused to be published."""

import dataclasses
import json

import pytest

from ctid_cli.errors import RefusedError, UsageError
from ctid_cli.studies import catalogue, claims, first_estimates, publishing
from ctid_cli.studies.catalogue import all_studies, find_study, read_study
from ctid_cli.studies.claims import Claim
from tests.reporting.frequency_results import run_here

STUDIES = all_studies()
SHORT = ("sampling.interval=0.01", "sampling.duration=33", "success.window=[28, 33]")


@pytest.fixture(scope="module")
def small(tmp_path_factory):
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


def test_list_names_every_study_and_specification(ctid, snapshot):
    assert ctid("reproduce", "--list").stdout == snapshot


@pytest.mark.parametrize("study", STUDIES.values(), ids=list(STUDIES))
def test_every_study_is_complete(study):
    shorts = [catalogue.last_part(name) for name in study.configs]
    for short in shorts:
        assert study.plan(short).experiment == study.experiment(short)
        # What ignores the loop, or the edges of the input, is there to show what that costs.
        assert all("unless that is the point" in warning for warning in study.plan(short).spec.warnings)
    for number, parts in study.figures.items():
        assert callable(getattr(study.module("figures"), f"figure_{number}"))
        assert set(parts) <= set(shorts)
    for name in [*study.texts.values(), *(item["rows"] for item in study.numbers.values())]:
        assert callable(getattr(study.module("tables"), name))
    for item in study.numbers.values():
        assert set(item.get("experiments", ())) <= set(shorts)
    for name, calls in study.claims.items():
        assert callable(getattr(study.module("claims"), name))
        assert {part for parts in calls for part in parts} <= set(shorts)
    assert set(study.first) == set(shorts)
    assert (study.folder / "README.md").is_file()
    assert first_estimates.read_first(study)


def test_studies_are_never_loaded_from_the_working_directory(monkeypatch, tmp_path):
    folder = tmp_path / "experiments" / "additive"
    folder.mkdir(parents=True)
    (folder / "claims.py").write_text("raise SystemExit", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert find_study("additive").module("claims").__file__.startswith(str(find_study("additive").folder))


def test_unknown_studies_are_refused(ctid):
    assert "there is no study named 'addition'" in ctid("reproduce", "addition", code=2).stderr


def test_what_was_not_run_does_not_hold(ctid, tmp_path):
    done = ctid("reproduce", "--check", "coverage", "--out", tmp_path, code=7)
    claims = len(find_study("coverage").configs)
    assert done.stdout.count("was run") == claims
    assert f"coverage: {claims} claims do not hold" in done.stderr


def test_actions_exclude_each_other(ctid):
    assert "--check and --publish exclude each other" in ctid("reproduce", "--check", "--publish", code=2).stderr


def test_run_runs_every_specification(ctid, tmp_path, monkeypatch):
    from ctid_cli.cli import experiment_commands

    calls = []
    monkeypatch.setattr(
        experiment_commands, "run", lambda configs, **options: calls.append(options | {"configs": configs})
    )
    ctid("reproduce", "coverage", "--runs", 3, "--jobs", 1, "--out", tmp_path)
    (call,) = calls
    assert [file.name for file in call["configs"]] == [
        config.partition("/")[2] for config in find_study("coverage").configs.values()
    ]
    assert (call["runs"], call["jobs"], call["place"].out) == (3, 1, tmp_path)


# First estimates -----------------------------------------------------------------------------------------


def test_first_estimates_are_those_that_are_stored_and_a_difference_is_seen(small, tmp_path):
    found = first_estimates.compute_first(small, tmp_path, jobs=1)
    assert len(found) == 10
    committed = json.loads(json.dumps(found))
    assert first_estimates.compare(found, committed) == ([], [])
    name = "two-tones finite_time None 0"
    committed[name]["status"] = "INVALID"
    assert first_estimates.compare(found, committed).wrong == [f"{name}: status VALID (not INVALID)"]
    del committed[name]
    assert first_estimates.compare(found, committed).wrong == [f"{name}: not among those that were committed"]
    assert first_estimates.compare(committed, found).wrong == [f"{name}: missing"]


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
@pytest.mark.parametrize("sign", [-1, 1])
def test_first_estimates_may_differ_by_a_stated_tolerance(quantity, allowed, unit, sign):
    committed = {"e 0": {"status": "CONVERGED", "values": FIRST}}

    def moved(by):
        return {"e 0": {"status": "CONVERGED", "values": {**FIRST, quantity: FIRST[quantity] + sign * by}}}

    inside = first_estimates.compare(moved(0.9 * allowed), committed)
    assert inside.wrong == []
    (line,) = inside.largest
    assert f" {unit} (allowed: " in line
    assert line.endswith(f"{quantity} of e 0")
    (line,) = first_estimates.compare(moved(1.1 * allowed), committed).wrong
    assert line.startswith(f"e 0: {quantity} {FIRST[quantity] + sign * 1.1 * allowed!r} (not {FIRST[quantity]!r}, ")
    (line,) = first_estimates.compare(moved(float("nan")), committed).wrong
    assert line.startswith(f"e 0: {quantity} nan")


def test_a_chaotic_iteration_is_compared_over_one_step():
    study = find_study("useful-redundancy")
    for short, overrides in study.first.items():
        plan = study.plan(short, overrides)
        plain = {cell.name for cell in plan.estimators if cell.content.get("variant") == "plain"}
        assert plain <= {"existing", "as_printed"}
        assert first_estimates._single_steps(plan) == plain
    committed = first_estimates.read_first(study)
    assert all(found["values"] for name, found in committed.items() if " existing " in name)


# Publishing ----------------------------------------------------------------------------------------------


@pytest.fixture
def clean(monkeypatch):
    """A checkout without changes, whose code computed the results."""
    answers = {"status": "", "rev-parse": "1234abcd"}
    monkeypatch.setattr(publishing, "_git", lambda *arguments: answers[arguments[0]])
    monkeypatch.setattr(publishing, "spec_from_canonical", lambda content, folder: content)
    monkeypatch.setattr(publishing, "build_plan", lambda spec: spec)
    monkeypatch.setattr(publishing, "current_version", lambda plan: "c")
    return answers


@pytest.fixture
def target(monkeypatch, tmp_path):
    """The folder that everything is published in."""
    monkeypatch.setattr(publishing, "published_folder", lambda study: tmp_path / "published")
    return tmp_path / "published"


def checked(small, out, *found):
    return claims.CheckedClaims(read_study(small, out), found)


def test_everything_is_published_with_its_commit(small, out, target, clean):
    (target / "figures").mkdir(parents=True)
    (target / "figures" / "figure_9.svg").write_text("old", encoding="utf-8")
    first = Claim("one", "1", "at most 2", True, "two-tones")
    other = Claim("other", "3", "at most 2", False, "two-tones")
    publishing.publish(checked(small, out, first, other), out)
    assert {file.relative_to(target).as_posix() for file in target.rglob("*.*")} == {
        "settling.csv", "claims.md", "claims.csv", "environment.json", "figures/figure_1.svg",
    }  # fmt: skip
    environment = json.loads((target / "environment.json").read_text(encoding="utf-8"))
    assert environment == {"commit": "1234abcd", "sessions": {"two-tones": []}}
    assert "| two-tones | other | 3 | at most 2 | NO |" in (target / "claims.md").read_text(encoding="utf-8")
    assert "1 of 2 hold" in (target / "claims.md").read_text(encoding="utf-8")


def test_changed_files_are_not_published(small, out, tmp_path, clean):
    clean["status"] = " M ctid_cli/signals/record.py"
    with pytest.raises(RefusedError, match=r"not committed:\n M ctid_cli/signals/record\.py"):
        publishing.publish(checked(small, out), out)


def test_results_of_other_code_are_not_published(small, out, tmp_path, clean, monkeypatch):
    monkeypatch.setattr(publishing, "current_version", lambda plan: "d")
    with pytest.raises(RefusedError, match="was not computed by the code that is checked out"):
        publishing.publish(checked(small, out), out)


def test_mixed_results_are_not_published(small, out, tmp_path, clean):
    found = read_study(small, out)
    (results,) = found.experiments.values()
    (origin,) = results.stored.origins
    results.stored.export.origins = (origin, origin._replace(code_version="d"))
    with pytest.raises(RefusedError, match="mixes results"):
        publishing.publish(claims.CheckedClaims(found, []), out)


def test_an_installed_package_publishes_nothing(small, out, tmp_path, monkeypatch):
    monkeypatch.setattr(publishing, "DATA", tmp_path / "package" / "_data")
    with pytest.raises(UsageError, match="from a checkout of the repository"):
        publishing.publish(checked(small, out), out)
