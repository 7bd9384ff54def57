"""Costs of filtered, resampled records against those of every filtered sample, and what enters them."""

import numpy as np
import pytest

from ctid_cli.estimation.filtered_costs import SampledCost, filtered_costs
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from tests.estimation.adapters import CoefficientProblem, best_coefficients, least_squares_start, steps
from tests.estimators.records import CASE_1, CASE_2, SVF_CUTOFF, make_record, theta_of

LONGEST = 15.0
DEGREES = {CASE_1: Structure(2, 0), CASE_2: Structure(4, 1)}
#: The widest and the narrowest band that the benchmarks' filter sets have, and one between.
CUTOFFS = {CASE_1: (0.202, 0.5, 2.02), CASE_2: (2.685, 8.0, 26.85)}
BANDS = [(model, cutoff) for model, cutoffs in CUTOFFS.items() for cutoff in cutoffs]
DELAYS = np.arange(0.0, 15.1, 0.5)
THOROUGH = steps(max_iterations=100, tolerance=1e-9, halvings=12)


def with_delay(model):
    """Coefficients to start from; the delay at the end is not used."""
    return np.append(theta_of(model), 0.0)


def percent(record, model, delays=DELAYS):
    """Output error of the true coefficients at wrong delays, as a percentage of the output's deviation."""
    data = filter_data(record, LONGEST)
    spread = np.sum((data.y_used - data.y_used.mean()) ** 2)
    theta = theta_of(model)
    squared = [CoefficientProblem(data, DEGREES[model], d).equations(theta).squared_error for d in delays]
    return 100 * np.sqrt(np.array(squared) / spread)


@pytest.mark.parametrize("snr_db", [None, 5])
@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize(("model", "cutoff"), BANDS)
def test_cost_of_a_resampled_record_is_that_of_every_sample(model, cutoff, regular, snr_db):
    # Within 9 % of the output, between 0 at the true delay and the 190 % of signals that have nothing in common: the
    # lines between the samples of the input lose that much of what passes near the cut-off.
    record = make_record(model, snr_db=snr_db, regular=regular)
    lowpass = Lowpass(cutoff, 10)
    full, resampled = (percent(r, model) for r in (lowpass.apply(record), lowpass.resample(record)))
    assert np.ptp(full) > 50
    np.testing.assert_allclose(resampled, full, atol=9.0, rtol=0)
    # The minimum stays where it was.
    assert DELAYS[np.argmin(full)] == DELAYS[np.argmin(resampled)] == 8.0


@pytest.mark.parametrize(("model", "cutoff"), BANDS[:-1])  # at the last one the clock is the limit
def test_error_of_resampling_falls_with_the_square_of_the_interval(model, cutoff):
    # Straight lines are of second order: twice the samples, a quarter of the error. At the true delay and without
    # noise nothing else is left.
    record, lowpass = make_record(model, regular=False), Lowpass(cutoff, 10)
    one, two, four = (percent(lowpass.resample(record, rate), model, [8.0])[0] for rate in (6, 12, 24))
    assert 0.5 < one < 6
    assert one / two == pytest.approx(4, rel=0.35)
    assert two / four == pytest.approx(4, rel=0.35)


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize(("model", "cutoff"), BANDS)
def test_best_coefficients_fit_both_records_alike(model, cutoff, regular):
    # Minimised over the coefficients, near the true delay: within 2.5 % of the output.
    record, lowpass = make_record(model, snr_db=15, regular=regular), Lowpass(cutoff, 10)
    for error in (-0.1, -0.05, -0.02, 0.0, 0.02):
        delay = 8.0 + error * 2 * np.pi / cutoff
        found = []
        for filtered in (lowpass.apply(record), lowpass.resample(record)):
            cost = SampledCost(filter_data(filtered, LONGEST), DEGREES[model], SVF_CUTOFF[model], THOROUGH)
            minimum = cost.minimise(delay, with_delay(model))
            found.append(100 * np.sqrt(minimum.squared_error / cost.spread))
        assert found[1] == pytest.approx(found[0], abs=2.5)


@pytest.mark.parametrize("cutoff", CUTOFFS[CASE_1])
@pytest.mark.parametrize("regular", [True, False])
def test_missing_samples_do_not_enter(regular, cutoff):
    # Lines bridge the hole before the filter sees it, and what lies in it does not count.
    record = make_record(snr_db=15, regular=regular)
    gone = (record.t > 60) & (record.t < 66)
    bridged = np.where(gone, np.interp(record.t, record.t[~gone], record.y[~gone]), record.y)
    cost = sampled(Record(record.t, np.where(gone, np.nan, record.y), record.input), cutoff)
    other = sampled(Record(record.t, bridged, record.input), cutoff)
    t, used = cost.data.t, cost.data.use
    np.testing.assert_array_equal(t, other.data.t)
    hole = (t > 60.2) & (t < 65.8)
    assert hole.any()
    assert not used[hole].any()
    assert used[(t > LONGEST) & ((t < 59.8) | (t > 66.2))].all()
    np.testing.assert_allclose(cost.data.y[used], other.data.y[used], rtol=1e-12)
    np.testing.assert_array_equal(cost.data.u, other.data.u)


def sampled(record, cutoff, order=10, **more):
    """The one cost of one filter."""
    (cost,) = filtered_costs(
        record, [Lowpass(cutoff, order)], DEGREES[CASE_1], (0.0, LONGEST), search="time", start=LONGEST, svf_cutoff=1.0,
        **more,
    )  # fmt: skip
    return cost


