"""Fits to frequency responses: against samples of periodic records, and against theory."""

import numpy as np
import pytest

from ctid_cli import (
    AdditiveModel,
    DataError,
    Fixed,
    FrequencyData,
    FrequencyDomain,
    FrequencyDomainSum,
    HeldSignal,
    Record,
    Submodel,
    Term,
    TransferFunction,
    estimate_frequency_response,
    identify_frequency_response,
    simulate,
)
from ctid_cli.estimation.measured_lines import MeasuredLines
from ctid_cli.estimation.optimum.box import box_of, point_of
from ctid_cli.estimation.optimum.projection import project, slopes
from ctid_cli.estimation.optimum.triangle import Delay
from ctid_cli.estimation.parameter_layout import Degrees
from ctid_cli.inference.sensitivities import Parametric, Structure
from ctid_cli.models.factoring import unfactored

SECOND = TransferFunction([2.0, 4.0], [1.0, 1.0, 4.0])
LINES = np.geomspace(0.1, 20.0, 120)
PERIOD = 200


def sampled(model: TransferFunction, interval: float) -> FrequencyData:
    """Return the values for samples of a record in steady state, from simulation and the discrete Fourier transform."""
    u = np.random.default_rng(1).standard_normal(PERIOD)
    u -= u.mean()
    stable = model.poles[model.poles != 0]
    periods = 2 + int((40.0 / np.abs(stable.real).min() + model.delay) / (PERIOD * interval))
    t = interval * np.arange(periods * PERIOD)
    y = simulate(model, HeldSignal(t, np.tile(u, periods)), t)[-PERIOD:]
    values = np.fft.rfft(y)[1:] / np.fft.rfft(u)[1:]
    return FrequencyData(2 * np.pi / (PERIOD * interval) * np.arange(1, values.size + 1), values, interval=interval)


def noisy(model: TransferFunction, seed: int, level: float = 0.05) -> FrequencyData:
    """Return values with errors proportional to the gain."""
    values, rng = model.frequency_response(LINES), np.random.default_rng(seed)
    error = level * (np.abs(values) + 0.1)
    parts = rng.standard_normal((2, LINES.size)) / np.sqrt(2.0)
    return FrequencyData(LINES, values + error * (parts[0] + 1j * parts[1]), error)


@pytest.mark.parametrize(
    ("model", "interval", "most"),
    [
        (TransferFunction([1.0], [1.0, 1.0]), 0.1, 0.0),
        (TransferFunction([2.0, 4.0], [1.0, 1.0, 4.0], 0.731), 0.2, 2.0),
        (TransferFunction([4.0], np.poly([-1.0, -1.0, -4.0, -30.0]), 0.31), 0.05, 2.0),
        (TransferFunction([1.0, 2.0, 1.0], [1.0, 1.0, 4.0], 0.5), 0.2, 0.5),
        (TransferFunction([2.0, 1.0], [1.0, 1.0, 0.0], 0.3), 0.1, 1.0),
    ],
    ids=str,
)
def test_lines_of_samples_give_the_coefficients_that_made_them(model, interval, most):
    low = most if model.numerator.size == model.denominator.size else 0.0
    integrators = int(model.denominator[-1] == 0.0)
    degrees = model.order - integrators, model.numerator.size - 1
    fit = FrequencyDomain(*degrees, (low, most), integrators=integrators).fit(sampled(model, interval))
    np.testing.assert_allclose(fit.model.denominator, model.denominator, rtol=1e-8)
    np.testing.assert_allclose(fit.model.numerator, model.numerator, rtol=1e-8)
    assert fit.model.delay == pytest.approx(model.delay, abs=1e-8)


@pytest.mark.parametrize("interval", [0.0, 0.2])
@pytest.mark.parametrize("poles", [[-1.0 + 2j, -1.0 - 2j, -3.0], [-1.0, -1.0, -3.0]], ids=["fractions", "states"])
def test_gradient_is_that_of_differences(interval, poles):
    data = FrequencyData(np.linspace(0.0, 12.0, 40), 1.0 / (1j * np.linspace(0.0, 12.0, 40) + 0.5), interval=interval)
    measured = MeasuredLines(data, Degrees.of(Structure(3, 1, delay=True)), (0.0, 2.0))
    problem, box = measured.problem, box_of(measured.problem, (0.0, 2.0))
    point = point_of(np.array(poles, dtype=complex), 0.33, box)

    def cost(coordinates):
        speed, damping = point.shifted(coordinates[:3])
        delay = Delay(point.delay.seconds + coordinates[3], point.delay.cell)
        return project(problem, speed, damping, delay)

    found = slopes(problem, point.speed, point.damping, point.delay, cost(np.zeros(4)), (0,))
    steps = 1e-5 * np.eye(4)
    differences = [(cost(h).squared_error - cost(-h).squared_error) / 4e-5 for h in steps]
    np.testing.assert_allclose(found.gradient, differences, rtol=1e-5, atol=1e-8 * np.abs(found.gradient).max())


