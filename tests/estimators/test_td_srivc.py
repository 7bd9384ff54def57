"""Coefficients and delay together, on whole records."""

import numpy as np
import pytest

from ctid_cli.estimation.common import Start
from ctid_cli.estimators.srivc import Srivc
from ctid_cli.estimators.td_srivc import TdSrivc
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.inference.bounds import cramer_rao_bound
from ctid_cli.inference.fit import Status
from ctid_cli.signals.record import Record
from tests.estimators.records import CASE_1, CASE_2, SVF_CUTOFF, assert_same_model, make_record


def options(model, **more):
    degrees = {"poles": model.order, "zeros": model.numerator.size - 1}
    return {**degrees, "delay_bounds": (0, 15), "svf_cutoff": SVF_CUTOFF[model], **more}


@pytest.mark.parametrize(
    ("model", "lowpass"),
    [
        (CASE_1, None),
        (CASE_1, Lowpass(0.202, 2)),
        # The fast mode, whose period is 0.31 s, puts a local minimum 0.13 s before the true delay where the input is
        # white: from that side no local search on unfiltered data can pass, and the low-pass filter is what it is for.
        (CASE_2, Lowpass(2.685, 2)),
    ],
)
@pytest.mark.parametrize("regular", [True, False])
# 0.2 s late, case 2 on its irregular clock turns on rounding: one start in four, 1e-9 s apart, ends in a local minimum.
@pytest.mark.parametrize("offset", [0.1, -0.2])
def test_noise_free_data_return_the_true_model_and_delay(model, lowpass, regular, offset):
    # Exact input edges, no samples from the start-up.
    n = 4500 if model is CASE_2 and not regular else None
    record = make_record(model, regular=regular, n=n)
    fit = TdSrivc(**options(model, tolerance=1e-12, lowpass=lowpass)).fit(record, Start(8.0 + offset))
    assert fit.status is Status.CONVERGED
    assert_same_model(fit.model, model, 1e-6)


@pytest.mark.parametrize("regular", [True, False])
def test_published_variant_returns_the_true_model_up_to_its_smallest_step(regular):
    # It ends at delay steps of 1e-5 of the range, without the joint iterations of the guarded variant.
    fit = TdSrivc(**options(CASE_1, tolerance=1e-12, variant="plain")).fit(make_record(regular=regular), Start(8.2))
    assert fit.status is Status.CONVERGED
    assert abs(fit.model.delay - 8.0) < 1e-5 * 15
    assert_same_model(fit.model, CASE_1, 1e-3)


@pytest.mark.parametrize("start", [0.5, 4.0, 7.5, 10.0, 14.0])
def test_a_local_minimum_is_called_one(start):
    # From the right basin the estimate converges, from the others the cost at 8 s is seen to be lower.
    record = make_record(seed=11, snr_db=10.0)
    fit = TdSrivc(2, 0, (0.0, 15.0)).fit(record, Start(start))
    if abs(start - 8.0) < 1.0:
        assert fit.status is Status.CONVERGED
        assert fit.model.delay == pytest.approx(8.0, abs=0.1)
    else:
        assert (fit.status is Status.LOCAL) == (abs(fit.model.delay - 8.0) > 0.1)


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_hold_of_the_output_does_not_move_the_estimate(model, regular):
    record = make_record(model, snr_db=15, regular=regular, n=4000)
    fits = [
        TdSrivc(**options(model, tolerance=1e-11, hold_output=hold)).fit(record, Start(8.05)) for hold in ("foh", "zoh")
    ]
    assert fits[0].status is fits[1].status is Status.CONVERGED
    assert_same_model(fits[0].model, fits[1].model, 1e-8)