@pytest.mark.parametrize("cutoff", CUTOFFS[CASE_1])
def test_input_that_begins_before_the_output_counts(cutoff):
    # The output is at rest until 8 s, so a record of it from 5 s on tells the same.
    record = make_record(snr_db=15)
    y = np.where(record.t < 8.0 - 1e-9, 0.0, record.y)
    late = record.t > 5.0 - 1e-9
    whole, part = Record(record.t, y, record.input), Record(record.t[late], y[late], record.input)
    one, two = sampled(whole, cutoff), sampled(part, cutoff)
    # A clock that input and output do not share is resampled at intervals of its own: alike, not the same.
    assert one.spread * one.mean_factor == pytest.approx(two.spread * two.mean_factor, rel=0.05)
    for delay in (2.0, 7.0, 8.0):
        errors = [cost.minimise(delay, with_delay(CASE_1)).squared_error / cost.spread for cost in (one, two)]
        assert np.sqrt(errors[0]) == pytest.approx(np.sqrt(errors[1]), abs=0.03)


def test_samples_before_the_start_do_not_enter():
    record = make_record(snr_db=15)
    for start in (0.0, 8.0, 40.0):
        (cost,) = filtered_costs(
            record, [Lowpass(2.02, 10)], DEGREES[CASE_1], (0, LONGEST), search="time", start=start, svf_cutoff=1.0
        )
        assert cost.data.t[cost.data.use].min() >= start - 1e-9
        assert cost.data.t[~cost.data.use].max(initial=-1.0) < start
        assert cost.spread == pytest.approx(np.sum((cost.data.y_used - cost.data.y_used.mean()) ** 2), rel=1e-12)
        assert cost.mean_factor == pytest.approx(1 / cost.data.count)


def test_cutoffs_near_the_clock_never_add_samples():
    # 5 samples for each period of the cut-off on a long record, but never more than there are.
    record = make_record(n=1000)
    nyquist = np.pi / 0.05
    counts = [sampled(record, nyquist * part).data.t.size for part in (0.02, 0.05, 0.2, 0.5, 0.99, 3.0)]
    assert counts == sorted(counts)
    assert counts[-1] == 1000
    assert counts[0] == 167  # a sixteenth of a period of 5 s holds six whole intervals
    for regular in (True, False):
        record = make_record(regular=regular, n=1000)
        assert sampled(record, 100.0).data.interval >= np.median(np.diff(record.t)) * (1 - 1e-12)


def test_costs_are_those_of_their_filters_in_order():
    # Several at once are each one by itself; cut-offs of the starts for all or for each.
    record = make_record(snr_db=15, n=2000)
    lowpasses = [Lowpass(cutoff, 4) for cutoff in (0.3, 1.0, 2.0)]
    many = filtered_costs(
        record, lowpasses, DEGREES[CASE_1], (0, LONGEST), search="time", start=LONGEST, svf_cutoff=[0.2, 0.7, 1.5]
    )
    for cost, lowpass, cutoff in zip(many, lowpasses, (0.2, 0.7, 1.5), strict=True):
        data = filter_data(lowpass.resample(record), LONGEST)
        np.testing.assert_array_equal(cost.data.y, data.y)
        np.testing.assert_array_equal(cost.starts(7.0)[0][:-1], least_squares_start(data, DEGREES[CASE_1], 7.0, cutoff))


def test_minimum_is_the_best_of_its_starts():
    record = make_record(snr_db=15, n=2000)
    cost = sampled(record, 2.02)
    least_squares = cost.minimise(7.7, None)
    from_start = cost.minimise_from(7.7, cost.starts(7.7))
    assert least_squares.theta.tolist() == from_start.theta.tolist()
    starts = [with_delay(CASE_1), np.array([0.1, 1e-3, 1.0, 0.0]), *cost.starts(7.7)]
    alone = [cost.minimise(7.7, theta).squared_error for theta in starts]
    best = cost.minimise_from(7.7, starts)
    assert best.squared_error == min(alone) < max(alone)
    effort = {"max_iterations": 10, "tolerance": 1e-2, "halvings": 3}
    theta, squared_error, step = best_coefficients(cost.data, cost.structure, 7.7, np.array(starts)[:, :-1], **effort)
    assert (best.theta[:-1].tolist(), best.squared_error, best.step) == (theta.tolist(), squared_error, step)
    assert (best.delay, cost.minimise_from(7.7, [])) == (7.7, None)


def test_input_that_rests_while_it_counts_has_no_minimum():
    # All that the output could tell of the input lies before the samples that count.
    t = 0.05 * np.arange(1000)
    record = Record(t, np.sin(t), HeldSignal(t, np.where(t < t[-1], 0.0, 1.0)))
    cost = sampled(record, 2.02)
    assert cost.starts(1.0) == []
    assert cost.minimise(1.0, None) is None


@pytest.mark.parametrize("search", ["time", "spectral"])
@pytest.mark.parametrize("regular", [True, False])
def test_both_searches_find_the_minimum_where_it_is(search, regular):
    # Without noise: the least cost over a lattice lies within a twentieth of the filter's period of the true delay.
    record = make_record(regular=regular)
    cutoffs = [0.5, 1.0, 2.02]
    lowpasses = [Lowpass(cutoff, 10) for cutoff in cutoffs]
    costs = filtered_costs(
        record, lowpasses, DEGREES[CASE_1], (0, LONGEST), search=search, start=LONGEST, svf_cutoff=1.0, effort=THOROUGH
    )
    for cost, cutoff in zip(costs, cutoffs, strict=True):
        delays = 8.0 + np.arange(-10, 11) * 0.02 * 2 * np.pi / cutoff
        errors = [cost.minimise(d, with_delay(CASE_1)).squared_error for d in delays[delays < LONGEST]]
        assert abs(delays[int(np.argmin(errors))] - 8.0) <= 0.061 * 2 * np.pi / cutoff
        assert np.sqrt(min(errors) / cost.spread) < 0.01
