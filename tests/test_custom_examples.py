"""The examples of custom components run as documented, and require permission."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

EXAMPLES = Path(__file__).resolve().parents[1] / "docs" / "examples"


def ctid(*arguments, code=0, env=None):
    from ctid_cli.cli.main import app

    done = CliRunner().invoke(app, [str(argument) for argument in arguments], env=env)
    assert done.exit_code == code, f"exit code {done.exit_code}\n{done.output}\n{done.exception!r}"
    return done


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("out")
    files = [EXAMPLES / "custom_study.yaml", EXAMPLES / "tank.yaml"]
    assert ctid("run", *files, "--allow-code", "--quiet", "--jobs", "2", "--out", folder).stdout == ""
    return folder


@pytest.mark.slow
def test_the_study(out):
    rows = json.loads(ctid("export", "custom-study", "--format", "json", "--out", out).stdout)
    assert len(rows) == 12
    by_name = {name: [row for row in rows if row["estimator"] == name] for name in ("mine", "external", "srivc")}
    assert {row["status"] for row in by_name["external"]} == {"LEAST_SQUARES"}
    for mine, ours in zip(by_name["mine"], by_name["srivc"], strict=True):
        # Both minimise the output error, one of them from the time of the greatest delay on.
        assert mine["status"] == "CONVERGED"
        assert mine["delay"] == pytest.approx(ours["delay"], abs=2 * ours["standard_errors"]["delay"])
        assert mine["standard_errors"]["delay"] == pytest.approx(ours["standard_errors"]["delay"], rel=0.2)
        assert mine["parameters"]["b0"] == mine["numerator"][0]
    worst = {name: [row["custom_measures"]["WorstGain"] for row in own] for name, own in by_name.items()}
    assert 0.0 < max(worst["mine"] + worst["srivc"]) < min(worst["external"])
    assert re.search(r"mine +\d+\.\d \[.*\] +\d", ctid("table", "custom-study", "--out", out).stdout)


@pytest.mark.slow
def test_the_tank_is_nearly_linear(out):
    rows = json.loads(ctid("export", "tank", "--format", "json", "--out", out).stdout)
    found = np.array([[row["numerator"][0], row["denominator"][1]] for row in rows])
    np.testing.assert_allclose(found, [[0.5, 0.25]] * 4, rtol=0.03)


@pytest.mark.slow
def test_an_estimator_of_frequencies(tmp_path):
    ctid("run", EXAMPLES / "zero_crossings.yaml", "--allow-code", "--quiet", "--jobs", "1", "--out", tmp_path)
    rows = json.loads(ctid("export", "zero-crossings", "--format", "json", "--out", tmp_path).stdout)
    mine = [row["measures"] for row in rows if row["estimator"] == "mine"]
    assert len(mine) == 2
    for measures in mine:
        assert measures["omega_1"] == pytest.approx(2.0, abs=1e-3)
        assert (measures["valid_share"], "settling_time_1" in measures) == (100.0, False)
    assert all(row["converged"] for row in rows)


@pytest.mark.parametrize(
    "command",
    [("validate",), *(pytest.param(words, marks=pytest.mark.slow) for words in (("run", "--dry-run"), ("accuracy",)))],
)
def test_permission(command, tmp_path, monkeypatch):
    file = EXAMPLES / "custom_study.yaml"
    place = () if command[0] != "run" else ("--out", tmp_path)
    message = ctid(*command, file, *place, code=3).stderr
    assert re.search(r"custom_study.yaml:6:21: noise.kind: names code, which would be run; .*--allow-code", message)
    answer = ctid(*command, file, *place, env={"CTID_ALLOW_CODE": "1"}).stdout
    assert (
        "the theory here does not cover custom systems" in " ".join(answer.split())
        if command[0] == "accuracy"
        else "custom-study: " in answer
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_whole_study_shows_its_files_and_they_run(tmp_path):
    page = (EXAMPLES.parent / "custom-components.md").read_text(encoding="utf-8")
    for language, name in (("py", "projection.py"), ("yaml", "projection.yaml")):
        assert f"```{language}\n{(EXAMPLES / name).read_text(encoding='utf-8')}```\n" in page
    smaller = ["--runs", "1", "--set", "sampling.samples=100", "--set", "noise.snr_db=20", "--jobs", "1"]
    ctid("run", EXAMPLES / "projection.yaml", "--allow-code", "--quiet", *smaller, "--out", tmp_path)
    mine, ours = json.loads(ctid("export", "projection", "--format", "json", "--out", tmp_path).stdout)
    assert (mine["estimator"], ours["estimator"]) == ("mine", "search")
    # Both minimise the output error.
    assert mine["cost"] == pytest.approx(ours["cost"], rel=1e-4)
    assert mine["delay"] == pytest.approx(ours["delay"], abs=1e-3)
    assert mine["converged"] is not None
