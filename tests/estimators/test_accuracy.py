"""Monte Carlo statistics against theory."""

import numpy as np
import pytest

from ctid_cli.estimation.common import Start
from ctid_cli.estimators.td_srivc import TdSrivc
from ctid_cli.inference.bounds import cramer_rao_bound
from ctid_cli.inference.fit import Status
from tests.estimators.records import CASE_1, make_record

RUNS = 200


@pytest.fixture(scope="module")
def monte_carlo():
    """Estimates, reported standard errors and bounds of the second-order benchmark, 15 dB."""
    estimator = TdSrivc(poles=2, zeros=0, delay_bounds=(0, 15))
    estimates, errors, bounds = [], [], []
    for replicate in range(RUNS):
        record = make_record(CASE_1, seed=20170331, replicate=replicate, snr_db=15)
        fit = estimator.fit(record, Start(delay=7.0))
        assert fit.status is Status.CONVERGED
        estimates.append(list(fit.parameters.values()))
        errors.append(list(fit.standard_errors.values()))
        noise = np.sqrt(np.mean(record.noise_free**2) / 10**1.5)
        bounds.append(np.diag(cramer_rao_bound(CASE_1, record, noise, start=15.0)))
    return np.array(estimates), np.array(errors), np.sqrt(np.mean(bounds, axis=0)), np.sqrt(bounds)


def test_deviations_reach_the_cramer_rao_bound(monte_carlo):
    # The deviation of 200 runs is itself known to 5 % (one standard error): 15 % is three of them.
    estimates, _, bound, _ = monte_carlo
    np.testing.assert_allclose(estimates.std(axis=0, ddof=1), bound, rtol=0.15)


def test_reported_standard_errors_are_the_bound(monte_carlo):
    # On average, and of each data set.
    _, errors, bound, bounds = monte_carlo
    np.testing.assert_allclose(errors.mean(axis=0), bound, rtol=0.02)
    np.testing.assert_allclose(errors, bounds, rtol=0.1)


def test_estimates_are_unbiased(monte_carlo):
    # |bias| below 3.3 standard errors of the mean: 99.9 % of the time for each parameter.
    estimates, _, _, _ = monte_carlo
    truth = [2.8, 4.0, 8.0, 8.0]
    standard_error = estimates.std(axis=0, ddof=1) / np.sqrt(RUNS)
    assert (np.abs(estimates.mean(axis=0) - truth) < 3.3 * standard_error).all()


def test_confidence_intervals_cover(monte_carlo):
    # 95 % of the intervals of two standard errors hold the truth; 200 of them leave 90 to 99 %.
    estimates, errors, _, _ = monte_carlo
    covered = np.abs(estimates - [2.8, 4.0, 8.0, 8.0]) < 1.96 * errors
    assert ((covered.mean(axis=0) > 0.90) & (covered.mean(axis=0) < 0.99)).all()
