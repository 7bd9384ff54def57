"""Derived quantities: derivatives against central differences, values by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.inference.derived import derived_parameters
from ctid_cli.models.transfer_function import TransferFunction

FOURTH = TransferFunction([-6400.0, 1600.0], [1.0, 5.0, 408.0, 416.0, 1600.0])
MIXED = TransferFunction([3.0], np.poly([-0.2, -5.0, -1 + 2j, -1 - 2j]).real)


def by_name(model, covariance, **options):
    return {row.name: row for row in derived_parameters(model, np.asarray(covariance), **options)}


@pytest.mark.parametrize("model", [FOURTH, MIXED])
def test_every_standard_error_is_that_of_central_differences(model):
    size = model.order + model.numerator.size
    theta = np.concatenate((model.denominator[1:], model.numerator))
    root = np.random.default_rng(1).standard_normal((size, size)) * 1e-4 * np.abs(theta)[:, None]
    covariance = root @ root.T
    rows = by_name(model, covariance)

    def values(parameters):
        moved = TransferFunction(parameters[model.order :], np.append(1.0, parameters[: model.order]))
        return np.array([row.estimate for row in derived_parameters(moved, covariance)])

    gradients = np.zeros((len(rows), size))
    for k in range(size):
        step = np.zeros(size)
        step[k] = 1e-6 * abs(theta[k])
        gradients[:, k] = (values(theta + step) - values(theta - step)) / (2 * step[k])
    expected = np.sqrt(np.einsum("ij,jk,ik->i", gradients, covariance, gradients))
    np.testing.assert_allclose([row.standard_error for row in rows.values()], expected, rtol=1e-5)
    assert not any(row.reason for row in rows.values())


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
            assert "so close to another" in loose[name].reason
            assert np.isnan([loose[name].standard_error, loose[name].low, loose[name].high]).all()
    assert np.isfinite(loose["static_gain"].standard_error)
    exact = by_name(TransferFunction([1.0], [1.0, 2.0, 1.0]), np.diag([1e-20, 1e-20, 1e-20]))
    assert all("so close" in row.reason for name, row in exact.items() if name != "static_gain")


def test_a_pair_close_to_the_real_axis_keeps_frequency_and_damping():
    rows = by_name(TransferFunction([1.0], [1.0, 1.999, 1.0]), np.diag([1e-2, 1e-2, 1e-2]) ** 2)
    assert "so close" in rows["pole_1_imag"].reason
    assert rows["natural_frequency_1"].standard_error == pytest.approx(0.005, rel=1e-6)
    assert rows["damping_1"].standard_error == pytest.approx(0.01 * np.hypot(0.5, 1.999 / 4), rel=1e-6)


def test_integrators_and_undefined_covariances_are_said():
    rows = by_name(TransferFunction([1.0], [1.0, 2.0, 0.0]), np.diag([1e-4, 1e-4, 1e-4]))
    assert rows["time_constant_2"].estimate == np.inf
    assert "origin" in rows["time_constant_2"].reason
    assert "integrates" in rows["static_gain"].reason
    assert np.isnan(rows["static_gain"].standard_error)
    rows = by_name(TransferFunction([1.0], [1.0, 2.0]), np.full((2, 2), np.nan))
    assert all("not defined" in row.reason and np.isnan(row.standard_error) for row in rows.values())
