"""Data sets of sums of submodels, in open and closed loop: equations satisfied by their records."""

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.estimators.loop_output_error import LoopOutputError
from ctid_cli.filtering.loop import simulate_loop
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.controller import DiscreteController
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.running.plan import build_plan
from ctid_cli.signals.excitation import Gaussian
from ctid_cli.signals.files import file_sha256
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.noise import ArmaNoise, WhiteNoise, stream
from ctid_cli.signals.sampling import RegularSampling, UniformIntervals
from ctid_cli.simulation.dataset import LoopOptions, MeasuredSource, SimulatedSource
from ctid_cli.specification.load import load_spec

MODES = AdditiveModel([Submodel([3.0], [0.25, 0.25, 1.0]), Submodel([1.0], [0.025, 0.01, 1.0])])
SYSTEMS = {
    "modes": MODES,
    "delayed modes": AdditiveModel(MODES.submodels, 0.12),
    "rigid body and mode": AdditiveModel([Submodel([0.05], [1.0], 2), MODES.submodels[0]]),
    "fraction": TransferFunction([2.0], [0.25, 0.7, 1.0], 0.1),
}
PID = DiscreteController.from_pid(0.0115, 0.00725, 0.00454)
#: Controller that stabilises all of the systems.
LEAD = DiscreteController([0.5, -0.48], [1.0, -0.8])
RECORD = RegularSampling(0.05, 400)

UNSTABLE = """
experiment: unstable
system: {numerator: [4], denominator: [1, 0, -1]}
loop:
  controller: {numerator: [11, -10], denominator: [1, 0]}
  reference: {kind: gaussian, standard_deviation: 1.0}
sampling: {kind: regular, interval: 0.05, samples: 2000}
noise: {kind: white, variance: 0.01}
estimators:
  loop: {kind: loop_output_error, poles: 2, zeros: 0, delay_bounds: [0, 0]}
monte_carlo: {runs: 1, seed: 1}
"""


def source(system=MODES, controller=PID, enters="controller", noise=WhiteNoise(variance=0.01), sampling=RECORD, **more):  # noqa: B008
    loop = LoopOptions(controller, more.pop("reference", Gaussian()), enters)
    return SimulatedSource(system, None, sampling, noise, 5, loop=loop, **more)


@pytest.mark.parametrize("enters", ["controller", "input"])
@pytest.mark.parametrize("name", SYSTEMS)
def test_a_data_set_is_the_simulated_loop_of_its_streams(name, enters):
    system, noise = SYSTEMS[name], ArmaNoise((1.0, 0.5), (1.0, -0.85), innovation_variance=0.02)
    data = source(system, LEAD, enters, noise).dataset(3)
    record = data.record
    assert data.true_model is system
    reference = stream(5, "input", 3).standard_normal(400)
    disturbance = noise.generate(np.zeros(400), stream(5, "noise", 3))
    u, x = simulate_loop(system, LEAD, reference, disturbance, 0.05, enters)
    np.testing.assert_array_equal(record.loop.reference, reference)
    np.testing.assert_allclose(record.input.values, u, atol=1e-12)
    np.testing.assert_allclose(record.noise_free, x, atol=1e-12)
    np.testing.assert_allclose(record.y - record.noise_free, disturbance, atol=1e-14)
    assert isinstance(record.input, HeldSignal)
    assert record.input_on_grid
    assert record.input.hold == "zoh"
    assert (record.loop.controller, record.loop.enters) == (LEAD, enters)


def test_an_irregular_loop_is_refused():
    with pytest.raises(DataError, match="a closed loop needs a regular clock"):
        source(sampling=UniformIntervals(0.04, 0.06, 50)).dataset(0)


def test_a_measured_loop(tmp_path):
    simulated = source().dataset(0).record
    file = tmp_path / "record.csv"
    columns = (simulated.t, simulated.input.values, simulated.y, simulated.loop.reference)
    file.write_text("t,u,y,r\n" + "\n".join(",".join(map(repr, row)) for row in np.array(columns).T.tolist()))
    options = {"file": str(file), "sha256": file_sha256(str(file)), "reference": "r"}
    record = MeasuredSource(**options, loop=LoopOptions(PID, enters="controller")).dataset(0).record
    np.testing.assert_array_equal(record.loop.reference, simulated.loop.reference)
    np.testing.assert_array_equal(record.input.values, simulated.input.values)
    assert MeasuredSource(**options).dataset(0).record.loop is None
    part = MeasuredSource(**options, loop=LoopOptions(PID), estimation_samples=100, offset="remove").dataset(0)
    shift = simulated.loop.reference[:100].mean()
    np.testing.assert_allclose(part.record.loop.reference, simulated.loop.reference[:100] - shift, atol=1e-15)
    assert part.validation.loop is None


CONTINUOUS = UNSTABLE.replace(
    "{numerator: [11, -10], denominator: [1, 0]}", "{continuous: {numerator: [1.5, 3], denominator: [0.05, 1]}}"
).replace("kind: regular, interval: 0.05", "kind: uniform_intervals, low: 0.02, high: 0.08")


@pytest.mark.parametrize("text", [UNSTABLE, CONTINUOUS], ids=["discrete", "continuous, irregular clock"])
def test_an_unstable_plant_in_a_stable_loop_is_simulated_and_found(tmp_path, text):
    file = tmp_path / "unstable.yaml"
    file.write_text(text, encoding="utf-8")
    (cell,) = build_plan(load_spec(file)).data_cells
    fit = LoopOutputError(2, 0).fit(cell.dataset(0).record)
    error = (fit.theta - [0.0, -1.0, 4.0]) / np.sqrt(np.diag(fit.covariance))
    assert fit.status.succeeded
    assert np.abs(error).max() < 4.0
