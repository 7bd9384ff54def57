"""``ctid compare``, ``ctid fit --csv`` and ``ctid export --as``: fitted models in use."""

import json
import re
import runpy

import numpy as np
import pandas as pd
import pytest

from ctid_cli import DelayProfile, Record, compare, identify, load_fit
from ctid_cli.signals.measurement import read_measurement
from tests.cli.records import rows, write


def write_record(file, seed, n=500, header="t [s],u [V],y [mm]"):
    return write(file, rows(seed, n, 0.05, 0.3), header)


@pytest.fixture(scope="module")
def home(tmp_path_factory, ctid):
    """Two fits to one record, and another record."""
    folder = tmp_path_factory.mktemp("models")
    record = write_record(folder / "record.csv", 0)
    write_record(folder / "other.csv", 1)
    for poles in (1, 2):
        ctid("fit", record, "--poles", poles, "--delay", "0:3", "--offset", "estimate", "--out", folder / f"p{poles}")
    return folder


def columns(file):
    return pd.read_csv(file).to_numpy().T


def test_compare_is_what_fit_says_of_a_validation_record(ctid, home, tmp_path, monkeypatch, snapshot):
    fits = home / "p1" / "fit.json", home / "p2" / "fit.json"
    monkeypatch.chdir(home)
    text = ctid("compare", *fits, "--on", "other.csv", "--out", tmp_path).stdout
    assert re.sub(r"\S*/", "", text) == snapshot
    content = json.loads(ctid("compare", *fits, "--on", home / "other.csv", "--json", "--out", tmp_path).stdout)
    other = home / "other.csv"
    judged = ctid(
        *("fit", home / "record.csv", "--poles", 2, "--delay", "0:3", "--offset", "estimate"),
        *("--validate", other, "--json", "--out", tmp_path / "again"),
    )
    validation = json.loads(judged.stdout)["validation"]
    found = next(row for row in content["models"] if row["name"] == "p2")
    assert found["fit_percent"] == pytest.approx(validation["fit_percent"], rel=1e-12)
    assert found["white"]
    assert found["uncorrelated"]
    assert not content["models"][0]["uncorrelated"]
    measured, one, two = columns(tmp_path / "comparison.csv")[1:]
    assert np.std(measured - two) < np.std(measured - one)


def test_the_files_of_csv_are_what_the_model_does(ctid, home, tmp_path):
    ctid("fit", home / "record.csv", "--poles", 2, "--delay", "0:3", "--csv", tmp_path / "csv", "--out", tmp_path)
    fitted = load_fit(tmp_path / "fit.json")
    assert sorted(path.name for path in (tmp_path / "csv").iterdir()) == [
        "bode.csv", "residuals.csv", "simulation.csv", "step.csv",
    ]  # fmt: skip
    t, value, error, lower, upper = columns(tmp_path / "csv" / "step.csv")
    band = fitted.step_response(t)
    np.testing.assert_allclose([value, error, lower, upper], [band.value, band.standard_error, band.lower, band.upper])
    bode = pd.read_csv(tmp_path / "csv" / "bode.csv")
    w = bode.iloc[:, 0].to_numpy()
    np.testing.assert_allclose(bode["gain [mm/V]"], fitted.frequency_response(w).gain)
    residuals = columns(tmp_path / "csv" / "residuals.csv")[1]
    np.testing.assert_allclose(residuals, fitted.fit.residuals[0], atol=1e-9)
    _, _, measured, simulated = columns(tmp_path / "csv" / "simulation.csv")
    np.testing.assert_allclose(measured - simulated, residuals, atol=1e-12)


@pytest.mark.parametrize("tool", ["control", "scipy"])
def test_exported_code_builds_the_model(ctid, home, tmp_path, tool):
    model = load_fit(home / "p2" / "fit.json").fit.model
    file = tmp_path / "model.py"
    file.write_text(ctid("export", home / "p2" / "fit.json", "--as", tool).stdout, encoding="utf-8")
    built = runpy.run_path(str(file))
    system = built["G"]
    b, a = (system.num[0][0], system.den[0][0]) if tool == "control" else (system.num, system.den)
    np.testing.assert_allclose(np.ravel(b), model.numerator, rtol=1e-12)
    np.testing.assert_allclose(np.ravel(a), model.denominator, rtol=1e-12)
    assert built["delay"] == model.delay


