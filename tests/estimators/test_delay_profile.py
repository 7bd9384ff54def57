"""Global search over the delay, and measured records: states, offsets, gaps, experiments, units."""

from dataclasses import replace

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.estimation.common import assumed_holds
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.estimation.output_sensitivities import sensitivities
from ctid_cli.estimation.parameter_layout import Degrees, Layout
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.fit import Status
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from tests.estimators.records import CASE_1, CASE_2, assert_same_model, make_record

SYSTEM = TransferFunction([3.0], [1.0, 1.2, 4.0], 0.73)


def random_input(rng, t, every=7):
    values = np.repeat(rng.choice([-1.0, 1.0], t.size // every + 1), every)[: t.size]
    return HeldSignal(t, values)


def record_of(model=SYSTEM, *, n=600, seed=0, noise=0.0, irregular=False, offset=0.0, past=0):
    """Return a record; the first ``past`` samples are removed, so that it begins with an initial state."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.05, 0.15, n)) if irregular else 0.1 * np.arange(n)
    signal = random_input(rng, t)
    y = simulate(model, signal, t) + offset + noise * rng.standard_normal(n)
    return Record(t[past:], y[past:], HeldSignal(signal.t[past:], signal.values[past:]))


# --- sensitivities ---------------------------------------------------------------------------------


@pytest.mark.parametrize("irregular", [False, True])
@pytest.mark.parametrize(
    ("structure", "delay"),
    [(Structure(2, 1, delay=True), 0.73), (Structure(2, 2), 0.3), (Structure(1, 1), 0.0), (Structure(3, 0), 0.2)],
)
def test_sensitivities_are_the_derivatives_of_the_output(structure, delay, irregular):
    rng = np.random.default_rng(3)
    data = [filter_data(record_of(n=80, seed=k, noise=0.1, irregular=irregular), 1.0) for k in range(2)]
    layout = Layout(Degrees.of(structure), 2, initial_state=True, trend=(0,))
    problem = Problem(tuple(data), structure.zeros, True, True, (0.0, 0.0))
    n, m = structure.poles, structure.zeros
    a = np.poly([-0.8, -1.0 + 2.0j, -1.0 - 2.0j][-n:]).real[1:] if n > 1 else np.array([1.3])
    theta = np.concatenate((a, rng.standard_normal(m + 1), [delay] * structure.delay))
    theta = np.concatenate((theta, rng.standard_normal(layout.size - theta.size)))
    parts = sensitivities(problem, layout, theta, [delay])
    for k in range(layout.size):
        step = 1e-5 * max(abs(theta[k]), 1.0)
        ends = [theta + sign * step * np.eye(layout.size)[k] for sign in (1, -1)]
        moved = [sensitivities(problem, layout, end, [delay]) for end in ends]
        for (psi, _), (_, above), (_, below) in zip(parts, *moved, strict=True):
            # The error decreases with increasing simulated output.
            slope = (below - above) / (2 * step)
            np.testing.assert_allclose(psi[:, k], slope, atol=2e-8 * max(1.0, np.abs(slope).max()))


# --- states and offsets ----------------------------------------------------------------------------


@pytest.mark.parametrize("irregular", [False, True])
def test_initial_state_and_offset_of_a_noise_free_record_are_found(irregular):
    record = record_of(past=150, offset=21.5, irregular=irregular)
    fit = DelayProfile(2, 0, (0, 3), initial_state="estimate", offset="estimate").fit(record)
    assert fit.status is Status.CONVERGED
    assert_same_model(fit.model, SYSTEM, 1e-6)
    assert fit.offsets == pytest.approx([21.5])
    assert fit.parameters["offset"] == fit.offsets[0]
    # Assuming rest and no offset, the record gives another model.
    wrong = DelayProfile(2, 0, (0, 3)).fit(record)
    assert abs(wrong.model.dc_gain / SYSTEM.dc_gain - 1) > 0.01


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_a_periodic_record_is_fitted_exactly(hold):
    t = 0.1 * np.arange(2000)
    one = np.random.default_rng(5).standard_normal(200)
    signal = HeldSignal(t, np.tile(one, 10), hold)
    y = simulate(SYSTEM, signal, t)
    last = Record(t[-200:] - t[-200], y[-200:], HeldSignal(t[-200:] - t[-200], one, hold))
    fit = DelayProfile(2, 0, (0, 3), initial_state="periodic").fit(last)
    assert_same_model(fit.model, SYSTEM, 1e-6)
    assert fit.count == 200
    assert fit.cost < 1e-12 * np.var(y)
    assert DelayProfile(2, 0, (0, 3)).fit(last).cost > 1e-4 * np.var(y)


def test_as_many_zeros_as_poles_with_a_known_delay():
    model = TransferFunction([0.5, -1.0, 2.0], [1.0, 1.2, 4.0], 0.73)
    fit = DelayProfile(2, 2, (0.73, 0.73)).fit(record_of(model))
    assert_same_model(fit.model, model, 1e-6)
    assert fit.parameter_names == ("a1", "a2", "b0", "b1", "b2")
    with pytest.raises(ValueError, match="zeros must be at most 1"):
        DelayProfile(2, 2, (0, 1))


# --- several experiments ---------------------------------------------------------------------------


def test_an_experiment_and_its_negative_give_the_same_model_and_half_the_variance():
    record = record_of(noise=0.1)
    negative = replace(record, y=-record.y, inputs=HeldSignal(record.input.t, -record.input.values))
    options = DelayProfile(2, 0, (0, 3), offset="estimate", covariance="white")
    one, two = options.fit(record), options.fit([record, negative])
    assert_same_model(two.model, one.model, 1e-6)
    assert two.parameter_names[-2:] == ("offset_1", "offset_2")
    assert two.cost == pytest.approx(one.cost, rel=1e-9)
    n = record.n_samples
    expected = (n - 5) / (2 * n - 6)
    ratio = two.standard_errors["delay"] ** 2 / one.standard_errors["delay"] ** 2
    assert ratio == pytest.approx(expected, rel=1e-4)


# --- the search ------------------------------------------------------------------------------------


@pytest.mark.parametrize("replicate", range(2))
@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("model", [CASE_1, CASE_2])
def test_finds_the_delay_in_heavy_noise(model, regular, replicate):
    record = make_record(model, snr_db=5, regular=regular, replicate=replicate)
    fit = DelayProfile(model.order, model.numerator.size - 1, (0, 15)).fit(record)
    assert fit.status is Status.CONVERGED
    assert abs(fit.model.delay - 8.0) < 0.08
    # At most the cost of the true system.
    assert fit.cost <= np.mean((record.y - record.noise_free) ** 2)


# --- a given model on other records ----------------------------------------------------------------


@pytest.mark.parametrize("initial_state", ["estimate", "periodic"])
def test_errors_of_a_model_with_its_own_state_and_offset(initial_state):
    record = record_of(noise=0.05, offset=4.0, past=100)
    options = DelayProfile(2, 0, (0, 3), initial_state=initial_state, offset="estimate")
    fit = options.fit(record)
    applied = options.prepare(record).laid_out.errors_of(fit.model)
    # On the model's own record, state and offset are already optimal.
    np.testing.assert_allclose(applied.residuals[0], fit.residuals[0], atol=1e-6)
    assert applied.offsets == pytest.approx(fit.offsets, abs=1e-6)


# --- refusals --------------------------------------------------------------------------------------


def test_a_constant_input():
    t = np.arange(50.0)
    record = Record.from_arrays(t, np.full(50, 3.0), 2.0 + np.exp(-0.1 * t))
    with pytest.raises(DataError, match="constant"):
        DelayProfile(1, 0, (0, 5)).fit(record)
    with pytest.raises(DataError, match="input_before"):
        DelayProfile(1, 0, (0, 0)).fit(record)
    fit = DelayProfile(1, 0, (0, 0), initial_state="estimate").fit(record)
    assert fit.model.denominator[1] == pytest.approx(0.1)
    assert fit.model.dc_gain == pytest.approx(2 / 3)


def test_a_range_beyond_the_record_or_no_record_is_refused():
    with pytest.raises(DataError, match="not shorter than the record"):
        DelayProfile(2, 0, (0, 100)).fit(record_of())
    with pytest.raises(DataError, match="no record"):
        DelayProfile(2, 0, (0, 1)).fit([])


# --- a drift of the output -------------------------------------------------------------------------


@pytest.mark.parametrize("irregular", [False, True])
@pytest.mark.parametrize("initial_state", ["rest", "estimate"])
def test_a_drift_is_a_constant_and_a_slope(initial_state, irregular):
    record = record_of(irregular=irregular)
    drifting = Record(record.t, record.y + 4.0 + 0.3 * (record.t - record.t[0]), record.input)
    fit = DelayProfile(2, 0, (0, 3), initial_state=initial_state, offset="drift").fit(drifting)
    assert [fit.parameters["offset"], fit.parameters["drift"]] == pytest.approx([4.0, 0.3], rel=1e-6)
    assert fit.model.delay == pytest.approx(SYSTEM.delay, abs=1e-6)
    with pytest.raises(ValueError, match="offset drift goes without integrators"):
        DelayProfile(2, 0, (0, 3), offset="drift", integrators=1)


def test_a_refinement_without_a_pole_counts_it_among_those_at_infinity():
    record = record_of(TransferFunction([1.0], [1.0, 1.0]))
    fit = DelayProfile(2, 0, (0.0, 0.0))._refine([record], (np.array([1.0, 1.0]), 0.0))
    assert (fit.model.order, fit.poles_at_infinity) == (1, 1)


# --- the hold of the input -------------------------------------------------------------------------


def sampled_multisine(hold, seed=0, count=300, interval=0.2):
    """Return times, samples of a smooth input, and a noisy output of the input as held, or as smooth for None."""
    rng, lead, fine = np.random.default_rng(seed), 100, 20
    frequencies, phases = np.linspace(0.01, 0.5, 20), rng.uniform(0.0, 2.0 * np.pi, 20)
    t = interval * np.arange(count + lead)
    dense = interval / fine * np.arange((count + lead) * fine)
    u, smooth = (0.3 * np.cos(2 * np.pi * np.outer(times, frequencies) + phases).sum(axis=1) for times in (t, dense))
    signal = HeldSignal(dense, smooth, "foh") if hold is None else HeldSignal(t, u, hold)
    y = simulate(TransferFunction([2.0], [1.0, 1.0], 1.03), signal, t) + 0.05 * rng.standard_normal(t.size)
    return t[lead:] - t[lead], u[lead:], y[lead:]


@pytest.mark.parametrize("hold", [None, "zoh"])
def test_the_interval_of_the_delay_allows_for_the_hold_of_a_smooth_input(hold):
    t, u, y = sampled_multisine(hold)
    options = DelayProfile(1, 0, (0, 5), initial_state="estimate")
    fit = options.fit(Record.from_arrays(t, u, y))
    ((low, high),) = fit.intervals["delay"]
    assert low <= 1.03 <= high
    assert fit.marks()[0].startswith("The hold of the input was not given: ")
    given = options.fit(Record.from_arrays(t, u, y, "zoh"))
    assert not given.marks()
    assert (given.parameters["delay"] - 1.03 < -2.0 * given.standard_errors["delay"]) == (hold is None)


def test_a_hold_that_is_not_given_is_asked_for_smooth_inputs_only():
    t, steps, y = np.arange(200.0), np.repeat([0.0, 1.0, -1.0, 2.0], 50), np.random.default_rng(0).standard_normal(200)
    record = Record.from_arrays(t, steps, y)
    assert assumed_holds(record) == {None: record}
    two = Record(t, y, {"smooth": np.sin(t), "steps": steps})
    assert list(assumed_holds([two])) == ["zoh", ("foh", "zoh"), ("band-limited", "zoh")]
    given = replace(two, inputs={"smooth": HeldSignal(t, np.sin(t)), "steps": HeldSignal(t, steps)})
    assert list(assumed_holds(given)) == [None]
