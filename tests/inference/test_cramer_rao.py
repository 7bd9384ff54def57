"""The Cramér-Rao bound against finite differences of the simulation and against known values."""

import numpy as np
import pytest

from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.bounds import cramer_rao_bound
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.excitation import Prbs
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from ctid_cli.signals.streams import stream

CASE_1 = TransferFunction([2.0], [0.25, 0.7, 1.0], 8.0)
CASE_2 = TransferFunction([-6400.0, 1600.0], [1.0, 5.0, 408.0, 416.0, 1600.0], 8.0)


def record(model, clock_period, regular=True, n=4000, interval=0.05):
    rng = stream(1, "sampling", 0)
    t = interval * np.arange(n) if regular else np.cumsum(rng.uniform(0.2, 1.8, n)) * interval
    held = Prbs(stages=10, clock_period=clock_period).generate(t, stream(1, "input", 0))
    return Record(t, simulate(model, held, t), held)


def information(model, r, start, delay_is_free):
    """Sum of squares of the sensitivities, by central differences of the simulated output."""
    theta = np.concatenate((model.denominator[1:], model.numerator, [model.delay] * delay_is_free))
    n = model.order
    columns = []
    for k, value in enumerate(theta):
        step = 1e-6 * abs(value)
        moved = []
        for sign in (1, -1):
            p = theta.copy()
            p[k] += sign * step
            delay = p[-1] if delay_is_free else model.delay
            b = p[n : n + model.numerator.size]
            moved.append(simulate(TransferFunction(b, np.append(1.0, p[:n]), delay), r.input, r.t))
        columns.append((moved[0] - moved[1]) / (2 * step))
    psi = np.column_stack(columns)[r.valid & (r.t >= r.input.t[0] + start - 1e-9)]
    return psi.T @ psi


@pytest.mark.parametrize("estimate_delay", [True, False])
@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize(("model", "interval"), [(CASE_1, 0.05), (CASE_2, 0.01)])
def test_bound_is_that_of_finite_differences(model, interval, regular, estimate_delay):
    r = record(model, 10 * interval, regular, n=3000, interval=interval)
    y = r.y.copy()
    y[1200:1300] = np.nan
    r = Record(r.t, y, r.input)
    bound = cramer_rao_bound(model, r, 0.3, start=9.0, estimate_delay=estimate_delay)
    expected = 0.3**2 * np.linalg.inv(information(model, r, 9.0, estimate_delay))
    deviations = np.sqrt(np.diag(expected))
    assert np.abs((bound - expected) / np.outer(deviations, deviations)).max() < 1e-4


@pytest.mark.parametrize(
    ("clock", "expected"),
    [(1, [0.0267, 0.0308, 0.0693, 0.00192]), (4, [0.0295, 0.0353, 0.0781, 0.00238])],
)
def test_known_bounds_of_the_second_order_benchmark(clock, expected):
    # Standard deviations of a1, a2, b0 and the delay at 15 dB, from an independent implementation; they move by a
    # few per cent with the phase of the input, which is drawn here and was drawn there.
    r = record(CASE_1, clock * 0.05)
    noise = np.sqrt(np.mean(r.y**2) / 10**1.5)
    np.testing.assert_allclose(np.sqrt(np.diag(cramer_rao_bound(CASE_1, r, noise, 15.0))), expected, rtol=0.1)


def test_bound_is_proportional_to_the_variance_and_blind_to_the_outputs():
    r = record(CASE_1, 0.5, n=1000)
    other = Record(r.t, np.random.default_rng(0).standard_normal(r.n_samples), r.input)
    bound = cramer_rao_bound(CASE_1, r, 0.1, 10.0)
    np.testing.assert_allclose(cramer_rao_bound(CASE_1, other, 0.3, 10.0), 9 * bound, rtol=1e-9)


def test_more_parameters_never_help():
    r = record(CASE_1, 0.5, n=1000)
    known = cramer_rao_bound(CASE_1, r, 0.1, 10.0, estimate_delay=False)
    unknown = cramer_rao_bound(CASE_1, r, 0.1, 10.0)
    assert (np.diag(unknown)[:-1] > np.diag(known)).all()


def test_bound_is_undefined_where_the_data_say_nothing():
    t = 0.05 * np.arange(500)
    silent = Record(t, np.sin(t), HeldSignal(t, np.zeros(500)))
    assert np.isnan(cramer_rao_bound(CASE_1, silent, 0.1)).all()
