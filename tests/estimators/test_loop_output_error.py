"""Simulated loop against a plain simulation and open loop; unstable plants; delay, state and offset."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete

from ctid_cli.errors import DataError
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.loop_output_error import LoopOutputError
from ctid_cli.estimators.measured_submodels import MeasuredSubmodels, without_feedback
from ctid_cli.estimators.srivc import Srivc
from ctid_cli.filtering.loop import loop_radius, simulate_continuous_loop, simulate_loop
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.fit import Status
from ctid_cli.models.additive import Term
from ctid_cli.models.controller import ContinuousController, DiscreteController
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Loop, Record

UNSTABLE, STABLE = TransferFunction([4.0], [1.0, 0.0, -1.0]), TransferFunction([2.0], [1.0, 1.2, 1.0])
PD, PI = DiscreteController([11.0, -10.0], [1.0, 0.0]), DiscreteController([0.5, -0.48], [1.0, -1.0])
NOTHING, LEAD = DiscreteController([0.0], [1.0]), ContinuousController([1.5, 3.0], [0.05, 1.0])


def record(plant, law, noise=0.02, interval=0.05, count=2000, seed=1, enters="controller", colour=0.0):
    rng = np.random.default_rng(seed)
    r, v = rng.standard_normal(count), noise * rng.standard_normal(count)
    for k in range(1, count):
        v[k] += colour * v[k - 1]
    u, x = simulate_loop(plant, law, r, v, interval, enters)
    t = interval * np.arange(count)
    return Record(t, x + v, HeldSignal(t, u), loop=Loop(r, law, enters))


def rows_of(options, one, theta, count, state=None):
    return options.prepare(one).laid_out.problem.response.rows(np.array(theta), count, state=state)


def continuous_loop(plant, law, r, t, fine, foh=False):
    """Return the output of a continuous-time loop by short steps of its state equations (fourth-order Runge-Kutta)."""
    n, m = plant.order, law.denominator.size - 1
    A, B = np.vstack((-plant.denominator[1:], np.eye(n)[:-1])), np.eye(n)[0]
    C = np.concatenate((np.zeros(n - plant.numerator.size), plant.numerator))
    E, F, G, H = law.state_space()

    def slope(state, reference):
        error = reference - C @ state[:n]
        u = G[0] @ state[n:] + H[0, 0] * error
        return np.concatenate((A @ state[:n] + B * u, E @ state[n:] + F[:, 0] * error))

    state, y = np.zeros(n + m), np.zeros(t.size)
    for k in range(t.size - 1):
        y[k], h = C @ state[:n], (t[k + 1] - t[k]) / fine
        for j in range(fine):
            at = [r[k] + foh * (r[k + 1] - r[k]) * (j + part) / fine for part in (0.0, 0.5, 1.0)]
            first = slope(state, at[0])
            second = slope(state + 0.5 * h * first, at[1])
            third = slope(state + 0.5 * h * second, at[1])
            fourth = slope(state + h * third, at[2])
            state = state + h / 6 * (first + 2 * second + 2 * third + fourth)
    y[-1] = C @ state[:n]
    return y


@pytest.mark.parametrize("enters", ["controller", "input"])
def test_output_of_a_loop_is_that_of_difference_equations(enters):
    one = record(UNSTABLE, PD, count=200, enters=enters)
    F, g, c, _, _ = cont2discrete(
        tuple(map(np.array, ([[0.0, 1.0], [1.0, 0.0]], [[1.0], [0.0]], [[0.0, 4.0]], [[0.0]]))), 0.05
    )
    z, before, y = np.zeros(2), 0.0, np.zeros(200)
    for k, r in enumerate(one.loop.reference):
        y[k] = c[0] @ z
        error = (r if enters == "controller" else 0.0) - y[k]
        u = 11.0 * error - 10.0 * before + (0.0 if enters == "controller" else r)
        z, before = F @ z + g[:, 0] * u, error
    found = rows_of(LoopOutputError(2, 0), one, [0.0, -1.0, 4.0, 0.0], 0).output
    np.testing.assert_allclose(found, y, atol=1e-12 * np.abs(y).max())


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_output_of_a_loop_in_continuous_time_is_that_of_short_steps(hold):
    rng = np.random.default_rng(2)
    t = np.cumsum(rng.uniform(0.05, 0.15, 40))
    r = rng.standard_normal(40)
    one = Record(t, r, HeldSignal(t, r), loop=Loop(r, LEAD, hold=hold))
    found = rows_of(LoopOutputError(2, 0), one, [0.0, -1.0, 4.0, 0.0], 0).output
    simulated = simulate_continuous_loop(UNSTABLE, LEAD, HeldSignal(t, r, hold), 0.0 * r).x
    np.testing.assert_allclose(found, simulated, atol=1e-10)
    np.testing.assert_allclose(found, continuous_loop(UNSTABLE, LEAD, r, t, 40, hold == "foh"), atol=2e-5)


DERIVED = {
    "discrete": (record(UNSTABLE, PD, count=150), [0.1, -1.0, 4.0, 0.03]),
    "as many zeros as poles": (record(STABLE, PI, count=150), [1.2, 1.0, 0.3, 0.1, 2.0, 0.0]),
    "continuous": (None, [0.1, -1.0, 4.0]),
}


@pytest.mark.parametrize("case", DERIVED)
def test_derivatives_are_those_of_central_differences(case):
    one, theta = DERIVED[case]
    if one is None:
        t = 0.1 * np.arange(60)
        r = np.random.default_rng(3).standard_normal(60)
        one, theta = Record(t, r, HeldSignal(t, r), loop=Loop(r, LEAD)), [*theta, 0.0]
    zeros, count = len(theta) - 4, len(theta) - (theta[-1] == 0.0)
    options = LoopOutputError(2, zeros, (0.0, 0.0) if theta[-1] == 0.0 else (0.03, 0.03))
    state = 0.1 * np.arange(1.0, 4.0 + (theta[-1] > 0.0))
    slopes = rows_of(options, one, theta, count, state).slopes
    for j, unit in enumerate(1e-6 * np.eye(len(theta))[:count]):
        above, below = (rows_of(options, one, theta + step, 0, state).output for step in (unit, -unit))
        np.testing.assert_allclose(slopes[:, j], (above - below) / 2e-6, atol=1e-6 * np.abs(slopes[:, j]).max())


def test_loop_whose_controller_does_nothing_is_open_loop():
    one = record(STABLE, NOTHING, enters="input")
    closed = LoopOutputError(2, 0, (0.0, 0.4), covariance="white").fit(one)
    opened = DelayProfile(2, 0, (0.0, 0.4), covariance="white").fit(replace(one, loop=None))
    assert closed.parameters == pytest.approx(opened.parameters, rel=1e-5, abs=1e-5)
    size = len(closed.covariance)
    errors = [np.sqrt(np.diag(each.covariance[:size, :size])) for each in (closed, opened)]
    np.testing.assert_allclose(*errors, rtol=1e-3)
    assert closed.cost == pytest.approx(opened.cost, rel=1e-9)


@pytest.mark.parametrize(("delay", "bounds"), [(0.0, (0.0, 0.0)), (0.065, (0.0, 0.4))])
def test_unstable_plant_with_its_delay(delay, bounds):
    plant = TransferFunction(UNSTABLE.numerator, UNSTABLE.denominator, delay)
    fit = LoopOutputError(2, 0, bounds).fit(record(plant, PD, count=3000))
    assert fit.status is Status.CONVERGED
    assert fit.loop_radius == pytest.approx(loop_radius(fit.model, PD, 0.05), rel=1e-9)
    for name, value in {"a1": 0.0, "a2": -1.0, "b0": 4.0, "delay": delay}.items():
        assert name not in fit.parameters or abs(fit.parameters[name] - value) < 3.5 * fit.standard_errors[name]


def test_output_error_is_noise_filtered_by_the_sensitivity_function():
    plant = TransferFunction(STABLE.numerator, STABLE.denominator, 0.13)
    one = record(plant, PI, noise=0.2, count=600)
    fit = LoopOutputError(2, 0, (0.0, 0.4)).fit(one)
    v = np.random.default_rng(2).standard_normal(600)
    np.testing.assert_allclose(
        fit.sensitivity.filtered(v), simulate_loop(fit.model, PI, 0 * v, v, 0.05).x + v, atol=1e-9
    )


def test_output_error_in_continuous_time_is_held_noise_filtered_by_the_sensitivity_function():
    t, r = 0.1 * np.arange(400), np.random.default_rng(3).standard_normal(400)
    x = simulate_continuous_loop(STABLE, LEAD, HeldSignal(t, r), 0.0 * r).x
    fit = LoopOutputError(2, 0).fit(Record(t, x + 0.01 * r[::-1], HeldSignal(t, r), loop=Loop(r, LEAD)))
    v = np.random.default_rng(2).standard_normal(400)
    error = simulate_continuous_loop(fit.model, LEAD, HeldSignal(t, 0.0 * v), v).x + v
    np.testing.assert_allclose(fit.sensitivity.filtered(v) * error[0] / v[0], error, atol=1e-9)


def test_missing_output_errors_are_completed_and_not_in_the_sums():
    one = record(STABLE, PI, noise=0.2, count=1200)
    whole = LoopOutputError(2, 0).fit(one)
    used = np.random.default_rng(5).random(1200) > 0.1
    fit = LoopOutputError(2, 0).fit(replace(one, y=np.where(used, one.y, np.nan)))
    psi, errors = fit.sensitivity.completed(fit.sensitivities[0], fit.residuals[0], used)
    assert errors.size == 1200 - int(np.argmax(used))
    assert not psi[~used[np.argmax(used) :]].any()
    assert np.std(fit.sensitivity.removed(errors)) == pytest.approx(0.2, rel=0.06)
    ratios = [fit.standard_errors[name] / whole.standard_errors[name] for name in ("a1", "a2", "b0")]
    assert ratios == pytest.approx([1 / np.sqrt(0.9)] * 3, rel=0.08)


def test_a_record_and_its_negative_have_the_errors_of_one_over_the_root_of_two():
    one = record(UNSTABLE, PD, noise=0.1, count=800)
    loop = replace(one.loop, reference=-one.loop.reference)
    negative = replace(one, y=-one.y, inputs=HeldSignal(one.t, -one.input.values), loop=loop)
    options = LoopOutputError(2, 0, initial_state="estimate", offset="estimate", covariance="white")
    once, twice = options.fit(one), options.fit([one, negative])
    assert twice.parameter_names[-8:] == ("x1_1", "x2_1", "x3_1", "offset_1", "x1_2", "x2_2", "x3_2", "offset_2")
    assert len(twice.initial_states) == len(twice.residuals) == 2
    for name in ("a1", "a2", "b0"):
        assert twice.parameters[name] == pytest.approx(once.parameters[name], abs=1e-5)
        assert twice.standard_errors[name] == pytest.approx(once.standard_errors[name] / np.sqrt(2), rel=0.01)
    assert twice.parameters["offset_2"] == pytest.approx(-once.parameters["offset"], abs=1e-6)


def test_integrator_offset_and_state_that_is_not_rest():
    whole = record(TransferFunction([2.0], [1.0, 1.0, 0.0]), DiscreteController([0.6], [1.0]), count=2500)
    late = slice(300, None)
    loop = Loop(whole.loop.reference[late], whole.loop.controller)
    t = whole.t[late]
    one = Record(t, whole.y[late] + 5.0, HeldSignal(t, whole.input.values[late]), loop=loop)
    fit = LoopOutputError(1, 0, initial_state="estimate", offset="estimate", integrators=1).fit(one)
    assert fit.status is Status.CONVERGED
    assert fit.known == ("a2",)
    for name, value in {"a1": 1.0, "b0": 2.0, "offset": 5.0}.items():
        assert abs(fit.parameters[name] - value) < 3.5 * fit.standard_errors[name]


def test_instruments_of_the_reference_need_no_controller_where_noise_is_coloured():
    one = record(STABLE, PI, noise=0.2, count=6000, colour=0.9, seed=4)
    unknown = replace(one, loop=Loop(one.loop.reference, None))
    fit = Srivc(2, 0, instruments="reference").fit(unknown)
    direct = Srivc(2, 0).fit(unknown)
    wrong = [abs(direct.parameters[name] - value) for name, value in {"a1": 1.2, "a2": 1.0, "b0": 2.0}.items()]
    errors = [abs(fit.parameters[name] - value) for name, value in {"a1": 1.2, "a2": 1.0, "b0": 2.0}.items()]
    assert all(error < 3.5 * fit.standard_errors[name] for error, name in zip(errors, ("a1", "a2", "b0"), strict=True))
    assert max(wrong) > 3.0 * max(errors)


def test_two_stage_method_agrees_with_instruments_of_the_reference():
    one = record(STABLE, PI, noise=0.2, count=6000, colour=0.9, seed=4)
    unknown = replace(one, loop=Loop(one.loop.reference, None))
    options = MeasuredSubmodels((Term(2, 0),), instruments="reference", factored=False)
    fit = options.fit(unknown)
    two_stage = replace(options, instruments="open_loop").fit(without_feedback(unknown))
    for name, value in {"a1": 1.2, "a2": 1.0, "b0": 2.0}.items():
        assert abs(two_stage.parameters[name] - value) < 3.5 * two_stage.standard_errors[name]
    assert 0.0 < fit.two_stage < 2.0
    assert np.isnan(replace(options, instruments="open_loop").fit(unknown).two_stage)


def test_what_is_no_solution_has_no_error():
    one = record(UNSTABLE, PD, noise=0.1, count=1000)
    fit = Srivc(2, 0, instruments="closed_loop", max_iterations=2).fit(one)
    assert not fit.status.succeeded
    assert np.isnan(list(fit.standard_errors.values())).all()


def test_margin_of_consistency_is_that_of_the_signals_it_is_made_of():
    one = record(STABLE, NOTHING, noise=0.0, enters="input", interval=0.4)
    fit = MeasuredSubmodels((Term(2, 0),)).fit(replace(one, loop=None))
    A, u, t = STABLE.denominator, one.input, one.t
    powers = [TransferFunction(np.eye(3)[2 - k], A) for k in range(3)]
    x = simulate(STABLE, u, t)
    held = HeldSignal(t, x, "foh")
    twice = [TransferFunction(2.0 * power.numerator, np.polymul(A, A)) for power in powers[1:]]
    psi = np.column_stack([*(-simulate(each, u, t) for each in twice), simulate(powers[0], u, t)])
    phi = np.column_stack([*(-simulate(power, held, t) for power in powers[1:]), simulate(powers[0], u, t)])
    psi, phi = (part / np.linalg.norm(psi, axis=0) for part in (psi, phi))
    expected = np.linalg.svd(psi.T @ psi)[1][-1] / np.linalg.norm(psi.T @ (phi - psi), 2)
    assert fit.consistency == pytest.approx(expected, rel=1e-4)
    assert fit.sampling == pytest.approx(np.pi / (0.4 * 0.8), rel=1e-4)


CONTINUOUS = Record(
    *(lambda t: (t, np.cos(t), HeldSignal(t, np.sin(t))))(0.1 * np.arange(50)), loop=Loop(np.ones(50), LEAD)
)
REFUSED = {
    "a reference alone": (
        LoopOutputError(1, 0),
        replace(record(STABLE, PI), loop=Loop(np.ones(2000), None)),
        "give the controller too",
    ),
    "missing samples": (
        LoopOutputError(1, 0),
        Record(np.arange(50.0), [np.nan, *np.cos(np.arange(49.0))], HeldSignal(np.arange(50.0), np.arange(50.0))),
        "without missing samples",
    ),
    "a delay in continuous time": (LoopOutputError(1, 0, (0.1, 0.1)), CONTINUOUS, "the delay must be 0"),
    "two controllers": (LoopOutputError(1, 0), [record(STABLE, PI), record(STABLE, PD)], "the same controller"),
    "instruments in continuous time": (Srivc(1, 0, instruments="closed_loop"), CONTINUOUS, "loop_output_error"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_not_supported_is_refused_with_a_sentence(case):
    options, given, said = REFUSED[case]
    with pytest.raises(DataError, match=said):
        options.fit(given)
