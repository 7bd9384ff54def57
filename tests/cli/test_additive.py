"""An experiment with submodels in a loop, from its specification to its tables, exports and single estimates."""

import csv
import io
import json
import math

import pytest

SPEC = """\
experiment: loop
system:
  additive:
    - {numerator: [1], denominator: [0.025, 0.01, 1]}
    - {numerator: [3], denominator: [0.25, 0.25, 1]}
loop:
  controller: {pid: {kp: 0.0115, ki: 0.00725, kd: 0.00454}}
  reference: {kind: gaussian, standard_deviation: 10.0}
sampling: {kind: regular, interval: 0.05, samples: {geometric: [300, 600, 2]}}
noise: {kind: arma, numerator: [1], denominator: [1, -0.5], variance: 0.01}
estimators:
  both: {kind: additive_srivc, terms: [{poles: 2, zeros: 0}, {poles: 2, zeros: 0}], instruments: closed_loop}
  one: {kind: srivc, poles: 4, zeros: 2, instruments: closed_loop}
starts: {parameters: [{relative_uniform: 0.01}, {relative_uniform: 0.02}]}
monte_carlo: {runs: 2, seed: 1}
success: {parameter_relative_error: 0.2}
"""
NAMES = [f"g{k}_{name}" for k in (1, 2) for name in ("a1", "a2", "b0")]


@pytest.fixture(scope="module")
def results(tmp_path_factory, ctid):
    """Results folder of the experiment, run once."""
    folder = tmp_path_factory.mktemp("loop")
    (folder / "spec.yaml").write_text(SPEC, encoding="utf-8")
    ctid("run", folder / "spec.yaml", "--jobs", 1, "--quiet", "--out", folder / "results")
    return folder / "results"


@pytest.fixture
def exported(ctid, results):
    return json.loads(ctid("export", "loop", "--format", "json", "--out", results).stdout)


def test_every_estimate_has_the_parameters_of_the_submodels(exported):
    assert len(exported) == 2 * 2 * 2 * 2
    for estimate in exported:
        assert list(estimate)[8:12] == ["numerator", "denominator", "parameters", "standard_errors"]
        extra = [] if estimate["estimator"] == "both" else ["g1_b1", "g2_b1"]
        assert sorted(estimate["parameters"]) == sorted(NAMES + extra)
        assert all(estimate["standard_errors"][name] > 0 for name in NAMES + extra)
        # By natural frequency, although the specification has the faster one first.
        assert estimate["parameters"]["g1_a2"] == pytest.approx(0.25, rel=0.2)
        assert estimate["parameters"]["g2_a2"] == pytest.approx(0.025, rel=0.2)
        # The sum of the submodels is the fraction.
        gain = estimate["numerator"][-1] / estimate["denominator"][-1]
        assert estimate["parameters"]["g1_b0"] + estimate["parameters"]["g2_b0"] == pytest.approx(gain, rel=1e-9)
        truth = [0.25, 0.25, 3.0, 0.01, 0.025, 1.0]
        errors = [abs(estimate["parameters"][name] / true - 1) for name, true in zip(NAMES, truth, strict=True)]
        assert estimate["converged"] is (max(errors) <= 0.2)


def test_the_table_has_them_in_columns(ctid, results, exported):
    rows = list(csv.DictReader(io.StringIO(ctid("export", "loop", "--out", results).stdout)))
    columns = list(rows[0])
    first = columns.index("g1_a1")
    assert columns[first - 1 : first + 9] == [
        "a4", "g1_a1", "g1_a2", "g1_b0", "g1_b1", "g2_a1", "g2_a2", "g2_b0", "g2_b1", "se_b0",
    ]  # fmt: skip
    assert "parameters" not in columns
    for row, estimate in zip(rows, exported, strict=True):
        assert row["id"] == estimate["id"]
        for name, value in estimate["parameters"].items():
            assert float(row[name]) == value
            assert float(row[f"se_{name}"]) == estimate["standard_errors"][name]
        assert (row["g1_b1"] == "") is (estimate["estimator"] == "both")


def test_tables_tell_several_starts_apart(ctid, results):
    text = ctid("table", "loop", "--out", results).stdout
    assert "parameters all lie within 20 % of the true ones" in text
    rows = json.loads(ctid("table", "loop", "--format", "json", "--out", results).stdout)
    assert [(row["samples"], row["method"], row["start"], row["n"]) for row in rows] == [
        (samples, method, f"parameters({percent}%)", 2)
        for samples in (300, 600)
        for method in ("both", "one")
        for percent in (1, 2)
    ]


def test_one_estimate_in_full(ctid, results, exported):
    for estimate in (exported[0], exported[-1]):
        text = ctid("export", "--id", estimate["id"], "--out", results).stdout
        assert f"start {estimate['start']}" in text
        assert "g1: submodel of the least natural frequency" in text
        assert ("monic denominator" in text) is (estimate["estimator"] == "one")
        shown = json.loads(ctid("export", "--id", estimate["id"], "--json", "--out", results).stdout)
        found = {item["name"]: item for item in shown["parameters"]}
        assert found["g1_a2"]["estimate"] == estimate["parameters"]["g1_a2"]
        assert found["g1_a2"]["standard_error"] == estimate["standard_errors"]["g1_a2"]
        assert (found["g1_a2"]["unit"], found["g1_b0"]["unit"]) == ("s^2", "out/in")
        assert math.isclose(
            found["g1_b0"]["high"] - found["g1_b0"]["estimate"],
            estimate["quantiles"]["g1_b0"] * estimate["standard_errors"]["g1_b0"],
            rel_tol=1e-9,
        )


def test_validate_counts_the_work(ctid, tmp_path):
    (tmp_path / "spec.yaml").write_text(SPEC, encoding="utf-8")
    assert "4 data sets (2 data cells), 16 estimates" in ctid("validate", tmp_path / "spec.yaml").stdout


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("kp: 0.0115", "kp: 0.575", ":7:3: loop.controller: the loop with"),
        ("variance: 0.01", "snr_db: 10", ":10:69: noise.snr_db: in a loop the noise feeds back"),
        ("[0.25, 0.25, 1]", "[0.25, -0.25, 1]", ":5:7: system.additive[1]: the submodel is unstable"),
        ("poles: 4", "poles: 5", ":14:23: starts.parameters[0]: the start has 4 poles"),
    ],
)
def test_mistakes_are_lines(ctid, tmp_path, old, new, place):
    assert SPEC.count(old) == 1
    file = tmp_path / "spec.yaml"
    file.write_text(SPEC.replace(old, new), encoding="utf-8")
    done = ctid("run", file, "--out", tmp_path / "results", code=2)
    assert f"{file}{place}" in done.stderr
    assert not (tmp_path / "results").exists()
