"""Noise model of the standard errors, in every estimator with the option."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter

from ctid_cli.errors import DataError
from ctid_cli.estimation.common import Start
from ctid_cli.estimators.additive_srivc import AdditiveSrivc
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.srivc import Srivc
from ctid_cli.estimators.td_srivc import TdSrivc
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.fit import Status
from ctid_cli.inference.intervals import student_quantile
from ctid_cli.inference.uncertainty import Uncertainty
from ctid_cli.models.additive import Term
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from ctid_cli.storage.result_file import decoded, encoded

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


@cache
def fitted(name, colour, covariance, feedback=False, **options):
    start = Start(delay=0.3) if name == "td_srivc" else None
    given = replace(record(colour), feedback=feedback)
    return ESTIMATORS[name](covariance=covariance, **options).fit(given, start)


def errors(name, colour, covariance):
    return np.array([*fitted(name, colour, covariance).standard_errors.values()])


@pytest.mark.parametrize("name", ESTIMATORS)
def test_auto_is_white_unless_the_residuals_are_not(name):
    np.testing.assert_allclose(errors(name, 0.0, "auto"), errors(name, 0.0, "white"), rtol=1e-9)
    coloured = errors(name, 0.9, "robust")
    np.testing.assert_array_equal(errors(name, 0.9, "auto"), coloured)
    np.testing.assert_array_equal(errors(name, 0.9, "sandwich"), coloured)
    assert (coloured[:2] > 1.5 * errors(name, 0.9, "white")[:2]).all()


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_bootstrap_has_the_robust_errors_and_quantiles_of_its_own(name):
    robust, found = (fitted(name, 0.9, kind, bootstrap_draws=50) for kind in ("robust", "bootstrap"))
    assert found.standard_errors == robust.standard_errors
    assert len(set(found.quantiles.values())) > 1
    assert all(0.6 < found.quantiles[key] / value < 1.7 for key, value in robust.quantiles.items())
    # A quantity and a multiple of it have the same interval in standard errors.
    row = np.eye(len(found.parameters))[0]
    assert found.law.quantile(row) == pytest.approx(found.law.quantile(-3.0 * row))


@pytest.mark.parametrize("name", ESTIMATORS)
def test_intervals_are_those_of_student(name):
    white, coloured = fitted(name, 0.0, "auto"), fitted(name, 0.9, "auto")
    size = len(white.parameters)
    expected = dict.fromkeys(white.parameters, student_quantile(white.count - size))
    assert white.quantiles == pytest.approx(expected, rel=1e-9)
    law = coloured.law
    freedom = (
        2.0
        * np.diag(law.covariance) ** 2
        / [np.sum([(row @ change @ row) ** 2 for change in law.variation]) for row in law.tangent]
    )
    assert (freedom[:2] < 200).all()
    assert [*coloured.quantiles.values()] == pytest.approx([student_quantile(each) for each in freedom], rel=1e-9)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_fit_that_ignores_a_loop_has_no_errors_where_residuals_are_coloured(name):
    found = fitted(name, 0.9, "auto", feedback=True)
    assert (found.law.kind, found.status) == ("biased", Status.CONVERGED)
    assert np.isnan([*found.standard_errors.values()]).all()
    assert fitted(name, 0.9, "robust", feedback=True).standard_errors == fitted(name, 0.9, "robust").standard_errors
    assert fitted(name, 0.0, "auto", feedback=True).standard_errors == fitted(name, 0.0, "auto").standard_errors


def test_files_of_earlier_versions_have_the_degrees_of_freedom_of_their_number_of_samples():
    law = fitted("delay_profile", 0.9, "auto").law
    content = encoded(law)
    del content["variation"]
    content["effective_count"] = 33.0
    found = decoded(content, Uncertainty, "law")
    assert found.quantiles() == pytest.approx(student_quantile(30.0), rel=1e-9)
    with pytest.raises(DataError, match="law is not what a fit has there"):
        decoded(content | {"effective_count": "many"}, Uncertainty, "law")
