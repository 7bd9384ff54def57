"""The estimation problem on spectra: its moments by explicit projection, and the models it finds."""

import numpy as np
import pytest

from ctid_cli.estimation.stability import reflect_unstable
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.filtering.simulate import simulate
from ctid_cli.filtering.spectra import lowpass_weight, record_spectra
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from tests.estimation.adapters import (
    DelayProblem,
    SpectralCoefficientProblem,
    SpectralDelayProblem,
    iterate,
    spectral_least_squares_start,
    spectral_refit_numerator,
)
from tests.estimators.records import CASE_1, CASE_2, SVF_CUTOFF, make_record, theta_of

#: Frequencies up to about one and a half bandwidths.
HIGHEST = {CASE_1: 3.0, CASE_2: 40.0}


def structure_of(model, delay=False):
    return Structure(model.order, model.numerator.size - 1, delay)


def spectra_of(model, greatest_delay=12.0, **options):
    if model is CASE_2 and not options.get("regular", True):
        options.setdefault("n", 4500)
    record = make_record(model, **options)
    return record, record_spectra(record, greatest_delay, HIGHEST[model], greatest_delay)


def explicit(spectra, weight, a, b, delay):
    """Columns (dx/da, dx/db, dx/dtau, eps) and the output, stacked as real numbers, the transient projected out.

    An orthogonal decomposition in the parameters' own units, independent of the normal equations of the problem.
    """
    n, m = a.size - 1, b.size - 1
    jw, y, u = 1j * spectra.frequencies, spectra.outputs, spectra.inputs(delay)
    denominator = np.polyval(a, jw)
    root = np.sqrt(weight * np.where(jw == 0, 1, 2))

    def stacked(columns):
        return np.concatenate((columns.real, columns.imag))

    powers = np.column_stack([jw**i for i in range(n)]) / np.abs(jw[-1]) ** np.arange(n)
    basis, triangle = np.linalg.qr(stacked(root[:, None] * powers / denominator[:, None]))
    forced = np.polyval(b, jw) * u / denominator
    transient = np.linalg.solve(triangle, basis.T @ stacked(root * (y - forced)))
    x = forced + powers @ transient / denominator
    columns = [-(jw ** (n - i)) * x / denominator for i in range(1, n + 1)]
    columns += [jw ** (m - j) * u / denominator for j in range(m + 1)]
    columns += [-jw * forced]
    columns = stacked(root[:, None] * np.column_stack([*columns, y - x]))
    return columns - basis @ (basis.T @ columns), stacked(root * x)


def assert_close(actual, expected, tolerance=1e-8):
    """Equal to a fraction of the greatest element."""
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance * np.abs(expected).max())


@pytest.mark.parametrize("model", [CASE_1, CASE_2])
@pytest.mark.parametrize("lowpass", [None, Lowpass(1.3, 2)])
@pytest.mark.parametrize("keep_mean", [True, False])
def test_moments_are_products_of_projected_columns(model, lowpass, keep_mean):
    record = make_record(model, snr_db=10, n=3000)
    spectra = record_spectra(record, 9.0, HIGHEST[model], 9.0, keep_mean=keep_mean)
    weight = lowpass_weight(spectra.frequencies, lowpass)
    truth = theta_of(model)
    theta = np.append(truth * (1 + 0.05 * np.cos(np.arange(truth.size))), 7.9)
    n, p = model.order, theta.size
    columns, x = explicit(spectra, weight, np.append(1.0, theta[:n]), theta[n:-1], 7.9)
    scale = np.linalg.norm(columns, axis=0)
    for size, problem in (
        (p, SpectralDelayProblem(spectra, structure_of(model), (0.0, 9.0), weight)),
        (p - 1, SpectralCoefficientProblem(spectra, structure_of(model), 7.9, weight)),
    ):
        equations = problem.equations(theta[:size])
        psi = columns[:, :size] / scale[:size]
        left, both = scale[:size], np.outer(scale[:size], scale[:size])
        eps = columns[:, -1]
        # The lowest frequencies alone carry what lies beyond 1e-6 of the greatest weight.
        tolerance = 1e-9 if lowpass is None else 1e-5
        assert_close(equations.hessian / both, psi.T @ psi, tolerance)
        assert_close(equations.instrument_error / left, psi.T @ eps, tolerance)
        assert equations.squared_error == pytest.approx(eps @ eps, rel=tolerance)
        assert equations.output_power == pytest.approx(x @ x, rel=tolerance)


