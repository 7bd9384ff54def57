"""``ctid model``: what stored fits answer, and stored fits on other records."""

import json
import re
import runpy

import numpy as np
import pandas as pd
import pytest

from ctid_cli import DelayProfile, HeldSignal, Record, compare, identify, load_fit
from ctid_cli.signals.measurement import read_measurement
from tests.cli.records import rows, write


def write_record(file, seed, n=500, header="t [s],u [V],y [mm]"):
    return write(file, rows(seed, n, 0.05, 0.3), header)


@pytest.fixture(scope="module")
def home(tmp_path_factory, ctid):
    """Two fits to one record, another record, and an input without an output."""
    folder = tmp_path_factory.mktemp("models")
    record = write_record(folder / "record.csv", 0)
    write_record(folder / "other.csv", 1)
    (folder / "input.csv").write_text("t [s],u [V]\n0,0\n1,1\n2.5,1\n4,-2\n9,0.5\n", encoding="utf-8")
    for poles in (1, 2):
        ctid("fit", record, "--poles", poles, "--delay", "0:3", "--offset", "estimate", "--out", folder / f"p{poles}")
    return folder


def columns(file):
    return pd.read_csv(file).to_numpy().T


def test_simulate_answers_to_an_input_without_an_output(ctid, home, tmp_path):
    fit = home / "p2" / "fit.json"
    text = ctid("model", "simulate", fit, "--on", home / "input.csv", "--out", tmp_path).stdout
    assert "value [mm]" in text
    assert sorted(path.name for path in tmp_path.iterdir()) == ["simulation.csv", "simulation.svg"]
    t, u, value, error, lower, upper = columns(tmp_path / "simulation.csv")
    band = load_fit(fit).simulate(HeldSignal(t, u))
    np.testing.assert_array_equal(
        [value, error, lower, upper], [band.value, band.standard_error, band.lower, band.upper]
    )


def test_step_and_bode_show_several_models(ctid, home, tmp_path):
    fits = home / "p1" / "fit.json", home / "p2" / "fit.json"
    text = ctid("model", "step", *fits, "--until", 8, "--out", tmp_path).stdout
    assert "p1:\n  t [s]" in text
    step = columns(tmp_path / "step.csv")
    assert step.shape == (9, 500)
    np.testing.assert_array_equal(step[5], load_fit(fits[1]).step_response(step[0]).value)
    ctid("model", "bode", *fits, "--on", home / "record.csv", "--band", "0.1:20", "--out", tmp_path)
    picture = (tmp_path / "bode.svg").read_text(encoding="utf-8")
    assert "local-polynomial" in picture
    frame = pd.read_csv(tmp_path / "bode.csv")
    w = frame.iloc[:, 0].to_numpy()
    assert (w[0], w[-1]) == pytest.approx((0.1, 20.0))
    np.testing.assert_array_equal(frame["gain p2 [mm/V]"], load_fit(fits[1]).frequency_response(w).gain)


def test_compare_is_what_fit_says_of_a_validation_record(ctid, home, tmp_path):
    fits = home / "p1" / "fit.json", home / "p2" / "fit.json"
    text = ctid("model", "compare", *fits, "--on", home / "other.csv", "--out", tmp_path).stdout
    assert text.index("\np2 ") < text.index("\np1 ")
    content = json.loads(
        ctid("model", "compare", *fits, "--on", home / "other.csv", "--json", "--out", tmp_path).stdout
    )
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


def test_residuals_on_the_record_of_the_fit_are_those_of_the_fit(ctid, home, tmp_path):
    fit = home / "p2" / "fit.json"
    content = json.loads(
        ctid("model", "residuals", fit, "--on", home / "record.csv", "--json", "--out", tmp_path).stdout
    )
    loaded = load_fit(fit)
    np.testing.assert_allclose(columns(tmp_path / "residuals.csv")[1], loaded.fit.residuals[0], atol=1e-9)
    (test,) = loaded.tests
    np.testing.assert_allclose(content["correlation"]["autocorrelation"]["values"], test.autocorrelation, atol=1e-8)
    assert content["correlation"]["cross_correlation"]["band"] == pytest.approx(test.cross_correlation_band, rel=1e-6)
    assert content["models"][0]["cross_p_value"] == pytest.approx(test.cross_p_value, rel=1e-6)
    text = ctid("model", "residuals", fit, "--on", home / "record.csv", "--out", tmp_path).stdout
    assert test.sentence.split(".")[0] in text


@pytest.mark.parametrize("style", ["control", "scipy"])
def test_exported_code_builds_the_model(ctid, home, tmp_path, style):
    model = load_fit(home / "p2" / "fit.json").fit.model
    ctid("model", "export", home / "p2" / "fit.json", "--format", style, "--name", "plant", "--out", tmp_path)
    built = runpy.run_path(str(tmp_path / f"plant_{style}.py"))
    system = built["plant"]
    b, a = (system.num[0][0], system.den[0][0]) if style == "control" else (system.num, system.den)
    np.testing.assert_allclose(np.ravel(b), model.numerator, rtol=1e-12)
    np.testing.assert_allclose(np.ravel(a), model.denominator, rtol=1e-12)
    assert built["delay"] == model.delay


