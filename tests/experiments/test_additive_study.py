"""The study of additive models: specifications with the published settings, and checks that detect deviations."""

import csv

import pytest

from ctid_cli.reporting.results import Results
from ctid_cli.reporting.study import data_folder, find_study
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import load_spec
from ctid_cli.studies.catalogue import StudyResults, read_study
from ctid_cli.studies.claims import check_claims, near, within
from ctid_cli.studies.publishing import published_texts
from tests.reporting.ideal_results import ideal_results
from tests.storage.made_results import export_image

STUDY = find_study("additive")
measures = STUDY.module("measures")
FILES = sorted(config.rpartition("/")[2] for config in STUDY.configs.values())
#: Biases found under coloured noise in closed loop.
BIASES = {"g1_a1": -0.6, "g1_a2": -1.1, "g1_b0": -0.7, "g2_a1": -5.7, "g2_a2": 1.4, "g2_b0": -6.1}


def published(file, overrides=()):
    return load_spec(data_folder("configs") / "additive" / file, overrides)


def test_every_experiment_has_data_sets_of_its_own():
    assert len({published(file).monte_carlo.seed for file in FILES}) == len(FILES)


@pytest.fixture(scope="session")
def ideal(tmp_path_factory):
    """Return a study with results as in theory, with fewer data sets and numbers of samples."""
    out = tmp_path_factory.mktemp("ideal")
    overrides = {
        "open_loop.yaml": ["sampling.samples=[5000, 20000, 50000]", "monte_carlo.runs=400"],
        "closed_loop.yaml": ["sampling.samples=[500, 25000, 60000]", "monte_carlo.runs=400"],
        "closed_loop_coloured.yaml": ["monte_carlo.runs=400"],
        "coverage_open_loop.yaml": ["monte_carlo.runs=1000"],
    }
    for file in FILES:
        plan = build_plan(published(file, overrides.get(file, ())))
        bias = {"srivc": BIASES, "additive_direct": BIASES} if "coloured" in file else None
        results = ideal_results(
            plan, out, bias=bias, width={"white": 0.4} if file == "coverage_open_loop.yaml" else None
        )
        if file == "flexible_beam.yaml":
            for value in results.stored.results.values():
                truth = plan.data_cells[0].source.system.parameters
                value["parameters"] = {name: 1.000001 * true for name, true in truth.items()}
        folder = out / plan.experiment
        folder.mkdir(parents=True)
        image = export_image(results.manifest, results.stored.origins, results.stored.results)
        (folder / "runs.h5").write_bytes(image)
    return out


@pytest.fixture(scope="session")
def study(ideal):
    return read_study(STUDY, ideal)


def failures(checks):
    return [check.claim for check in checks if check.holds is False]


@pytest.fixture
def changed(study):
    """Return claims on the study with the errors or statuses of one experiment changed."""

    def claims_of(name, change):
        right = study[name]
        wrong = Results(right.folder, right.stored)
        errors, groups = right.errors.copy(), measures.groups_of(right)
        change(errors, groups.loc[errors["group"], "estimator"].to_numpy(), wrong)
        vars(wrong)["errors"] = errors
        coverage = {key: value for key, value in study.experiments.items() if "coverage" in key + name}
        found = check_claims(StudyResults(STUDY, study.out, coverage | {name: wrong})).claims
        return [claim for claim in found if claim.claim != "was run"]

    return claims_of


@pytest.mark.slow
def test_a_study_as_theory_expects_is_accepted(study):
    found = check_claims(study)
    assert failures(found.claims) == []
    assert sum(check.holds is True for check in found.claims) >= 28
    assert f"{len(found.claims) - sum(check.holds is None for check in found.claims)} hold" in found.counted


def scaled(estimator, factor, shift=0.0):
    def change(errors, estimators, _):
        own = errors[estimators == estimator]
        deviation = own.groupby(["group", "parameter"])["value"].transform("std")
        errors.loc[own.index, "value"] = factor * own["value"] + shift * deviation

    return change


def stopped(estimator, least, count):
    """Return a change in which the first estimates of each group did not converge."""

    def change(_, __, results):
        groups = measures.groups_of(results)
        there = (groups["estimator"] == estimator) & (groups["samples"] >= least)
        groups.loc[there, "not_converged"] = count

    return change


def wide(errors, *_):
    errors["standard_error"] *= 1.3


@pytest.mark.parametrize(
    ("name", "change", "claim"),
    [
        ("open-loop", scaled("additive", 1.4), "N MSE / theory"),
        ("open-loop", scaled("srivc", 0.6), "MSE of srivc / MSE of additive, g2_b0"),
        ("closed-loop", scaled("clsrivc", 0.6), "MSE of clsrivc / MSE of additive, g1_a2"),
        ("closed-loop", scaled("additive", 1.0, 0.4), "bias below"),
        ("open-loop", stopped("additive", 0, 1), "additive converges"),
        ("open-loop", stopped("srivc", 7000, 1), "srivc converges, N from 20000"),
        ("closed-loop", stopped("clsrivc", 0, 5), "clsrivc converges"),
        ("closed-loop-coloured", scaled("additive", 1.0, 0.4), "bias of additive, "),
        ("closed-loop-coloured", scaled("srivc", 1.0, 5.0), "bias of srivc, g2_a1"),
        ("coverage-open-loop", wide, "coverage outside"),
    ],
)
def test_each_claim_sees_what_it_is_for(changed, name, change, claim):
    wrong = failures(changed(name, change))
    assert any(claim in text for text in wrong), wrong


def test_a_few_estimates_that_did_not_converge_may_be_forgiven(changed):
    assert failures(changed("closed-loop", stopped("clsrivc", 0, 3))) == []
    wrong = failures(changed("open-loop", stopped("srivc", 0, 3)))
    assert wrong == ["srivc converges, N from 20000 to 50000"]


def test_what_was_not_run_does_not_hold(study):
    only = StudyResults(STUDY, study.out, {"open-loop": study["open-loop"]})
    assert failures(check_claims(only).claims) == ["was run"] * 5


@pytest.mark.slow
def test_what_is_published(study):
    texts = published_texts(study)
    assert list(texts) == ["tables.md", "errors.csv", "ratios.csv", "coverage.csv", "unfinished.csv"]
    tables = {
        name: list(csv.DictReader(texts[f"{name}.csv"].splitlines())) for name in ("errors", "ratios", "coverage")
    }
    assert len(tables["errors"]) == 2 * 3 * 12 + 3 * 3 * 6 + 4 * 6 + 2 * 12 + 6 + 12
    assert len(tables["ratios"]) == 3 * 12 + 2 * 3 * 6 + 6
    assert [row["misused"] for row in tables["coverage"]] == ["no"] * 12 + ["yes"] * 12 + ["no"] * 6
    assert texts["unfinished.csv"] == "experiment,estimator,samples,replicate,seed,status,id\n"
    for row in tables["ratios"]:
        assert float(row["ratio"]) == pytest.approx(float(row["theory"]), abs=6 * float(row["standard_error"]))
    for heading in ("Open loop, section 6.1", "Closed loop, section 6.2", "SIMULATED stand-in", "Coverage of 95 %"):
        assert heading in texts["tables.md"]


def test_a_missed_number_is_noticed():
    assert near("name", 1.04, 1.0, 0.05).holds
    assert not near("name", 1.06, 1.0, 0.05).holds
    assert not within("name", None, high=3.0).holds
    assert not within("name", float("nan"), 0.0, 1.0).holds
    assert within("name", 1.0, low=0.5).required == "at least 0.5"
