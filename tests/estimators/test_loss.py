"""Estimates by Huber's and Tukey's loss."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.fit import Status
from ctid_cli.inference.robust_loss import BEND, END
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

SYSTEM = TransferFunction([0.6], [1.0, 0.4, 0.64], 0.7)
FAST = TransferFunction([1.0], [1.0, 2.0])
LOSSES = ("huber", "tukey")


def record_of(model, seed, *, n=300, interval=0.5, jitter=0.0, offset=0.0, wild=(), size=50.0, one_side=False):
    """Return a record with outliers of a given number of noise standard deviations, and that noise."""
    rng = np.random.default_rng(seed)
    t = interval * np.arange(n)
    t[1:-1] += interval * rng.uniform(-jitter, jitter, n - 2)
    signal = HeldSignal(t, np.repeat(rng.choice([-1.0, 1.0], n // 4 + 1), 4)[:n])
    x = simulate(model, signal, t)
    e = 0.1 * x.std() * rng.standard_normal(n)
    wild = np.asarray(wild if np.ndim(wild) else rng.choice(n, wild, replace=False), dtype=int)
    e[wild] += 0.1 * x.std() * size * (1.0 if one_side else rng.choice([-1.0, 1.0], wild.size))
    return Record(t, x + e + offset, signal)


def tukey(z):
    """Return twice the loss, and its two derivatives, as functions of the squared error over the squared threshold."""
    left = np.maximum(1.0 - z, 0.0)
    return np.array([(1.0 - left**3) / 3.0, left**2, -2.0 * left])


@pytest.mark.parametrize(("loss", "bend"), [("huber", BEND), ("tukey", END)])
def test_a_general_optimiser_finds_nothing_better(loss, bend):
    record = record_of(SYSTEM, 1, wild=15)
    fit = DelayProfile(2, 0, (0.7, 0.7), loss=loss).fit(record)
    assert fit.status is Status.CONVERGED
    (own,) = fit.weighting.losses

    def errors(theta):
        return record.y - simulate(TransferFunction(theta[2:], [1.0, *theta[:2]], 0.7), record.input, record.t)

    np.testing.assert_allclose(errors(fit.theta), fit.residuals[0], atol=1e-9)
    kind = "huber" if loss == "huber" else tukey
    found = least_squares(errors, fit.theta, loss=kind, f_scale=bend * own.scale, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert fit.cost * fit.count <= 2.0 * found.cost * (1 + 1e-9)
    assert fit.cost * fit.count == pytest.approx(2.0 * found.cost, rel=1e-9)
    np.testing.assert_allclose(fit.theta, found.x, rtol=1e-6)


@pytest.mark.parametrize("loss", LOSSES)
def test_the_size_of_an_outlier_does_not_matter(loss):
    """Two records, one irregular with missing samples, initial state and offset; outliers adjacent and at the start."""
    fits = []
    for size in (50.0, 5e4):
        wild = {"wild": [2, 90, 91, 200], "size": size, "one_side": True}
        records = [record_of(SYSTEM, seed, n=250, jitter=0.3 * seed, offset=3.0, **wild) for seed in (0, 1)]
        y = records[1].y.copy()
        y[20:25] = np.nan
        records[1] = Record(records[1].t, y, records[1].input)
        options = DelayProfile(2, 0, (0.7, 0.7), initial_state="estimate", offset="estimate", loss=loss)
        fits.append(options.fit(records))
    one, other = fits
    errors = np.sqrt(np.diag(one.covariance))
    np.testing.assert_allclose((one.theta - other.theta) / errors, 0.0, atol=1e-2)
    np.testing.assert_allclose(np.sqrt(np.diag(other.covariance)), errors, rtol=1e-3)
    for record, use, out in zip(records, other.used, other.weighting.outliers, strict=True):
        assert set(record.t[[2, 90, 91, 200]]) <= set(record.t[use][out])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("loss", "contamination"),
    [
        ("huber", {"wild": 20, "size": 10.0}),
        ("tukey", {"wild": 20, "size": 10.0}),
    ],
)
def test_errors_are_as_large_as_the_covariance_says(loss, contamination):
    """Squared errors over the covariance are chi-square, and the covariance is hardly larger than without outliers."""
    truth, count = np.array([2.0, 1.0]), 20
    squares, sizes, clean = 0.0, [], []
    for seed in range(count):
        fit = DelayProfile(1, 0, (0.0, 0.0), loss=loss).fit(record_of(FAST, seed, n=200, interval=0.1, **contamination))
        error = fit.theta - truth
        squares += error @ np.linalg.solve(fit.covariance, error)
        sizes.append(np.diag(fit.covariance))
        if seed < 5:
            record = record_of(FAST, seed, n=200, interval=0.1)
            clean.append(np.diag(DelayProfile(1, 0, (0.0, 0.0)).fit(record).covariance))
    low, high = chi2.ppf([0.0005, 0.9995], 2 * count)
    assert low < squares < high
    # 10 % of outliers reduce the precision of Huber's estimate by half at most, that of least squares by nine tenths.
    assert (np.mean(sizes, axis=0) < 2.2 * np.mean(clean, axis=0)).all()


def test_where_the_estimate_is_its_pseudo_errors_are_least_squares():
    record = record_of(SYSTEM, 3, wild=15, one_side=True)
    prepared = DelayProfile(2, 0, (0.0, 2.0), loss="tukey").prepare(record)
    fit = prepared.fit()
    near = prepared.laid_out.near(fit.residuals, fit.weighting)
    linear = fit.linear
    assert near.squared_error_at(fit.model, fit.model.delay) == pytest.approx(linear.cost * linear.count, rel=1e-8)
    assert linear.count == fit.count - np.count_nonzero(fit.weighting.outliers[0])
    assert DelayProfile(2, 0, (0.0, 2.0)).fit(record).linear.weighting is None
