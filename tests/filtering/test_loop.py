"""The closed loop against python-control, step-by-step simulation and known numbers."""

import control
import numpy as np
import pytest
from scipy.signal import lfilter

from ctid_cli.errors import DataError
from ctid_cli.filtering.loop import loop_radius, simulate_continuous_loop, simulate_loop
from ctid_cli.filtering.simulate import simulate, simulate_additive
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.controller import ContinuousController, DiscreteController
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from tests.filtering.plants import parts, with_delay

INTERVAL = 0.05
TWO_MODES = AdditiveModel([Submodel([3.0], [0.25, 0.25, 1.0]), Submodel([1.0], [0.025, 0.01, 1.0])])
PID = DiscreteController([0.02329, -0.02058, 0.00454], [1.0, -1.0, 0.0])
# A rigid body with a flexible mode, a filtered derivative, and a plant with a direct feedthrough.
RIGID = AdditiveModel([Submodel([0.5], [1.0], 2), Submodel([0.1], [0.01, 0.002, 1.0])])
LEAD = DiscreteController([2.0, -1.9], [1.0, -0.4])
BIPROPER = AdditiveModel([Submodel([0.4, 1.0], [0.5, 1.0]), Submodel([1.0], [0.025, 0.05, 1.0])])
LOOPS = {
    "two modes": (TWO_MODES, PID),
    "rigid body": (RIGID, LEAD),
    "biproper": (BIPROPER, DiscreteController([0.3, 0.1], [1.0, -0.2])),
    "biproper, strictly proper controller": (BIPROPER, DiscreteController([0.1], [1.0, -0.9])),
    "gain and gain": (AdditiveModel([Submodel([2.0], [1.0])]), DiscreteController([0.4], [1.0])),
    "fraction": (TransferFunction([2.0], [1.0, 3.0, 0.0]), DiscreteController([0.5], [1.0])),
}


def plant_of_python_control(model, interval):
    return sum(
        control.sample_system(control.tf2ss(control.tf(g.numerator, g.denominator)), interval, "zoh")
        for g in parts(model)
    )


def signals(count=400, seed=0):
    return np.random.default_rng(seed).standard_normal((2, count)) * np.array([[1.0], [0.1]])


def test_known_numbers():
    rng = np.random.default_rng(5)
    r, v = rng.standard_normal(3000), 0.1 * rng.standard_normal(3000)
    u, x = simulate_loop(TWO_MODES, PID, r, v, INTERVAL)
    np.testing.assert_allclose(u[:4], [-0.0185404823, -0.0333535724, -0.0183051125, -0.0047443714], atol=5e-11)
    assert np.sum(u**2) == pytest.approx(4.521475672, rel=1e-9)
    assert np.sum(x**2) == pytest.approx(81.84333235, rel=1e-9)


