"""Discrete-time controllers: normal form, realisation, and refusals."""

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from ctid_cli.errors import DataError
from ctid_cli.models.controller import DiscreteController

PID = DiscreteController([0.02329, -0.02058, 0.00454], [1.0, -1.0, 0.0])
CONTROLLERS = {
    "pid": PID,
    "proportional": DiscreteController([2.5], [1.0]),
    "no feedthrough": DiscreteController([0.3, -0.1], [1.0, -1.5, 0.7, -0.1]),
    "biproper": DiscreteController([2.0, 0.4], [4.0, -1.0]),
    "zero": DiscreteController([0.0, 0.0], [1.0, -0.5]),
}


@pytest.mark.parametrize("name", CONTROLLERS)
def test_realisation_filters_as_the_difference_equation(name):
    controller = CONTROLLERS[name]
    b = np.pad(controller.numerator, (controller.denominator.size - controller.numerator.size, 0))
    e = np.random.default_rng(0).standard_normal(60)
    expected = lfilter(b, controller.denominator, e)
    A, B, C, D = controller.state_space()
    state, output = np.zeros(controller.order), []
    for value in e:
        output.append(C[0] @ state + D[0, 0] * value)
        state = A @ state + B[:, 0] * value
    np.testing.assert_allclose(output, expected, atol=1e-12)
    assert controller.direct == D[0, 0] == b[0]


@pytest.mark.parametrize("name", CONTROLLERS)
def test_frequency_response_is_that_of_python_control(name):
    controller, interval = CONTROLLERS[name], 0.05
    w = np.array([0.3, 2.0, 20.0, 60.0])
    tool = control.tf(controller.numerator, controller.denominator, interval)
    np.testing.assert_allclose(
        controller.frequency_response(w, interval), tool(np.exp(1j * w * interval)), rtol=1e-12, atol=1e-15
    )
    with pytest.raises(ValueError, match="sampling interval must be a positive number"):
        controller.frequency_response(w, 0.0)


def test_three_term_controller_by_hand():
    # kp + ki q/(q-1) + kd (q-1)/q over q (q - 1): kp + ki + kd, -(kp + 2 kd), kd
    pid = DiscreteController.from_pid(0.0115, 0.00725, 0.00454)
    np.testing.assert_allclose(pid.numerator, PID.numerator, rtol=1e-12)
    assert pid.denominator.tolist() == [1.0, -1.0, 0.0]
    assert sorted(pid.poles.real) == [0.0, 1.0]
    assert pid.direct == pytest.approx(0.02329)


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-2, 2))
def test_each_action_adds_its_own_pole_and_nothing_else(kp, ki, kd):
    controller = DiscreteController.from_pid(kp, ki, kd)
    assert sorted(controller.poles.real) == [0.0] * bool(kd) + [1.0] * bool(ki)
    q = np.exp(1j * np.array([0.1, 1.0, 3.0]))
    expected = kp + ki * q / (q - 1) + kd * (q - 1) / q
    np.testing.assert_allclose(controller.frequency_response([0.1, 1.0, 3.0], 1.0), expected, atol=1e-12)


def test_normal_form():
    controller = DiscreteController([0.0, 2.0, 4.0], [2.0, -1.0, 0.5])
    assert controller.numerator.tolist() == [1.0, 2.0]
    assert controller.denominator.tolist() == [1.0, -0.5, 0.25]
    assert (controller.order, controller.direct) == (2, 0.0)
    np.testing.assert_allclose(np.abs(controller.poles), 0.5)
    with pytest.raises(ValueError, match="read-only"):
        controller.numerator[0] = 3.0


@pytest.mark.parametrize(
    ("numerator", "denominator", "message"),
    [
        ([1.0], [], "lists of coefficients in descending powers of q"),
        ([1.0], [1.0, np.nan], "not a finite number"),
        ([1.0], [0.0, 1.0], "first denominator coefficient of the controller is zero"),
        ([1.0, 2.0, 3.0], [1.0, 2.0], r"more zeros \(2\) than poles \(1\) would need samples of the future"),
    ],
)
def test_impossible_controllers_are_refused(numerator, denominator, message):
    with pytest.raises(DataError, match=message):
        DiscreteController(numerator, denominator)
