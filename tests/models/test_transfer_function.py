"""Transfer functions: normal form and derived properties."""

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.errors import DataError
from ctid_cli.models.transfer_function import TransferFunction

COEFFICIENT = st.floats(0.1, 10.0)


@given(st.lists(COEFFICIENT, min_size=1, max_size=4), st.lists(COEFFICIENT, min_size=4, max_size=6), COEFFICIENT)
def test_common_factor_of_the_coefficients_does_not_matter(numerator, denominator, factor):
    # B/A = (f B)/(f A), with the denominator monic either way.
    plain = TransferFunction(numerator, denominator)
    scaled = TransferFunction(factor * np.array(numerator), factor * np.array(denominator))
    assert plain.denominator[0] == scaled.denominator[0] == 1.0
    np.testing.assert_allclose(scaled.denominator, plain.denominator, rtol=1e-14)
    np.testing.assert_allclose(scaled.numerator, plain.numerator, rtol=1e-14)


@given(st.lists(COEFFICIENT, min_size=1, max_size=4), st.lists(COEFFICIENT, min_size=4, max_size=6), COEFFICIENT)
def test_frequency_response_is_that_of_python_control_times_the_delay(numerator, denominator, delay):
    frequencies = 0.97 * np.logspace(-2, 2, 9)  # off the poles of coefficients such as 1, 1, 1, 1
    expected = control.tf(numerator, denominator)(1j * frequencies) * np.exp(-1j * frequencies * delay)
    response = TransferFunction(numerator, denominator, delay).frequency_response(frequencies)
    np.testing.assert_allclose(response, expected, rtol=1e-10)


def test_leading_zeros_of_the_numerator_are_dropped():
    g = TransferFunction([0.0, 0.0, 3.0, 6.0], [2.0, 4.0, 8.0, 10.0])
    assert g.numerator.tolist() == [1.5, 3.0]
    assert (g.order, g.relative_degree) == (3, 2)
    assert TransferFunction([0.0, 0.0], [1.0, 2.0]).numerator.tolist() == [0.0]


def test_poles_and_zeros_are_the_roots_fastest_first():
    g = TransferFunction(np.poly([-2.0, 5.0]), np.poly([-0.5, -30.0, -3 + 4j, -3 - 4j]).real)
    np.testing.assert_allclose(g.poles, [-30.0, -3 - 4j, -3 + 4j, -0.5], rtol=1e-12)
    np.testing.assert_allclose(g.zeros, [5.0, -2.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("poles", "stable"), [([-1.0, -2.0], True), ([-1.0, 2.0], False), ([-1.0, 0.0], False), ([2j, -2j], False)]
)
def test_stability_is_a_strict_matter(poles, stable):
    assert TransferFunction([1.0], np.poly(poles).real).is_stable is stable


def test_dc_gain_is_the_response_at_zero_and_infinite_with_an_integrator():
    g = TransferFunction([3.0, 8.0], [1.0, 2.8, 4.0], delay=5.0)
    assert g.dc_gain == g.frequency_response(0.0).real == 2.0
    assert TransferFunction([1.0], [1.0, 0.0]).dc_gain == np.inf


def test_model_never_changes():
    numerator, denominator = np.array([2.0]), np.array([2.0, 4.0])
    g = TransferFunction(numerator, denominator)
    assert numerator.tolist() == [2.0]
    numerator[0] = denominator[1] = 99.0
    assert g.numerator.tolist() == [1.0]
    assert g.denominator.tolist() == [1.0, 2.0]
    with pytest.raises(ValueError, match="read-only"):
        g.denominator[1] = 3.0
    with pytest.raises(AttributeError):
        g.delay = 1.0


@pytest.mark.parametrize(
    ("numerator", "denominator", "delay", "message"),
    [
        ([1.0], [], 0.0, "lists of coefficients in descending powers"),
        ([1.0], [1.0, np.nan], 0.0, "not a finite number"),
        ([1.0], [0.0, 2.0], 0.0, "first denominator coefficient of the transfer function is zero"),
        ([1.0], [1.0, 2.0], -0.5, "zero or more; got -0.5"),
        ([1.0], [1.0, 2.0], np.nan, "a finite number of seconds"),
    ],
)
def test_impossible_models_are_refused(numerator, denominator, delay, message):
    with pytest.raises(DataError, match=message):
        TransferFunction(numerator, denominator, delay)