@pytest.mark.parametrize("model", [CASE_1, CASE_2])
@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_gradient_of_the_cost_is_that_of_central_differences(model, hold):
    # d/dtheta of half the squared error = -sum psi eps: projecting the transient out costs nothing (its own gradient
    # vanishes), and it takes the end values of the delayed input.
    record = make_record(model, snr_db=5, n=3000, regular=False)
    record = Record(record.t, record.y, HeldSignal(record.t, record.input.at(record.t), hold))
    spectra = record_spectra(record, 12.0, HIGHEST[model], 12.0)
    weight = lowpass_weight(spectra.frequencies, Lowpass(0.8 * HIGHEST[model], 4))
    problem = SpectralDelayProblem(spectra, structure_of(model), (0.0, 12.0), weight)
    theta = np.append(theta_of(model) * 1.05, 8.1234)
    gradient = -problem.equations(theta).instrument_error
    for k, value in enumerate(theta):
        step = np.zeros(theta.size)
        step[k] = 1e-5 * value
        plus, minus = (problem.equations(theta + sign * step).squared_error for sign in (1, -1))
        assert gradient[k] == pytest.approx((plus - minus) / (4 * step[k]), rel=1e-6)


def test_hessian_is_that_of_the_cost_where_the_error_vanishes():
    # At the minimum of a noise-free cost Gauss and Newton agree.
    _, spectra = spectra_of(CASE_1)
    problem = SpectralDelayProblem(spectra, Structure(2, 0), (0.0, 12.0), np.ones(spectra.frequencies.size))
    theta = iterate(
        problem, np.append(theta_of(CASE_1), 8.0), max_iterations=20, tolerance=1e-9, variant="guarded"
    ).theta
    hessian = problem.equations(theta).hessian
    scale = 1e-4 / np.sqrt(np.diag(hessian))
    second = np.empty((4, 4))
    for i in range(4):
        step = np.zeros(4)
        step[i] = scale[i]
        plus, minus = (problem.equations(theta + sign * step).instrument_error for sign in (1, -1))
        second[i] = (minus - plus) / (2 * scale[i])
    relative = np.outer(scale, scale) * 1e8
    assert_close(second * relative, hessian * relative, 1e-3)


@pytest.mark.parametrize(
    ("model", "regular", "tolerance"),
    [(CASE_1, True, 1e-5), (CASE_1, False, 3e-4), (CASE_2, True, 1e-5), (CASE_2, False, 1e-3)],
)
def test_noise_free_records_give_the_true_model(model, regular, tolerance):
    _, spectra = spectra_of(model, regular=regular)
    structure, truth = structure_of(model), theta_of(model)
    weight = np.ones(spectra.frequencies.size)
    theta = spectral_least_squares_start(spectra, structure, 8.0, SVF_CUTOFF[model], weight)
    np.testing.assert_allclose(theta, truth, rtol=50 * tolerance)
    problem = SpectralDelayProblem(spectra, structure, (0.0, 12.0), weight)
    found = iterate(problem, np.append(theta, 7.98), max_iterations=50, tolerance=1e-6, variant="guarded")
    np.testing.assert_allclose(found.theta, np.append(truth, 8.0), rtol=tolerance)
    assert found.equations.squared_error < (10 * tolerance) ** 2 * found.equations.output_power
    fixed = iterate(
        SpectralCoefficientProblem(spectra, structure, 8.0, weight),
        theta,
        max_iterations=50,
        tolerance=1e-6,
        variant="plain",
    )
    np.testing.assert_allclose(fixed.theta, truth, rtol=tolerance)


@pytest.mark.parametrize("model", [CASE_1, CASE_2])
@pytest.mark.parametrize("regular", [True, False])
def test_estimate_is_that_of_the_time_domain(model, regular):
    # Same data, all frequencies: they differ by less than the estimate's own uncertainty (the time domain knows that
    # the system starts at rest, the spectra do not).
    record = make_record(model, regular=regular, snr_db=15, replicate=2, n=4500 if model is CASE_2 else None)
    spectra = record_spectra(record, 12.0, np.inf, 12.0)
    start = np.append(theta_of(model), 8.0)
    structure = structure_of(model)
    options = {"max_iterations": 50, "tolerance": 1e-6, "variant": "guarded"}
    data = filter_data(record, 12.0)
    direct = iterate(DelayProblem(data, structure, (0.0, 12.0)), start, **options)
    problem = SpectralDelayProblem(spectra, structure, (0.0, 12.0), np.ones(spectra.frequencies.size))
    spectral = iterate(problem, start, **options)
    variance = direct.equations.squared_error / data.count
    errors = np.sqrt(variance * np.diag(np.linalg.inv(direct.equations.hessian)))
    assert np.all(np.abs(spectral.theta - direct.theta) < errors)
    # Means over the window where the time domain has sums over samples, and a transient to project out.
    moments, sums = problem.equations(direct.theta), direct.equations
    assert moments.output_power == pytest.approx(sums.output_power / data.count, rel=0.02)
    np.testing.assert_allclose(np.diag(moments.hessian), np.diag(sums.hessian) / data.count, rtol=0.3)


