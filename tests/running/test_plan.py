"""From a specification to a plan: expansion, and content of the identity of an estimate."""

import hashlib

import pytest

from ctid_cli.canonical import content_hash
from ctid_cli.errors import UsageError
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import load_spec, spec_from_canonical

SPEC = """\
experiment: toy
system: {numerator: [2], denominator: [0.25, 0.7, 1], delay: 1.0}
excitation: {kind: prbs, stages: 6, clock_period: 0.5}
sampling: {kind: uniform_intervals, low: 0.05, high: 0.15, samples: 200, input_record: sampled}
noise: {kind: white, snr_db: [5, 15]}
estimators:
  search: {kind: td_srivc, poles: 2, zeros: 0, delay_bounds: [0, 9]}
  known: {kind: srivc, poles: 2, zeros: 0, delay: 1.0}
starts: {initial_delay: [3, {uniform: [0, 9]}]}
monte_carlo: {runs: 3, seed: 11}
"""


@pytest.fixture
def plan_of(tmp_path):
    def plan(*overrides, text=SPEC, runs=None):
        file = tmp_path / "spec.yaml"
        file.write_text(text, encoding="utf-8")
        return build_plan(load_spec(file, overrides), runs)

    return plan


def ids(plan):
    cells = range(len(plan.data_cells))
    return {key.id for cell in cells for replicate in range(plan.runs) for key, _, _ in plan.keys(cell, replicate)}


def test_expansion(plan_of):
    plan = plan_of(
        "sampling.samples=[100,200]", "estimators.search.svf_cutoff=[1,2]", "estimators.search.variant=[plain,guarded]"
    )
    assert [cell.swept for cell in plan.data_cells] == [
        {"samples": 100, "snr_db": 5.0},
        {"samples": 100, "snr_db": 15.0},
        {"samples": 200, "snr_db": 5.0},
        {"samples": 200, "snr_db": 15.0},
    ]
    assert [(cell.name, cell.swept) for cell in plan.estimators] == [
        ("search", {"svf_cutoff": 1.0, "variant": "plain"}),
        ("search", {"svf_cutoff": 1.0, "variant": "guarded"}),
        ("search", {"svf_cutoff": 2.0, "variant": "plain"}),
        ("search", {"svf_cutoff": 2.0, "variant": "guarded"}),
        ("known", {}),
    ]
    assert plan.estimators[1].estimator.svf_cutoff == 1.0
    assert plan.estimators[1].estimator.variant == "guarded"
    assert plan.data_cells[2].content["sampling"]["samples"] == 200
    assert len({cell.hash for cell in plan.data_cells}) == 4
    assert len({cell.hash for cell in plan.estimators}) == 5


def test_tasks_and_keys(plan_of):
    plan = plan_of()
    assert plan.data_sets == 3 * 2
    keys = plan.keys(1, 2)
    assert [(cell.name, start.label) for _, cell, start in keys] == [
        ("search", "3"),
        ("search", "uniform(0, 9)"),
        ("known", "none"),
    ]
    key = keys[1][0]
    assert (key.data_hash, key.replicate, key.start) == (plan.data_cells[1].hash, 2, "uniform(0, 9)")
    text = f"{key.data_hash}/2/{key.estimator_hash}/uniform(0, 9)"
    assert key.id == hashlib.sha256(text.encode()).hexdigest()[:12]
    assert len(ids(plan)) == 3 * 2 * 3
    assert [(start.label, start.initial_delay) for start in plan.starts] == [
        ("3", 3.0),
        ("uniform(0, 9)", "random"),
        ("none", None),
    ]


@pytest.mark.parametrize(
    "override",
    [
        "noise.snr_db=[5,10,15]",
        "starts.initial_delay=[0,3,{uniform: [0, 5]},{uniform: [0, 9]}]",
        "estimators.third={kind: svf, poles: 2, zeros: 0}",
        "monte_carlo.runs=5",
        "estimators.known.max_iterations=[50,60]",
    ],
)
def test_adding_leaves_what_there_is_alone(plan_of, override):
    before, after = plan_of(), plan_of(override)
    assert ids(before) < ids(after)


