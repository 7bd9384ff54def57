"""A covariance that goes along from one fraction to its submodels."""

import numpy as np
import pytest

from ctid_cli.inference.accuracy import ParameterAccuracy, estimated_parameters
from ctid_cli.models.additive import AdditiveModel, Submodel, Term
from ctid_cli.models.factoring import FactoringError, factored, factored_jacobian, unfactored, unfactored_jacobian
from ctid_cli.models.transfer_function import TransferFunction

MODEL = AdditiveModel([Submodel([0.3, 3.0], [0.25, 0.25, 1.0]), Submodel([0.5], [0.2, 1.0])], 0.4)


def spread(size):
    root = np.random.default_rng(2).standard_normal((size, size))
    return root @ root.T


def test_names_and_values():
    names, values = estimated_parameters(unfactored(MODEL), delay=True)
    assert names == ("a1", "a2", "a3", "b0", "b1", "b2", "delay")
    fraction = unfactored(MODEL)
    np.testing.assert_array_equal(values, [*fraction.denominator[1:], *fraction.numerator, 0.4])
    names, values = estimated_parameters(TransferFunction([3.0], [1.0, 1.0, 2.0]), zeros=1)
    assert names == ("a1", "a2", "b0", "b1")
    np.testing.assert_array_equal(values, [1, 2, 0, 3])
    assert estimated_parameters(MODEL)[0] == MODEL.names
    for options in ({"zeros": 2}, {"delay": True}):
        with pytest.raises(ValueError, match="leave both out"):
            estimated_parameters(MODEL, **options)
    with pytest.raises(ValueError, match="zeros must be from 2, as the model has, to its 3 poles; got 1"):
        estimated_parameters(unfactored(MODEL), zeros=1)
    with pytest.raises(ValueError, match="got 4"):
        estimated_parameters(unfactored(MODEL), zeros=4)


@pytest.mark.parametrize("delay", [0, 1])
def test_factoring_undoes_the_sum(delay):
    # The covariance of the sum's coefficients, from that of the submodels, leads back to it.
    jacobian = unfactored_jacobian(MODEL)
    jacobian = np.block([[jacobian, np.zeros((6, delay))], [np.zeros((delay, 6)), np.eye(delay)]])
    expected = spread(6 + delay)
    model = unfactored(MODEL)
    names, values = estimated_parameters(model, delay=bool(delay))
    accuracy = ParameterAccuracy(model, names, values, jacobian @ expected @ jacobian.T)
    back = accuracy.factored()
    assert back.names == MODEL.names + ("delay",) * delay
    np.testing.assert_allclose(back.values, [*MODEL.theta, *[0.4] * delay], rtol=1e-12)
    np.testing.assert_allclose(back.covariance, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(back.standard_errors, np.sqrt(np.diag(expected)), rtol=1e-9)
    assert back.factored() is back


def test_terms_choose_the_submodels():
    model = TransferFunction([3.0, 5.0], [1.0, 3.0, 2.0])
    names, values = estimated_parameters(model)
    accuracy = ParameterAccuracy(model, names, values, spread(4))
    assert accuracy.factored().names == ("g1_a1", "g1_b0", "g2_a1", "g2_b0")
    terms = (Term(2, 1),)
    together = accuracy.factored(terms)
    assert together.names == ("g1_a1", "g1_a2", "g1_b0", "g1_b1")
    np.testing.assert_allclose(together.values, factored(model, terms).theta)


def test_a_direct_feedthrough():
    model = TransferFunction([0.2, 3.0, 5.0], [1.0, 3.0, 2.0])
    names, values = estimated_parameters(model)
    found = ParameterAccuracy(model, names, values, spread(5)).factored()
    assert found.names == ("g1_a1", "g1_b0", "g2_a1", "g2_b0", "g3_b0")
    jacobian = factored_jacobian(model)
    np.testing.assert_allclose(found.covariance, jacobian @ spread(5) @ jacobian.T, rtol=1e-9)
    strictly_proper = TransferFunction([3.0, 5.0], [1.0, 3.0, 2.0])
    names, values = estimated_parameters(strictly_proper, zeros=2)
    with pytest.raises(FactoringError, match="no room for a direct feedthrough"):
        ParameterAccuracy(strictly_proper, names, values, spread(5)).factored()