def test_initial_state_is_projected_out():
    # A free response of the system, larger than the forced one, changes neither the estimate nor the cost.
    record = make_record(CASE_1)
    kick = HeldSignal([0.0, 10.0, 10.5], [0.0, 400.0, 0.0])
    free = simulate(TransferFunction([1.0, 3.0], CASE_1.denominator), kick, record.t)
    assert np.abs(free[record.t > 12]).max() > 3 * np.abs(record.y).max()
    found = []
    for y in (record.y, record.y + free):
        spectra = record_spectra(Record(record.t, y, record.input), 12.0, 3.0, 12.0)
        problem = SpectralDelayProblem(spectra, Structure(2, 0), (0.0, 12.0), np.ones(spectra.frequencies.size))
        start = np.append(theta_of(CASE_1) * 1.02, 8.02)
        found.append(iterate(problem, start, max_iterations=50, tolerance=1e-6, variant="guarded"))
    np.testing.assert_allclose(found[1].theta, found[0].theta, rtol=1e-4)
    assert found[1].equations.squared_error < 1e-8 * found[1].equations.output_power


def test_record_cut_from_a_running_experiment():
    # The input is known from the cut on: so is the delayed input in the window, and nothing else is needed.
    record = make_record(CASE_1, regular=False)
    later = record.t > 60.0
    edge = record.input.t > 60.0
    cut = Record(record.t[later], record.y[later], HeldSignal(record.input.t[edge], record.input.values[edge]))
    spectra = record_spectra(cut, 12.0, 3.0, 12.0)
    problem = SpectralDelayProblem(spectra, Structure(2, 0), (0.0, 12.0), np.ones(spectra.frequencies.size))
    start = np.append(theta_of(CASE_1) * 1.02, 8.02)
    found = iterate(problem, start, max_iterations=50, tolerance=1e-6, variant="guarded")
    np.testing.assert_allclose(found.theta, np.append(theta_of(CASE_1), 8.0), rtol=5e-4)


@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_units_do_not_matter(model):
    # Time in units of 1/1024 s, output and input in other units: powers of two, so that even rounding is nearly equal.
    record, spectra = spectra_of(model, snr_db=10)
    n, m = model.order, model.numerator.size - 1
    factor, output, inp = 1024.0, 8.0, 0.25
    scaled = record_spectra(
        Record(
            record.t * factor,
            record.y * output,
            HeldSignal(record.input.t * factor, record.input.values * inp, "zoh"),
        ),
        12.0 * factor,
        HIGHEST[model] / factor,
        12.0 * factor,
    )
    scale = np.concatenate(
        (factor ** -np.arange(1.0, n + 1), factor ** -np.arange(n - m, n + 1.0) * output / inp, [factor])
    )
    theta = np.append(theta_of(model) * 1.02, 7.97)
    weight = lowpass_weight(spectra.frequencies, Lowpass(HIGHEST[model], 3))
    plain = SpectralDelayProblem(spectra, structure_of(model), (0.0, 12.0), weight).equations(theta)
    other = SpectralDelayProblem(scaled, structure_of(model), (0.0, 12.0 * factor), weight).equations(theta * scale)
    power = output**2
    assert other.squared_error == pytest.approx(power * plain.squared_error, rel=1e-9)
    assert other.output_power == pytest.approx(power * plain.output_power, rel=1e-9)
    root = np.sqrt(np.diag(plain.hessian))
    lengths = np.outer(root, root)
    assert_close(other.hessian * np.outer(scale, scale) / power / lengths, plain.hessian / lengths)
    assert_close(other.instrument_error * scale / power / root, plain.instrument_error / root)
    cutoff = SVF_CUTOFF[model]
    start = spectral_least_squares_start(spectra, structure_of(model), 8.0, cutoff, weight)
    again = spectral_least_squares_start(scaled, structure_of(model), 8.0 * factor, cutoff / factor, weight)
    np.testing.assert_allclose(again, start * scale[:-1], rtol=1e-6)


