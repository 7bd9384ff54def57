"""SRIVC, its delay known or estimated, and the state-variable-filter estimate on whole records."""

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.estimation.common import Start
from ctid_cli.estimators.srivc import Srivc
from ctid_cli.estimators.svf import Svf
from ctid_cli.estimators.td_srivc import TdSrivc
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.bounds import cramer_rao_bound
from ctid_cli.inference.fit import Status
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from tests.estimators.records import CASE_1, CASE_2, SVF_CUTOFF, assert_same_model, make_record


def known(model, estimator=Srivc, **more):
    """Return an estimator at the true delay."""
    return estimator(model.order, model.numerator.size - 1, delay=model.delay, svf_cutoff=SVF_CUTOFF[model], **more)


def searched(model, **more):
    """Return an estimator of coefficients and delay."""
    return TdSrivc(model.order, model.numerator.size - 1, (0, 15), svf_cutoff=SVF_CUTOFF[model], **more)


EXACT = [
    (model, known(model, variant=variant, tolerance=1e-12), None)
    for model in (CASE_1, CASE_2)
    for variant in ("plain", "guarded")
]
# The fast mode of case 2, with a period of 0.31 s, causes a local minimum 0.13 s before the true delay if the input is
# white: no local search on unfiltered data passes it from that side, which is the purpose of the low-pass filter.
# 0.2 s late, case 2 on its irregular clock depends on rounding: of starts 1e-9 s apart, one in four is trapped.
EXACT += [
    (model, searched(model, lowpass=lowpass, tolerance=1e-12), Start(start))
    for model, lowpass in ((CASE_1, None), (CASE_1, Lowpass(0.202, 2)), (CASE_2, Lowpass(2.685, 2)))
    for start in (8.1, 7.8)
]


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize(("model", "estimator", "start"), EXACT)
def test_noise_free_data_return_the_true_model_and_delay(model, estimator, start, regular):
    # Exact input edges, no samples from the start-up.
    n = 4500 if model is CASE_2 and not regular else None
    fit = estimator.fit(make_record(model, regular=regular, n=n), start)
    assert fit.status is Status.CONVERGED
    assert_same_model(fit.model, model, 1e-6)


@pytest.mark.parametrize("replicate", range(3))
def test_starts_from_the_record_reach_the_estimate_that_a_good_cutoff_gives(replicate):
    # Two modes, a decade apart: a cut-off of 1 rad/s fails on two thirds of such records.
    record = make_record(CASE_2, seed=5, replicate=replicate, snr_db=10.0, n=2000)
    found = Srivc(4, 1, delay=8.0).fit(record)
    assert found.status is Status.CONVERGED
    assert found.cost <= known(CASE_2).fit(record).cost * (1 + 1e-9)


@pytest.mark.parametrize("hold_output", ["zoh", "foh"])
def test_fine_sampling_makes_the_state_variable_filter_exact(hold_output):
    # Without noise, the only error is the interpolation of the output: it decreases with the interval.
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


def test_too_few_iterations_say_so():
    fit = known(CASE_2, max_iterations=1, tolerance=1e-12).fit(make_record(CASE_2, snr_db=5))
    assert (fit.status, fit.iterations) == (Status.MAX_ITERATIONS, 1)
    fit = TdSrivc(2, 0, (0, 15), max_iterations=1, variant="plain").fit(make_record(snr_db=15), Start(7.0))
    assert fit.status is Status.MAX_ITERATIONS


def single_tone(noise=0.0):
    """Return the steady response to one sinusoid, which has only two numbers: amplitude and phase."""
    t = 0.05 * np.arange(3000)
    held = HeldSignal(t, np.sin(1.3 * t))
    y = simulate(TransferFunction([2.0], [1.0, 2.0], 1.0), held, t)
    return Record(t, y + noise * np.random.default_rng(0).standard_normal(t.size), held)


def test_one_tone_determines_two_parameters():
    fit = Srivc(1, 0, delay=1.0).fit(single_tone(0.1))
    assert fit.status is Status.CONVERGED
    for name in ("a1", "b0"):
        assert abs(fit.parameters[name] - 2.0) < 4 * fit.standard_errors[name]
    # Two poles and a gain without noise: the equations are singular.
    fit = Srivc(2, 0, delay=1.0).fit(single_tone())
    assert not fit.status.succeeded
    assert all(np.isnan(error) for error in fit.standard_errors.values())


@pytest.mark.parametrize("estimator", [Svf(2, 0), Srivc(2, 0)])
def test_input_that_never_reaches_the_output_is_singular(estimator):
    # At rest until the last sample: not constant, but without a filtered response.
    t = 0.1 * np.arange(200)
    record = Record.from_arrays(t, np.where(t < t[-1], 0.0, 1.0), np.sin(t))
    with pytest.raises(DataError, match="equations became singular: the data do not determine all parameters"):
        estimator.fit(record)


@pytest.mark.parametrize("start", [0.5, 4.0, 7.5, 10.0, 14.0])
def test_a_local_minimum_is_called_one(start):
    # From the right basin the estimate converges; from the others, the cost at 8 s is lower.
    record = make_record(seed=11, snr_db=10.0)
    fit = TdSrivc(2, 0, (0.0, 15.0)).fit(record, Start(start))
    if abs(start - 8.0) < 1.0:
        assert fit.status is Status.CONVERGED
        assert fit.model.delay == pytest.approx(8.0, abs=0.1)
    else:
        assert (fit.status is Status.LOCAL) == (abs(fit.model.delay - 8.0) > 0.1)


@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_at_the_estimated_delay_it_is_srivc(model):
    # SRIVC with that delay solves the same equations for the coefficients, on the same samples.
    record = make_record(model, snr_db=15)
    fit = searched(model, tolerance=1e-11).fit(record, Start(8.05))
    from_start = Record(record.t, np.where(record.t < 15 - 1e-9, np.nan, record.y), record.input)
    fixed = Srivc(model.order, model.numerator.size - 1, delay=fit.model.delay, tolerance=1e-11).fit(from_start)
    assert fixed.count == fit.count
    assert_same_model(fixed.model, fit.model, 1e-7)
    assert fixed.cost == pytest.approx(fit.cost, rel=1e-10)
    # Estimating the delay increases the standard errors of the coefficients.
    assert all(fixed.standard_errors[name] < fit.standard_errors[name] for name in fixed.standard_errors)


def test_standard_errors_are_the_bound_at_the_estimate():
    # The Cramér-Rao formula at the estimated model and noise level.
    record = make_record(snr_db=15)
    fit = searched(CASE_1, covariance="white").fit(record, Start(7.0))
    variance = fit.cost * fit.count / (fit.count - 4)
    bound = cramer_rao_bound(fit.model, record, np.sqrt(variance), 15.0)
    np.testing.assert_allclose(fit.covariance, bound, rtol=1e-8, atol=1e-12)
    assert list(fit.standard_errors) == ["a1", "a2", "b0", "delay"]


@pytest.mark.parametrize(("bounds", "start", "bound"), [((0, 7.5), 7.2, 7.5), ((8.1, 12), 8.4, 8.1)])
@pytest.mark.parametrize("variant", ["plain", "guarded"])
def test_true_delay_beyond_a_bound_ends_at_the_bound(variant, bounds, start, bound):
    # The cost decreases all the way to the bound; that is neither convergence nor a stall.
    fit = TdSrivc(2, 0, bounds, variant=variant).fit(make_record(snr_db=15), Start(start))
    assert fit.model.delay == pytest.approx(bound, abs=2e-3)
    assert fit.status is Status.DELAY_AT_BOUND
    assert not fit.status.succeeded
