"""Accuracy bounds against known numbers, integrals over the unit circle, and finite differences."""

import numpy as np
import pytest
from scipy.signal import cont2discrete, tf2ss

from ctid_cli.errors import DataError
from ctid_cli.estimators.loop_output_error import LoopOutputError
from ctid_cli.filtering.loop import simulate_loop
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.bounds import (
    WHITE,
    EstimatedForm,
    ParameterAccuracy,
    accuracy_of_records,
    cramer_rao_bound,
    limiting_accuracy,
    output_variance,
    require_uncorrelated_input,
)
from ctid_cli.inference.sensitivities import sensitivities
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.controller import DiscreteController
from ctid_cli.models.factoring import unfactored, unfactored_jacobian
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.excitation import Prbs
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.noise import ArmaNoise, stream
from ctid_cli.signals.record import Loop, Record

INTERVAL = 0.05


def mode(pole, gain):
    return Submodel([gain], [1 / abs(pole) ** 2, -2 * pole.real / abs(pole) ** 2, 1.0])


# The two simulation examples of Gonzalez, Classens, Rojas, Welsh and Oomen, sections 6.1 and 6.2.
POLES = (-0.25 + 1.39j, -0.15 + 3.16j, -0.17 + 5.77j, -0.5 + 9.99j)
FOUR_MODES = AdditiveModel([mode(pole, gain) for pole, gain in zip(POLES, (3.0, 0.4, 0.2, 0.05), strict=True)])
TWO_MODES = AdditiveModel([Submodel([3.0], [0.25, 0.25, 1.0]), Submodel([1.0], [0.025, 0.01, 1.0])])
PID = DiscreteController.from_pid(0.0115, 0.00725, 0.00454)
COLOURED = ([1.0, 0.5], [1.0, -0.85])
OPEN = {"standard_deviation": 1.0, "innovation_variance": 0.02, "noise_filter": COLOURED, "samples": 1}
CLOSED = {"standard_deviation": 1.0, "innovation_variance": 0.01, "samples": 1}


def variances(accuracy, letter):
    """Return N times the variances of the parameters with a name ending, by submodel."""
    return [v for name, v in zip(accuracy.names, np.diag(accuracy.covariance), strict=True) if name.endswith(letter)]


def largest_relative_error(covariance, expected):
    deviations = np.sqrt(np.diag(expected))
    return np.abs((covariance - expected) / np.outer(deviations, deviations)).max()


def test_known_variances_of_four_modes_in_open_loop():
    additive = limiting_accuracy(FOUR_MODES, INTERVAL, **OPEN)
    np.testing.assert_allclose(variances(additive, "b0"), [35.60, 2.700, 0.4405, 0.2240], rtol=2e-4)
    np.testing.assert_allclose(variances(additive, "a1"), [0.48853, 0.029072, 0.0021642, 0.014862], rtol=5e-5)
    np.testing.assert_allclose(variances(additive, "a2"), [0.11691, 1.3780e-3, 3.0539e-5, 6.0108e-5], rtol=5e-5)
    unconstrained = limiting_accuracy(unfactored(FOUR_MODES), INTERVAL, **OPEN).factored()
    np.testing.assert_allclose(variances(unconstrained, "b0"), [36.75, 3.645, 0.5341, 0.2322], rtol=2e-4)
    np.testing.assert_allclose(variances(unconstrained, "a1"), [0.49374, 0.033565, 0.0023801, 0.014823], rtol=5e-5)
    np.testing.assert_allclose(variances(unconstrained, "a2"), [0.23860, 2.9082e-3, 6.4791e-5, 1.7786e-4], rtol=5e-5)
    # The formula for white noise of the same total variance gives other values.
    white = limiting_accuracy(FOUR_MODES, INTERVAL, standard_deviation=1.0, innovation_variance=0.151351, samples=1)
    assert variances(additive, "b0")[0] / variances(white, "b0")[0] == pytest.approx(11, rel=0.05)


def test_known_signal_to_noise_ratio():
    noise = 0.02 * (1 + 1.35**2 / (1 - 0.85**2))
    output = output_variance(FOUR_MODES, INTERVAL, 1.0)
    assert output == pytest.approx(1.16984, rel=1e-5)
    assert 10 * np.log10(output / noise) == pytest.approx(8.881, abs=5e-4)
    assert output_variance(FOUR_MODES, INTERVAL, 3.0) == pytest.approx(9 * output)
    assert output_variance(unfactored(FOUR_MODES), INTERVAL, 1.0) == pytest.approx(output)