@pytest.mark.parametrize(
    "override",
    [
        "system.delay=1.5",
        "system.numerator=[3]",
        "excitation.stages=7",
        "sampling.samples=201",
        "sampling.input_record=exact",
        "monte_carlo.seed=12",
        "noise={kind: white, standard_deviation: 5}",
    ],
)
def test_other_data_are_other_cells(plan_of, override):
    assert not ids(plan_of()) & ids(plan_of(override))


def test_names_runs_and_success_are_in_no_identity(plan_of):
    before = plan_of()
    renamed = plan_of("experiment=other", "success.fit_percent=3", text=SPEC.replace("search:", "other:"))
    assert ids(renamed) == ids(before)
    assert plan_of("monte_carlo.runs=9").spec_hash == before.spec_hash == plan_of(runs=9).spec_hash
    assert renamed.spec_hash != before.spec_hash


def test_runs_of_the_command_line(plan_of):
    plan = plan_of(runs=7)
    assert plan.runs == 7
    assert plan.data_sets == 14
    assert plan.spec.canonical()["monte_carlo"]["runs"] == 7, "what was run can be planned again"
    again = build_plan(spec_from_canonical(plan.spec.canonical()))
    assert ids(again) == ids(plan)
    assert again.spec_hash == plan.spec_hash
    assert plan.spec.text == SPEC
    with pytest.raises(UsageError, match="1 or more"):
        plan_of(runs=0)
    with pytest.raises(UsageError, match="too many"):
        plan_of(runs=1_000_000)


def test_too_many_cells(plan_of):
    many = ",".join(str(k) for k in range(2, 400))
    with pytest.raises(UsageError, match="158404 data cells"):
        plan_of(f"noise.snr_db=[{many}]", f"excitation.amplitude=[{many}]")


def test_what_a_data_cell_is_made_of(plan_of):
    """A changed hash would make the stored results of every user unused."""
    plan = plan_of()
    assert plan.data_cells[0].content == {
        "system": {"numerator": [2.0], "denominator": [0.25, 0.7, 1.0], "delay": 1.0},
        "excitation": {"kind": "prbs", "stages": 6, "clock_period": 0.5, "amplitude": 1.0},
        "sampling": {"kind": "uniform_intervals", "low": 0.05, "high": 0.15, "samples": 200, "input_record": "sampled"},
        "noise": {"kind": "white", "snr_db": 5.0, "standard_deviation": None, "variance": None},
        "seed": 11,
    }
    assert plan.data_cells[0].hash == "b3133309744adf43"
    assert plan.estimators[1].content["kind"] == "srivc"
    assert plan.estimators[1].hash == content_hash(plan.estimators[1].content)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, "a3e88a84b64c7e4b"),
        ({"nested": True}, "552743275c51f69f"),
        ({"zeros": 0, "fixed": [{"name": "a1", "value": 2.0}]}, "8f2cabde5359f0f1"),
        ({"poles": 1, "delay_bounds": [0.3, 0.3], "svf_cutoff": 2.0}, "f3207ed1a9f462e8"),
        ({"inputs": [{"name": "u1", "zeros": 0}]}, "32d0dca1b04ae60f"),
    ],
    ids=["defaults", "nested", "fixed", "known delay", "several inputs"],
)
def test_estimators_keep_the_hashes_of_earlier_versions(options, expected):
    estimator = {"kind": "delay_profile", "poles": 2, "zeros": 1, "delay_bounds": [0, 1]} | options
    content = {
        "experiment": "hashes",
        "system": {"numerator": [2.0], "denominator": [1.0, 1.0], "delay": 0.3},
        "excitation": {"kind": "prbs", "stages": 7, "clock_period": 0.5},
        "sampling": {"kind": "regular", "interval": 0.1, "samples": 400},
        "estimators": {"one": estimator},
        "monte_carlo": {"runs": 1, "seed": 1},
    }
    if "inputs" in options:
        one = {"system": content.pop("system"), "excitation": content.pop("excitation")}
        content["inputs"] = {"u1": one, "u2": one}
    spec = load_spec(content)
    assert [cell.hash for cell in build_plan(spec).estimators] == [expected]
    former = {"nested", "svf_cutoff"} & options.keys()
    assert [warning.split(": ", 2)[1] for warning in spec.warnings] == [f"estimators.one.{name}" for name in former]