@pytest.mark.parametrize("enters", ["controller", "input"])
@pytest.mark.parametrize("steps", [0, 1, 4])
@pytest.mark.parametrize("name", LOOPS)
def test_loop_with_whole_delays_is_that_of_python_control(name, steps, enters):
    model, controller = LOOPS[name]
    r, v = signals()
    plant = plant_of_python_control(model, INTERVAL)
    for _ in range(steps):
        plant = control.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], INTERVAL) * plant
    law = control.tf2ss(control.tf(controller.numerator, controller.denominator, INTERVAL))
    one = control.ss([], [], [], [[1.0]], INTERVAL)
    # Signals of the loop as transfer functions of (r, v): u = F r - K v, x = P u.
    from_noise = -control.feedback(law, plant)
    from_reference = control.feedback(law, plant) if enters == "controller" else control.feedback(one, plant * law)
    t = INTERVAL * np.arange(r.size)
    expected_u = (
        control.forced_response(from_reference, t, r).outputs + control.forced_response(from_noise, t, v).outputs
    )
    expected_x = control.forced_response(plant, t, expected_u).outputs
    delayed = with_delay(model, steps * INTERVAL)
    u, x = simulate_loop(delayed, controller, r, v, INTERVAL, enters)
    assert np.abs(u - expected_u).max() <= 1e-10 * np.abs(expected_u).max()
    assert np.abs(x - expected_x).max() <= 1e-10 * np.abs(expected_x).max()
    radius = np.abs(from_noise.poles()).max(initial=0.0)
    assert loop_radius(delayed, controller, INTERVAL) == pytest.approx(radius, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("delay", [0.0, 0.1, 0.123])
@pytest.mark.parametrize("enters", ["controller", "input"])
@pytest.mark.parametrize("name", LOOPS)
def test_every_signal_satisfies_its_equation(name, enters, delay):
    model, controller = LOOPS[name]
    model = with_delay(model, delay)
    r, v = signals()
    u, x = simulate_loop(model, controller, r, v, INTERVAL, enters)
    t = INTERVAL * np.arange(r.size)
    simulator = simulate_additive if isinstance(model, AdditiveModel) else simulate
    np.testing.assert_allclose(x, simulator(model, HeldSignal(t, u), t), atol=1e-10 * np.abs(x).max())
    before = float(enters == "controller")
    b = np.pad(controller.numerator, (controller.denominator.size - controller.numerator.size, 0))
    expected = lfilter(b, controller.denominator, before * r - x - v) + (1.0 - before) * r
    np.testing.assert_allclose(u, expected, atol=1e-10 * np.abs(u).max())


def test_what_cannot_be_simulated_is_refused():
    r, v = signals(3000)
    five = DiscreteController(5000 * PID.numerator, PID.denominator)
    with pytest.raises(DataError, match=r"not finite; .* stability: its largest pole .* \d\.\d"):
        simulate_loop(TWO_MODES, five, r, v, INTERVAL)
    with pytest.raises(DataError, match="not finite"):
        simulate_loop(TWO_MODES, PID, np.append(r[:10], np.nan), np.zeros(11), INTERVAL)
    with pytest.raises(DataError, match=r"equal length; got shapes \(3000,\) and \(2999,\)"):
        simulate_loop(TWO_MODES, PID, r, v[1:], INTERVAL)
    with pytest.raises(DataError, match="equal length"):
        simulate_loop(TWO_MODES, PID, 1.0, 0.0, INTERVAL)
    with pytest.raises(ValueError, match="enters must be 'controller' or 'input', not 'output'"):
        simulate_loop(TWO_MODES, PID, r, v, INTERVAL, "output")
    with pytest.raises(ValueError, match="sampling interval must be a positive number"):
        simulate_loop(TWO_MODES, PID, r, v, 0.0)


@pytest.mark.parametrize("gain", [-1.25, -1.25 * (1 + 1e-14)])
def test_an_algebraic_loop_without_solution_is_refused(gain):
    # Direct loop gains of 0.8 and -1.25; a delay removes the algebraic loop.
    opposite = DiscreteController([gain], [1.0])
    late = AdditiveModel(BIPROPER.submodels, INTERVAL)
    for function in (
        lambda model: simulate_loop(model, opposite, [1.0], 0.0, INTERVAL),
        lambda model: loop_radius(model, opposite, INTERVAL),
    ):
        with pytest.raises(DataError, match="the loop has no solution"):
            function(BIPROPER)
        function(late)


@pytest.mark.parametrize("enters", ["controller", "input"])
def test_a_gain_in_continuous_time_makes_its_input_of_reference_output_and_noise(enters):
    t, (r, v) = np.cumsum(np.random.default_rng(1).uniform(0.05, 0.2, 300)), signals(300)
    u, x = simulate_continuous_loop(TWO_MODES, ContinuousController([0.1], [1.0]), HeldSignal(t, r), v, enters)
    made = 0.1 * (r - x - v) if enters == "controller" else r - 0.1 * (x + v)
    np.testing.assert_allclose(u, made, atol=1e-10)


def test_a_fast_discrete_controller_nears_one_in_continuous_time():
    slow = ContinuousController([0.04, 0.02], [1.0, 0.0])
    radius = loop_radius(TWO_MODES, slow, INTERVAL)
    differences = []
    for finer in (50, 100):
        h = INTERVAL / finer
        r, v = (np.repeat(signal, finer) for signal in signals(100))
        exact = simulate_loop(TWO_MODES, slow, r, v, h).x
        sampled = DiscreteController([0.04, 0.02 * h - 0.04], [1.0, -1.0])
        differences.append(np.abs(simulate_loop(TWO_MODES, sampled, r, v, h).x - exact).max() / np.abs(exact).max())
        assert loop_radius(TWO_MODES, sampled, h) ** finer == pytest.approx(radius, rel=1e-3)
    assert differences[1] < 0.6 * differences[0] < 0.01


@pytest.mark.parametrize(
    ("model", "message"),
    [(TransferFunction([1.0], [1.0, 1.0], 0.1), "no finite state"), (TransferFunction([1.0], [1.0]), "no solution")],
)
def test_a_loop_in_continuous_time_that_is_refused(model, message):
    with pytest.raises(DataError, match=message):
        simulate_loop(model, ContinuousController([-1.0], [1.0]), [1.0, 1.0], 0.0, 0.1)
