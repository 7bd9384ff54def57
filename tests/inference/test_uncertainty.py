"""What standard errors take the noise for, in every estimator that asks."""

import numpy as np
import pytest
from scipy.signal import lfilter

from ctid_cli.estimation.common import Start
from ctid_cli.estimators.additive_srivc import AdditiveSrivc
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.srivc import Srivc
from ctid_cli.estimators.td_srivc import TdSrivc
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.quantile import normal_quantile
from ctid_cli.inference.uncertainty import estimate_uncertainty
from ctid_cli.models.additive import Term
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

DELAY = 0.25
ESTIMATORS = {
    "srivc": lambda **options: Srivc(1, 0, delay=DELAY, svf_cutoff=2.0, **options),
    "td_srivc": lambda **options: TdSrivc(1, 0, (0.0, 1.0), svf_cutoff=2.0, **options),
    "additive_srivc": lambda **options: AdditiveSrivc((Term(1, 0),), delay=DELAY, **options),
    "delay_profile": lambda **options: DelayProfile(1, 0, (0.0, 1.0), **options),
}


def record(colour):
    rng = np.random.default_rng(3)
    t = 0.1 * np.arange(600)
    u = HeldSignal(t, np.repeat(rng.choice([-1.0, 1.0], 120), 5))
    noise = 0.05 * lfilter([1.0], [1.0, -colour], rng.standard_normal(600))
    return Record(t, simulate(TransferFunction([2.0], [1.0, 2.0], DELAY), u, t) + noise, u)


def errors(name, colour, covariance, **options):
    start = Start(delay=0.3) if name == "td_srivc" else None
    fit = ESTIMATORS[name](covariance=covariance, **options).fit(record(colour), start)
    return np.array([*fit.standard_errors.values()])


@pytest.mark.parametrize("name", ESTIMATORS)
def test_auto_is_white_unless_the_residuals_are_not(name):
    np.testing.assert_allclose(errors(name, 0.0, "auto"), errors(name, 0.0, "white"), rtol=1e-9)
    coloured = errors(name, 0.9, "robust")
    np.testing.assert_array_equal(errors(name, 0.9, "auto"), coloured)
    np.testing.assert_array_equal(errors(name, 0.9, "sandwich"), coloured)
    assert (coloured[:2] > 1.5 * errors(name, 0.9, "white")[:2]).all()


@pytest.mark.parametrize("name", ["srivc", "delay_profile"])
def test_both_routes_to_a_bootstrap_differ_from_robust_errors_by_its_quantiles(name):
    scaled = errors(name, 0.9, "bootstrap", bootstrap_draws=50) / errors(name, 0.9, "robust")
    assert ((scaled > 0.6) & (scaled < 1.7)).all()
    assert (scaled != 1.0).all()


def test_normal_intervals_of_the_widened_covariance_are_those_of_the_bootstrap():
    fit = DelayProfile(1, 0, (0.0, 1.0)).fit(record(0.9))
    found = estimate_uncertainty(fit.sensitivities, fit.residuals, "bootstrap", 50, regular=True)
    unit = np.eye(fit.theta.size)
    reach = [found.quantile(row) for row in unit] * np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(normal_quantile() * np.sqrt(np.diag(found.widened())), reach, rtol=1e-12)
    # A quantity and a multiple of it have the same interval in standard errors.
    assert found.quantile(unit[0]) == pytest.approx(found.quantile(-3.0 * unit[0]))
