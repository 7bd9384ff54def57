"""A covariance that goes along from one fraction to its submodels."""

import numpy as np
import pytest

from ctid_cli.inference.bounds import ParameterAccuracy
from ctid_cli.models.additive import AdditiveModel, Submodel, Term
from ctid_cli.models.factoring import factored, factored_jacobian, unfactored, unfactored_jacobian
from ctid_cli.models.transfer_function import TransferFunction

MODEL = AdditiveModel([Submodel([0.3, 3.0], [0.25, 0.25, 1.0]), Submodel([0.5], [0.2, 1.0])], 0.4)


def spread(size):
    root = np.random.default_rng(2).standard_normal((size, size))
    return root @ root.T


def test_names_and_values():
    fraction = unfactored(MODEL)
    found = ParameterAccuracy.of(fraction, spread(7), delay=True)
    assert found.names == ("a1", "a2", "a3", "b0", "b1", "b2", "delay")
    np.testing.assert_array_equal(found.values, [*fraction.denominator[1:], *fraction.numerator, 0.4])
    found = ParameterAccuracy.of(TransferFunction([3.0], [1.0, 1.0, 2.0]), spread(4), zeros=1)
    assert found.names == ("a1", "a2", "b0", "b1")
    np.testing.assert_array_equal(found.values, [1, 2, 0, 3])
    assert ParameterAccuracy.of(MODEL, spread(6)).names == MODEL.names


@pytest.mark.parametrize("delay", [0, 1])
def test_factoring_undoes_the_sum(delay):
    # The covariance of the sum's coefficients, from that of the submodels, leads back to it.
    jacobian = unfactored_jacobian(MODEL)
    jacobian = np.block([[jacobian, np.zeros((6, delay))], [np.zeros((delay, 6)), np.eye(delay)]])
    expected = spread(6 + delay)
    model = unfactored(MODEL)
    accuracy = ParameterAccuracy.of(model, jacobian @ expected @ jacobian.T, delay=bool(delay))
    back = accuracy.factored()
    assert back.names == MODEL.names + ("delay",) * delay
    np.testing.assert_allclose(back.values, [*MODEL.theta, *[0.4] * delay], rtol=1e-12)
    np.testing.assert_allclose(back.covariance, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(back.standard_errors, np.sqrt(np.diag(expected)), rtol=1e-9)
    assert back.factored() is back


def test_terms_choose_the_submodels():
    model = TransferFunction([3.0, 5.0], [1.0, 3.0, 2.0])
    accuracy = ParameterAccuracy.of(model, spread(4))
    assert accuracy.factored().names == ("g1_a1", "g1_b0", "g2_a1", "g2_b0")
    terms = (Term(2, 1),)
    together = accuracy.factored(terms)
    assert together.names == ("g1_a1", "g1_a2", "g1_b0", "g1_b1")
    np.testing.assert_allclose(together.values, factored(model, terms).theta)


def test_a_direct_feedthrough():
    model = TransferFunction([0.2, 3.0, 5.0], [1.0, 3.0, 2.0])
    found = ParameterAccuracy.of(model, spread(5)).factored()
    assert found.names == ("g1_a1", "g1_b0", "g2_a1", "g2_b0", "g3_b0")
    jacobian = factored_jacobian(model, factored(model))
    np.testing.assert_allclose(found.covariance, jacobian @ spread(5) @ jacobian.T, rtol=1e-9)
