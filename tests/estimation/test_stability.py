"""Stability of polynomials and the reflection of unstable ones."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ctid_cli.estimation.sampled_problem import is_hurwitz, reflect_unstable, with_stable_denominator


@st.composite
def polynomials(draw):
    """Draw polynomials of degree 1 to 8 with roots away from the axis and from each other, and a unit of time."""
    roots = []
    for _ in range(draw(st.integers(1, 4))):
        real = draw(st.floats(0.05, 5)) * draw(st.sampled_from([-1, -1, -1, 1]))
        imag = draw(st.floats(0.1, 5))
        roots += [real + 1j * imag, real - 1j * imag] if draw(st.booleans()) else [complex(real)]
    roots = np.array(roots)
    gaps = np.abs(roots[:, None] - roots) + 10 * np.eye(roots.size)
    assume(gaps.min() > 0.05)  # close roots are known from the coefficients to few digits
    return roots, 10.0 ** draw(st.floats(-6, 6))


@given(polynomials())
def test_unstable_roots_are_mirrored_and_the_others_kept(polynomial):
    roots, unit = polynomial
    a, mirrored = (np.poly(r).real * unit ** np.arange(r.size + 1) for r in (roots, -abs(roots.real) + 1j * roots.imag))
    stable = bool((roots.real < 0).all())
    assert is_hurwitz(a) == stable
    found = with_stable_denominator(np.append(a[1:], [3.0, -4.0]), roots.size)
    assert is_hurwitz(np.append(1.0, found[:-2]))
    scale = unit ** np.arange(1, a.size)
    largest = np.abs(mirrored[1:] / scale).max()
    np.testing.assert_allclose(found[:-2] / scale, mirrored[1:] / scale, rtol=1e-6, atol=1e-6 * largest)
    assert np.array_equal(found[-2:], [3.0, -4.0])
    if stable:
        assert np.array_equal(found[:-2], a[1:])


@pytest.mark.parametrize("a", [[1.0, 0.0], [1.0, 0.0, 4.0], [1.0, 1.0, 1.0, 1.0], [1.0, 2.0, 0.0], [1.0, 0.0, 0.0]])
def test_roots_on_the_axis_are_moved_off_it(a):
    assert not is_hurwitz(np.array(a))
    moved = reflect_unstable(np.array(a))
    assert is_hurwitz(moved) or not np.any(a[1:])  # a polynomial s^n has no scale to move by
    np.testing.assert_allclose(moved, a, atol=1e-4)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_parameters_that_are_not_finite_are_left_alone(bad):
    theta = np.array([-1.0, bad, -3.0, 4.0])
    assert np.array_equal(with_stable_denominator(theta, 3), theta, equal_nan=True)
    assert not is_hurwitz(theta)
