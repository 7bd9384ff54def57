"""The set of admissible models and its coordinates."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.estimation.optimum.box import LIMITS, Box, admissible, box_of, frozen, moved_by, point_of
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.filtering.filter_data import filter_data
from tests.estimation.optimum.systems import MODEL, random_poles, record_of

BOX = Box(0.01, 20.0, 6.0, (0.0, 2.0), 0.5, 1.0)


@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_poles_survive_the_coordinates(seed, n):
    poles = random_poles(np.random.default_rng(seed), n, 0.02, 5.0)
    point = point_of(poles, 0.3, BOX)
    np.testing.assert_allclose(np.sort_complex(point.poles), np.sort_complex(poles), rtol=1e-7)
    np.testing.assert_allclose(point.denominator, np.poly(poles).real, rtol=1e-9)
    assert (np.diff(point.speed) <= 0).all()


@given(st.integers(0, 2**32 - 1), st.integers(1, 8), st.floats(0.1, 5.0))
def test_no_step_leaves_the_set(seed, n, size):
    rng = np.random.default_rng(seed)
    point = point_of(random_poles(rng, n, 0.01, 20.0), 0.3, BOX)
    for _ in range(5):
        point = moved_by(point, rng.uniform(-size, size, n + 1), BOX)
        poles = point.poles
        assert poles.size == n
        assert (np.abs(poles) >= BOX.slowest * (1 - 1e-9)).all()
        assert (np.abs(poles) <= BOX.fastest * (1 + 1e-9)).all()
        assert (np.abs(poles.imag) <= BOX.imaginary * (1 + 1e-9)).all()
        assert (-poles.real >= BOX.least_damping * np.abs(poles) * (1 - 1e-9)).all()
        assert 0.0 <= point.delay.seconds <= 2.0
        np.testing.assert_allclose([admissible(pole, BOX) for pole in poles], poles, rtol=1e-7)


@pytest.mark.parametrize(
    ("poles", "outward"),
    [
        ([-0.01], [1, 0]),
        ([-20.0], [-1, 0]),
        ([20j - 2e-9, -20j - 2e-9], [0, -1, 0]),
        ([-0.5 + 9j, -0.5 - 9j], [0, -1, 0]),
    ],
)
def test_what_points_out_of_the_set_is_frozen(poles, outward):
    point = point_of(np.array(poles, dtype=complex), 0.3, BOX)
    outward = np.array(outward, dtype=float)
    assert frozen(point, outward, BOX).tolist() == (outward != 0).tolist()
    assert not frozen(point, -outward, BOX).any()


def test_the_edge_of_imaginary_parts_has_its_own_coordinates():
    point = point_of(np.array([-0.5 + 6.0j, -0.5 - 6.0j]), 0.3, BOX)
    assert point.edge.tolist() == [True]
    # Real and imaginary part, and their derivatives.
    moved = moved_by(point, np.array([np.log(2.0), -np.log(2.0), 0.0]), BOX)
    np.testing.assert_allclose(np.sort_complex(moved.poles), [-1 - 3j, -1 + 3j])
    differences = [
        (np.log(np.ravel(point.shifted(step))) - np.log(np.ravel(point.shifted(-step)))) / 2e-6
        for step in 1e-6 * np.eye(2)
    ]
    np.testing.assert_allclose(point.jacobian(), np.transpose(differences), atol=1e-8)


def test_a_delay_at_a_sample_keeps_its_side():
    point = point_of(np.array([-1.0 + 0j]), 0.9, BOX)
    assert point.delay.cell == 1
    step = np.array([0.0, 0.1])
    assert moved_by(point, step, BOX).delay == (1.0, 1)
    assert moved_by(point, 2 * step, BOX).delay.cell == 2
    assert frozen(moved_by(point, step, BOX), np.array([0.0, -1.0]), BOX)[-1]


@pytest.mark.parametrize(
    ("free_response", "period", "state"), [(0, 0.0, "rest"), (0, 25.0, "periodic"), (1, 0.0, "estimated")]
)
def test_the_set_depends_on_what_is_known_of_the_state(free_response, period, state):
    data = filter_data(record_of(MODEL, np.random.default_rng(1), samples=50))
    box = box_of(Problem((data,), 0, bool(free_response), (), (period,)), (0.0, 0.0))
    limits = {name: getattr(limit, state) for name, limit in LIMITS.items()}
    assert box.slowest == pytest.approx(limits["slowest"] / 24.5)
    assert box.fastest == pytest.approx(limits["fastest"] / 0.5)
    assert box.least_damping == limits["least_damping"]
    assert box.imaginary == pytest.approx(limits["imaginary"] * np.pi / 0.5)
    # Starts are spread over the same range for every treatment of the state.
    assert box.spread == pytest.approx((LIMITS["slowest"].estimated / 24.5, LIMITS["least_damping"].estimated))


def test_bounds_that_poles_are_at_are_named():
    poles = point_of(np.array([-1e-9, -1e-9 + 3j, -1e-9 - 3j, -0.5]), 0.0, BOX).poles
    assert [(name, value) for name, _, value in BOX.limits_met(poles)] == [("slowest", 0.01), ("least_damping", 1e-3)]
