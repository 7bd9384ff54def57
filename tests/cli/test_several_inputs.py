"""``ctid fit`` with several inputs: from columns to a model, and refusals."""

import json

import numpy as np
import pytest

from ctid_cli import HeldSignal, TransferFunction, simulate

BOTH = ("--input", "u1", "--input", "u2")


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    rng, t = np.random.default_rng(0), 0.1 * np.arange(300)
    u1, u2 = np.repeat(rng.choice([-1.0, 1.0], (2, 60)), 5, axis=1)
    y = simulate(TransferFunction([2.0], [1.0, 1.2, 1.0], 0.7), HeldSignal(t, u1), t)
    y += simulate(TransferFunction([-1.5], [1.0, 0.6]), HeldSignal(t, u2), t) + 0.1 * rng.standard_normal(300)
    path = tmp_path_factory.mktemp("rig") / "rig.csv"
    columns = np.column_stack((t, u1, u2, y, 1.0 - u1))
    np.savetxt(path, columns, delimiter=",", header="t [s],u1 [V],u2 [A],y [m],u3", comments="")
    return path


@pytest.mark.slow
def test_a_model_is_fitted_written_compared_and_exported(ctid, record, tmp_path):
    options = ("--poles", "u1=2", "--poles", "u2=1", "--delay", 0, "--fix", "u1_delay=0.7")
    options += ("--initial-state", "rest", "--offset", "none", "--hold", "u1=zoh", "--hold", "u2=foh")
    options += ("--validate", record)
    written = ("--json", "--report", "--csv", tmp_path, "--export", "control", "--out", tmp_path)
    content = json.loads(ctid("fit", record, *BOTH, *options, *written).stdout)
    model = content["model"]
    assert not model["common_denominator"]
    assert model["inputs"]["u1"]["denominator"] == pytest.approx([1.0, 1.2, 1.0], rel=0.1)
    assert model["inputs"]["u2"]["numerator"] == pytest.approx([-1.5], rel=0.1)
    units = {item["name"]: (item["unit"], item["status"]) for item in content["parameters"]}
    assert units["u1_b0"] == ("m/V/s^2", "free")
    assert units["u2_b0"] == ("m/A/s", "free")
    assert units["u1_delay"] == ("s", "fixed")
    assert content["records"][0]["columns"]["input"] == ["u1 [V]", "u2 [A]"]
    assert content["settings"]["hold"] == content["records"][0]["hold"] == ["zoh", "foh"]
    assert len(content["residual_tests"]) == 2
    assert {path.name for path in tmp_path.iterdir()} >= {"step_u1.csv", "bode_u2.csv", "fit.html", "G_control.py"}
    assert "Response to u2" in (tmp_path / "fit.html").read_text(encoding="utf-8")
    compared = json.loads(ctid("compare", tmp_path / "fit.json", "--on", record, "--json", "--out", tmp_path).stdout)
    assert compared["models"][0]["fit_percent"] == pytest.approx(content["fit_percent"], abs=1e-6)
