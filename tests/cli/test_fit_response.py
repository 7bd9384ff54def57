"""``ctid fit`` on a frequency response."""

import json

import numpy as np
import pandas as pd
import pytest

from tests.cli.records import write

RESPONSE = np.geomspace(0.1, 20.0, 60)


def response_file(folder):
    """Write values of 2 / (p + 1) exp(-p/2) with standard errors."""
    rng = np.random.default_rng(0)
    values = 2.0 * np.exp(-0.5j * RESPONSE) / (1j * RESPONSE + 1.0)
    values = values + 0.02 * (rng.standard_normal(60) + 1j * rng.standard_normal(60)) / np.sqrt(2.0)
    columns = RESPONSE, values.real, values.imag, np.full(60, 0.02)
    header = "frequency [rad/s],real [mm/V],imaginary [mm/V],standard_error [mm/V]"
    return write(folder / "frf.csv", columns, header)


def test_a_frequency_response_is_fitted_drawn_and_reported(ctid, tmp_path, snapshot, monkeypatch):
    response_file(tmp_path)
    monkeypatch.chdir(tmp_path)
    done = ctid("fit frf.csv --poles 1 --delay 0:2 --report --csv tables --export matlab --out new")
    assert done.stdout == snapshot
    content = json.loads((tmp_path / "new" / "fit.json").read_text())
    assert content["frequency_response"]["lines"] == 60
    assert content["units"] == {"time": "s", "input": "V", "output": "mm"}
    lines = pd.read_csv(tmp_path / "tables" / "lines.csv")
    assert len(lines) == 60
    ctid("report new/fit.json --file again.html")
    pages = [(tmp_path / name).read_text() for name in ("new/fit.html", "again.html")]
    assert pages[0] == pages[1]


@pytest.mark.slow
def test_a_sum_of_one_submodel_is_the_transfer_function(ctid, tmp_path):
    file, found = response_file(tmp_path), []
    for options in ("--poles 1", "--model additive --terms 1/0 --report"):
        out = tmp_path / str(len(found))
        found.append(json.loads(ctid(f"fit {options} --delay 0:2 --json --out", out, file).stdout))
    fraction, one_submodel = found
    assert one_submodel["fit_percent"] == pytest.approx(fraction["fit_percent"], rel=1e-9)
    assert one_submodel["model"]["submodels"][0]["numerator"] == pytest.approx([2.0], rel=0.01)
    again = ctid("report --file", tmp_path / "again.html", tmp_path / "1" / "fit.json")
    assert (tmp_path / "again.html").read_text() == (tmp_path / "1" / "fit.html").read_text(), again.stderr


def test_a_delay_that_is_missing_is_named(ctid, tmp_path):
    response_file(tmp_path)
    found = ctid("fit --poles 1 --json --out", tmp_path / "new", tmp_path / "frf.csv").stdout
    assert json.loads(found)["warnings"][0].startswith("The delay is taken as 0 s: with --delay 0:16 the fit is 9")


def test_the_structure_is_chosen_and_its_candidates_are_shown(ctid, tmp_path):
    file = response_file(tmp_path)
    found = json.loads(ctid("fit --json --out", tmp_path / "new", file).stdout)
    assert found["choices"][0].startswith("Structure: 1 pole and no zero, with a delay; the criterion is ")
    assert found["parameters"][-1]["estimate"] == pytest.approx(0.5, abs=0.02)
    shown = ctid("order --out", tmp_path / "order", file).stdout
    assert "Chosen: 1 pole and no zero, with a delay." in shown
    content = json.loads((tmp_path / "order" / "order.json").read_text())
    assert content["recommended"] == {"poles": 1, "zeros": 0, "integrators": 0}
    assert [each["taken"] for each in content["orders"]].count(True) == 1
    assert (tmp_path / "order" / "order.svg").read_bytes().startswith(b"<?xml")
    again = json.loads(ctid(" ".join(["fit", *content["command"], "--json --out"]), tmp_path / "again", file).stdout)
    estimates = ([each["estimate"] for each in one["parameters"]] for one in (found, again))
    assert next(estimates) == pytest.approx(next(estimates), rel=1e-6)