def test_standard_errors_are_those_of_the_linear_model_of_the_response():
    fit = FrequencyDomain(2, 1, (0.0, 2.0)).fit(noisy(TransferFunction([2.0, 4.0], [1.0, 1.0, 4.0], 0.7), 0))
    assert fit.errors_known
    slopes_of_response = Parametric(fit.model, fit.parameter_names).frequency_slopes(LINES)
    weighted = slopes_of_response * (np.sqrt(2.0) / fit.data.standard_error[:, None])
    theory = np.linalg.inv((weighted.conj().T @ weighted).real)
    np.testing.assert_allclose(fit.covariance, theory, rtol=1e-8)


def test_close_modes_are_determined_although_their_coefficients_are_nearly_dependent():
    """The condition number is 2e9 for coefficients; errors are those of poles and residues."""
    w = np.linspace(18.0, 24.0, 400)
    s, modes = 1j * w, np.array([20.0, 20.8, 21.6])
    rng = np.random.default_rng(3)
    G = sum(gain * f**2 / (s**2 + 0.02 * f * s + f**2) for gain, f in zip((1.0, 0.6, -0.3), modes, strict=True))
    error = 0.01 * (rng.standard_normal(400) + 1j * rng.standard_normal(400)) / np.sqrt(2.0)
    found = identify_frequency_response(FrequencyData(w, G + error, np.full(400, 0.01)), FrequencyDomain(6, 4))
    assert not found.warnings
    assert found.fit.condition_number < 1e4
    poles = found.fit.model.poles[found.fit.model.poles.imag > 0]
    model = found.fit.model
    residues = np.polyval(model.numerator, poles) / np.polyval(np.polyder(model.denominator), poles)
    # By Re p, Im p, Re r, Im r of each pair.
    columns = [
        factor * column + np.conj(factor) * other
        for p, r in zip(poles, residues, strict=True)
        for column, other, factor in (
            *((r / (s - p) ** 2, np.conj(r) / (s - np.conj(p)) ** 2, f) for f in (1.0, 1j)),
            *((1.0 / (s - p), 1.0 / (s - np.conj(p)), f) for f in (1.0, 1j)),
        )
    ]
    psi = np.column_stack([np.concatenate((each.real, each.imag)) for each in columns]) * np.sqrt(2.0) / 0.01
    # The numerator of degree 4 has one coefficient less than the residues: their sum is zero.
    constraint = np.zeros(12)
    constraint[2::4] = 1.0
    free = np.linalg.svd(constraint[None])[2][1:].T
    covariance = free @ np.linalg.inv(free.T @ psi.T @ psi @ free) @ free.T
    printed = {item.name: item.standard_error for item in found.derived}
    for k in range(3):
        assert printed[f"pole_{k + 1}_real"] == pytest.approx(covariance[4 * k, 4 * k] ** 0.5, rel=1e-5)
        assert printed[f"pole_{k + 1}_imag"] == pytest.approx(covariance[4 * k + 1, 4 * k + 1] ** 0.5, rel=1e-5)


def test_the_size_of_errors_comes_from_the_residuals_where_it_is_not_known():
    known = noisy(SECOND, 1)
    weights_only = FrequencyData(LINES, known.response, 7.0 * known.standard_error, freedom=10.0)
    fits = [FrequencyDomain(2, 1).fit(data) for data in (known, weights_only)]
    np.testing.assert_allclose(fits[0].theta, fits[1].theta, rtol=1e-9)
    ratio = np.array(list(fits[1].standard_errors.values())) / list(fits[0].standard_errors.values())
    assert ((0.7 < ratio) & (ratio < 1.4)).all()
    assert not fits[1].errors_known


def test_lines_with_common_errors_have_the_standard_errors_of_correlated_noise():
    w, rng = np.linspace(0.05, 20.0, 400), np.random.default_rng(2)
    draws = rng.standard_normal((2, w.size + 8))
    noise = np.array([np.convolve(part, np.ones(9) / 3.0, "valid") for part in draws])
    values = SECOND.frequency_response(w) + 0.05 * (noise[0] + 1j * noise[1])
    fit = FrequencyDomain(2, 1).fit(FrequencyData(w, values))
    assert fit.law.kind == "robust"
    assert fit.standard_errors["b1"] > 1.5 * np.sqrt(fit.uncertainty("white").covariance[3, 3])


