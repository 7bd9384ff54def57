"""Monte Carlo statistics of the estimators that search for the delay, against theory and the local estimator."""

import numpy as np
import pytest

from ctid_cli.estimation.common import Start
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.td_srivc import TdSrivc
from ctid_cli.estimators.useful_redundancy import UsefulRedundancy
from ctid_cli.inference.bounds import cramer_rao_bound
from ctid_cli.inference.fit import Status
from tests.estimators.records import CASE_1, make_record

BOUNDS = (0.0, 15.0)
TRUTH = np.array([2.8, 4.0, 8.0, 8.0])
#: Data sets; estimator; one of the same cost that need not search; and the time from which samples count [s].
SEARCHES = {
    "useful_redundancy": (
        120,
        UsefulRedundancy(2, 0, delay_bounds=BOUNDS, bandwidth=2.02, svf_cutoff=1.0),
        TdSrivc(2, 0, BOUNDS),
        15.0,
    ),
    # At rest the input before the record is known to be zero, and every sample counts.
    "delay_profile": (200, DelayProfile(2, 0, delay_bounds=BOUNDS), DelayProfile(2, 0, delay_bounds=(7.9, 8.1)), 0.0),
}


@pytest.fixture(scope="module", params=SEARCHES)
def monte_carlo(request):
    """Estimates, standard errors and bounds of the second-order benchmark at 15 dB, all from 0 s."""
    runs, estimator, _, begin = SEARCHES[request.param]
    estimates, errors, bounds = [], [], []
    for replicate in range(runs):
        record = make_record(CASE_1, seed=20170331, replicate=replicate, snr_db=15)
        fit = estimator.fit(record, Start(0.0))
        assert fit.status is Status.CONVERGED
        estimates.append(list(fit.parameters.values()))
        errors.append(list(fit.standard_errors.values()))
        noise = np.sqrt(np.mean(record.noise_free**2) / 10**1.5)
        bounds.append(np.diag(cramer_rao_bound(CASE_1, record, noise, start=begin)))
    return request.param, np.array(estimates), np.array(errors), np.sqrt(bounds)


def test_every_estimate_is_near_the_truth(monte_carlo):
    # Not one in a local minimum: five standard deviations, of which no sample of a normal distribution falls short.
    _, estimates, _, bounds = monte_carlo
    assert (np.abs(estimates - TRUTH) < 5 * bounds).all()


def test_deviations_reach_the_cramer_rao_bound(monte_carlo):
    # The deviation of 120 to 200 runs is itself known to 6.5 to 5 % (one standard error).
    _, estimates, _, bounds = monte_carlo
    np.testing.assert_allclose(estimates.std(axis=0, ddof=1), np.sqrt(np.mean(bounds**2, axis=0)), rtol=0.15)


def test_reported_standard_errors_are_the_bound(monte_carlo):
    _, _, errors, bounds = monte_carlo
    np.testing.assert_allclose(errors, bounds, rtol=0.1)


def test_estimates_are_unbiased(monte_carlo):
    # |bias| below 3.3 standard errors of the mean: 99.9 % of the time for each parameter.
    _, estimates, _, _ = monte_carlo
    standard_error = estimates.std(axis=0, ddof=1) / np.sqrt(len(estimates))
    assert (np.abs(estimates.mean(axis=0) - TRUTH) < 3.3 * standard_error).all()


def test_estimates_are_those_of_a_search_beside_the_truth(monte_carlo):
    # By far less than a standard deviation: both end in the same minimum.
    name, estimates, _, bounds = monte_carlo
    local = SEARCHES[name][2]
    for replicate in range(0, len(estimates), 8):
        record = make_record(CASE_1, seed=20170331, replicate=replicate, snr_db=15)
        expected = list(local.fit(record, Start(8.0)).parameters.values())
        assert (np.abs(estimates[replicate] - expected) < 1e-3 * bounds[replicate]).all()