def test_exported_pade_delay_and_matlab(ctid, home, tmp_path):
    fit = home / "p2" / "fit.json"
    ctid("export", fit, "--as", "control", "--pade", 5, "--file", tmp_path / "plant.py")
    system = runpy.run_path(str(tmp_path / "plant.py"))["G"]
    model = load_fit(fit).fit.model
    np.testing.assert_allclose(np.ravel(system(1j * np.array([1.0]))), model.frequency_response([1.0]), rtol=1e-6)
    text = ctid("export", fit, "--as", "matlab").stdout
    assert float(re.search(r"delay = (.*);", text)[1]) == model.delay
    assert "--pade is for control" in ctid("export", fit, "--as", "scipy", "--pade", 3, code=2).stderr


def refused(ctid, *arguments, out):
    done = ctid("compare", *arguments, "--out", out, code=2)
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert not out.exists()
    return done.stderr


def test_bad_input_is_one_sentence_and_nothing_is_written(ctid, home, tmp_path):
    fit, out, on = home / "p2" / "fit.json", tmp_path / "none", home / "other.csv"
    content = json.loads(fit.read_text(encoding="utf-8"))
    files = {
        "newer": ({**content, "format": 99}, "newer ctid"),
        "damaged": ({**content, "fit_percent": 12.0}, "damaged"),
        "kind": ({"kind": "ctid order"}, "kind 'ctid order'"),
    }
    for name, (changed, message) in files.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(changed), encoding="utf-8")
        assert message in refused(ctid, tmp_path / f"{name}.json", "--on", on, out=out)
    assert "given twice" in refused(ctid, fit, fit, "--on", on, out=out)
    seconds = write_record(tmp_path / "ms.csv", 1, header="t [ms],u [V],y [mm]")
    assert "the time is in ms, and the model is in s" in refused(ctid, fit, "--on", seconds, out=out)
    other = write_record(tmp_path / "names.csv", 1, header="t [s],heater [V],height [mm]")
    assert "no column 'fan'" in refused(ctid, fit, "--on", other, "--input", "fan", out=out)
    short = tmp_path / "short.csv"
    short.write_text("\n".join(on.read_text(encoding="utf-8").splitlines()[:7]) + "\n", encoding="utf-8")
    assert "delay" in refused(ctid, fit, "--on", short, out=out)
    assert "missing.csv" in refused(ctid, fit, "--on", tmp_path / "missing.csv", out=out)


def test_inputs_are_not_overwritten(ctid, home, tmp_path):
    record = write_record(tmp_path / "comparison.csv", 1)
    before = record.read_bytes()
    done = ctid("compare", home / "p2" / "fit.json", "--on", record, "--out", tmp_path, code=2)
    assert "would be overwritten" in done.stderr
    assert record.read_bytes() == before


def test_models_are_compared_from_python_with_one_treatment(home):
    record = read_measurement(home / "record.csv").record
    options = DelayProfile(2, 0, (0.0, 3.0), offset="estimate")
    fits = [identify([record], options), options.fit(record, None)]
    other = read_measurement(home / "other.csv").record
    own, plain = compare(fits, other)
    assert (own.offset, plain.offset) == ("estimate", "none")
    assert own.fit_percent > plain.fit_percent + 20
    same = compare(fits, other, offset="estimate")
    assert same[0].fit_percent == same[1].fit_percent == own.fit_percent
    from_rest, treated = compare(fits[1:], other, initial_state="rest")[0], compare(fits[1:], other, offset="remove")[0]
    assert treated.rms < from_rest.rms
    states = compare([fits[0], options.fit(record, None)], other, initial_state="estimate")
    assert (states[0].t == states[1].t).all()
    gaps = Record(other.t, np.where(other.t == 2.0, np.nan, other.y), other.input)
    assert compare(fits, gaps)[0].count == other.n_samples - 1
