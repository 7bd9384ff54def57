"""``ctid fit`` with submodels, integrators, known parameters and loops."""

import json

import numpy as np
import pytest

from ctid_cli import HeldSignal, load_fit
from ctid_cli.filtering.simulate import simulate_additive
from ctid_cli.models.additive import AdditiveModel, Submodel
from tests.cli.records import LOOP, in_loop, write

STEP = 0.05
MODES = AdditiveModel([Submodel([3.0], [0.25, 0.25, 1.0]), Submodel([1.0], [0.025, 0.01, 1.0])])


def record(file, system, n=800, noise=0.05, seed=0):
    rng = np.random.default_rng(seed)
    t = STEP * np.arange(n)
    u = rng.standard_normal(n)
    y = simulate_additive(system, HeldSignal(t, u), t) + noise * rng.standard_normal(n)
    return write(file, (t, u, y))


@pytest.fixture
def closed(tmp_path):
    (tmp_path / "loop.yaml").write_text(LOOP, encoding="utf-8")
    return in_loop(tmp_path / "closed.csv")


def fitted(ctid, *arguments):
    return json.loads(ctid("fit", *arguments, "--json").stdout)


def near(content, expected, errors=5.0):
    """Return whether parameters are within a number of standard errors of the expected values."""
    found = {item["name"]: item for item in content["parameters"]}
    for name, value in expected.items():
        assert found[name]["estimate"] == pytest.approx(value, abs=errors * found[name]["standard_error"])
        assert found[name]["standard_error"] < 0.2 * abs(value) + 0.01


def test_a_sum_of_submodels_is_printed_written_and_read_back(ctid, tmp_path):
    file, other = record(tmp_path / "one.csv", MODES), record(tmp_path / "other.csv", MODES, seed=1)
    arguments = (file, "--model", "additive", "--terms", "2/0,2/0", "--validate", other, "--out", tmp_path)
    content = fitted(ctid, *arguments)
    near(content, {"g1_b0": 3.0, "g1_a1": 0.25, "g1_a2": 0.25, "g2_b0": 1.0, "g2_a2": 0.025})
    assert [len(part["denominator"]) for part in content["model"]["submodels"]] == [3, 3]
    assert content["validation"]["r2"] > 0.99
    assert content["warnings"] == []
    text = ctid("fit", *arguments).stdout
    assert "sum of 2 submodels with poles/zeros 2/0, 2/0; delay known, 0 s" in text
    assert (tmp_path / "fit.svg").read_bytes().startswith(b"<?xml")
    again = load_fit(tmp_path / "fit.json")
    assert again.fit.additive.parameters == {
        item["name"]: item["estimate"] for item in content["parameters"] if item["name"] != "delay"
    }
    assert np.mean(again.fit.residuals[0] ** 2) == pytest.approx(content["cost"], rel=1e-12)
    assert again.validation.applied.residuals[0].size == 800


@pytest.mark.slow
def test_a_loop_removes_the_bias_that_coloured_noise_makes(ctid, closed, tmp_path):
    options = (closed, "--input", "u", "--poles", 1, "--out", tmp_path)
    content = fitted(ctid, *options, "--loop", tmp_path / "loop.yaml", "--reference", "r")
    near(content, {"a1": 1.5, "b0": 2.0}, errors=3.0)
    stored = load_fit(tmp_path / "fit.json")
    assert stored.records[0].loop.controller.numerator.tolist() == [0.8, -0.7]
    assert np.mean(stored.fit.residuals[0] ** 2) == pytest.approx(content["cost"], rel=1e-12)
    assert not any("follows the output" in warning for warning in content["warnings"])
    ignored = fitted(ctid, *options, "--loop", tmp_path / "loop.yaml", "--direct")
    assert any("direct method" in note for note in ignored["notes"])
    direct = fitted(ctid, *options)
    estimates, plain = ({one["name"]: one["estimate"] for one in each["parameters"]} for each in (ignored, direct))
    assert estimates == plain
    # Estimates known to be biased have no standard errors; without the loop the bias is unknown.
    assert all(one["standard_error"] is None for one in ignored["parameters"])
    assert "estimate is biased" in ignored["covariance"]["reason"]


@pytest.mark.slow
def test_a_loop_whose_controller_is_not_known(ctid, closed, tmp_path):
    options = (closed, "--input", "u", "--poles", 1, "--out", tmp_path)
    content = fitted(ctid, *options, "--reference", "r")
    near(content, {"a1": 1.5, "b0": 2.0}, errors=3.0)
    assert any("delay was taken as 0" in note for note in content["notes"])
    known = fitted(ctid, *options, "--loop", "unknown", "--reference", "r", "--delay", 0)
    assert known["parameters"] == content["parameters"]
    assert not any("delay was taken" in note for note in known["notes"])
    assert load_fit(tmp_path / "fit.json").records[0].loop.controller is None
    direct = fitted(ctid, *options, "--loop", "unknown")
    assert any("direct method" in note for note in direct["notes"])
    assert all(one["standard_error"] is None for one in direct["parameters"])
