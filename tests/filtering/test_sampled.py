"""The sampled equivalent of a model against the exact simulation."""

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.filtering.simulate import sampled_model, simulate, simulate_additive
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.factoring import unfactored
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from tests.filtering.plants import FOUR_MODES, parts, with_delay

INTERVAL = 0.05
FLEXIBLE = Submodel([1.0], [0.025, 0.01, 1.0])
MODELS = {
    "four modes": FOUR_MODES,
    "integrator with a lag": AdditiveModel([Submodel([1.0], [0.5, 1.0], 1), FLEXIBLE]),
    "two integrators": AdditiveModel([Submodel([2.0], [1.0], 2), FLEXIBLE]),
    "biproper": AdditiveModel([Submodel([0.3, 2.0, 1.0], [0.5, 1.0, 1.0]), FLEXIBLE]),
    "pure gain": AdditiveModel([FLEXIBLE, Submodel([0.3], [1.0])]),
    "only a gain": AdditiveModel([Submodel([0.3], [1.0])]),
    "repeated poles": TransferFunction([1.0, 2.0], [1.0, 6.0, 12.0, 8.0]),
    "unstable": TransferFunction([1.0], [1.0, -0.2, 1.0]),
}


def response(matrices, u):
    A, B, C, D = matrices
    state, output = np.zeros(len(A)), []
    for value in u:
        output.append(C[0] @ state + D[0, 0] * value)
        state = A @ state + B[:, 0] * value
    return np.array(output)


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.35, 0.013, 0.05 - 1e-4, 0.05 + 1e-4, 0.222])
@pytest.mark.parametrize("name", MODELS)
def test_response_is_the_exact_one_whatever_the_delay(name, delay):
    u = np.random.default_rng(1).standard_normal(120)
    t = INTERVAL * np.arange(120)
    model = with_delay(MODELS[name], delay)
    simulator = simulate_additive if isinstance(model, AdditiveModel) else simulate
    # One instant off the grid makes the simulator step from break to break.
    expected = simulator(model, HeldSignal(t, u), np.append(t, t[-1] + 0.01))[:-1]
    matrices = sampled_model(model, INTERVAL).state_space()
    np.testing.assert_allclose(response(matrices, u), expected, atol=1e-12 * np.abs(expected).max())
    assert len(matrices[0]) == sum(g.order for g in parts(model)) + int(np.ceil(delay / INTERVAL - 1e-9))


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("name", ["four modes", "integrator with a lag", "two integrators", "biproper"])
def test_sum_of_submodels_and_single_fraction_simulate_alike(name, hold, regular):
    rng = np.random.default_rng(3)
    t = INTERVAL * np.arange(600.0) if regular else np.cumsum(rng.uniform(0.02, 0.08, 600))
    held = HeldSignal(t, rng.standard_normal(600), hold)
    for delay in (0.0, 0.07):
        model = with_delay(MODELS[name], delay)
        expected = simulate(unfactored(model), held, t)
        result = simulate_additive(model, held, t)
        assert np.abs(result - expected).max() <= 1e-11 * np.abs(expected).max()


def test_what_has_no_sampled_equivalent_is_refused():
    with pytest.raises(DataError, match="more zeros than poles"):
        sampled_model(TransferFunction([1.0, 0.0, 0.0], [1.0, 1.0]), 0.1).state_space()
    for interval in (0.0, np.nan):
        with pytest.raises(ValueError, match="sampling interval must be a positive number"):
            sampled_model(FOUR_MODES, interval).state_space()
    with pytest.raises(DataError, match="increase strictly"):
        simulate_additive(FOUR_MODES, HeldSignal([0.0], [1.0]), [1.0, 1.0])
