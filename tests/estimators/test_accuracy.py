"""Monte Carlo statistics of estimators of a delay, against theory."""

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
#: Number of data sets; estimator and its start; the time from which samples count [s].
SEARCHES = {
    "td_srivc": (200, TdSrivc(2, 0, BOUNDS), 7.0, 15.0),
    "useful_redundancy": (120, UsefulRedundancy(2, 0, BOUNDS, bandwidth=2.02, svf_cutoff=1.0), 0.0, 15.0),
    # At rest the input before the record is known to be zero, so every sample counts.
    "delay_profile": (200, DelayProfile(2, 0, BOUNDS), 0.0, 0.0),
}


def record_of(replicate):
    return make_record(CASE_1, seed=20170331, replicate=replicate, snr_db=15)


@pytest.fixture(scope="module", params=SEARCHES)
def monte_carlo(request):
    """Return estimates, standard errors and bounds of the second-order benchmark at 15 dB."""
    runs, estimator, start, begin = SEARCHES[request.param]
    estimates, errors, bounds = [], [], []
    for replicate in range(runs):
        record = record_of(replicate)
        fit = estimator.fit(record, Start(start))
        assert fit.status is Status.CONVERGED
        estimates.append(list(fit.parameters.values()))
        errors.append(list(fit.standard_errors.values()))
        noise = np.sqrt(np.mean(record.noise_free**2) / 10**1.5)
        bounds.append(np.diag(cramer_rao_bound(CASE_1, record, noise, start=begin)))
    return np.array(estimates), np.array(errors), np.sqrt(bounds)


def test_deviations_reach_the_cramer_rao_bound(monte_carlo):
    # The standard error of the deviation of 120 to 200 runs is 6.5 to 5 %. No run is in a local minimum: the limit is
    # five standard deviations, which no sample of a normal distribution reaches.
    estimates, _, bounds = monte_carlo
    np.testing.assert_allclose(estimates.std(axis=0, ddof=1), np.sqrt(np.mean(bounds**2, axis=0)), rtol=0.15)
    assert (np.abs(estimates - TRUTH) < 5 * bounds).all()


def test_reported_standard_errors_are_the_bound(monte_carlo):
    # On average, and for each data set.
    _, errors, bounds = monte_carlo
    np.testing.assert_allclose(errors.mean(axis=0), np.sqrt(np.mean(bounds**2, axis=0)), rtol=0.02)
    np.testing.assert_allclose(errors, bounds, rtol=0.1)


def test_estimates_are_unbiased_and_intervals_cover(monte_carlo):
    # |bias| is below 3.3 standard errors of the mean 99.9 % of the time for each parameter. 95 % of the intervals of
    # two standard errors contain the true value; for 120 of them 88 to 100 % do.
    estimates, errors, _ = monte_carlo
    standard_error = estimates.std(axis=0, ddof=1) / np.sqrt(len(estimates))
    assert (np.abs(estimates.mean(axis=0) - TRUTH) < 3.3 * standard_error).all()
    covered = (np.abs(estimates - TRUTH) < 1.96 * errors).mean(axis=0)
    assert ((covered > 0.88) & (covered < 1.0)).all()
