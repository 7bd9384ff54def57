"""``ctid fit`` with several inputs: from columns to a model, and refusals."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from ctid_cli import HeldSignal, TransferFunction, simulate
from ctid_cli.cli.main import app
from ctid_cli.errors import ExitCode

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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((*BOTH, "--output", "y", "--output", "u3"), "fit one --output at a time"),
        ((*BOTH, "--model", "additive", "--terms", "1/0"), "--model additive has one input"),
        ((*BOTH, "--poles", 1, "--reference", "u3"), "a record in a loop is fitted with one input"),
        ((*BOTH, "--loop", "unknown", "--poles", 1, "--delay", 0), "a record in a loop is fitted with one input"),
        ((*BOTH, "--poles", "u1=1"), "--poles is given for u1 and not for u2"),
        ((*BOTH, "--poles", "u9=1"), "the inputs are u1, u2"),
        ((*BOTH, "--poles", 1, "--poles", 2), "--poles is given twice"),
        ((*BOTH, "--poles", "one"), "--poles must be a whole number, or INPUT=NUMBER"),
        ((*BOTH, "--poles", "u1=2", "--poles", "u2=1", "--zeros", "u1=3"), "input u1: zeros must be at most 1"),
        ((*BOTH, "--poles", 1, "--hold", "u3=foh"), "the inputs are u1, u2"),
        ((*BOTH, "--poles", 1, "--hold", "u1=auto"), "--hold auto chooses one for all inputs"),
        (("--input", "u1", "--poles", "u1=1"), "name several with --input"),
        (("--input", "u1", "--input", "u3", "--poles", 1, "--delay", 0), "u1 and u3 are collinear"),
        (("--input", "u1", "--input", "u1"), "cannot be both the input and the input 2"),
    ],
)
def test_what_does_not_go_together_is_refused(record, tmp_path, options, message):
    done = CliRunner().invoke(app, ["fit", str(record), *map(str, options), "--out", str(tmp_path)])
    assert done.exit_code == ExitCode.BAD_INPUT
    assert message in " ".join(done.stderr.split())
    assert not list(tmp_path.iterdir())
