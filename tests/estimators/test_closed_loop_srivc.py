"""Closed-loop instruments: reference numbers, CLSRIVC, invariances, integrators, limit cycles, bias, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from ctid_cli.errors import DataError
from ctid_cli.estimation.additive_problem import AdditiveProblem, loop_data
from ctid_cli.estimation.common import Start
from ctid_cli.estimators.additive_srivc import AdditiveSrivc
from ctid_cli.estimators.srivc import Srivc
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.loop import loop_radius, simulate_loop
from ctid_cli.inference.fit import Status
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.controller import DiscreteController
from ctid_cli.models.factoring import factored
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Loop, Record
from tests.estimators.additive_records import (
    INTERVAL,
    MODE,
    PID,
    TWO_MODES,
    assert_parameters,
    deviations,
    disturbed,
    loop_record,
    modes,
    open_record,
)

TWO = (MODE, MODE)
#: PD control of integrating systems.
PD = DiscreteController.from_pid(0.5, 0.0, 2.0)
DELAYED = AdditiveModel(TWO_MODES.submodels, 0.12)
BIPROPER = AdditiveModel([TWO_MODES.submodels[0], Submodel([0.3, 0.5], [0.1, 1.0])])


def fitted(record, start, **options):
    model = start if isinstance(start, AdditiveModel) else disturbed(*start)
    options = {"instruments": "closed_loop", **options}
    return AdditiveSrivc(terms=model.terms, delay=model.delay, **options).fit(record, Start(model=model))


def reference_record():
    rng = np.random.default_rng(5)
    r, v = rng.standard_normal(3000), 0.1 * rng.standard_normal(3000)
    u, x = simulate_loop(TWO_MODES, PID, r, v, INTERVAL)
    t = INTERVAL * np.arange(3000)
    return Record(t, x + v, HeldSignal(t, u), noise_free=x, loop=Loop(r, PID))


@pytest.mark.parametrize("variant", ["plain", "relaxed"])
def test_reference_estimate(variant):
    fit = fitted(reference_record(), (TWO_MODES, 1), variant=variant, tolerance=1e-10)
    assert fit.status is Status.CONVERGED
    expected = [0.2525147842, 0.2520988224, 2.9731573318, 0.0105729478, 0.0250662962, 1.055782623]
    np.testing.assert_allclose(fit.additive.theta, expected, rtol=1e-6)
    assert fit.cost == pytest.approx(0.010247018062, rel=1e-8)
    assert fit.loop_radius == pytest.approx(loop_radius(fit.additive, PID, INTERVAL), rel=1e-9)
    assert fit.loop_radius < 1


# Published forms with one transfer function: a1, a2, b0, b1 of each mode after factoring.
DIRECT = [
    0.2614989003,
    0.2620573993,
    3.006078987,
    0.1293118982,
    0.01026209494,
    0.02494293123,
    1.000089481,
    -0.0123080584,
]
CLOSED = [
    0.2601848654,
    0.2619285108,
    2.995978495,
    0.1261494879,
    0.01026263713,
    0.02493611947,
    1.004863998,
    -0.0120096842,
]


@pytest.mark.parametrize(("instruments", "expected"), [("open_loop", DIRECT), ("closed_loop", CLOSED)])
def test_reference_estimates_of_the_unfactored_model(instruments, expected):
    estimator = Srivc(4, 2, instruments=instruments, tolerance=1e-10)
    fit = estimator.fit(reference_record(), Start(model=disturbed(TWO_MODES, 1)))
    assert fit.status is Status.CONVERGED
    np.testing.assert_allclose(factored(fit.model).theta, expected, rtol=1e-6)


def filtered(matrix, gain, source):
    """Return the states of a filter driven by a held signal, at the samples."""
    dynamics, drive, *_ = cont2discrete((matrix, gain, np.eye(len(matrix)), np.zeros_like(gain)), INTERVAL)
    states = np.zeros((source.size, len(matrix)))
    for k in range(source.size - 1):
        states[k + 1] = dynamics @ states[k] + drive[:, 0] * source[k]
    return states


def test_estimate_with_closed_loop_instruments_solves_the_equations_of_clsrivc():
    # By companion matrices and difference equations: sum psi eps = 0, psi from the noise-free loop of the estimate.
    record = reference_record()
    fit = Srivc(4, 2, instruments="closed_loop", tolerance=1e-11).fit(record, Start(model=disturbed(TWO_MODES, 1)))
    a, b, n = fit.model.denominator, fit.model.numerator, 4
    A, B, C = np.vstack((-a[1:], np.eye(n)[:-1])), np.eye(n, 1), np.concatenate(([0.0], b))[None]
    numerator, denominator, *_ = cont2discrete((b, a), INTERVAL)
    closed = np.polyadd(np.polymul(denominator, PID.denominator), np.polymul(numerator[0], PID.numerator))
    z = lfilter(np.polymul(PID.numerator, denominator), closed, record.loop.reference)
    eps = record.y - filtered(A, B, record.input.values) @ C[0]
    double = np.block([[A, np.zeros((n, n))], [B @ C, A]])
    states = filtered(double, np.vstack((B, 0 * B)), z)
    psi = np.column_stack((-states[:, n:], states[:, n - b.size : n]))
    correlation = psi.T @ eps / np.sqrt((psi**2).sum(axis=0) * (eps @ eps))
    assert np.abs(correlation).max() < 1e-8
    # The direct estimate differs.
    direct = Srivc(4, 2, tolerance=1e-11).fit(record, Start(model=disturbed(TWO_MODES, 1)))
    assert np.abs(direct.model.numerator / b - 1).max() > 1e-4


@pytest.mark.parametrize("enters", ["controller", "input"])
@pytest.mark.parametrize("system", [TWO_MODES, DELAYED, BIPROPER], ids=["modes", "delay", "biproper"])
def test_noise_free_loop_returns_the_true_model(system, enters):
    record = loop_record(system, 1500, 0.0, 8, enters=enters)
    for instruments in ("open_loop", "closed_loop"):
        fit = fitted(record, (system, 1, 0.02), instruments=instruments, tolerance=1e-11)
        assert fit.status is Status.CONVERGED
        assert_parameters(fit, system, 1e-7)


def test_relaxed_steps_end_a_cycle_of_full_ones():
    # A short record on which full steps do not converge.
    record = loop_record(TWO_MODES, 500, 0.1, 150)
    start = disturbed(TWO_MODES, 1150)
    assert fitted(record, start, variant="plain").status is Status.MAX_ITERATIONS
    fit = fitted(record, start, variant="relaxed")
    assert fit.status is Status.CONVERGED
    assert fit.iterations < 60
    # It is a root of the same equations.
    problem = AdditiveProblem(filter_data(record), TWO, 0.0, loop_data(record, "closed_loop"))
    equations = problem.equations(fit.additive.theta)
    lengths = np.sqrt(np.diag(equations.hessian) * equations.squared_error)
    assert np.abs(equations.instrument_error / lengths).max() < 1e-6


def test_coloured_noise_in_a_loop_biases_direct_instruments_only():
    # v = e/(1 - 0.9 q^-1) of variance 0.01: direct estimates of the second mode are biased by several deviations.
    estimates = {"open_loop": [], "closed_loop": []}
    for seed in range(12):
        record = loop_record(TWO_MODES, 20000, 0.1 * np.sqrt(1 - 0.81), 300 + seed, filter=([1.0], [1.0, -0.9]))
        for instruments, found in estimates.items():
            fit = fitted(record, (TWO_MODES, seed), instruments=instruments, covariance="sandwich")
            assert fit.status is Status.CONVERGED
            found.append(deviations(fit, TWO_MODES))
    closed, direct = (np.array(estimates[name]) for name in ("closed_loop", "open_loop"))
    # The mean of 12 unbiased standardised estimates lies within 4/sqrt(12) = 1.15 of zero with 99.99 % confidence.
    assert np.abs(closed.mean(axis=0)).max() < 1.15
    assert (np.abs(direct.mean(axis=0))[[3, 5]] > 2.5).all()
    # Their standard deviation is one: the mean square of 72 lies within 0.5 and 1.7.
    assert 0.5 < np.mean((closed - closed.mean(axis=0)) ** 2) * 12 / 11 < 1.7


ESTIMATORS = [
    (AdditiveSrivc(terms=TWO, instruments="closed_loop"), TWO_MODES),
    (Srivc(4, 2, instruments="closed_loop"), TWO_MODES),
]


@pytest.mark.parametrize(("estimator", "model"), ESTIMATORS, ids=["additive", "srivc"])
def test_record_without_a_loop_is_refused(estimator, model):
    record = open_record(TWO_MODES, 200, 0.1, 1)
    with pytest.raises(DataError, match=r"need the reference and the controller.* or use instruments 'open_loop'"):
        estimator.fit(record, Start(model=model))
    irregular = open_record(TWO_MODES, 200, 0.1, 1, times=np.cumsum(np.random.default_rng(1).uniform(0.02, 0.08, 200)))
    with pytest.raises(DataError, match="need the reference and the controller"):
        estimator.fit(irregular, Start(model=model))
    with pytest.raises(DataError, match="a closed loop needs a regular clock"):
        replace(irregular, loop=Loop(np.zeros(200), PID))
    with pytest.raises(DataError, match="in a closed loop the input is held"):
        replace(record, inputs=HeldSignal(record.t, record.input.values, "foh"), loop=Loop(np.zeros(200), PID))
    with pytest.raises(DataError, match="the reference has 199 values for 200 samples"):
        replace(record, loop=Loop(np.zeros(199), PID))


@pytest.mark.parametrize(("estimator", "model"), ESTIMATORS, ids=["additive", "srivc"])
def test_start_that_makes_an_unstable_loop_is_refused(estimator, model):
    record = loop_record(TWO_MODES, 2000, 0.1, 1)
    wild = modes([0.25, 0.25, 60.0, 0.01, 0.025, 40.0])
    radius = loop_radius(wild, PID, INTERVAL)
    assert radius > 1.05
    with pytest.raises(
        DataError, match=r"start makes an unstable loop .*magnitude 1\.\d+.* start closer, or .*'open_loop'"
    ):
        estimator.fit(record, Start(model=wild))


def test_loop_without_a_solution_is_refused():
    # A direct loop gain of -1 at the start: no input satisfies the loop equations.
    record = open_record(BIPROPER, 200, 0.1, 1)
    looped = replace(record, loop=Loop(np.ones(200), DiscreteController([-1 / 3.0], [1.0])))
    assert BIPROPER.submodels[1].transfer_function().numerator[0] == pytest.approx(3.0)
    with pytest.raises(DataError, match="the loop has no solution"):
        AdditiveSrivc(terms=BIPROPER.terms, instruments="closed_loop").fit(looped, Start(model=BIPROPER))


@pytest.mark.parametrize("enters", ["controller", "input"])
@pytest.mark.parametrize("controller", [PID, PD, DiscreteController([0.02, -0.004], [1.0, -0.5, 0.06])])
def test_loop_of_the_record_is_the_one_that_instruments_are_simulated_in(controller, enters):
    # A controller with a delay of one sample has fewer numerator coefficients than the others.
    record = loop_record(DELAYED, 400, 0.1, 13, controller=controller, enters=enters)
    problem = AdditiveProblem(filter_data(record), DELAYED.terms, DELAYED.delay, loop_data(record, "closed_loop"))
    *_, output = problem.filter.rows(DELAYED.theta)
    expected = simulate_loop(DELAYED, controller, record.loop.reference, 0.0, INTERVAL, enters).x
    np.testing.assert_allclose(output, expected, atol=1e-9 * np.abs(expected).max())