def test_exported_pade_delay_and_matlab(ctid, home, tmp_path):
    fit = home / "p2" / "fit.json"
    ctid("model", "export", fit, "--format", "control", "--pade", 5, "--out", tmp_path)
    system = runpy.run_path(str(tmp_path / "G_control.py"))["G"]
    model = load_fit(fit).fit.model
    np.testing.assert_allclose(np.ravel(system(1j * np.array([1.0]))), model.frequency_response([1.0]), rtol=1e-6)
    ctid("model", "export", fit, "--format", "matlab", "--kind", "tf", "--out", tmp_path)
    text = (tmp_path / "G.m").read_text(encoding="utf-8")
    assert float(re.search(r"delay = (.*);", text)[1]) == model.delay
    assert "'InputDelay', delay, 'TimeUnit', 'seconds'" in text


def refused(ctid, *arguments, out):
    done = ctid("model", *arguments, "--out", out, code=2)
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert not out.exists()
    return done.stderr


def test_bad_input_is_one_sentence_and_nothing_is_written(ctid, home, tmp_path):
    fit, out = home / "p2" / "fit.json", tmp_path / "none"
    content = json.loads(fit.read_text(encoding="utf-8"))
    files = {
        "newer": {**content, "format": 99},
        "damaged": {**content, "fit_percent": 12.0},
        "kind": {"kind": "ctid order"},
    }
    for name, changed in files.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(changed), encoding="utf-8")
    assert "newer ctid" in refused(ctid, "step", tmp_path / "newer.json", out=out)
    assert "damaged" in refused(ctid, "bode", tmp_path / "damaged.json", out=out)
    assert "kind 'ctid order'" in refused(ctid, "step", fit, tmp_path / "kind.json", out=out)
    assert "given twice" in refused(ctid, "step", fit, fit, out=out)

    seconds = write_record(tmp_path / "ms.csv", 1, header="t [ms],u [V],y [mm]")
    assert "the time is in ms, and the model is in s" in refused(ctid, "compare", fit, "--on", seconds, out=out)
    volts = write_record(tmp_path / "mA.csv", 1, header="t [s],u [mA],y [mm]")
    assert "the input is in mA" in refused(ctid, "simulate", fit, "--on", volts, out=out)
    other = write_record(tmp_path / "names.csv", 1, header="t [s],heater [V],height [mm]")
    assert "no column 'fan'" in refused(ctid, "residuals", fit, "--on", other, "--input", "fan", out=out)

    short = tmp_path / "short.csv"
    rows = (home / "other.csv").read_text(encoding="utf-8").splitlines()[:7]
    short.write_text("\n".join(rows) + "\n", encoding="utf-8")
    assert "delay" in refused(ctid, "compare", fit, "--on", short, out=out)
    assert "delay" in refused(ctid, "simulate", fit, "--on", short, out=out)

    for arguments, message in (
        (("export", fit, "--format", "matlab", "--pade", 3), "--pade belongs to --format control"),
        (("export", fit, "--format", "scipy", "--kind", "tf"), "--kind belongs to --format matlab"),
        (("export", fit, "--format", "scipy", "--name", "for"), "'for'"),
        (("export", fit, "--format", "matlab", "--name", "../x"), "'../x'"),
        (("bode", fit, "--input", "u"), "name it with --on FILE"),
        (("bode", fit, "--band", "3:1"), "LOW:HIGH"),
        (("step", fit, "--until", -1), "--until"),
        (("step", fit, "--level", 95), "between 0 and 1"),
        (("simulate", fit, "--on", tmp_path / "missing.csv"), "missing.csv"),
    ):
        assert message in refused(ctid, *arguments, out=out)


def test_inputs_are_not_overwritten(ctid, home, tmp_path):
    record = write_record(tmp_path / "simulation.csv", 1)
    before = record.read_bytes()
    done = ctid("model", "simulate", home / "p2" / "fit.json", "--on", record, "--out", tmp_path, code=2)
    assert "would be overwritten" in done.stderr
    assert record.read_bytes() == before


def test_models_are_compared_from_python_with_one_treatment(home):
    record = read_measurement(home / "record.csv").record
    options = DelayProfile(2, 0, (0.0, 3.0), offset="estimate")
    fits = [identify(options, [record]), options.fit(record, None)]
    other = read_measurement(home / "other.csv").record
    own, plain = compare(fits, other)
    assert (own.offset, plain.offset) == ("estimate", "none")
    assert own.fit_percent > plain.fit_percent + 20
    same = compare(fits, other, offset="estimate")
    assert same[0].fit_percent == same[1].fit_percent == own.fit_percent
    from_rest, treated = compare(fits[1:], other, initial_state="rest")[0], compare(fits[1:], other, offset="remove")[0]
    assert treated.rms < from_rest.rms
    gaps = Record(other.t, np.where(other.t == 2.0, np.nan, other.y), other.input)
    assert compare(fits, gaps)[0].count == other.n_samples - 1
