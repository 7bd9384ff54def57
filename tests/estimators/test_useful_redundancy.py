"""Useful redundancy on whole records: convergence from any start, and the report of the search."""

from itertools import pairwise

import numpy as np
import pytest

from ctid_cli.estimation.common import Start
from ctid_cli.estimation.filtered_costs import LATTICE, percents
from ctid_cli.estimators.td_srivc import TdSrivc
from ctid_cli.estimators.useful_redundancy import UsefulRedundancy
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.inference.fit import Status
from tests.estimators.records import CASE_1, CASE_2, SVF_CUTOFF, assert_same_model, make_record

BOUNDS = (0.0, 15.0)
BANDWIDTH = {CASE_1: 2.02, CASE_2: 26.85}
FILTERS = {CASE_1: 10, CASE_2: 15}


def member_costs(prepared, delay):
    """Return the costs of all filters at a delay, each with separate coefficients."""
    search = prepared.laid_out.filtered
    return percents(search.at(delay).squared_errors, np.array([cost.spread for cost in search.costs]))


def reference_cost(prepared, delay):
    """Return J0 as evaluated by the search."""
    return prepared.laid_out.filtered.reference_cost(delay)


def options(model=CASE_1, **more):
    """Return the settings of the benchmark."""
    return {
        "poles": model.order,
        "zeros": model.numerator.size - 1,
        "delay_bounds": BOUNDS,
        "bandwidth": BANDWIDTH[model],
        "filters": FILTERS[model],
        "svf_cutoff": SVF_CUTOFF[model],
        **more,
    }


@pytest.fixture(scope="module")
def prepared():
    """Return a noisy record of the first benchmark, for tests that only read it."""
    return UsefulRedundancy(**options()).prepare(make_record(snr_db=5, seed=5, replicate=2))


def same(one, two):
    """Return whether two fits and their searches are bit-identical."""
    paths = [[(p.round, p.filter, p.delays.tolist(), p.costs.tolist()) for p in fit.paths] for fit in (one, two)]
    return (one.parameters, one.history, one.search, paths[0]) == (two.parameters, two.history, two.search, paths[1])


# To the truth -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("start", [0.0, 9.0])
@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_noise_free_data_return_the_true_model_and_delay(model, regular, start):
    record = make_record(model, regular=regular, n=2500)
    fit = UsefulRedundancy(**options(model)).fit(record, Start(start))
    assert fit.status is Status.CONVERGED
    assert abs(fit.model.delay - 8.0) < 1e-6
    assert_same_model(fit.model, model, 1e-6)


@pytest.mark.parametrize("start", [0.0, 3.0, 15.0, None])
def test_every_start_leads_to_the_same_estimate(start):
    # The result of the plain search started very near the true delay.
    record = make_record(snr_db=5, regular=False)
    fit = UsefulRedundancy(**options()).fit(record, None if start is None else Start(start))
    near = TdSrivc(2, 0, BOUNDS).fit(record, Start(8.1))
    assert_same_model(fit.model, near.model, 1e-6)
    assert fit.cost == pytest.approx(near.cost, rel=1e-9)
    np.testing.assert_allclose(list(fit.standard_errors.values()), list(near.standard_errors.values()), rtol=1e-4)
    assert fit.count == near.count


# Data sets on which the plain search from the same start ends in a local minimum, for each of these filters.
TRAPS = [
    (CASE_1, {"seed": 5, "replicate": 2, "snr_db": 15}, 3.0, [None, Lowpass(2.02, 10)]),
    (CASE_2, {"seed": 5, "replicate": 0, "snr_db": 15, "n": 4000}, 0.0, [None, Lowpass(2.685, 10), Lowpass(2.685, 2)]),
]


@pytest.mark.parametrize(("model", "data", "start", "lowpasses"), TRAPS, ids=["case 1", "case 2"])
def test_escapes_where_one_filter_is_trapped(model, data, start, lowpasses):
    record = make_record(model, **data)
    degrees = (model.order, model.numerator.size - 1)
    fit = UsefulRedundancy(**options(model)).fit(record, Start(start))
    assert abs(fit.model.delay - 8.0) < 0.01
    for lowpass in lowpasses:
        single = TdSrivc(*degrees, BOUNDS, lowpass=lowpass, svf_cutoff=SVF_CUTOFF[model]).fit(record, Start(start))
        assert abs(single.model.delay - 8.0) > 1.0
        assert single.cost > 2 * fit.cost


@pytest.mark.parametrize("regular", [True, False])
def test_bandwidth_is_estimated_where_it_is_not_given(regular):
    record = make_record(snr_db=15, regular=regular)
    fit = UsefulRedundancy(2, 0, BOUNDS).fit(record, Start(0.0))
    assert 1.0 < fit.filters.bandwidth < 10.0
    assert_same_model(fit.model, UsefulRedundancy(**options()).fit(record, Start(9.0)).model, 1e-6)


