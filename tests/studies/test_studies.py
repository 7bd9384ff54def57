"""Studies: completeness, first estimates, and refusals to publish."""

import dataclasses
import json

import pytest

from ctid_cli.errors import RefusedError, UsageError
from ctid_cli.reporting.study import Study, all_studies, find_study, last_part
from ctid_cli.studies import claims, first_estimates, publishing
from ctid_cli.studies.catalogue import read_study
from ctid_cli.studies.claims import Claim
from tests.reporting.frequency_results import run_here

STUDIES = all_studies()
SHORT = ("sampling.interval=0.01", "sampling.duration=33", "success.window=[28, 33]")


@pytest.fixture(scope="module")
def small():
    """Return a study of one experiment, with a single short record."""
    return dataclasses.replace(
        find_study("finite-time-frequency"),
        experiments={"finite-time-frequency/two-tones": {"config": "finite_time_frequency/two_tones.yaml"}},
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
    shorts = {last_part(name) for name in study.configs}
    for short in shorts:
        assert study.plan(short).experiment == study.experiment(short)
        # Estimators that ignore the loop, or the edges of the input, are included to show the effect.
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


# --- first estimates ------------------------------------------------------------------------------------


def test_first_estimates_are_those_that_are_stored(small, tmp_path):
    found = first_estimates.compute_first(small, tmp_path, jobs=1)
    assert len(found) == 10
    assert first_estimates.compare(found, json.loads(json.dumps(found))) == ([], [])


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
    """Set up a checkout without changes, whose code computed the results, and a folder for publishing."""
    answers = {"status": "", "rev-parse": "1234abcd"}
    monkeypatch.setattr(publishing, "_git", lambda *arguments: answers[arguments[0]])
    monkeypatch.setattr(publishing, "spec_from_canonical", lambda content, folder: content)
    monkeypatch.setattr(publishing, "build_plan", lambda spec: spec)
    monkeypatch.setattr(publishing, "current_version", lambda plan: answers.get("version", "c"))
    monkeypatch.setattr(Study, "published", tmp_path / "published")
    return answers


def checked(small, out, *found):
    return claims.CheckedClaims(read_study(small, out), found)


def test_everything_is_published_with_its_commit(small, out, tmp_path, clean):
    target = tmp_path / "published"
    (target / "figures").mkdir(parents=True)
    (target / "figures" / "figure_9.svg").write_text("old", encoding="utf-8")
    first = Claim("one", "1", "at most 2", True, "two-tones")
    other = Claim("other", "3", "at most 2", False, "two-tones")
    publishing.publish(checked(small, out, first, other), out)
    names = {"settling.csv", "claims.md", "claims.csv", "environment.json", "figures/figure_1.svg"}
    assert {file.relative_to(target).as_posix() for file in target.rglob("*.*")} == names
    environment = json.loads((target / "environment.json").read_text(encoding="utf-8"))
    assert environment == {"commit": "1234abcd", "sessions": {"two-tones": []}}
    text = (target / "claims.md").read_text(encoding="utf-8")
    assert "| two-tones | other | 3 | at most 2 | NO |" in text
    assert "1 of 2 hold" in text


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