def test_known_variances_of_two_modes_in_closed_loop():
    additive = limiting_accuracy(TWO_MODES, INTERVAL, PID, **CLOSED)
    np.testing.assert_allclose(variances(additive, "a1"), [0.20003, 1.28798e-3], rtol=3e-5)
    np.testing.assert_allclose(variances(additive, "a2"), [0.035010, 1.52180e-5], rtol=3e-5)
    np.testing.assert_allclose(variances(additive, "b0"), [14.287, 6.7705], rtol=4e-5)
    unconstrained = limiting_accuracy(unfactored(TWO_MODES), INTERVAL, PID, **CLOSED)
    factors = unconstrained.factored()
    np.testing.assert_allclose(variances(factors, "a1"), [0.22218, 1.37704e-3], rtol=3e-5)
    np.testing.assert_allclose(variances(factors, "a2"), [0.090118, 2.49911e-5], rtol=3e-5)
    np.testing.assert_allclose(variances(factors, "b0"), [14.683, 8.0467], rtol=4e-5)
    # The input is S (r - v), and v has the variance 0.01: for the input itself, the noise is excitation too.
    direct = limiting_accuracy(unfactored(TWO_MODES), INTERVAL, PID, instruments="open_loop", **CLOSED)
    np.testing.assert_allclose(1.01 * direct.covariance, unconstrained.covariance, rtol=1e-6)


def sampled_response(numerator, denominator, z):
    """Return the zero-order-hold equivalent of a filter on the unit circle, from SciPy."""
    A, B, C, D, _ = cont2discrete(tf2ss(numerator, denominator), INTERVAL)
    states = np.linalg.solve(z[:, None, None] * np.eye(A.shape[0]) - A, np.broadcast_to(B, (z.size, *B.shape)))
    return (C @ states + D)[:, 0, 0]


def spectra(model, z):
    """Return the responses of the input sensitivities of an additive model, and of the model, on the unit circle."""
    rows, total = [], 0.0
    for submodel in model.submodels:
        b, a, integrators = submodel.numerator, submodel.denominator, np.zeros(submodel.integrators)
        whole, square = np.append(a, integrators), np.append(np.polymul(a, a), integrators)
        rows += [-sampled_response(np.append(b, np.zeros(k)), square, z) for k in range(1, a.size)]
        rows += [sampled_response(np.append(1.0, np.zeros(k)), whole, z) for k in range(b.size)]
        total = total + sampled_response(b, whole, z)
    return np.array(rows), total


def integral(rows, power):
    """Return the covariance from a spectrum, by the trapezoidal rule over the unit circle."""
    return np.real((rows * power) @ rows.conj().T) / rows.shape[1]


def sandwich(rows, power, noise_power):
    inverse = np.linalg.inv(integral(rows, power))
    return inverse @ integral(rows, power * noise_power) @ inverse


# Shifted by half a step from zero frequency, where integrators are infinite.
Z = np.exp(2j * np.pi * (np.arange(8192) + 0.5) / 8192)
H_POWER = np.abs((1 + 0.5 / Z) / (1 - 0.85 / Z)) ** 2


FAST = AdditiveModel([Submodel([0.5, 1.0], [0.04, 0.1, 1.0]), Submodel([0.7], [0.5, 1.0])], 0.13)
RIGID = AdditiveModel([Submodel([0.4], [0.3, 1.0], integrators=1), Submodel([0.1], [0.01, 0.1, 1.0])])
DOUBLE = AdditiveModel([Submodel([0.2, 0.4], [1.0], integrators=2), Submodel([0.1], [0.02, 0.1, 1.0])])
# As many zeros as poles: direct feedthrough, also in the loop.
DIRECT = AdditiveModel([Submodel([0.02, 0.3, 1.0], [0.04, 0.1, 1.0]), Submodel([0.7], [0.5, 1.0])])
DIRECT_RIGID = AdditiveModel([Submodel([0.1, 0.2, 0.4], [0.3, 1.0], integrators=1)])
PD = DiscreteController.from_pid(0.5, 0.0, 0.5)
FIRM = DiscreteController.from_pid(3.0, 0.0, 0.5)
STIFF = DiscreteController.from_pid(8.0, 0.0, 8.0)