# Costs ------------------------------------------------------------------------------------------------


def test_reference_cost_is_the_mean_of_the_members_on_a_lattice_within_the_bounds():
    prepared = UsefulRedundancy(**options(delay_bounds=(1.0, 9.0))).prepare(make_record(snr_db=5, n=2000))
    step = LATTICE * 2 * np.pi / BANDWIDTH[CASE_1]
    for place in (4, 20):
        mean = member_costs(prepared, place * step).mean()
        for part in (-0.49, 0.0, 0.3, 0.49):
            assert reference_cost(prepared, (place + part) * step) == pytest.approx(mean, rel=1e-9)
        assert abs(reference_cost(prepared, (place + 0.51) * step) - mean) > 1e-3 * mean
    # The lattice points next to both bounds are outside, and are moved onto the bounds.
    assert round(1.0 / step) * step < 1.0
    assert round(9.0 / step) * step > 9.0
    for bound in (1.0, 9.0):
        assert reference_cost(prepared, bound) == member_costs(prepared, bound).mean()


# Search -----------------------------------------------------------------------------------------------


def test_starts_do_not_influence_one_another():
    # Bit-identical in any order, with one prepared record or one for each.
    record = make_record(snr_db=5, seed=5, replicate=2, n=1500)
    estimator = UsefulRedundancy(**options())
    starts = [0.0, 9.0, 3.0]
    alone = {start: estimator.fit(record, Start(start)) for start in starts}
    for order in (starts, starts[::-1]):
        prepared = estimator.prepare(record)
        reference_cost(prepared, 7.9)
        for start in order + order[:1]:
            assert same(prepared.fit(Start(start)), alone[start])


def test_search_tells_how_it_went():
    estimator = UsefulRedundancy(**options(CASE_2))
    prepared = estimator.prepare(make_record(CASE_2, snr_db=5, seed=5, replicate=1, n=4000))
    fit = prepared.fit(Start(0.0))
    search, trajectory, on_lattice = fit.search, fit.search.trajectory, prepared.laid_out.filtered.on_lattice
    assert search.status.succeeded
    # The first incumbent is the start, and every later one is better.
    assert (trajectory[0].point, trajectory[0].round, trajectory[0].path) == (0.0, 0, -1)
    costs = [visit.cost for visit in trajectory]
    assert all(after < before for before, after in pairwise(costs))
    assert [visit.cost for visit in search.visits] == [reference_cost(prepared, v.point) for v in search.visits]
    assert (search.point, search.cost) == (trajectory[-1].point, trajectory[-1].cost)
    assert min(visit.cost for visit in search.visits) == search.cost
    # Each round follows every filter from the incumbent; candidates are the ends of these paths.
    incumbents = {visit.round + 1: visit.point for visit in trajectory}
    for number in range(1, search.rounds + 1):
        followed = [path for path in fit.paths if path.round == number]
        candidates = [visit for visit in search.visits if visit.round == number]
        assert [path.filter for path in followed] == [visit.path for visit in candidates]
        assert [on_lattice(path.delays[-1]) for path in followed] == [visit.point for visit in candidates]
        assert set(range(FILTERS[CASE_2])) == {path.filter for path in followed}
        assert {path.delays[0] for path in followed} == {incumbents[number]}
    # On a path the cost of its filter decreases, and the delay stays within the bounds.
    for path in fit.paths:
        assert path.delays.shape == path.costs.shape
        assert (np.diff(path.costs) < 0).all()
        assert (path.delays >= 0).all()
        assert (path.delays <= 15).all()
        assert path.delays.size <= estimator.max_iterations + 1
    assert fit.switches == search.switches


def test_without_a_descending_path_the_next_valleys_are_searched():
    # Two filters are too few for this start: J0 is above 25 % at their ends, and new paths start one period away.
    record = make_record(snr_db=5, seed=5, replicate=2, n=2500)
    fit = UsefulRedundancy(**options(filters=2, beta=2.0)).fit(record, Start(14.0))
    away = []
    for path in fit.paths:
        incumbent = [visit.point for visit in fit.search.trajectory if visit.round < path.round][-1]
        away.append(abs(path.delays[0] - incumbent) / fit.filters.periods[path.filter])
    assert set(np.round(away, 9)) == {0.0, 1.0}
    assert fit.model.delay == pytest.approx(8.0, abs=0.01)


# Bounds -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bounds", [(0.0, 7.8), (8.2, 15.0)])
def test_true_delay_beyond_a_bound_ends_at_the_bound(bounds):
    nearest = min(max(8.0, bounds[0]), bounds[1])
    fit = UsefulRedundancy(**options(delay_bounds=bounds)).fit(make_record(snr_db=15))
    assert (fit.model.delay, fit.status) == (nearest, Status.DELAY_AT_BOUND)


# Options ----------------------------------------------------------------------------------------------
