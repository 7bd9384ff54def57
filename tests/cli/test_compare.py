"""Use of fitted models: ``ctid compare``, ``ctid fit --csv``, ``ctid export --as``, and their Python functions."""

import json
import runpy

import numpy as np
import pandas as pd
import pytest

from ctid_cli import load_fit


def test_models_are_compared_on_the_same_samples(ctid, home, tmp_path):
    command = "compare p1/fit.json p2/fit.json --on other.csv --json --out"
    worse, best = json.loads(ctid(command, tmp_path).stdout)["models"]
    fit = "fit record.csv --poles 2 --delay 0:3 --offset estimate --validate other.csv --json --out"
    validation = json.loads(ctid(fit, tmp_path).stdout)["validation"]
    assert best["fit_percent"] == pytest.approx(validation["fit_percent"], rel=1e-12)
    assert (best["name"], best["white"], best["uncorrelated"], worse["uncorrelated"]) == ("p2", True, True, False)
    measured, one, two = pd.read_csv(tmp_path / "comparison.csv").to_numpy().T[1:]
    assert np.std(measured - two) < np.std(measured - one)


def test_the_files_of_csv_are_what_the_model_does(ctid, home, tmp_path):
    ctid("fit record.csv --poles 2 --delay 0:3 --csv", tmp_path / "csv", "--out", tmp_path)
    fitted = load_fit(tmp_path / "fit.json")
    frames = {path.stem: pd.read_csv(path) for path in (tmp_path / "csv").iterdir()}
    assert sorted(frames) == ["bode", "residuals", "simulation", "step"]
    t, *columns = frames["step"].to_numpy().T
    band = fitted.step_response(t)
    np.testing.assert_allclose(columns, [band.value, band.standard_error, band.lower, band.upper])
    w = frames["bode"].iloc[:, 0].to_numpy()
    np.testing.assert_allclose(frames["bode"]["gain [mm/V]"], fitted.frequency_response(w).gain)
    residuals = frames["residuals"].to_numpy().T[1]
    np.testing.assert_allclose(residuals, fitted.fit.residuals[0], atol=1e-9)
    _, _, measured, simulated = frames["simulation"].to_numpy().T
    np.testing.assert_allclose(measured - simulated, residuals, atol=1e-12)


@pytest.mark.parametrize("options", ["--as control", "--as control --pade 5", "--as scipy"])
def test_exported_code_builds_the_model(ctid, home, tmp_path, options):
    model = load_fit(home / "p2" / "fit.json").fit.model
    ctid(f"export p2/fit.json {options} --file", tmp_path / "model.py")
    built = runpy.run_path(str(tmp_path / "model.py"))
    system = built["G"]
    if "pade" in options:
        response = np.ravel(system(1j * np.array([1.0])))
        np.testing.assert_allclose(response, model.frequency_response([1.0]), rtol=1e-6)
        return
    b, a = (system.num[0][0], system.den[0][0]) if "control" in options else (system.num, system.den)
    np.testing.assert_allclose(np.ravel(b), model.numerator, rtol=1e-12)
    np.testing.assert_allclose(np.ravel(a), model.denominator, rtol=1e-12)
    assert built["delay"] == model.delay