@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_at_the_estimated_delay_it_is_srivc(model):
    # SRIVC with that delay solves the same equations for the coefficients, on the same samples.
    record = make_record(model, snr_db=15)
    fit = TdSrivc(**options(model, tolerance=1e-11)).fit(record, Start(8.05))
    from_start = Record(record.t, np.where(record.t < 15 - 1e-9, np.nan, record.y), record.input)
    more = options(model, tolerance=1e-11)
    del more["delay_bounds"]
    fixed = Srivc(**more, delay=fit.model.delay).fit(from_start)
    assert fixed.count == fit.count
    assert_same_model(fixed.model, fit.model, 1e-7)
    assert fixed.cost == pytest.approx(fit.cost, rel=1e-10)
    # A delay that must be estimated makes the coefficients less certain, never more.
    assert all(fixed.standard_errors[name] < fit.standard_errors[name] for name in fixed.standard_errors)


def test_standard_errors_are_the_bound_at_the_estimate():
    # The Cramér-Rao formula at the estimated model and noise level.
    record = make_record(snr_db=15)
    fit = TdSrivc(**options(CASE_1)).fit(record, Start(7.0))
    variance = fit.cost * fit.count / (fit.count - 4)
    bound = cramer_rao_bound(fit.model, record, np.sqrt(variance), 15.0)
    np.testing.assert_allclose(fit.covariance, bound, rtol=1e-8, atol=1e-12)
    assert list(fit.standard_errors) == ["a1", "a2", "b0", "delay"]


@pytest.mark.parametrize("lowpass", [None, Lowpass(0.202, 2)])
def test_cost_falls_within_every_stage(lowpass):
    fit = TdSrivc(**options(CASE_1, lowpass=lowpass)).fit(make_record(snr_db=5), Start(7.0))
    stages = {}
    for entry in fit.history:
        stages.setdefault(entry.stage, []).append(entry)
    assert list(stages) == ["search"] + ["refine"] * (lowpass is not None) + ["joint"]
    for entries in stages.values():
        assert [entry.iteration for entry in entries] == list(range(len(entries)))
        costs = np.array([entry.cost for entry in entries])
        assert (np.diff(costs) <= 1e-12 * costs[0]).all()
    assert fit.history[-1].cost == pytest.approx(fit.cost, rel=1e-12)
    assert fit.history[-1].delay == fit.model.delay
    assert fit.iterations == len(fit.history) - len(stages)


@pytest.mark.parametrize("regular", [True, False])
def test_lowpass_filter_widens_the_region_of_convergence(regular):
    # From 3 s the plain search is caught by a local minimum; the filtered one finds the true delay.
    record = make_record(snr_db=15, regular=regular)
    direct = TdSrivc(**options(CASE_1)).fit(record, Start(3.0))
    filtered = TdSrivc(**options(CASE_1, lowpass=Lowpass(0.4, 2))).fit(record, Start(3.0))
    assert abs(direct.model.delay - 8.0) > 1.0
    assert abs(filtered.model.delay - 8.0) < 0.08
    assert filtered.cost < 0.5 * direct.cost


def test_without_a_start_the_middle_of_the_bounds_is_taken():
    estimator, record = TdSrivc(**options(CASE_1, delay_bounds=(6, 11))), make_record(snr_db=15, n=2000)
    assert estimator.fit(record).history == estimator.fit(record, Start(8.5)).history


@pytest.mark.parametrize(("bounds", "start", "bound"), [((0, 7.5), 7.2, 7.5), ((8.1, 12), 8.4, 8.1)])
@pytest.mark.parametrize("variant", ["plain", "guarded"])
def test_true_delay_beyond_a_bound_ends_at_the_bound(variant, bounds, start, bound):
    # The cost falls all the way to the bound; that is neither convergence nor a stall.
    fit = TdSrivc(2, 0, bounds, variant=variant).fit(make_record(snr_db=15), Start(start))
    assert fit.model.delay == pytest.approx(bound, abs=2e-3)
    assert fit.status is Status.DELAY_AT_BOUND
    assert not fit.status.succeeded


def test_too_few_iterations_say_so():
    fit = TdSrivc(2, 0, (0, 15), max_iterations=1, variant="plain").fit(make_record(snr_db=15), Start(7.0))
    assert fit.status is Status.MAX_ITERATIONS
