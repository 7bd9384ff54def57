"""The estimate has the minimum output error of its structure and of all structures that it contains."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.fit import Status
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from tests.estimation.optimum.dense import residual
from tests.estimation.optimum.systems import record_of

INTERVAL = 0.5


def periodic_record(damping, noise=0.05, samples=100, seed=1):
    """Return the last of many periods of a second-order system's response."""
    rng = np.random.default_rng(seed)
    model = TransferFunction([0.6], [1.0, 2 * damping * 0.8, 0.64], 0.7)
    u = np.repeat(rng.choice([-1.0, 1.0], samples // 2), 2)
    periods = int(np.ceil(35.0 / (0.8 * damping * samples * INTERVAL))) + 1
    t = INTERVAL * np.arange(periods * samples)
    x = simulate(model, HeldSignal(t, np.tile(u, periods)), t)[-samples:]
    return Record.from_arrays(t[:samples], u, x + noise * x.std() * rng.standard_normal(samples) + 3.0), model


def in_motion(seed=2, samples=160):
    """Return a record that begins in the middle of another, with an offset."""
    rng = np.random.default_rng(seed)
    model = TransferFunction([0.6], [1.0, 0.4, 0.64], 0.7)
    whole = record_of(model, rng, samples=samples + 40, noise=0.1, offset=3.0)
    return Record.from_arrays(whole.t[40:], whole.input.values[40:], whole.y[40:]), model


@pytest.mark.parametrize(("damping", "seed"), [(0.3, 1), (0.001, 1), (0.001, 5)])
def test_periodic_records_end_where_a_general_optimiser_does_on_dense_matrices(damping, seed):
    record, model = periodic_record(damping, seed=seed)
    fit = DelayProfile(2, 0, (0.0, 2.0), initial_state="periodic", offset="estimate").fit(record)
    period = record.n_samples * INTERVAL
    check(fit, model, lambda a, tau: residual(record, a, 0, tau, offset=True, period=period))
    assert fit.status in (Status.CONVERGED, Status.AT_BOUND)
    np.testing.assert_allclose(fit.model.denominator[2], model.denominator[2], rtol=0.05)


def test_state_and_offset_end_where_a_general_optimiser_does_on_dense_matrices():
    record, model = in_motion()
    fit = DelayProfile(2, 0, (0.0, 2.0), initial_state="estimate", offset="estimate").fit(record)
    assert fit.status is Status.CONVERGED
    # The input before is unknown, so that samples count from the greatest delay on.
    y = np.where(record.t - record.t[0] < 2.0 - 1e-9, np.nan, record.y)
    known = Record(record.t, y, record.input)
    check(fit, model, lambda a, tau: residual(known, a, 0, tau, free_response=True, offset=True))


def check(fit, model, residual_of):
    """Compare with least squares from the true w, damping and delay, within the admissible damping."""

    def errors(x):
        w, zeta = np.exp(x[:2])
        return residual_of(np.array([1.0, 2 * zeta * w, w * w]), x[2])

    w = np.sqrt(model.denominator[2])
    start = np.array([np.log(w), np.log(max(0.5 * model.denominator[1] / w, 1.1e-3)), model.delay])
    bounds = [-np.inf, np.log(1e-3), 0.0], [np.inf, np.inf, 2.0]
    found = least_squares(errors, start, bounds=bounds, x_scale="jac", xtol=1e-12, ftol=1e-14, gtol=1e-12)
    squared_error = fit.cost * fit.count
    # The model has the reported cost, and the second method finds the same one.
    a = fit.model.denominator
    assert float(np.sum(residual_of(a, fit.model.delay) ** 2)) == pytest.approx(squared_error, rel=1e-7)
    assert np.concatenate(fit.residuals) @ np.concatenate(fit.residuals) == pytest.approx(squared_error, rel=1e-9)
    assert squared_error <= 2 * found.cost * (1 + 1e-6)
