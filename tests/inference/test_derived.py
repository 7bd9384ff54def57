"""Derived quantities of models and of submodels: derivatives against central differences, values by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.inference.derived import derived_parameters
from ctid_cli.inference.uncertainty import Uncertainty
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.transfer_function import TransferFunction

TWO_MODES = AdditiveModel([Submodel([3.0], [0.25, 0.25, 1.0]), Submodel([1.0], [0.025, 0.01, 1.0])])
SUM = AdditiveModel(
    [
        Submodel([2.0, 1.0], [0.5, 1.0], integrators=1),
        Submodel([0.3, 2.0], np.poly([-0.2, -1.0, -8.0, -3 + 4j, -3 - 4j]).real),
        Submodel([0.5], [0.025, 0.01, 1.0]),
        Submodel([1.0], [0.1, 0.8, 1.0]),
        Submodel([0.2], [1.0]),
    ]
)
MODELS = {
    "fraction": TransferFunction([-6400.0, 1600.0], [1.0, 5.0, 408.0, 416.0, 1600.0]),
    "fraction, real poles": TransferFunction([3.0], np.poly([-0.2, -5.0, -1 + 2j, -1 - 2j]).real),
    "two modes": TWO_MODES,
    "sum": SUM,
}


def by_name(model, covariance, **options):
    law = Uncertainty.known(np.asarray(covariance))
    return {row.name: row for row in derived_parameters(model, law, **options)}


def theta_of(model):
    if isinstance(model, AdditiveModel):
        return model.theta
    return np.concatenate((model.denominator[1:], model.numerator))


def moved(model, theta):
    if isinstance(model, AdditiveModel):
        return AdditiveModel.from_theta(theta, model.terms)
    return TransferFunction(theta[model.order :], np.append(1.0, theta[: model.order]))


def random_covariance(model, relative=1e-6):
    theta = theta_of(model)
    root = np.random.default_rng(1).standard_normal((theta.size, theta.size)) * relative * np.abs(theta)[:, None]
    return root @ root.T


@pytest.mark.parametrize("name", MODELS)
def test_every_standard_error_is_that_of_central_differences(name):
    model = MODELS[name]
    theta, covariance = theta_of(model), random_covariance(model)
    rows = by_name(model, covariance)
    finite = [name for name, row in rows.items() if not row.reason]
    assert set(rows) - set(finite) == ({"g1_static_gain"} if model is SUM else set())

    def values(theta):
        found = by_name(moved(model, theta), covariance)
        return np.array([found[name].estimate for name in finite])

    steps = np.diag(1e-5 * np.abs(theta))
    gradients = np.array([(values(theta + step) - values(theta - step)) / (2 * step.sum()) for step in steps]).T
    expected = np.sqrt(np.einsum("ij,jk,ik->i", gradients, covariance, gradients))
    np.testing.assert_allclose([rows[name].standard_error for name in finite], expected, rtol=1e-5)


@given(st.floats(0.05, 0.95), st.floats(1e-3, 1e3))
def test_second_order_in_closed_form(damping, frequency):
    a1, a2 = 2 * damping * frequency, frequency**2
    covariance = np.diag([1e-3 * a1, 1e-3 * a2, 1e-3]) ** 2
    rows = by_name(TransferFunction([1.0], [1.0, a1, a2]), covariance)
    assert rows["natural_frequency_1"].estimate == pytest.approx(frequency, rel=1e-9)
    # w = sqrt(a2), zeta = a1 / (2 sqrt(a2))
    assert rows["natural_frequency_1"].standard_error == pytest.approx(frequency * 0.5e-3, rel=1e-6)
    assert rows["natural_frequency_1_hz"].standard_error == pytest.approx(frequency * 0.5e-3 / (2 * np.pi), rel=1e-6)
    assert rows["damping_1"].estimate == pytest.approx(damping, rel=1e-9)
    assert rows["damping_1"].standard_error == pytest.approx(damping * 1e-3 * np.sqrt(1.25), rel=1e-6)
    assert rows["pole_1_real"].standard_error == pytest.approx(0.5e-3 * a1, rel=1e-6)


def test_near_repeated_poles_are_undetermined():
    a = np.poly([-1.0, -1.1, -20.0])
    tight = by_name(TransferFunction([1.0], a), np.diag([1e-8, 1e-8, 1e-8, 1e-4]))
    assert not any(row.reason for row in tight.values())
    loose = by_name(TransferFunction([1.0], a), np.diag([1e-4, 1e-2, 1e-2, 1e-4]))
    assert loose["pole_1"].reason == ""  # far away at -20
    for k in (2, 3):
        for name in (f"pole_{k}", f"time_constant_{k}"):
            assert "cannot distinguish it from another pole" in loose[name].reason
            assert np.isnan([loose[name].standard_error, loose[name].low, loose[name].high]).all()
    assert np.isfinite(loose["static_gain"].standard_error)
    exact = by_name(TransferFunction([1.0], [1.0, 2.0, 1.0]), np.diag([1e-20, 1e-20, 1e-20]))
    assert all("another pole" in row.reason for name, row in exact.items() if name != "static_gain")


def test_integrators_and_undefined_covariances_have_reasons():
    fraction = by_name(TransferFunction([1.0], [1.0, 2.0, 0.0]), np.diag([1e-4, 1e-4, 1e-4]))
    assert fraction["time_constant_2"].estimate == np.inf
    assert "origin" in fraction["time_constant_2"].reason
    for gain in (fraction["static_gain"], by_name(SUM, random_covariance(SUM))["g1_static_gain"]):
        assert gain.estimate == np.inf
        assert "integrates" in gain.reason
        assert np.isnan(gain.standard_error)
    for model, size in ((TransferFunction([1.0], [1.0, 2.0]), 2), (TWO_MODES, 6)):
        rows = by_name(model, np.full((size, size), np.nan))
        assert all("not determine" in row.reason and np.isnan(row.standard_error) for row in rows.values())
