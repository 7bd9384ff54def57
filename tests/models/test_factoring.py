"""Conversion between one fraction and a sum of submodels, with derivatives in both directions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.errors import DataError
from ctid_cli.models.additive import AdditiveModel, Submodel, Term
from ctid_cli.models.factoring import factored, factored_jacobian, unfactored, unfactored_jacobian
from ctid_cli.models.transfer_function import TransferFunction
from tests.filtering.plants import FOUR_MODES

TWO_MODES = AdditiveModel([Submodel([3.0], [0.25, 0.25, 1.0]), Submodel([1.0], [0.025, 0.01, 1.0])], delay=0.3)
FLEXIBLE = Submodel([0.1, 1.0], [0.025, 0.01, 1.0])
MODELS = {
    "two modes": TWO_MODES,
    "four modes": FOUR_MODES,
    "real poles": AdditiveModel([Submodel([k], [k, 1.0]) for k in (100.0, 3.0, 0.2, 0.001)]),
    "integrator with a lag": AdditiveModel([Submodel([2.0, 1.0], [0.5, 1.0], 1), FLEXIBLE]),
    "two integrators": AdditiveModel([Submodel([-0.7, 2.0], [1.0], 2), FLEXIBLE, Submodel([1.0], [3.0, 1.0])]),
    "three integrators": AdditiveModel([Submodel([0.2, 0.0, 2.0], [1.0], 3), FLEXIBLE]),
    "biproper mode": AdditiveModel([Submodel([0.3, 2.0, 1.0], [0.5, 1.0, 1.0]), FLEXIBLE]),
    "pure gain": AdditiveModel([FLEXIBLE, Submodel([0.3], [1.0])]),
    "paired real poles": AdditiveModel([Submodel([1.0, 2.0], np.poly([-0.1, -0.4])), FLEXIBLE]),
    "unstable": AdditiveModel([Submodel([1.0], [-2.0, 1.0]), FLEXIBLE]),
}


def completed(model):
    """Return the model with numerators of the length of a partial fraction."""
    submodels = []
    for part in model.sorted().submodels:
        b = np.concatenate((np.zeros(max(part.order - part.numerator.size, 0)), part.numerator))
        submodels.append(Submodel(b, part.denominator, part.integrators))
    return AdditiveModel(submodels, model.delay)


def coefficients(fraction, length=None):
    """Return ``a_1 … a_n`` and the numerator, padded to a length."""
    length = length or fraction.numerator.size
    padding = np.zeros(length - fraction.numerator.size)
    return np.concatenate((fraction.denominator[1:], padding, fraction.numerator))


def central_differences(function, x, steps):
    """Return derivatives by five points, which allow large steps; zero where the step is zero."""
    columns = []
    for step in np.diag(steps):
        one, two = function(x + step) - function(x - step), function(x + 2 * step) - function(x - 2 * step)
        columns.append((8 * one - two) / (12 * step.sum()) if step.any() else 0 * one)
    return np.array(columns).T


def test_two_modes_by_hand():
    fraction = unfactored(TWO_MODES)
    antimonic = 1.0 / fraction.denominator[-1]
    np.testing.assert_allclose(antimonic * fraction.denominator[-2::-1], [0.26, 0.2775, 0.00875, 0.00625], rtol=1e-14)
    np.testing.assert_allclose(antimonic * fraction.numerator[::-1], [4.0, 0.28, 0.325], rtol=1e-14)
    assert (fraction.order, fraction.relative_degree, fraction.delay) == (4, 2, 0.3)


@pytest.mark.parametrize("name", MODELS)
def test_unfactored_model_is_the_same_function(name):
    model = MODELS[name]
    fraction = unfactored(model)
    w = np.logspace(-2, 2, 15)
    np.testing.assert_allclose(fraction.frequency_response(w), model.frequency_response(w), rtol=1e-10)
    assert fraction.denominator[0] == 1.0
    assert fraction.relative_degree == min(part.relative_degree for part in model.submodels)


@pytest.mark.parametrize("name", MODELS)
def test_round_trip(name):
    model = MODELS[name]
    result, expected = factored(unfactored(model), model.terms), completed(model)
    assert [(t.poles, t.zeros, t.integrators) for t in result.terms] == [
        (t.poles, t.zeros, t.integrators) for t in expected.terms
    ]
    assert result.delay == model.delay
    for one, other in zip(result.submodels, expected.submodels, strict=True):
        np.testing.assert_allclose(one.denominator, other.denominator, rtol=1e-12)
        # b_k in the mode's own unit of time, against the largest.
        unit = one.denominator[0] ** (1.0 / max(len(one.denominator) - 1, 1)) if one.denominator[0] > 0 else 1.0
        powers = unit ** -np.arange(one.numerator.size - 1.0, -1.0, -1.0)
        difference = np.abs(one.numerator - other.numerator) * powers
        assert difference.max() <= 1e-12 * (np.abs(other.numerator) * powers).max()


POLE = st.one_of(
    st.floats(0.05, 20.0).map(lambda p: [complex(-p)]),
    st.tuples(st.floats(0.05, 20.0), st.floats(0.2, 3.0)).map(
        lambda polar: [-polar[0] * np.exp(1j * polar[1] / 2), -polar[0] * np.exp(-1j * polar[1] / 2)]
    ),
)


@given(st.lists(POLE, min_size=1, max_size=4), st.integers(0, 2**31), st.integers(0, 2), st.integers(0, 1))
def test_default_factors_add_up(poles, seed, integrators, direct):
    p = np.concatenate(poles)
    distances = np.abs(p[:, None] - p) + 100 * np.eye(p.size)
    if distances.min() < 0.05 * np.abs(p).max():  # partial fractions of near multiples are large and cancel
        return
    a = np.concatenate((np.poly(p).real, np.zeros(integrators)))
    b = np.random.default_rng(seed).standard_normal(a.size - 1 + direct)
    fraction = TransferFunction(b, a, delay=0.1)
    result = factored(fraction)
    w = np.logspace(-2, 2, 9)
    expected = fraction.frequency_response(w)
    parts = np.sum([np.abs(part.frequency_response(w)) for part in result.submodels], axis=0)
    assert (np.abs(result.frequency_response(w) - expected) <= 1e-9 * parts).all()
    assert [t.poles for t in result.terms].count(2) == sum(len(pole) == 2 for pole in poles)
    assert sum(t.integrators for t in result.terms) == integrators
    assert all(t.poles == 0 for t in result.terms if t.integrators)
    assert [t for t in result.terms if t.order == 0] == [Term(0, 0)] * direct
    assert result.order_of_sorting == tuple(range(len(result.submodels)))


def test_terms_pair_neighbouring_real_poles_and_leave_pairs_together():
    a = np.poly([-0.1, -1.0, -5.0, -40.0, -2 + 3j, -2 - 3j]).real
    fraction = TransferFunction([1.0, 7.0], a)
    result = factored(fraction, [Term(2, 0), Term(1, 0), Term(2, 0), Term(1, 0)])
    groups = [sorted(np.round(part.poles, 9), key=abs) for part in result.submodels]
    # The pair is assigned to the first term with two poles; real poles fill the others, slowest first.
    assert groups == [[-0.1], [-1.0, -5.0], [-2 - 3j, -2 + 3j], [-40.0]]
    w = np.array([0.05, 1.0, 20.0])
    np.testing.assert_allclose(result.frequency_response(w), fraction.frequency_response(w), rtol=1e-10)
    whole = factored(fraction, [Term(6, 1)]).submodels[0]
    np.testing.assert_allclose(whole.transfer_function().denominator, a, rtol=1e-12)
    np.testing.assert_allclose(whole.numerator[-2:], np.array([1.0, 7.0]) / a[-1], rtol=1e-9)


def test_feedthrough_goes_to_the_term_that_can_hold_it():
    fraction = unfactored(MODELS["biproper mode"])
    assert factored(fraction, [Term(2, 0), Term(2, 2)]).terms == (Term(2, 1), Term(2, 2))
    assert factored(fraction, [Term(2, 1), Term(2, 1), Term(0, 0)]).terms == (Term(2, 1), Term(2, 1), Term(0, 0))
    # Without a feedthrough nothing is removed.
    assert factored(unfactored(TWO_MODES), [Term(2, 2), Term(2, 0)]).terms == (Term(2, 1), Term(2, 1))
    assert factored(fraction).submodels[-1].numerator == pytest.approx(fraction.numerator[0])


@pytest.mark.parametrize("name", MODELS)
def test_unfactored_jacobian_is_that_of_central_differences(name):
    model = MODELS[name]
    jacobian = unfactored_jacobian(model)
    length = len(jacobian) - model.order
    assert length == model.order + any(part.relative_degree == 0 for part in model.submodels)

    def function(theta):
        return coefficients(unfactored(AdditiveModel.from_theta(theta, model.terms)), length)

    theta = model.theta
    expected = central_differences(function, theta, 1e-3 * np.where(theta == 0, 1.0, np.abs(theta)))
    scale = np.abs(expected).max(axis=1, keepdims=True)
    assert jacobian.shape == expected.shape
    assert (np.abs(jacobian - expected) <= 1e-8 * scale).all()


@pytest.mark.parametrize("name", MODELS)
def test_factored_jacobian_is_that_of_central_differences(name):
    model = MODELS[name]
    fraction = unfactored(model)
    n, x = fraction.order, coefficients(fraction)
    jacobian = factored_jacobian(fraction, factored(fraction, model.terms))

    def function(x):
        return factored(TransferFunction(x[n:], np.append(1.0, x[:n])), model.terms).theta

    # Poles at the origin stay there: their coefficients are not varied.
    expected = central_differences(function, x, 1e-4 * np.abs(x))
    assert jacobian.shape == expected.shape
    # Rows in units of their largest derivative, columns in units of their coefficient.
    expected, result = expected * np.abs(x), jacobian * np.abs(x)
    scale = np.abs(expected).max(axis=1, keepdims=True)
    assert (np.abs(result - expected) <= 3e-6 * scale).all()


@pytest.mark.parametrize(
    ("fraction", "terms", "message"),
    [
        (TransferFunction([1.0], [1.0, 2.0, 1.0]), None, r"pole at -1\S* rad/s is repeated"),
        (TransferFunction([1.0], np.poly([-1 + 2j, -1 - 2j] * 2).real), None, "is repeated"),
        (TransferFunction([1.0, 0.0, 0.0], [1.0, 2.0]), None, "more zeros than poles"),
        (unfactored(TWO_MODES), [Term(2, 0)], "the terms have 2 poles and 0 integrators"),
        (unfactored(TWO_MODES), [Term(2, 0), Term(2, 0, 1)], "1 integrators, the latter in 1 of them; the model has 4"),
        (unfactored(MODELS["two integrators"]), [Term(0, 0, 1), Term(1, 0, 1), Term(2, 0)], "must be in one term"),
        (unfactored(TWO_MODES), [Term(2, 0), Term(1, 0), Term(1, 0)], "2 complex pairs of poles, .* allow 1"),
        (unfactored(MODELS["biproper mode"]), [Term(2, 1), Term(2, 1)], "must be biproper; 0 of the terms are"),
    ],
)
def test_what_is_no_such_sum_is_refused(fraction, terms, message):
    with pytest.raises(DataError, match=message):
        factored(fraction, terms)