@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_start_is_the_least_squares_solution(model):
    # (jw)^n F Y on -(jw)^(n-i) F Y, (jw)^(m-j) F U and (jw)^l F, with real coefficients, by orthogonal decomposition.
    _, spectra = spectra_of(model, snr_db=15)
    n, m, cutoff = model.order, model.numerator.size - 1, SVF_CUTOFF[model]
    weight = lowpass_weight(spectra.frequencies, Lowpass(0.7 * HIGHEST[model], 6))
    jw, y, u = 1j * spectra.frequencies, spectra.outputs, spectra.inputs(7.9)
    root = np.sqrt(weight * np.where(jw == 0, 1, 2)) / (jw + cutoff) ** n
    columns = [-(jw ** (n - i)) * y for i in range(1, n + 1)] + [jw ** (m - j) * u for j in range(m + 1)]
    columns += [jw**i for i in range(n)] + [jw**n * y]
    columns = root[:, None] * np.column_stack(columns)
    columns = np.concatenate((columns.real, columns.imag))
    size = np.linalg.norm(columns, axis=0)
    solution = np.linalg.lstsq(columns[:, :-1] / size[:-1], columns[:, -1], rcond=None)[0] / size[:-1]
    expected = np.concatenate((reflect_unstable(np.append(1.0, solution[:n]))[1:], solution[n : n + m + 1]))
    found = spectral_least_squares_start(spectra, structure_of(model), 7.9, cutoff, weight)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_unstable_starts_are_reflected():
    # A response that grows: the least-squares model is unstable, the start is its mirror image.
    t = 0.05 * np.arange(400)
    u = HeldSignal(t, np.where(t < 1, 1.0, 0.0))
    spectra = record_spectra(Record(t, 5 * np.exp(0.5 * t), u), 0.5, 10.0, 0.5)
    weight = np.ones(spectra.frequencies.size)
    theta = spectral_least_squares_start(spectra, Structure(1, 0), 0.25, 1.0, weight)
    assert theta[0] == pytest.approx(0.5, rel=1e-2)
    problem = SpectralCoefficientProblem(spectra, Structure(1, 0), 0.25, weight)
    np.testing.assert_allclose(problem.admissible(np.array([-0.5, 1.0])), [0.5, 1.0])


def test_numerator_is_the_best_for_its_denominator():
    _, spectra = spectra_of(CASE_2, snr_db=15)
    weight = lowpass_weight(spectra.frequencies, Lowpass(25.0, 4))
    theta = theta_of(CASE_2) * 1.05
    columns, _ = explicit(spectra, weight, np.append(1.0, theta[:4]), np.zeros(2), 8.0)
    expected = np.linalg.lstsq(columns[:, 4:6], columns[:, -1], rcond=None)[0]
    refitted = spectral_refit_numerator(spectra, Structure(4, 1), theta, 8.0, weight)
    np.testing.assert_allclose(refitted[4:], expected, rtol=1e-5)
    assert np.array_equal(refitted[:4], theta[:4])


def test_with_fewer_bins_than_transient_coefficients_nothing_is_left():
    # The mean and one frequency are three real equations; three coefficients of a transient explain them all.
    t = 0.1 * np.arange(200)
    y = np.random.default_rng(0).standard_normal(200)
    spectra = record_spectra(Record(t, y, HeldSignal(t, np.sign(np.sin(t)))), 2.0, 0.36, 2.0)
    assert spectra.frequencies.size == 2
    for order in (3, 4, 5):
        a = np.poly(np.full(order, -1.0))
        equations = SpectralCoefficientProblem(spectra, Structure(order, 0), 1.0, np.ones(2)).equations(
            np.append(a[1:], 1.0)
        )
        assert equations.squared_error < 1e-20 * equations.output_power
        assert np.abs(equations.hessian).max() < 1e-12 * equations.output_power


def test_nothing_is_computed_outside_the_bounds_or_for_non_finite_parameters():
    _, spectra = spectra_of(CASE_1, n=1000)
    weight = np.ones(spectra.frequencies.size)
    theta = theta_of(CASE_1)
    delay_problem = SpectralDelayProblem(spectra, Structure(2, 0), (1.0, 9.0), weight)
    assert delay_problem.equations(np.append(theta, 1.5)) is not None
    for delay in (0.5, 9.5, np.nan):
        assert delay_problem.equations(np.append(theta, delay)) is None
    problem = SpectralCoefficientProblem(spectra, Structure(2, 0), 1.0, weight)
    assert problem.equations(theta * np.nan) is None
    assert problem.equations(theta * np.inf) is None
    assert problem.equations(theta * 1e200) is None
    pole_on_a_bin = np.array([0.0, spectra.frequencies[-1] ** 2, 1.0])
    assert problem.equations(pole_on_a_bin) is None


def test_same_record_same_numbers():
    results = []
    for _ in range(2):
        _, spectra = spectra_of(CASE_2, regular=False, snr_db=5)
        weight = lowpass_weight(spectra.frequencies, Lowpass(10.0, 10))
        theta = spectral_least_squares_start(spectra, Structure(4, 1), 8.0, 25.0, weight)
        theta = spectral_refit_numerator(spectra, Structure(4, 1), theta, 8.0, weight)
        problem = SpectralDelayProblem(spectra, Structure(4, 1), (0.0, 12.0), weight)
        results.append(iterate(problem, np.append(theta, 8.0), max_iterations=9, tolerance=1e-6, variant="guarded"))
    assert np.array_equal(results[0].theta, results[1].theta)
