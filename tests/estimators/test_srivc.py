"""SRIVC and the state-variable-filter estimate on whole records."""

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.estimators.srivc import Srivc
from ctid_cli.estimators.svf import Svf
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.criteria import fit_percent, r_squared
from ctid_cli.inference.fit import Status
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from tests.estimators.records import CASE_1, CASE_2, SVF_CUTOFF, assert_same_model, make_record


def options(model, **more):
    degrees = {"poles": model.order, "zeros": model.numerator.size - 1}
    return {**degrees, "delay": model.delay, "svf_cutoff": SVF_CUTOFF[model], **more}


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("variant", ["plain", "guarded"])
@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_noise_free_data_return_the_true_model(model, variant, regular):
    fit = Srivc(**options(model, variant=variant, tolerance=1e-12)).fit(make_record(model, regular=regular))
    assert fit.status is Status.CONVERGED
    assert_same_model(fit.model, model, 1e-6)


@pytest.mark.parametrize("replicate", range(3))
def test_starts_from_the_record_reach_the_estimate_that_a_good_cutoff_gives(replicate):
    # Two modes, a decade apart: a cut-off of 1 rad/s loses two thirds of such records.
    record = make_record(CASE_2, seed=5, replicate=replicate, snr_db=10.0, n=2000)
    found = Srivc(4, 1, delay=8.0).fit(record)
    known = Srivc(**options(CASE_2)).fit(record)
    assert found.status is Status.CONVERGED
    assert found.cost <= known.cost * (1 + 1e-9)


@pytest.mark.parametrize("hold_output", ["zoh", "foh"])
def test_fine_sampling_makes_the_state_variable_filter_exact(hold_output):
    # Its only error without noise is the interpolation of the output: it falls with the interval.
    errors = []
    for interval in (0.1, 0.05, 0.025):
        t = np.arange(0, 100, interval)
        held = HeldSignal(t, np.sin(1.7 * t) + np.sin(0.6 * t), "foh")
        record = Record(t, simulate(CASE_1, held, t), held)
        fit = Svf(2, 0, delay=8.0, hold_output=hold_output).fit(record)
        assert fit.status is Status.LEAST_SQUARES
        errors.append(abs(fit.model.denominator[2] / 4.0 - 1))
    order = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (order > (1.8 if hold_output == "foh" else 0.8)).all()


@pytest.mark.parametrize("estimator", [Svf, Srivc])
def test_report_is_that_of_the_simulated_model(estimator):
    # Cost and fit of the samples after the delay, recomputed by simulation.
    record = make_record(snr_db=15)
    fit = estimator(**options(CASE_1)).fit(record)
    used = record.t >= 8.0 - 1e-9
    y, x = record.y[used], simulate(fit.model, record.input, record.t)[used]
    assert fit.count == used.sum()
    assert fit.cost == pytest.approx(np.mean((y - x) ** 2), rel=1e-9)
    assert fit.r2 == pytest.approx(r_squared(y, x), rel=1e-9)
    assert fit.fit_percent == pytest.approx(fit_percent(y, x), rel=1e-9)
    assert fit.model.delay == 8.0


def test_history_ends_at_the_estimate_and_counts_the_iterations():
    fit = Srivc(**options(CASE_2)).fit(make_record(CASE_2, snr_db=15))
    assert [entry.iteration for entry in fit.history] == list(range(fit.iterations + 1))
    assert {entry.stage for entry in fit.history} == {"refine"}
    assert fit.history[-1].denominator == tuple(fit.model.denominator)
    assert fit.history[-1].cost == pytest.approx(fit.cost, rel=1e-12)
    costs = [entry.cost for entry in fit.history]
    assert (np.diff(costs) <= 1e-12 * costs[0]).all()


@pytest.mark.parametrize("variant", ["plain", "guarded"])
@pytest.mark.parametrize("regular", [True, False])
def test_hold_of_the_output_does_not_move_the_estimate(regular, variant):
    record = make_record(snr_db=5, regular=regular)
    fits = [
        Srivc(**options(CASE_1, hold_output=h, variant=variant, tolerance=1e-11)).fit(record) for h in ("zoh", "foh")
    ]
    assert_same_model(fits[0].model, fits[1].model, 1e-8)
    # They took different paths there.
    assert fits[0].history[0].denominator != fits[1].history[0].denominator


def test_too_few_iterations_say_so():
    fit = Srivc(**options(CASE_2, max_iterations=1, tolerance=1e-12)).fit(make_record(CASE_2, snr_db=5))
    assert fit.status is Status.MAX_ITERATIONS
    assert fit.iterations == 1


def single_tone(noise=0.0):
    """The steady response to one sinusoid: two numbers, amplitude and phase, are all it can tell."""
    t = 0.05 * np.arange(3000)
    held = HeldSignal(t, np.sin(1.3 * t))
    y = simulate(TransferFunction([2.0], [1.0, 2.0], 1.0), held, t)
    return Record(t, y + noise * np.random.default_rng(0).standard_normal(t.size), held)


def test_one_tone_determines_two_parameters():
    fit = Srivc(1, 0, delay=1.0).fit(single_tone(0.1))
    assert fit.status is Status.CONVERGED
    for name in ("a1", "b0"):
        assert abs(fit.parameters[name] - 2.0) < 4 * fit.standard_errors[name]
    # Two poles and a gain, and no noise: the equations are singular.
    fit = Srivc(2, 0, delay=1.0).fit(single_tone())
    assert not fit.status.succeeded
    assert all(np.isnan(error) for error in fit.standard_errors.values())


@pytest.mark.parametrize("estimator", [Svf(2, 0), Srivc(2, 0)])
def test_input_that_never_reaches_the_output_is_singular(estimator):
    # It rests until the last sample: not constant, yet nothing that a filter passes on.
    t = 0.1 * np.arange(200)
    record = Record.from_arrays(t, np.where(t < t[-1], 0.0, 1.0), np.sin(t))
    with pytest.raises(DataError, match="equations became singular: the data do not determine all parameters"):
        estimator.fit(record)
