"""Additive SRIVC in open loop: the published iteration, reference numbers, invariances, states, accuracy, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from ctid_cli.errors import DataError
from ctid_cli.estimation.additive_problem import AdditiveProblem
from ctid_cli.estimation.common import Start
from ctid_cli.estimation.iteration import Steps, iterate
from ctid_cli.estimators.additive_srivc import AdditiveSrivc
from ctid_cli.estimators.srivc import Srivc
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.simulate import simulate, simulate_additive
from ctid_cli.inference.fit import Status
from ctid_cli.models.additive import AdditiveModel, Submodel, Term
from ctid_cli.models.controller import DiscreteController
from ctid_cli.models.factoring import factored, factored_jacobian, unfactored
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from tests.estimators.additive_records import (
    FOUR_MODES,
    INTERVAL,
    MODE,
    TWO_MODES,
    assert_parameters,
    deviations,
    disturbed,
    loop_record,
    modes,
    open_record,
)
from tests.estimators.records import assert_same_model

TWO = (MODE, MODE)
MIXED = AdditiveModel([Submodel([0.2, 2.0], [0.7, 1.0]), Submodel([0.4], [0.05, 0.01, 1.0])], 0.12)
DELAYED = AdditiveModel(TWO_MODES.submodels, 0.12)
#: Sum of 1/p and 1/p^2, each with a flexible mode.
DRIVE = AdditiveModel([Submodel([0.5], [0.4, 1.0], 1), Submodel([0.2], [0.02, 0.02, 1.0])])
RIGID = AdditiveModel([Submodel([0.3], [1.0], 2), Submodel([0.2], [0.02, 0.02, 1.0])])


def fitted(record, start, **options):
    model = start if isinstance(start, AdditiveModel) else disturbed(*start)
    return AdditiveSrivc(terms=model.terms, delay=model.delay, **options).fit(record, Start(model=model))


def published_step(record, model, hold_output):
    """Solve equation (29) as printed: a right-hand side for every submodel, and one matrix."""
    x = [simulate(TransferFunction(*_of(part), model.delay), record.input, record.t) for part in model.submodels]
    psi, phi, targets = [], [], []
    for part, own in zip(model.submodels, x, strict=True):
        term, a, b = part.term(), part.denominator, part.numerator
        origin = np.zeros(term.integrators)
        left = HeldSignal(record.t, record.y - np.sum(x, axis=0) + own, hold_output)

        def of_input(numerator, denominator):
            return simulate(TransferFunction(numerator, denominator, model.delay), record.input, record.t)

        for k in range(1, term.poles + 1):
            power = np.append(1.0, np.zeros(k))
            psi.append(-of_input(np.polymul(power, b), np.append(np.polymul(a, a), origin)))
            phi.append(-simulate(TransferFunction(power, a), left, record.t))
        for k in range(term.zeros + 1):
            psi.append(of_input(np.append(1.0, np.zeros(k)), np.append(a, origin)))
            phi.append(psi[-1])
        targets.append(simulate(TransferFunction([1.0], a), left, record.t) if term.poles else left.at(record.t))
    used = record.t >= record.t[0] + model.delay - 1e-9
    psi, phi, targets = (np.column_stack(part)[used] for part in (psi, phi, targets))
    size = np.sqrt((psi**2).sum(axis=0))
    return np.linalg.solve((psi / size).T @ (phi / size), (psi / size).T @ targets) / size[:, None]


def _of(part):
    return part.numerator, np.append(part.denominator, np.zeros(part.integrators))


@pytest.mark.parametrize("hold_output", ["zoh", "foh"])
@pytest.mark.parametrize("system", [TWO_MODES, MIXED, DRIVE, RIGID], ids=["modes", "mixed", "drive", "rigid"])
def test_step_is_the_published_one(system, hold_output):
    # Diagonal blocks are the new parameters; off the diagonal is only the common change.
    record = open_record(system, 600, 0.1, 3)
    start = disturbed(system, 4)
    problem = AdditiveProblem(filter_data(record, system.delay, hold_output), system.terms, system.delay)
    result = iterate(problem, start.theta, Steps(1, 1e-12, "plain"))
    change = result.theta - start.theta
    expected = np.tile(change[:, None], (1, len(system.terms)))
    first = 0
    for k, term in enumerate(system.terms):
        expected[first : first + term.size, k] += start.theta[first : first + term.size]
        first += term.size
    found = published_step(record, start, hold_output)
    assert np.abs((found - expected) / (np.abs(start.theta) + np.abs(change))[:, None]).max() <= 1e-9


def reference_record():
    rng = np.random.default_rng(0)
    t = INTERVAL * np.arange(5000)
    u = HeldSignal(t, rng.standard_normal(5000))
    v = lfilter([1.0, 0.5], [1.0, -0.85], np.sqrt(0.02) * rng.standard_normal(5000))
    return Record(t, simulate_additive(FOUR_MODES, u, t) + v, u)


@pytest.mark.parametrize("variant", ["plain", "relaxed", "guarded"])
def test_reference_estimate_of_four_modes(variant):
    # Values of an independent implementation.
    fit = fitted(reference_record(), (FOUR_MODES, 1), variant=variant, tolerance=1e-10)
    assert fit.status is Status.CONVERGED
    gains = [2.90641429, 0.40364981, 0.19854286, 0.06228051]
    np.testing.assert_allclose([part.dc_gain for part in fit.additive.submodels], gains, rtol=1e-6)
    assert fit.cost == pytest.approx(0.16533830866, rel=1e-8)


def record_of(system, n, noise, seed, instruments, **options):
    """Return a record in open or in closed loop."""
    return (open_record if instruments == "open_loop" else loop_record)(system, n, noise, seed, **options)


@pytest.mark.parametrize(
    ("system", "initial_state", "instruments"),
    [
        (TWO_MODES, "rest", "open_loop"),
        (MIXED, "estimated", "open_loop"),
        (DRIVE, "estimated", "open_loop"),
        (TWO_MODES, "rest", "closed_loop"),
        (DELAYED, "rest", "closed_loop"),
    ],
)
def test_hold_of_the_output_does_not_move_the_estimate(system, initial_state, instruments):
    record = record_of(system, 3000, 0.2, 5, instruments)
    options = {"initial_state": initial_state, "instruments": instruments, "tolerance": 1e-11}
    one, two = (fitted(record, (system, 2, 0.02), hold_output=hold, **options) for hold in ("foh", "zoh"))
    assert one.status is two.status is Status.CONVERGED
    np.testing.assert_allclose(one.additive.theta, two.additive.theta, rtol=1e-8)
    assert one.history[1].denominator != two.history[1].denominator


@pytest.mark.parametrize("instruments", ["open_loop", "closed_loop"])
@pytest.mark.parametrize(
    "submodel",
    [
        Submodel([2.0], [0.25, 0.2, 1.0]),
        Submodel([0.02, -0.3, 1.0], [0.1, 0.35, 0.8, 1.0]),
        Submodel([2.0], [0.7, 1.0]),
    ],
)
def test_one_submodel_is_srivc(submodel, instruments):
    system = AdditiveModel([submodel], 0.13)
    record = record_of(system, 2000, 0.2, 6, instruments)
    start, term = Start(model=disturbed(system, 7)), submodel.term()
    options = {"instruments": instruments, "delay": 0.13, "covariance": "sandwich", "tolerance": 1e-12}
    one = AdditiveSrivc(terms=system.terms, **options).fit(record, start)
    two = Srivc(term.poles, term.zeros, **options).fit(record, start)
    assert one.status is two.status is Status.CONVERGED
    assert_same_model(one.model, two.model, 1e-10)
    assert one.cost == pytest.approx(two.cost, rel=1e-10)
    assert one.fit_percent == pytest.approx(two.fit_percent, rel=1e-10)
    assert one.count == two.count == 1997
    # The covariance of the anti-monic form is that of the monic one by the delta method.
    if term.zeros == term.poles - 1:
        jacobian = factored_jacobian(two.model, factored(two.model, system.terms))
        size = np.sqrt(np.outer(*2 * [np.diag(one.covariance)]))
        np.testing.assert_allclose(jacobian @ two.covariance @ jacobian.T / size, one.covariance / size, atol=1e-7)


def test_order_of_the_terms_does_not_matter():
    # Submodels of different structure, which are distinguishable.
    system = AdditiveModel([*TWO_MODES.submodels, Submodel([0.3, 1.5], [0.2, 1.0])])
    record = open_record(system, 3000, 0.2, 8)
    start = disturbed(system, 3)
    turned = AdditiveModel([start.submodels[k] for k in (1, 2, 0)])
    one, two = (fitted(record, model) for model in (start, turned))
    assert one.additive.terms == two.additive.terms
    assert one.parameter_names == two.parameter_names == one.additive.names
    # Submodels are summed in a fixed order, so that rounding is equal too.
    np.testing.assert_array_equal(one.additive.theta, two.additive.theta)
    np.testing.assert_array_equal(one.covariance, two.covariance)
    assert one.additive.order_of_sorting == (0, 1, 2)


@pytest.mark.parametrize("instruments", ["open_loop", "closed_loop"])
@pytest.mark.parametrize("system", [DRIVE, RIGID], ids=["integrator and pole", "rigid body"])
def test_integrators(system, instruments):
    # In the loop under PD control.
    options = {} if instruments == "open_loop" else {"controller": DiscreteController.from_pid(0.1, 0.0, 0.4)}
    fit = fitted(record_of(system, 2000, 0.03, 1, instruments, **options), (system, 1), instruments=instruments)
    assert fit.status is Status.CONVERGED
    assert fit.iterations <= 15
    assert np.abs(deviations(fit, system)).max() < 4
    assert fit.additive.submodels[0].integrators == system.submodels[0].integrators


@pytest.mark.parametrize(
    ("whole", "system", "instruments"),
    [(open_record(system, 1100, 0.0, 2, hold="foh"), system, "open_loop") for system in (MIXED, DRIVE, RIGID)]
    + [(loop_record(system, 1100, 0.0, 10), system, "closed_loop") for system in (TWO_MODES, DELAYED)],
)
def test_record_that_starts_in_motion_is_fitted_exactly(whole, system, instruments):
    t = whole.t[100:]
    signal = HeldSignal(t, whole.input.values[100:], whole.input.hold)
    loop = whole.loop and replace(whole.loop, reference=whole.loop.reference[100:])
    record, start = Record(t, whole.y[100:], signal, loop=loop), disturbed(system, 1, 0.02)
    fit = fitted(record, start, instruments=instruments, initial_state="estimated", tolerance=1e-10)
    assert fit.status is Status.CONVERGED
    assert_parameters(fit, system, 1e-6)
    assert fit.covariance.shape == (system.theta.size,) * 2
    at_rest = fitted(record, start, instruments=instruments, tolerance=1e-10)
    assert np.abs(at_rest.additive.theta / system.sorted().theta - 1).max() > 1e-3


def test_standard_errors_are_those_of_repeated_experiments():
    # The ratio of 100 observed to stated standard deviations lies within 0.72 and 1.28 with 99.99 % confidence; the
    # covariance that ignores the colour of the noise is outside.
    system = modes([0.25, 0.25, 3.0, 0.02, 0.025, 1.0])
    n = 1000
    t = INTERVAL * np.arange(n)
    u = HeldSignal(t, np.random.default_rng(20).standard_normal(n))
    x = simulate_additive(system, u, t)
    rng = np.random.default_rng(21)
    noises = [lfilter([1.0], [1.0, -0.9], 0.2 * rng.standard_normal(n + 200))[200:] for _ in range(100)]
    white = [fitted(Record(t, x + noise, u), system, covariance="white") for noise in noises]
    # Stated errors hardly differ from run to run.
    robust = [fitted(Record(t, x + noise, u), system, covariance="sandwich") for noise in noises[:20]]
    observed = np.std([fit.additive.theta for fit in white], axis=0, ddof=1)
    ratio = np.sqrt(np.mean([np.diag(fit.covariance) for fit in robust], axis=0)) / observed
    assert ((ratio > 0.72) & (ratio < 1.28)).all()
    assert (np.sqrt(np.diag(white[0].covariance)) / observed)[:3].max() < 0.5


def test_history_and_report_are_those_of_the_simulated_model():
    record = open_record(MIXED, 2000, 0.3, 13)
    fit = fitted(record, (MIXED, 2))
    used = record.t >= MIXED.delay - 1e-9
    x = simulate_additive(fit.additive, record.input, record.t)
    assert fit.count == used.sum()
    assert fit.cost == pytest.approx(np.mean((record.y - x)[used] ** 2), rel=1e-9)
    assert len(fit.history) == fit.iterations + 1
    assert fit.history[-1].cost == pytest.approx(fit.cost, rel=1e-12)
    np.testing.assert_allclose(fit.history[-1].denominator, fit.model.denominator, rtol=1e-12)
    assert fit.model.delay == fit.additive.delay == MIXED.delay
    assert_same_model(fit.model, unfactored(fit.additive), 1e-12)
    assert tuple(fit.parameters) == fit.parameter_names == tuple(fit.standard_errors)
    assert np.isnan(fit.loop_radius)
    np.testing.assert_allclose(fit.start.theta, disturbed(MIXED, 2).theta)
    assert "given" in fit.start_method


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"terms": ()}, "at least one submodel"),
        ({"terms": (Term(0, 0, 1), Term(1, 0, 1))}, "integrators in one submodel only"),
        ({"terms": (Term(2, 2), Term(1, 1))}, "as many zeros as poles in one submodel only"),
        ({"terms": (Term(0, 0), Term(0, 1, 1))}, "as many zeros as poles in one submodel only"),
        ({"terms": (Term(21, 0), Term(20, 0))}, "41 poles together; at most 40"),
        ({"instruments": "closed"}, "instruments must be .*'closed_loop'.* not 'closed'"),
        ({"initial_state": "zero"}, "initial_state must be .*'estimated'.* not 'zero'"),
        ({"variant": "auto"}, "variant must be .*'relaxed'.* not 'auto'"),
        ({"instruments": "closed_loop", "variant": "guarded"}, "guarded is for open-loop .* use relaxed or plain"),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        AdditiveSrivc(**{"terms": TWO, **options})


@pytest.mark.parametrize(
    ("start", "message"),
    [
        (modes([0.25, 0.25, 3.0]), r"\{poles: 2, zeros: 0\}, not, in this order, \{poles: 2, zeros: 0\}, \{poles: 2"),
        (MIXED, r"\{poles: 1, zeros: 1\}.*\{poles: 2, zeros: 0\}.*, not, in this order"),
        (RIGID, r"\{poles: 0, zeros: 0, integrators: 2\}"),
    ],
)
def test_start_of_another_structure_is_refused(start, message):
    with pytest.raises(DataError, match=message):
        AdditiveSrivc(terms=TWO).fit(open_record(TWO_MODES, 200, 0.1, 1), Start(model=start))
    with pytest.raises(DataError, match="the start has 4 poles and 2 zeros as one fraction, not 4 poles and 1 zeros"):
        Srivc(4, 1).fit(open_record(TWO_MODES, 200, 0.1, 1), Start(model=TWO_MODES))


def test_terms_that_share_a_pole_are_no_start():
    with pytest.raises(DataError, match=r"g1 and g2 have .* in common; put it in one"):
        modes([0.25, 0.25, 3.0, 0.25, 0.25, 1.0])


RECORD = replace(open_record(TWO_MODES, 100, 0.1, 1), name="beam.csv")


@pytest.mark.parametrize(
    ("record", "options", "message"),
    [
        (open_record(TWO_MODES, 6, 0.1, 1), {}, "beam.csv: 6 usable samples are too few for 6 parameters"),
        (
            open_record(TWO_MODES, 10, 0.1, 1),
            {"initial_state": "estimated"},
            "10 usable samples are too few for 10",
        ),
        (RECORD, {"instruments": "closed_loop"}, "beam.csv: .*instruments 'open_loop'"),
        (replace(RECORD, inputs=HeldSignal(RECORD.t, np.ones(100))), {}, "beam.csv: the input is constant"),
        (replace(RECORD, y=np.zeros(100)), {}, "beam.csv: the output is constant"),
    ],
)
def test_records_that_do_not_suffice_are_refused(record, options, message):
    with pytest.raises(DataError, match=message):
        AdditiveSrivc(terms=TWO, **options).fit(replace(record, name="beam.csv"), Start(model=TWO_MODES))