@pytest.mark.parametrize("enters", ["controller", "input"])
@pytest.mark.parametrize(
    ("model", "controller"),
    [(TWO_MODES, PID), (RIGID, STIFF), (DOUBLE, STIFF), (DIRECT, PD), (DIRECT_RIGID, FIRM)],
    ids=["modes", "1 integrator", "2 integrators", "direct", "direct, 1 integrator"],
)
def test_closed_loop_is_an_integral_over_the_unit_circle(model, controller, enters):
    rows, G = spectra(model, Z)
    numerator, denominator = (np.polyval(part, Z) for part in (controller.numerator, controller.denominator))
    S = (numerator if enters == "controller" else denominator) / (denominator + G * numerator)
    power = 0.25 * np.abs(S) ** 2
    options = {"standard_deviation": 0.5, "innovation_variance": 0.01, "enters": enters, "samples": 1}
    accuracy = limiting_accuracy(model, INTERVAL, controller, **options)
    assert largest_relative_error(accuracy.covariance, sandwich(rows, power, 0.01)) < 1e-7
    coloured = limiting_accuracy(model, INTERVAL, controller, noise_filter=COLOURED, **options)
    assert largest_relative_error(coloured.covariance, sandwich(rows, power, 0.01 * H_POWER)) < 1e-7
    # If the reference enters at the input, the noise still passes the controller.
    noise = 0.01 * np.abs(numerator / (denominator + G * numerator)) ** 2
    direct = limiting_accuracy(model, INTERVAL, controller, instruments="open_loop", **options)
    assert largest_relative_error(direct.covariance, sandwich(rows, power + noise, 0.01)) < 1e-7


def test_a_delay_matters_in_open_loop_only_by_its_fraction_of_an_interval():
    options = {"standard_deviation": 2.0, "innovation_variance": 0.3, "noise_filter": COLOURED, "samples": 1}
    moved = [
        limiting_accuracy(AdditiveModel(FAST.submodels, delay), INTERVAL, **options).covariance
        for delay in (0.0, 0.13, 0.43)
    ]
    np.testing.assert_allclose(moved[2], moved[1], rtol=1e-9)
    assert largest_relative_error(moved[0], moved[1]) > 0.01


def test_a_reaction_at_once_of_the_model_is_solved_for():
    # y = b u + ..., biproper: u (1 + C(inf) b) = ...; a pure gain in a proportional loop has S = C/(1 + b C).
    gain = AdditiveModel([Submodel([2.0], [1.0])])
    accuracy = limiting_accuracy(gain, INTERVAL, DiscreteController([0.25], [1.0]), **CLOSED)
    assert accuracy.covariance.item() == pytest.approx(0.01 * (1.5 / 0.25) ** 2)
    with pytest.raises(DataError, match="direct feedthrough, so that the input is correlated with the noise"):
        require_uncorrelated_input(gain, INTERVAL, DiscreteController([0.25], [1.0]), WHITE)
    with pytest.raises(DataError, match="no solution"):
        limiting_accuracy(gain, INTERVAL, DiscreteController([-0.5], [1.0]), **CLOSED)


def test_refusals_say_why():
    with pytest.raises(DataError, match="no limit for long records"):
        limiting_accuracy(RIGID, INTERVAL, **OPEN)
    with pytest.raises(DataError, match=r"loop, is not stable.*magnitude 1"):
        limiting_accuracy(unfactored(RIGID), INTERVAL, STIFF, **CLOSED)
    with pytest.raises(DataError, match=r"loop, is not stable.*magnitude 1\."):
        limiting_accuracy(TWO_MODES, INTERVAL, DiscreteController(5 * PID.numerator, PID.denominator), **CLOSED)
    limiting_accuracy(TWO_MODES, INTERVAL, DiscreteController(2 * PID.numerator, PID.denominator), **CLOSED)
    with pytest.raises(DataError, match="too slow for the limit of long records"):
        limiting_accuracy(TransferFunction([1.0], [1.0, 1e-4]), INTERVAL, **OPEN)
    with pytest.raises(DataError, match=r"coloured, so that .* \(closed_loop instruments are not\)"):
        require_uncorrelated_input(TWO_MODES, INTERVAL, PID, COLOURED)
    silent = AdditiveModel([Submodel([0.0], [0.25, 0.25, 1.0])])
    cancelling = TransferFunction([1.0, 1.0], [1.0, 3.0, 2.0])
    for model in (silent, cancelling):
        with pytest.raises(DataError, match="some have no separate effect"):
            limiting_accuracy(model, INTERVAL, **OPEN)


MODEL = AdditiveModel([Submodel([0.3, 3.0], [0.25, 0.25, 1.0]), Submodel([0.5], [0.2, 1.0])], 0.4)


def spread(size):
    root = np.random.default_rng(2).standard_normal((size, size))
    return root @ root.T


