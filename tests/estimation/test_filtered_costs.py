"""Costs of a record behind low-pass filters: those of its spectra, from the starts that they are given."""

import numpy as np
import pytest

from ctid_cli.estimation.filtered_costs import filtered_costs, minima_behind_all, percents
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.filtering.spectra import lowpass_weight, record_spectra
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from tests.estimation.adapters import iterate, spectral_at, spectral_refit_numerator, steps
from tests.estimators.records import CASE_1, CASE_2, SVF_CUTOFF, make_record, theta_of

LONGEST = 15.0
DEGREES = {CASE_1: Structure(2, 0), CASE_2: Structure(4, 1)}
THOROUGH = {"max_iterations": 100, "tolerance": 1e-9, "variant": "gauss_newton", "halvings": 12}
CUTOFFS = [0.3, 1.0, 2.02]


def costs_of(record, model=CASE_1, cutoffs=CUTOFFS, order=10):
    lowpasses = [Lowpass(cutoff, order) for cutoff in cutoffs]
    svf_cutoffs = np.full(len(cutoffs), SVF_CUTOFF[model])
    more = {"start": LONGEST, "svf_cutoffs": svf_cutoffs, "steps": steps(**THOROUGH)}
    return filtered_costs(record, lowpasses, DEGREES[model], LONGEST, **more)


def started_at(model, factor=1.0):
    """One start; the delay at its end is not used."""
    return np.append(theta_of(model) * factor, 0.0)[None]


NONE = np.empty((0, 4))


@pytest.mark.parametrize(("model", "cutoffs"), [(CASE_1, CUTOFFS), (CASE_2, [2.685, 26.85])])
def test_least_cost_is_that_of_the_spectra(model, cutoffs):
    # The problem written out at all frequencies, without the cut where a filter passes next to nothing.
    record = make_record(model, snr_db=15, regular=False, n=2500)
    spectra = record_spectra(record, LONGEST, 1.5 * cutoffs[-1], LONGEST)
    costs = costs_of(record, model, cutoffs)
    for k, cutoff in enumerate(cutoffs):
        weight = lowpass_weight(spectra.frequencies, Lowpass(cutoff, 10))
        theta = spectral_refit_numerator(spectra, DEGREES[model], theta_of(model), 7.9, weight)
        problem = spectral_at(spectra, DEGREES[model], 7.9, weight)
        expected = iterate(problem, np.append(theta, 7.9), **THOROUGH)
        found = costs.behind(k).minimise(7.9, started_at(model), False)
        assert found.squared_error == pytest.approx(expected.equations.squared_error, rel=1e-5)
        assert found.delay == 7.9
        sides = np.where(spectra.frequencies > 0, 2.0, 0.0)
        assert costs.spreads[k] == pytest.approx(np.sum(sides * weight * np.abs(spectra.outputs) ** 2))


def test_minimum_is_the_best_of_its_starts():
    cost = costs_of(make_record(snr_db=15, n=2000)).behind(2)
    starts = np.vstack((started_at(CASE_1), started_at(CASE_1, 1e-3)))
    alone = [cost.minimise(7.7, start[None], False).squared_error for start in starts]
    least_squares = cost.minimise(7.7, NONE, True).squared_error
    assert cost.minimise(7.7, starts, False).squared_error == min(alone)
    assert cost.minimise(7.7, starts, True).squared_error == min(*alone, least_squares)
    assert cost.minimise(7.7, NONE, False).squared_error == np.inf


def test_costs_behind_all_filters_are_handed_down_and_up():
    costs = costs_of(make_record(snr_db=5, n=2000))
    thetas, squared_errors = minima_behind_all(costs, 6.5)
    down = [costs.behind(2).minimise(6.5, NONE, True)]
    for k in (1, 0):
        down.insert(0, costs.behind(k).minimise(6.5, down[0].theta[None], False))
    best = down[:1]
    for k in (1, 2):
        up = costs.behind(k).minimise(6.5, best[-1].theta[None], False)
        best.append(min(up, down[k], key=lambda minimum: minimum.squared_error))
    np.testing.assert_allclose(squared_errors, [minimum.squared_error for minimum in best], rtol=1e-9)
    np.testing.assert_allclose(thetas, [minimum.theta for minimum in best], rtol=1e-6)


def test_input_that_rests_while_it_counts_has_no_minimum():
    # All that the output could tell of the input lies before the samples that count.
    t = 0.05 * np.arange(1000)
    costs = costs_of(Record(t, np.sin(t), HeldSignal(t, np.where(t < t[-1], 0.0, 1.0))))
    _, squared_errors = minima_behind_all(costs, 1.0)
    assert np.isinf(squared_errors).all()
    assert percents(squared_errors, costs.spreads).tolist() == [100.0] * 3


@pytest.mark.parametrize("regular", [True, False])
def test_minimum_is_where_the_delay_is(regular):
    # Without noise: the least cost over a lattice lies within a twentieth of the filter's period of the true delay.
    costs = costs_of(make_record(regular=regular), cutoffs=[0.5, 1.0, 2.02])
    for k, cutoff in enumerate((0.5, 1.0, 2.02)):
        delays = 8.0 + np.arange(-10, 11) * 0.02 * 2 * np.pi / cutoff
        delays = delays[delays < LONGEST]
        errors = np.array([costs.behind(k).minimise(d, started_at(CASE_1), False).squared_error for d in delays])
        assert abs(delays[np.argmin(errors)] - 8.0) <= 0.061 * 2 * np.pi / cutoff
        assert percents(errors.min(), costs.spreads[k]) < 1.0
