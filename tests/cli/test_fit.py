"""``ctid fit``: from files to a model, or to a one-sentence error."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from ctid_cli import DataError, Record, load_fit
from tests.cli.records import rows, write


@pytest.fixture
def record(tmp_path):
    return write(tmp_path / "record.csv", rows())


def check_model(model, tolerance=0.05):
    assert model["numerator"] == pytest.approx([3.0], rel=tolerance)
    assert model["denominator"] == pytest.approx([1.0, 1.2, 4.0], rel=tolerance)
    assert model["delay"] == pytest.approx(0.73, rel=tolerance)


def test_fit_prints_a_table_and_writes_two_files_here(ctid, record, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    arguments = ("fit", record, "--poles", 2, "--zeros", 0, "--delay", "0:3")
    text = ctid(*arguments).stdout
    assert sorted(path.name for path in Path().iterdir()) == ["fit.json", "fit.svg"]
    assert Path("fit.svg").read_bytes().startswith(b"<?xml")
    assert text.endswith("\n\nWritten: fit.json, fit.svg\n")
    stored = Path("fit.json").read_text(encoding="utf-8")
    # The printed JSON equals the file, in every run.
    assert ctid(*arguments, "--json").stdout == stored == Path("fit.json").read_text(encoding="utf-8")
    check_model(json.loads(stored)["model"])


def test_every_option_reaches_the_fit(ctid, tmp_path):
    values = rows(offset=5.0)
    file = write(tmp_path / "named.csv", values[:, [2, 0, 1]], "speed [rpm],clock [s],drive [V]")
    options = ("--time", "clock", "--input", "drive", "--output", "speed", "--from", 1, "--to", 40, "--hold", "foh")
    options += ("--initial-state", "estimate", "--offset", "estimate", "--delay", 0.73, "--loss", "tukey")
    options += ("--zeros", 1, "--poles", 2)
    content = json.loads(ctid("fit", file, *options, "--json", "--out", tmp_path).stdout)
    (used,) = content["records"]
    assert (used["start"], used["stop"]) == (1.0, 40.0)
    assert used["columns"] == {"time": "clock [s]", "input": "drive [V]", "output": "speed [rpm]"}
    settings = content["settings"]
    assert (settings["hold"], settings["initial_state"], settings["offset"]) == ("foh", "estimate", "estimate")
    parameters = {item["name"]: item for item in content["parameters"]}
    assert list(parameters) == ["b0", "b1", "a1", "a2", "delay", "x1", "x2", "offset"]
    assert content["loss"]["kind"] == settings["loss"] == "tukey"
    assert parameters["b0"]["unit"] == "rpm/V/s"
    assert parameters["delay"]["status"] == "fixed"
    assert content["offset"]["output"] == [parameters["offset"]["estimate"]]
    assert content["offset"]["output"][0] == pytest.approx(5.0, abs=0.1)


def test_a_noise_model_is_printed_written_and_read_back(ctid, tmp_path):
    values = rows()
    values[:, 2] += lfilter([0.1], [1.0, -0.8], np.random.default_rng(1).standard_normal(len(values)))
    file = write(tmp_path / "noisy.csv", values)
    noise = ("--noise", "arma:1,1", "--predict", 5, "--validate", file)
    arguments = ("fit", file, "--poles", 2, "--delay", "0:3", *noise, "--out", tmp_path)
    content = json.loads(ctid(*arguments, "--json").stdout)
    check_model(content["model"], 0.1)
    noise = content["noise_model"]
    assert noise["denominator"][1] == pytest.approx(-0.8, abs=4 * noise["covariance"][0][0] ** 0.5)
    assert noise["prediction_fits"]["1"] > noise["prediction_fits"]["5"] > content["fit_percent"]
    # On the record of the fit, validation gives equal values.
    assert content["validation"]["prediction_fits"] == pytest.approx(noise["prediction_fits"], rel=1e-6)
    again, record = load_fit(tmp_path / "fit.json"), Record.from_arrays(*values.T)
    assert again.fit.prediction_fit(5) == pytest.approx(noise["prediction_fits"]["5"], rel=1e-9)
    assert np.isfinite(again.predict(record, 5)).all()


@pytest.mark.slow
def test_several_files_and_a_validation_record(ctid, record, tmp_path):
    second = write(tmp_path / "second.csv", rows(seed=1))
    third = write(tmp_path / "third.csv", rows(seed=2))
    arguments = ("--poles", 2, "--delay", "0:3", "--validate", third, "--json", "--out", tmp_path)
    content = json.loads(ctid("fit", record, second, *arguments).stdout)
    check_model(content["model"], 0.02)
    assert [item["file"] for item in content["records"]] == [str(record), str(second)]
    assert content["validation"]["file"] == str(third)
    assert content["validation"]["r2"] > 0.99


@pytest.mark.parametrize(("options", "noted"), [("--poles 9 --zeros 8", True), ("--poles 6 --zeros 4", False)])
def test_many_coefficients_of_few_samples_are_noted_before_the_search(ctid, record, monkeypatch, options, noted):
    def identify(*arguments, **options):
        raise DataError("the search begins")

    monkeypatch.setattr("ctid_cli.identification.identify.identify", identify)
    first, *others = ctid(f"fit {options} --delay 0", record, code=2).stderr.splitlines()
    assert ("18 coefficients are asked for, and 500 samples seldom determine them" in first) == noted
    assert [first, *others][-1] == "ctid: the search begins"


def test_a_range_of_degrees_is_chosen_from(ctid, record, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = json.loads(ctid("fit", "record.csv", "--poles", "1:2", "--zeros", "0", "--json").stdout)
    assert any(text.startswith("Structure: ") for text in found["choices"])
    refused = ctid("fit", "record.csv", "--poles", "1:2", "--fix", "a1=1", code=2)
    assert "--poles must be one number with --fix, not a range" in refused.stderr