@pytest.mark.parametrize("delay", [0, 1])
def test_factoring_undoes_the_sum(delay):
    # The covariance of the sum's coefficients, computed from that of the submodels, is converted back.
    jacobian = unfactored_jacobian(MODEL)
    jacobian = np.block([[jacobian, np.zeros((6, delay))], [np.zeros((delay, 6)), np.eye(delay)]])
    expected = spread(6 + delay)
    model = unfactored(MODEL)
    accuracy = ParameterAccuracy.of(model, jacobian @ expected @ jacobian.T, delay=bool(delay))
    back = accuracy.factored()
    assert back.names == MODEL.names + ("delay",) * delay
    np.testing.assert_allclose(back.values, [*MODEL.theta, *[0.4] * delay], rtol=1e-12)
    np.testing.assert_allclose(back.covariance, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(back.standard_errors, np.sqrt(np.diag(expected)), rtol=1e-9)
    assert back.factored() is back


CASE_1 = TransferFunction([2.0], [0.25, 0.7, 1.0], 8.0)
CASE_2 = TransferFunction([-6400.0, 1600.0], [1.0, 5.0, 408.0, 416.0, 1600.0], 8.0)


def record(model, clock_period, regular=True, n=4000, interval=0.05):
    rng = stream(1, "sampling", 0)
    t = interval * np.arange(n) if regular else np.cumsum(rng.uniform(0.2, 1.8, n)) * interval
    held = Prbs(stages=10, clock_period=clock_period).generate(t, stream(1, "input", 0))
    return Record(t, simulate(model, held, t), held)


@pytest.mark.parametrize("estimate_delay", [True, False])
def test_the_bound_counts_the_samples_that_are_used(estimate_delay):
    r = record(CASE_2, 0.1, regular=False, n=3000, interval=0.01)
    y = r.y.copy()
    y[1200:1300] = np.nan
    used = np.isfinite(y) & (r.t >= r.input.t[0] + 9.0)
    psi = sensitivities(CASE_2, r.input, r.t, estimate_delay=estimate_delay)[used]
    bound = cramer_rao_bound(CASE_2, Record(r.t, y, r.input), 0.3, start=9.0, estimate_delay=estimate_delay)
    assert largest_relative_error(bound, 0.09 * np.linalg.inv(psi.T @ psi)) < 1e-6


@pytest.mark.parametrize(
    ("clock", "expected"),
    [(1, [0.0267, 0.0308, 0.0693, 0.00192]), (4, [0.0295, 0.0353, 0.0781, 0.00238])],
)
def test_known_bounds_of_the_second_order_benchmark(clock, expected):
    # Standard deviations of a1, a2, b0 and the delay at 15 dB, from an independent implementation; they vary by a few
    # per cent with the phase of the input, which is random here and there.
    r = record(CASE_1, clock * 0.05)
    noise = np.sqrt(np.mean(r.y**2) / 10**1.5)
    np.testing.assert_allclose(np.sqrt(np.diag(cramer_rao_bound(CASE_1, r, noise, 15.0))), expected, rtol=0.1)


def test_errors_of_a_simulated_loop_are_those_of_its_derivatives_and_of_noise_that_passes_it():
    plant, law, count = TransferFunction([4.0], [1.0, 2.8, 4.0], 0.137), DiscreteController([0.5, -0.47], [1, -1]), 300
    t, r = INTERVAL * np.arange(count), np.random.default_rng(3).standard_normal(count)
    u, x = simulate_loop(plant, law, r, 0.0, INTERVAL)
    record, noise = Record(t, x, HeldSignal(t, u), loop=Loop(r, law)), ArmaNoise(*COLOURED, innovation_variance=0.02)
    form = EstimatedForm(plant, 0, 0.3, "closed_loop", simulated=True)
    found = accuracy_of_records(form, plant, [record], noise, "").parameters.covariance
    problem = LoopOutputError(2, 0, (0.0, 0.3)).prepare(record).laid_out.problem
    theta = np.array([2.8, 4.0, 4.0, 0.137])
    psi = problem.response.rows(theta, 4, problem.cell_of(0.137)).slopes
    S = np.array([v + simulate_loop(plant, law, 0.0 * v, v, INTERVAL).x for v in np.eye(count)]).T
    lags = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    reached = np.linalg.inv(psi.T @ psi) @ psi.T @ S
    expected = reached @ noise.autocovariance(np.arange(count), x)[lags] @ reached.T
    assert largest_relative_error(found, expected) < 1e-7
