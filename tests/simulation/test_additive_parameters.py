"""Estimates of one fraction converted to submodel parameters: values, errors, and missing results."""

from dataclasses import dataclass

import numpy as np
import pytest

from ctid_cli.inference.intervals import normal_quantile
from ctid_cli.inference.uncertainty import BootstrapT, Uncertainty
from ctid_cli.models.additive import AdditiveModel, Submodel, Term
from ctid_cli.models.factoring import factored, factored_jacobian, unfactored
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.simulation.dataset import additive_parameters

MODES = AdditiveModel([Submodel([0.1, 3.0], [0.25, 0.25, 1.0]), Submodel([0.02, 1.0], [0.025, 0.01, 1.0])])
TERMS = (Term(2, 0), Term(2, 0))


@dataclass
class FractionFit:
    model: TransferFunction
    parameter_names: tuple[str, ...]
    covariance: np.ndarray
    law: Uncertainty | None = None


def fraction_fit(model=MODES, names=None):
    fraction = unfactored(model)
    n, m = fraction.order, fraction.numerator.size - 1
    names = names or (*(f"a{k}" for k in range(1, n + 1)), *(f"b{k}" for k in range(m + 1)))
    root = np.random.default_rng(3).standard_normal((len(names), len(names)))
    scale = 1e-3 * np.abs([*fraction.denominator[1:], *fraction.numerator, 1.0][: len(names)])
    return FractionFit(fraction, names, scale[:, None] * (root @ root.T) * scale)


def test_errors_are_those_of_perturbed_coefficients():
    fit = fraction_fit()
    parameters, errors, quantiles = additive_parameters(fit, TERMS)
    assert parameters == pytest.approx(MODES.parameters, rel=1e-10)
    assert quantiles == dict.fromkeys(parameters, normal_quantile())
    coefficients = np.concatenate((fit.model.denominator[1:], fit.model.numerator))
    columns = []
    for k, value in enumerate(coefficients):
        ends = []
        for sign in (1, -1):
            moved = coefficients.copy()
            moved[k] += sign * 1e-6 * abs(value)
            ends.append(factored(TransferFunction(moved[4:], np.append(1.0, moved[:4])), TERMS).theta)
        columns.append((ends[0] - ends[1]) / (2e-6 * abs(value)))
    jacobian = np.array(columns).T
    expected = np.sqrt(np.diag(jacobian @ fit.covariance @ jacobian.T))
    np.testing.assert_allclose(list(errors.values()), expected, rtol=1e-5)


def test_the_order_of_the_covariance_and_an_estimated_delay_do_not_matter():
    fit = fraction_fit()
    order = [4, 5, 6, 7, 0, 3, 2, 1]
    names = (*(fit.parameter_names[k] for k in order), "delay")
    covariance = np.pad(fit.covariance[np.ix_(order, order)], (0, 1), constant_values=7.0)
    shuffled = FractionFit(fit.model, names, covariance)
    assert additive_parameters(shuffled, TERMS)[1] == pytest.approx(additive_parameters(fit, TERMS)[1], rel=1e-9)


def test_quantiles_are_those_of_each_parameter():
    fit = fraction_fit()
    rng, size = np.random.default_rng(4), len(fit.parameter_names)
    # The delay is a parameter of the fraction, not of the submodels.
    draws = BootstrapT(rng.standard_normal((60, size + 1)), np.broadcast_to(np.eye(size + 1), (60, size + 1, size + 1)))
    law = Uncertainty("bootstrap", np.eye(size + 1), np.eye(size + 1), 100.0, draws)
    covariance = np.pad(fit.covariance, ((1, 0), (1, 0)))
    found = additive_parameters(FractionFit(fit.model, ("delay", *fit.parameter_names), covariance, law), TERMS)
    model = factored(fit.model, TERMS)
    jacobian = factored_jacobian(fit.model, model)
    expected = [law.quantile(np.concatenate(([0.0], row))) for row in jacobian]
    np.testing.assert_allclose([*found.quantiles.values()], expected, rtol=1e-12)


def test_undefined_errors_are_not_finite():
    fit = fraction_fit()
    fit.covariance[:] = np.nan
    assert np.isnan(list(additive_parameters(fit, TERMS)[1].values())).all()
    # A numerator without its leading coefficient: the parameters do not match those of the model.
    fit = fraction_fit(AdditiveModel([Submodel([3.0], [0.25, 0.25, 1.0]), Submodel([1.0], [0.025, 0.01, 1.0])]))
    fit.parameter_names = (*fit.parameter_names, "b3")
    assert np.isnan(list(additive_parameters(fit, TERMS)[1].values())).all()


def test_a_sum_of_submodels_is_what_it_is():
    @dataclass
    class AdditiveFit:
        additive: AdditiveModel

    assert additive_parameters(AdditiveFit(MODES), TERMS) == (MODES.parameters, {}, {})


@pytest.mark.parametrize(
    ("denominator", "terms"),
    [
        ([1.0, 2.0, 1.0], (Term(2, 0),)),  # a repeated pole
        ([1.0, 2.0, 3.0], TERMS),  # another number of poles
        ([1.0, 2.0, 3.0], (Term(1, 0), Term(1, 0))),  # complex poles in two submodels
        ([1.0, 2.0, 3.0], (Term(1, 0), Term(0, 0, 1))),  # no integrator
        ([1.0, 2.0, 3.0], None),  # not requested
        ([1.0, 1e200, 1e-200], (Term(2, 0),)),  # no poles in double precision
    ],
)
def test_fractions_that_have_no_such_submodels(denominator, terms):
    fit = FractionFit(TransferFunction([1.0], denominator), ("a1", "a2", "b0"), np.eye(3))
    assert additive_parameters(fit, terms) == (None, {}, {})
