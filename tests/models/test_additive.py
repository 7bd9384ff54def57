"""Sums of submodels: parameters, properties, and refused sums."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.errors import DataError
from ctid_cli.models.additive import AdditiveModel, Submodel, Term

SLOW = Submodel([3.0], [0.25, 0.25, 1.0])
FAST = Submodel([1.0], [0.025, 0.01, 1.0])
REAL = Submodel([0.5, 2.0], [0.1, 1.0])
RIGID = Submodel([4.0], [1.0], integrators=2)
POSITIVE = st.floats(0.1, 10.0)


@given(st.lists(POSITIVE, min_size=1, max_size=3), st.lists(POSITIVE, min_size=3, max_size=5), POSITIVE)
def test_common_factor_of_the_coefficients_does_not_matter(numerator, denominator, factor):
    plain = Submodel(numerator, denominator)
    scaled = Submodel(-factor * np.array(numerator), -factor * np.array(denominator))
    assert plain.denominator[-1] == scaled.denominator[-1] == 1.0
    np.testing.assert_allclose(scaled.denominator, plain.denominator, rtol=1e-14)
    np.testing.assert_allclose(scaled.numerator, plain.numerator, rtol=1e-14)


@pytest.mark.parametrize("submodel", [SLOW, REAL, RIGID, Submodel([1.0, 2.0], [0.5, 1.0], 1), Submodel([7.0], [2.0])])
def test_submodel_is_its_transfer_function(submodel):
    fraction = submodel.transfer_function()
    w = np.logspace(-2, 2, 9)
    np.testing.assert_allclose(submodel.frequency_response(w), fraction.frequency_response(w), rtol=1e-12)
    assert fraction.denominator[0] == 1.0
    np.testing.assert_allclose(submodel.poles, fraction.poles, rtol=1e-12)
    assert (submodel.order, submodel.relative_degree) == (fraction.order, fraction.relative_degree)
    assert submodel.dc_gain == pytest.approx(fraction.dc_gain)


def test_order_frequency_and_stability_by_hand():
    assert SLOW.natural_frequency == pytest.approx(2.0, rel=1e-14)
    assert REAL.natural_frequency == pytest.approx(10.0)
    assert (SLOW.order, SLOW.relative_degree, SLOW.dc_gain, SLOW.is_stable) == (2, 2, 3.0, True)
    assert (RIGID.order, RIGID.natural_frequency, RIGID.dc_gain, RIGID.poles.tolist()) == (2, 0.0, np.inf, [0, 0])
    # Integrators are ignored; an undamped pair is not stable.
    assert RIGID.is_stable
    assert not Submodel([1.0], [1.0, 0.0, 1.0]).is_stable
    assert not Submodel([1.0], [-0.1, 1.0], integrators=1).is_stable
    gain = Submodel([6.0], [2.0])
    assert (gain.order, gain.natural_frequency, gain.dc_gain) == (0, np.inf, 3.0)


def test_parameters_rise_with_the_power_of_p():
    # (0.5 p + 2)/(0.1 p + 1) + (p^2/10 + 3)/(p (p^2/4 + p/2 + 1))
    model = AdditiveModel([REAL, Submodel([0.1, 0.0, 3.0], [0.25, 0.5, 1.0], integrators=1)])
    assert model.parameters == {
        "g1_a1": 0.1,
        "g1_b0": 2.0,
        "g1_b1": 0.5,
        "g2_a1": 0.5,
        "g2_a2": 0.25,
        "g2_b0": 3.0,
        "g2_b1": 0.0,
        "g2_b2": 0.1,
    }
    assert model.names == tuple(model.parameters)
    assert model.theta.tolist() == list(model.parameters.values())
    assert model.terms == (Term(1, 1), Term(2, 2, integrators=1))
    assert [term.size for term in model.terms] == [3, 5]


TERM = st.builds(lambda poles, missing: Term(poles, max(poles - missing, 0)), st.integers(1, 3), st.integers(1, 3))
RIGID_TERM = st.sampled_from([Term(0, 0, 1), Term(0, 1, 2), Term(1, 2, 1), Term(0, 0, 0)])


@given(st.lists(TERM, max_size=3), RIGID_TERM, st.integers(0, 2**31), st.floats(0, 5))
def test_theta_and_structure_make_the_model(others, rigid, seed, delay):
    terms = [*others, rigid]
    theta = np.random.default_rng(seed).uniform(0.5, 2.0, sum(term.size for term in terms))
    model = AdditiveModel.from_theta(theta, terms, delay)
    assert np.array_equal(model.theta, theta)
    assert model.terms == tuple(terms)
    assert model.delay == delay


def test_a_leading_coefficient_of_zero_keeps_its_place():
    model = AdditiveModel.from_theta([1.0, 0.5, 2.0, 0.0, 0.2, 1.0], [Term(2, 1), Term(1, 0)])
    assert model.submodels[0].numerator.tolist() == [0.0, 2.0]
    assert model.theta.tolist() == [1.0, 0.5, 2.0, 0.0, 0.2, 1.0]
    assert model.submodels[0].relative_degree == 1
    for size in (5, 7):
        with pytest.raises(ValueError, match=r"6 parameters in all; got an array of shape \(\d,\)"):
            AdditiveModel.from_theta(np.ones(size), [Term(2, 1), Term(1, 0)])


def test_sum_is_the_sum():
    model = AdditiveModel([SLOW, REAL, RIGID], delay=0.3)
    w = np.array([0.1, 1.0, 2.0, 30.0])
    by_hand = (3 / (0.25 * (1j * w) ** 2 + 0.25j * w + 1) + (0.5j * w + 2) / (0.1j * w + 1) - 4 / w**2) * np.exp(
        -0.3j * w
    )
    np.testing.assert_allclose(model.frequency_response(w), by_hand, rtol=1e-13)
    assert model.order == 5
    expected_poles = [-10.0, -0.5 - 1.9364916731j, -0.5 + 1.9364916731j, 0.0, 0.0]
    np.testing.assert_allclose(model.poles, expected_poles, rtol=1e-10)
    assert (model.dc_gain, AdditiveModel([SLOW, REAL]).dc_gain) == (np.inf, 5.0)
    # Integrators are marginally stable.
    assert (model.is_stable, model.is_marginally_stable) == (False, True)
    assert not AdditiveModel([SLOW, Submodel([1.0], [-1.0, 1.0])]).is_marginally_stable


def test_sorting_puts_slow_submodels_first():
    gain = Submodel([0.1], [1.0])
    model = AdditiveModel([FAST, gain, RIGID, SLOW], delay=0.4)
    ordered = model.sorted()
    assert model.order_of_sorting == (2, 3, 0, 1)
    assert ordered.submodels == (RIGID, SLOW, FAST, gain)
    assert (ordered.order_of_sorting, ordered.delay) == ((0, 1, 2, 3), 0.4)


@pytest.mark.parametrize(
    ("numerator", "denominator", "message"),
    [
        ([1.0], [], "lists of coefficients in descending powers"),
        ([1.0], [np.nan, 1.0], "not a finite number"),
        ([1.0], [0.0, 1.0], "first denominator coefficient of a submodel is zero"),
        ([1.0], [1.0, 0.0], "give poles at the origin as integrators"),
        ([1.0, 2.0, 3.0], [1.0, 2.0], r"more zeros \(2\) than poles \(1\)"),
    ],
)
def test_impossible_submodels_are_refused(numerator, denominator, message):
    with pytest.raises(DataError, match=message):
        Submodel(numerator, denominator)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ((-1, 0, 0), "number of poles of a submodel must be an integer of at least 0"),
        ((2, 0.5, 0), "number of zeros of a submodel must be an integer"),
        ((1, 2, 0), "got 2 zeros and 1 poles"),
    ],
)
def test_impossible_structures_are_refused(numbers, message):
    with pytest.raises(ValueError, match=message):
        Term(*numbers)
    assert Term(0, 1, 1).order == 1


@pytest.mark.parametrize(
    ("submodels", "delay", "message"),
    [
        ([], 0.0, "at least one submodel"),
        ([SLOW], -1.0, "zero or more; got -1.0"),
        ([SLOW], np.inf, "finite number of seconds"),
        (
            [SLOW, FAST, Submodel([9.0], [0.25, 0.25, 1.0])],
            0.0,
            r"g1 and g3 have the pole at -0.5[+-]1.936\d*j rad/s in",
        ),
        (
            [Submodel([1.0], np.poly([-2.0, -5.0])), Submodel([1.0], [1.0, 5.0])],
            0.0,
            "g1 and g2 have the pole at -5 rad/s in common",
        ),
        ([RIGID, Submodel([1.0], [1.0, 1.0], 1)], 0.0, "the pole at the origin in common"),
        ([REAL, SLOW, Submodel([1.0], [1.0])], 0.0, r"g1 and g3 are biproper \(as many zeros as poles\); at most one"),
    ],
)
def test_sums_that_do_not_determine_their_terms_are_refused(submodels, delay, message):
    with pytest.raises(DataError, match=message):
        AdditiveModel(submodels, delay)


def test_poles_close_to_each_other_may_belong_to_two_submodels():
    near = Submodel([1.0], [0.25 * (1 + 1e-5), 0.25, 1.0])
    assert AdditiveModel([SLOW, near]).order == 4
    # A double root of rounded coefficients becomes two roots 1e-8 apart.
    with pytest.raises(DataError, match="in common"):
        AdditiveModel([Submodel([1.0], np.poly([-0.3, -0.3])), Submodel([1.0], [1.0, 0.3])])


def test_closeness_of_poles_is_a_matter_of_proportion():
    assert AdditiveModel([Submodel([1.0], [constant, 1.0]) for constant in (1e9, 2e9)]).order == 2
    with pytest.raises(DataError, match="in common"):
        AdditiveModel([Submodel([1.0], [constant, 1.0]) for constant in (1e-9, 1e-9 * (1 + 1e-9))])