def test_a_sum_of_one_mode_is_the_transfer_function():
    data = noisy(TransferFunction([2.0, 4.0], [1.0, 1.0, 4.0], 0.7), 3)
    fraction = identify_frequency_response(data, FrequencyDomain(2, 1, (0.0, 2.0)))
    one_mode = identify_frequency_response(data, FrequencyDomainSum((Term(2, 1),), (0.0, 2.0)))
    np.testing.assert_allclose(one_mode.fit.model.denominator, fraction.fit.model.denominator, rtol=1e-6)
    np.testing.assert_allclose(one_mode.fit.model.numerator, fraction.fit.model.numerator, rtol=1e-6)
    np.testing.assert_allclose(one_mode.fit.responses_at(LINES), fraction.fit.responses_at(LINES), rtol=1e-6)
    assert one_mode.fit.cost == pytest.approx(fraction.fit.cost, rel=1e-9)
    bands = [each.frequency_response(LINES).gain_error for each in (fraction, one_mode)]
    np.testing.assert_allclose(*bands, rtol=1e-4)


@pytest.mark.parametrize("interval", [0.0, 0.1])
def test_lines_give_the_submodels_that_made_them(interval):
    integrating = Submodel([2.0], [1.0, 0.3], integrators=1)
    truth = AdditiveModel([integrating, Submodel([1.0], [1.0, 0.2, 4.0]), Submodel([9.0], [1.0, 0.4, 25.0])], 0.23)
    whole = unfactored(truth)
    data = sampled(whole, interval) if interval else FrequencyData(LINES, whole.frequency_response(LINES))
    fit = FrequencyDomainSum(truth.terms, (0.0, 1.0), fixed=(Fixed("g2_a1", float(truth.theta[2])),)).fit(data)
    np.testing.assert_allclose(fit.additive.theta, truth.theta, rtol=1e-8)
    assert fit.model.delay == pytest.approx(0.23, abs=1e-8)


def test_a_line_that_was_measured_twice_counts_twice():
    data = noisy(SECOND, 7)
    errors = data.standard_error / np.sqrt(2.0)
    twice = [np.tile(values, 2) for values in (LINES, data.response, data.standard_error)]
    fits = [
        FrequencyDomain(2, 1).fit(each) for each in (FrequencyData(*twice), FrequencyData(LINES, data.response, errors))
    ]
    np.testing.assert_allclose(fits[0].theta, fits[1].theta, rtol=1e-8)


@pytest.mark.parametrize("weight", ["inverse", "inverse-sqrt", "none"])
def test_weights_do_not_matter_to_values_without_errors(weight):
    data = FrequencyData(LINES, 1e-3 * SECOND.frequency_response(LINES), weight=weight)
    fit = FrequencyDomain(2, 1, fixed=(Fixed("a1", 1.0),)).fit(data)
    np.testing.assert_allclose(fit.theta, [1.0, 4.0, 2e-3, 4e-3], rtol=1e-9)


def test_an_estimated_response_gives_the_system_although_its_hold_was_divided_out():
    u = np.tile(np.random.default_rng(3).standard_normal(300), 8)
    t = 0.2 * np.arange(u.size)
    y = simulate(SECOND, HeldSignal(t, u), t) + 1e-6 * np.random.default_rng(4).standard_normal(u.size)
    found = estimate_frequency_response(Record(t, y, HeldSignal(t, u)))
    fit = FrequencyDomain(2, 1).fit(found.data)
    np.testing.assert_allclose(fit.theta, [1.0, 4.0, 2.0, 4.0], rtol=1e-5)


@pytest.mark.slow
def test_noise_alone_is_no_model():
    rng = np.random.default_rng(5)
    seen = 0
    for _ in range(8):
        values = rng.standard_normal((2, LINES.size))
        data = FrequencyData(LINES, values[0] + 1j * values[1])
        found = identify_frequency_response(data, FrequencyDomain(1, 0))
        seen += found.answer.seen
    assert seen <= 2
    assert all(item.status != "free" for item in found.estimates) or found.answer.seen


def test_what_a_frequency_response_cannot_have():
    data = FrequencyData(np.linspace(0.0, 5.0, 20), 1.0 / (1j * np.linspace(0.0, 5.0, 20) + 1.0))
    with pytest.raises(TypeError, match="unexpected keyword argument 'offset'"):
        FrequencyDomain(1, 0, offset="estimate")
    with pytest.raises(DataError, match="no value at frequency 0"):
        FrequencyDomain(1, 0, integrators=1).fit(data)
    with pytest.raises(DataError, match="too few"):
        FrequencyDomain(4, 3).fit(FrequencyData(LINES[:3], SECOND.frequency_response(LINES[:3])))
    with pytest.raises(DataError, match="too few"):
        FrequencyDomain(1, 1).fit(FrequencyData(np.ones(9), SECOND.frequency_response(np.ones(9))))
    t = 0.1 * np.arange(100)
    with pytest.raises(DataError, match="takes a frequency response"):
        FrequencyDomain(1, 0).fit(Record.from_arrays(t, np.sin(t), np.sin(t)))
