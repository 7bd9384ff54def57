"""Fit on fresh data: with other random numbers than the estimation data, and without noise."""

import numpy as np
import pytest

from ctid_cli import Gaussian, RegularSampling, SpecError, Srivc, TransferFunction, WhiteNoise, fit_percent, simulate
from ctid_cli.running.plan import build_plan
from ctid_cli.simulation.dataset import FRESH, SimulatedSource
from ctid_cli.specification.load import load_spec

SYSTEM = TransferFunction([2], [0.5, 1])
SOURCE = SimulatedSource(SYSTEM, Gaussian(), RegularSampling(0.1, samples=400), WhiteNoise(snr_db=0.0), 3, fresh=True)


def test_fresh_fit_is_computed_on_independent_data():
    data, other = SOURCE.dataset(2), SOURCE.dataset(FRESH + 2).record
    fit = Srivc(1, 0).fit(data.record)
    found = data.result_of(fit, None, None)["fresh_fit_percent"]
    assert found == fit_percent(other.noise_free, simulate(fit.model, other.input, other.t))
    # Noise as large as the output limits the fit on the record, and not on fresh data.
    assert fit.fit_percent < 40 < 80 < found < 100
    assert abs(np.corrcoef(other.y, data.record.y)[0, 1]) < 0.2


def test_fresh_fit_is_computed_only_as_a_measure(tmp_path):
    file = tmp_path / "fresh.yaml"
    file.write_text(
        "experiment: fresh\n"
        "system: {numerator: [2], denominator: [0.5, 1]}\n"
        "excitation: {kind: gaussian, standard_deviation: 1.0}\n"
        "sampling: {kind: regular, interval: 0.1, samples: 400}\n"
        "estimators: {srivc: {kind: srivc, poles: 1, zeros: 0}}\n"
        "monte_carlo: {runs: 2, seed: 1}\n"
        "measures: [rmse, fresh_fit]\n",
        encoding="utf-8",
    )
    asked, plain = build_plan(load_spec(file)), build_plan(load_spec(file, ["measures=[rmse]"]))
    assert (asked.data_cells[0].source.fresh, plain.data_cells[0].source.fresh) == (True, False)
    # Stored measures are part of the identity of a result; measures that are only shown are not.
    assert asked.data_cells[0].hash != plain.data_cells[0].hash
    shown = build_plan(load_spec(file, ["measures=[bias]"]))
    assert (shown.data_cells[0].hash, shown.spec_hash) == (plain.data_cells[0].hash, plain.spec_hash)
    fit = Srivc(1, 0).fit(plain.data_cells[0].dataset(0).record)
    assert plain.data_cells[0].dataset(0).result_of(fit, None, None)["fresh_fit_percent"] is None
    file.write_text(file.read_text().replace("fresh_fit", "fresh"))
    with pytest.raises(SpecError, match=r"fresh.yaml:7:18: .*no measure 'fresh'; did you mean 'fresh_fit'"):
        load_spec(file)
