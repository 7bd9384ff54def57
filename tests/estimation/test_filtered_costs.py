"""Fits to spectra of a low-pass filtered record, against explicit columns and SciPy's least squares."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from ctid_cli.estimation.delay_search import scan
from ctid_cli.estimation.filtered_costs import filtered_costs, percents
from ctid_cli.estimation.iteration import Steps
from ctid_cli.estimation.sampled_problem import reflect_unstable
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.filtering.simulate import simulate
from ctid_cli.filtering.spectra import lowpass_weight, record_spectra
from ctid_cli.filtering.spectral_kernels import least_cost
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from tests.estimators.records import CASE_1, CASE_2, SVF_CUTOFF, make_record, theta_of

GREATEST = 12.0
DEGREES = {CASE_1: Structure(2, 0), CASE_2: Structure(4, 1)}
#: Frequencies up to about one and a half bandwidths [rad/s].
HIGHEST = {CASE_1: 3.0, CASE_2: 40.0}
THOROUGH = Steps(100, 1e-9, "guarded", 12)
CUTOFFS = [0.3, 1.0, 2.02]


def spectral_data(record, highest, delay, lowpass=None):
    """Return frequencies, output, delayed input and weights as arguments of the kernels."""
    spectra = record_spectra(record, GREATEST, highest, GREATEST)
    return spectra.frequencies, spectra.outputs, spectra.inputs(delay), lowpass_weight(spectra.frequencies, lowpass)


def real_rows(data, columns):
    """Return weighted complex columns as real ones; a positive frequency also represents its negative."""
    frequencies, _, _, weights = data
    root = np.sqrt(weights * np.where(frequencies == 0, 1, 2))
    weighted = root[:, None] * np.column_stack(columns)
    return np.concatenate((weighted.real, weighted.imag))


def columns_of(data, theta, poles):
    """Return columns (dx/da, dx/db, dx/dtau, eps) and output, with the transient removed by an orthogonal basis."""
    frequencies, y, u, _ = data
    jw, a, b = 1j * frequencies, np.append(1.0, theta[:poles]), theta[poles:]
    inverse = 1 / np.polyval(a, jw)
    powers = np.column_stack([(jw / abs(jw[-1])) ** i * inverse for i in range(poles)])
    basis, _ = np.linalg.qr(real_rows(data, [powers]))
    forced = np.polyval(b, jw) * u * inverse
    transient = np.linalg.lstsq(real_rows(data, [powers]), real_rows(data, [y - forced])[:, 0], rcond=None)[0]
    x = forced + powers @ transient
    columns = [-(jw ** (poles - i)) * x * inverse for i in range(1, poles + 1)]
    columns += [jw ** (b.size - 1 - j) * u * inverse for j in range(b.size)]
    columns = real_rows(data, [*columns, -jw * forced, y - x])
    return columns - basis @ (basis.T @ columns), real_rows(data, [x])[:, 0]


def fitted(data, model, start, *, iterations=50, tolerance=1e-6):
    """Return the fit from a denominator, which is at the head of the parameters of a start."""
    n = model.order
    start = np.concatenate((start[:n], np.zeros(model.numerator.size + n)))
    return least_cost(*data, start, n, iterations, tolerance, 12)


def disturbed(model):
    theta = theta_of(model)
    return theta * (1 + 0.05 * np.cos(np.arange(theta.size)))


@pytest.mark.parametrize("lowpass", [None, Lowpass(30.0, 3)])
@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_fit_is_where_scipy_ends(model, lowpass):
    # By differences of the residual, scaled by the size of each parameter. The delay step is the projection of the
    # error on the delay sensitivity orthogonal to those of the coefficients.
    data = spectral_data(make_record(model, snr_db=10, regular=False, n=4000), HIGHEST[model], 8.02, lowpass)
    n, start = model.order, disturbed(model)
    theta, squared_error, step = fitted(data, model, start, iterations=100, tolerance=1e-12)
    found = least_squares(
        lambda x: columns_of(data, x * start, n)[0][:, -1], np.ones(start.size), xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    assert squared_error == pytest.approx(2 * found.cost, rel=1e-9)
    np.testing.assert_allclose(theta, found.x * start, rtol=1e-4)
    columns, _ = columns_of(data, theta, n)
    size = np.linalg.norm(columns[:, :-1], axis=0)
    joint = np.linalg.lstsq(columns[:, :-1] / size, columns[:, -1], rcond=None)[0] / size
    assert step == pytest.approx(joint[-1], rel=1e-4)


def test_initial_state_is_projected_out():
    # A free response larger than the forced one changes neither the estimate nor the cost.
    record = make_record(CASE_1)
    kick = HeldSignal([0.0, 10.0, 10.5], [0.0, 400.0, 0.0])
    free = simulate(TransferFunction([1.0, 3.0], CASE_1.denominator), kick, record.t)
    assert np.abs(free[record.t > 12]).max() > 3 * np.abs(record.y).max()
    data = spectral_data(Record(record.t, record.y + free, record.input), 3.0, 8.0)
    theta, squared_error, _ = fitted(data, CASE_1, disturbed(CASE_1))
    np.testing.assert_allclose(theta, theta_of(CASE_1), rtol=1e-4)
    assert squared_error < 1e-8 * np.sum(np.abs(data[1]) ** 2)


def test_with_fewer_bins_than_transient_coefficients_nothing_is_left():
    # The mean and one frequency are three real equations, solved exactly by three transient coefficients.
    t = 0.1 * np.arange(200)
    y = np.random.default_rng(0).standard_normal(200)
    spectra = record_spectra(Record(t, y, HeldSignal(t, np.sign(np.sin(t)))), 2.0, 0.36, 2.0)
    assert spectra.frequencies.size == 2
    data = spectra.frequencies, spectra.outputs, spectra.inputs(1.0), np.ones(2)
    for order in (3, 5):
        _, squared_error, step = least_cost(
            *data, np.append(np.poly(np.full(order, -1.0))[1:], np.zeros(1 + order)), order, 5, 1e-9, 12
        )
        assert squared_error < 1e-12 * np.sum(np.abs(spectra.outputs) ** 2)
        assert np.isnan(step)


def test_start_that_cannot_be_computed_has_no_cost():
    data = spectral_data(make_record(CASE_1, n=1000), 3.0, 1.0)
    on_a_bin = np.array([0.0, data[0][-1] ** 2, 1.0])
    for start in (on_a_bin, theta_of(CASE_1) * np.nan, theta_of(CASE_1) * np.inf):
        _, squared_error, step = fitted(data, CASE_1, start)
        assert squared_error == np.inf
        assert np.isnan(step)


# The costs of several filters -----------------------------------------------------------------------------------


def costs_of(record, model=CASE_1, cutoffs=CUTOFFS):
    lowpasses = [Lowpass(cutoff, 10) for cutoff in cutoffs]
    svf_cutoffs = [SVF_CUTOFF[model]] * len(cutoffs)
    return filtered_costs(
        record, lowpasses, DEGREES[model], GREATEST, start=GREATEST, svf_cutoffs=svf_cutoffs, steps=THOROUGH
    )


NONE = np.empty((0, 4))


@pytest.mark.parametrize(("model", "cutoffs"), [(CASE_1, CUTOFFS), (CASE_2, [2.685, 26.85])])
def test_least_cost_is_that_of_all_frequencies(model, cutoffs):
    # Without excluding frequencies at which a filter has almost no gain.
    record = make_record(model, snr_db=15, regular=False, n=2500)
    costs = costs_of(record, model, cutoffs)
    for k, cutoff in enumerate(cutoffs):
        data = spectral_data(record, 1.5 * cutoffs[-1], 7.9, Lowpass(cutoff, 10))
        _, expected, _ = fitted(data, model, theta_of(model), iterations=100, tolerance=1e-9)
        found = costs[k].minimise(7.9, np.append(theta_of(model), 0.0)[None], False)
        assert found.squared_error == pytest.approx(expected, rel=1e-5)
        assert found.delay == 7.9
        deviation = real_rows(data, [np.where(data[0] > 0, data[1], 0.0)])
        assert costs[k].spread == pytest.approx(np.sum(deviation**2))


@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_own_start_is_the_least_squares_solution(model):
    # (jw)^n Y/F on -(jw)^(n-i) Y/F, (jw)^(m-j) U/F and (jw)^l/F, with real coefficients, by orthogonal decomposition.
    record, cutoff = make_record(model, snr_db=15), HIGHEST[model] / 1.5
    cost = replace(costs_of(record, model, [cutoff])[0], steps=Steps(0, 1e-9, "guarded", 12))
    data = spectral_data(record, HIGHEST[model], 7.9, Lowpass(cutoff, 10))
    n, m, jw = model.order, model.numerator.size - 1, 1j * data[0]
    f = np.poly(np.full(n, -SVF_CUTOFF[model]))
    columns = [-(jw ** (n - i)) * data[1] for i in range(1, n + 1)]
    columns += [jw ** (m - j) * data[2] for j in range(m + 1)]
    columns += [jw**i for i in range(n)] + [jw**n * data[1]]
    columns = real_rows(data, [column / np.polyval(f, jw) for column in columns])
    size = np.linalg.norm(columns, axis=0)
    solution = np.linalg.lstsq(columns[:, :-1] / size[:-1], columns[:, -1], rcond=None)[0] / size[:-1]
    expected = reflect_unstable(np.append(1.0, solution[:n]))[1:]
    found = cost.minimise(7.9, np.empty((0, n + m + 2)), True)
    np.testing.assert_allclose(found.theta[:n], expected, rtol=1e-4)


def test_unstable_own_starts_are_reflected():
    # A growing response: the least-squares model is unstable, the start is its reflection.
    t = 0.05 * np.arange(400)
    record = Record(t, 5 * np.exp(0.5 * t), HeldSignal(t, np.where(t < 1, 1.0, 0.0)))
    steps = Steps(0, 1e-9, "guarded", 12)
    cutoffs = [1.0]
    costs = filtered_costs(
        record, [Lowpass(7.0, 10)], Structure(1, 0), 0.5, start=0.5, svf_cutoffs=cutoffs, steps=steps
    )
    assert costs[0].minimise(0.25, np.empty((0, 3)), True).theta[0] == pytest.approx(0.5, rel=1e-2)


def test_costs_behind_all_filters_are_handed_down_and_up():
    costs = costs_of(make_record(snr_db=5, n=2000))
    found = scan(costs[::-1], [6.5] * 3, own=False)
    down = [costs[2].minimise(6.5, NONE, True)]
    for k in (1, 0):
        down.insert(0, costs[k].minimise(6.5, down[0].theta[None], False))
    best = down[:1]
    for k in (1, 2):
        up = costs[k].minimise(6.5, best[-1].theta[None], False)
        best.append(min(up, down[k], key=lambda minimum: minimum.squared_error))
    np.testing.assert_allclose(found.squared_errors[::-1], [minimum.squared_error for minimum in best], rtol=1e-9)
    np.testing.assert_allclose(found.thetas[::-1], [minimum.theta for minimum in best], rtol=1e-6)


def test_input_that_rests_while_it_counts_has_no_minimum():
    # All information of the output about the input is before the used samples.
    t = 0.05 * np.arange(1000)
    costs = costs_of(Record(t, np.sin(t), HeldSignal(t, np.where(t < t[-1], 0.0, 1.0))))
    squared_errors = scan(costs, [1.0] * 3, own=False).squared_errors
    assert np.isinf(squared_errors).all()
    assert percents(squared_errors, costs[0].spread).tolist() == [100.0] * 3
