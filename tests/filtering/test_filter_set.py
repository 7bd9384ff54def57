"""Low-pass filter sets: costs of a delay error by independent routes, and the check against descents on a grid."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import integrate

from ctid_cli.filtering.filter_set import (
    FilterSet,
    check_filters,
    convergence_region,
    extrema,
    ideal_cost,
)
from ctid_cli.filtering.lowpass import Lowpass

# The ideal filter -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [0.02, -0.7, 15.0])
def test_ideal_cost_is_its_integral(error):
    # (35) with |L G0| = |L| = 1 up to the cut-off is (50): no factor lies between them.
    cutoff = 2 * np.pi
    integral, _ = integrate.quad(lambda w: 2 * np.sin(w * error / 2) ** 2, -cutoff, cutoff, limit=500, epsrel=1e-11)
    assert ideal_cost(error, cutoff) == pytest.approx(integral / np.pi, rel=1e-10)


def test_extrema_solve_their_equation_and_alternate():
    cutoff = 26.85
    exact = extrema(cutoff, 200, exact=True)
    x = cutoff * exact
    np.testing.assert_allclose(np.cos(x) * x, np.sin(x), atol=1e-12 * 200 * np.pi)
    step = 0.01 / cutoff
    curvature = ideal_cost(exact + step, cutoff) - 2 * ideal_cost(exact, cutoff) + ideal_cost(exact - step, cutoff)
    assert (curvature[::2] < 0).all()
    assert (curvature[1::2] > 0).all()
    # no extremum is missing: neighbours are half a period apart, and the first valley begins at zero
    assert (np.diff(x) > np.pi).all()
    assert (np.diff(x) < 1.03 * np.pi).all()
    assert x[0] == pytest.approx(4.493409457909064, rel=1e-15)


def test_printed_approximation_of_the_extrema():
    period = 2 * np.pi / 26.85
    i = np.arange(1, 201)
    printed = (2 * i + 1) / 4 * period - period / ((2 * i + 1) * np.pi**2)
    np.testing.assert_allclose(extrema(26.85, 200), printed, rtol=1e-14)
    excess = printed / extrema(26.85, 200, exact=True) - 1
    assert 0 < excess.max() == excess[0] < 0.0016
    assert excess[1] < 0.0002


def test_convergence_region():
    assert convergence_region(2.0) == pytest.approx(3 * np.pi / 4 - 1 / (3 * np.pi), rel=1e-14)
    inside = np.linspace(0, convergence_region(2.0, exact=True), 2001)
    assert (np.diff(ideal_cost(inside, 2.0)) > 0).all()
    assert ideal_cost(inside[-1] * 1.001, 2.0) < ideal_cost(inside[-1], 2.0)


# The set --------------------------------------------------------------------------------------------------------------


def test_periods_by_both_printed_formulas():
    filters = FilterSet(26.85, count=15)
    shortest, k = 2 * np.pi / 26.85, np.arange(1, 16)
    np.testing.assert_allclose(filters.periods, 10 * shortest + (k - 1) * (1 - 10) * shortest / 14, rtol=1e-13)
    np.testing.assert_allclose(filters.periods, 10 * shortest - (k - 1) * (10 - 1) * shortest / 14, rtol=1e-13)
    np.testing.assert_allclose(filters.cutoffs[[0, -1]], [2.685, 26.85], rtol=1e-14)
    assert filters.lowpasses == tuple(Lowpass(w, 10) for w in filters.cutoffs)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bandwidth": np.inf}, "bandwidth must be a positive number"),
        ({"count": 1}, "count must be an integer of at least 2"),
        ({"beta": 1.7}, r"be between 1\.7170 \(bound \(41\).* and 10, not 1\.7"),
        ({"beta": np.nan}, "and 10, not nan"),
        ({"order": 0}, "order must be an integer from 1 to 20"),
    ],
)
def test_impossible_sets_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        FilterSet(**{"bandwidth": 2.0, **options})


# The check ------------------------------------------------------------------------------------------------------------


def descents(cutoff, errors):
    """Return the ends of descents of the sampled ideal cost, from every point of a grid that begins at zero."""
    cost = ideal_cost(errors, cutoff)
    follow = np.arange(errors.size)
    lower, upper = cost[:-2] < cost[1:-1], cost[2:] < cost[1:-1]
    follow[1:-1] = np.arange(1, errors.size - 1) - lower + (upper & ~lower)
    for _ in range(int(np.log2(errors.size)) + 1):
        follow = follow[follow]
    return errors[follow]


@pytest.mark.parametrize(
    ("filters", "largest"), [(FilterSet(6.0, 4, 2.0), 9.0), (FilterSet(2.0, 3, 5.0), 30.0), (FilterSet(9.0, 7), 8.0)]
)
def test_check_against_descents_on_a_grid(filters, largest):
    check = check_filters(filters.cutoffs, largest)
    grid = np.linspace(0, 1.5 * largest, 60_001)
    step = grid[1]
    ends = np.array([descents(cutoff, grid) for cutoff in filters.cutoffs])
    pieces = [(i.low, i.high, i) for i in check.intervals] + [(*gap, None) for gap in check.gaps]
    pieces.sort(key=lambda piece: piece[0])
    assert [piece[0] for piece in pieces] == [0.0, *(piece[1] for piece in pieces[:-1])]
    assert pieces[-1][1] == largest
    looked_at = 0
    for low, high, interval in pieces:
        inside = (grid > low + 2 * step) & (grid < high - 2 * step)
        helps = ends[:, inside] < grid[inside] - step / 2
        looked_at += inside.sum()
        expected = set(interval.filters) if interval else set()
        for k in range(filters.count):
            assert (helps[k] == (k in expected)).all()
        if interval and inside.any():
            reached = np.where(helps, ends[:, inside], np.inf).min(axis=0)
            np.testing.assert_allclose(reached, interval.minimum, atol=step)
            np.testing.assert_allclose(ends[interval.filters[0], inside], interval.minimum, atol=step)
    assert looked_at > 0.98 * 40_000


@pytest.mark.parametrize("exact", [True, False])
def test_second_case(exact):
    # Adequacy is not monotonic in the number of filters: nine fail and seven pass.
    passing = [n for n in range(2, 16) if check_filters(FilterSet(26.85, n).cutoffs, 15.0, exact).passes]
    assert passing == [7, 8, 10, 11, 12, 13, 14, 15]
    assert [n for n in range(2, 16) if check_filters(FilterSet(26.85, n).cutoffs, 8.0, exact).passes] == [*range(7, 16)]
    (gap,) = check_filters(FilterSet(26.85, 9).cutoffs, 15.0, exact).gaps
    assert gap == pytest.approx((14.2961, 14.3331), abs=1e-4)


@given(
    cutoffs=st.lists(st.floats(0.3, 20), min_size=1, max_size=8),
    largest=st.floats(0.1, 25),
    fraction=st.floats(-1, 1),
)
def test_paths_descend(cutoffs, largest, fraction):
    check = check_filters(cutoffs, largest)
    error = fraction * largest
    for k, end in check.path(error):
        assert abs(end) < abs(error)
        assert end * error >= 0
        # a descent: the filter's cost decreases all the way
        way = ideal_cost(np.linspace(error, end, 200), cutoffs[k])
        assert (np.diff(way) <= 1e-12 * cutoffs[k]).all()
        error = end
    if error:
        assert not check.passes
        assert any(low <= abs(error) <= high for low, high in check.gaps)
    assert [(k, -end) for k, end in check.path(-fraction * largest)] == check.path(fraction * largest)


def test_what_cannot_be_checked():
    with pytest.raises(ValueError, match="up to 5 s, not 6 s"):
        check_filters([1.0], 5.0).path(-6.0)
    with pytest.raises(ValueError, match="cutoff must be a positive number"):
        check_filters([1.0, -1.0], 5.0)
    with pytest.raises(ValueError, match="at least one frequency"):
        check_filters([], 5.0)
    with pytest.raises(ValueError, match="too many extrema"):
        check_filters([1.0, 1e9], 5.0)
