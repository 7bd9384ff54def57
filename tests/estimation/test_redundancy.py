"""Escape from local minima by the paths of several costs: record and end of the search."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.estimation.redundancy import SearchStatus, local_paths, minimise_redundantly

CHOICES = ["first", "best"]

# Saw teeth on the integers: a descent that tries the lower neighbour first stops at the next lower multiple of the
# period, since the cost just beyond is higher by period - 1 - 1/2. The global minimum is 0; each period has other local
# minima, and all have common ones only at multiples of their least common multiple, 1001 for 7, 11 and 13.


def saw(period):
    return lambda n: n % period + 0.5 * (n // period) if n >= 0 else math.inf


def descend(cost, n):
    while lower := [neighbour for neighbour in (n - 1, n + 1) if cost(neighbour) < cost(n)]:
        n = lower[0]
    return n


def to(*points):
    return lambda _: list(points)


@pytest.mark.parametrize("choice", CHOICES)
@pytest.mark.parametrize("start", [8, 500, 1000])
def test_escapes_where_every_single_cost_is_trapped(choice, start):
    costs = [saw(period) for period in (7, 11, 13)]
    paths = local_paths(costs, descend)
    found = minimise_redundantly(start, float, paths, choice=choice, improvement=1e-4, max_rounds=1000)
    assert (found.point, found.cost, found.status) == (0, 0.0, SearchStatus.EXHAUSTED)
    assert found.status.succeeded


@pytest.mark.parametrize("choice", CHOICES)
def test_settled_and_max_rounds_end_the_search(choice):
    halve = [lambda x: [x / 2]]
    steps = []

    def settled(previous, new):
        steps.append((previous, new))
        return abs(new - previous) < 1.5

    found = minimise_redundantly(8.0, float, halve, choice=choice, settled=settled)
    assert steps == [(8.0, 4.0), (4.0, 2.0), (2.0, 1.0)]
    assert (found.point, found.rounds, found.status) == (1.0, 3, SearchStatus.SETTLED)
    assert found.status.succeeded
    found = minimise_redundantly(8.0, float, halve, choice=choice, max_rounds=2)
    assert (found.point, found.rounds, found.status) == (2.0, 2, SearchStatus.MAX_ROUNDS)
    assert not found.status.succeeded


@pytest.mark.parametrize("choice", CHOICES)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_cost_that_is_not_finite_is_infinitely_bad(choice, bad):
    reference = {"start": bad, "bad": bad, "good": 1e300, "better": 2.0}.__getitem__
    paths = [to("bad"), to(), to("bad", "good"), to("better", "bad")]
    found = minimise_redundantly("start", reference, paths, choice=choice)
    assert (found.point, found.cost) == ("better", 2.0)
    assert {visit.cost for visit in found.visits if visit.point in ("start", "bad")} == {math.inf}
    found = minimise_redundantly("start", reference, paths[:2], choice=choice)
    assert (found.point, found.cost, found.rounds) == ("start", math.inf, 1)
    assert found.status is SearchStatus.NO_FINITE_COST
    assert not found.status.succeeded


@pytest.mark.parametrize(("candidate", "accepted"), [(-5.004, False), (-5.006, True)])
def test_share_of_a_negative_cost_is_a_share_of_its_size(candidate, accepted):
    found = minimise_redundantly(-5.0, float, [to(candidate)], improvement=1e-3)
    assert found.visits[1].accepted is accepted


def test_the_reference_cost_is_evaluated_once_for_each_visit():
    asked = []

    def reference(x):
        asked.append(x)
        return x

    found = minimise_redundantly(9.0, reference, [to(5.0, 4.0), to(), to(3.0)], choice="best")
    assert asked == [visit.point for visit in found.visits] == [9.0, 5.0, 4.0, 3.0, 5.0, 4.0, 3.0]
    assert [visit.accepted for visit in found.visits] == [True, False, False, True, False, False, False]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"choice": "any"}, "choice"),
        ({"improvement": 1.0}, "improvement"),
        ({"improvement": math.nan}, "improvement"),
        ({"max_rounds": 2.5}, "max_rounds"),
        ({"paths": []}, "paths"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        minimise_redundantly(**{"start": 1.0, "reference": float, "paths": [to(0.0)], **options})


# Random families: points are the indices of a table of reference costs, path i leads from n to tables[i][n].
COSTS = st.lists(st.integers(0, 1000) | st.sampled_from([math.inf, math.nan]), min_size=1, max_size=12)


@st.composite
def families(draw):
    costs = draw(COSTS)
    leads = st.lists(st.integers(0, len(costs) - 1), max_size=2)
    table = st.lists(leads, min_size=len(costs), max_size=len(costs))
    return costs, draw(st.lists(table, min_size=1, max_size=4))


def as_printed(start, cost, tables, epsilon):
    """Run algorithm III as in the paper, with the stored path and end; infinities are kept."""
    point, i, failures = start, 0, 0
    while failures < len(tables):
        minima = tables[i][point]
        xi = min(minima, key=cost) if minima else point
        failure = cost(xi) == math.inf or cost(xi) > (1 - epsilon) * cost(point) or cost(xi) == cost(point)
        if failure:
            i, failures = (i + 1) % len(tables), failures + 1
        else:
            point, failures = xi, 0
    return point


def finite(costs):
    return lambda n: costs[n] if math.isfinite(costs[n]) else math.inf


@given(families(), st.sampled_from([0.0, 2.0**-10, 0.25]))
def test_first_is_algorithm_iii(family, epsilon):
    costs, tables = family
    cost = finite(costs)
    paths = [table.__getitem__ for table in tables]
    found = minimise_redundantly(0, costs.__getitem__, paths, improvement=epsilon)
    assert found.point == as_printed(0, cost, tables, epsilon)
    accepted = [visit.cost for visit in found.trajectory]
    for before, after in pairwise(accepted):
        assert after < before
        assert after <= (1 - epsilon) * before
    assert found.cost == accepted[-1] == cost(found.point)
    assert len(found.trajectory) == found.rounds


@given(families())
def test_best_takes_the_steepest_way(family):
    costs, tables = family
    cost = finite(costs)
    point, expected = 0, [cost(0)]
    while (least := min((cost(n) for table in tables for n in table[point]), default=math.inf)) < cost(point):
        point = next(n for table in tables for n in table[point] if cost(n) == least)
        expected.append(least)
    found = minimise_redundantly(0, costs.__getitem__, [table.__getitem__ for table in tables], choice="best")
    assert [visit.cost for visit in found.trajectory] == expected
    assert found.point == point
