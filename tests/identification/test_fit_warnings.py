"""Warnings of ``identify`` about planted faults, and none without faults."""

import re
from dataclasses import replace

import numpy as np
import pytest

from ctid_cli.estimators.additive_output_error import AdditiveOutputError
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.filtering.simulate import simulate
from ctid_cli.identification.choice import Candidate, Given
from ctid_cli.identification.criterion import block_numbers, held_back_errors
from ctid_cli.identification.fit_warnings import MOST, fit_warnings
from ctid_cli.identification.identify import identify
from ctid_cli.inference.fit import Status
from ctid_cli.models.additive import Term
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

SYSTEM = TransferFunction([2.0], [1.0, 0.8, 2.0], 0.0)
LATE = TransferFunction([2.0], [1.0, 0.8, 2.0], 2.5)
INTEGRATING = TransferFunction([2.0], [1.0, 0.8, 2.0, 0.0])
KNOWN, SEARCHED, FIRST_ORDER = DelayProfile(2, 0, (0, 0)), DelayProfile(2, 0, (0, 1)), DelayProfile(1, 0, (0, 0))
NOISE = 0.1


def record_of(model=SYSTEM, *, seed=0, hold="zoh", read_as=None, interval=0.2, n=1000):
    """Return a record with steps of random length, or with a random walk joined by straight lines."""
    rng = np.random.default_rng(seed)
    t = interval * np.arange(n)
    u = np.repeat(rng.choice([-1.0, 1.0], n), rng.integers(3, 12, n))[:n] if hold == "zoh" else rng.standard_normal(n)
    y = simulate(model, HeldSignal(t, u, hold), t) + NOISE * rng.standard_normal(n)
    return Record(t, y, HeldSignal(t, u, read_as or hold))


def changed(record, y):
    return Record(record.t, y, record.input)


def spoilt(record, samples, size):
    y = record.y.copy()
    y[samples] += size
    return changed(record, y)


def step_of(lead, model=SYSTEM):
    rng, t = np.random.default_rng(1), 0.2 * np.arange(400)
    signal = HeldSignal(t, (t >= lead).astype(float))
    return Record(t, simulate(model, signal, t) + NOISE * rng.standard_normal(t.size), signal)


def two_inputs(delay=0.0, seed=0, n=600):
    """Return the sum of the responses of two systems of second order to two inputs."""
    rng, t = np.random.default_rng(seed), 0.2 * np.arange(n)
    u1, u2 = (np.repeat(rng.choice([-1.0, 1.0], n), rng.integers(3, 12, n))[:n] for _ in range(2))
    pairs = zip((SYSTEM, replace(SYSTEM, delay=delay)), (u1, u2), strict=True)
    x = sum(simulate(model, HeldSignal(t, u), t) for model, u in pairs)
    return Record(t, x + NOISE * rng.standard_normal(n), {"u1": u1, "u2": u2})


def looped(gain=0.8, n=600):
    """Return a record in the loop of a proportional controller."""
    rng = np.random.default_rng(5)
    r = np.repeat(rng.choice([-1.0, 1.0], n // 5), 5)
    u, y, e, pole = np.zeros(n), np.zeros(n), 0.05 * rng.standard_normal(n), np.exp(-0.2)
    x = 0.0
    for k in range(n):
        y[k] = x + e[k]
        u[k] = gain * (r[k] - y[k])
        x = pole * x + (1 - pole) * u[k]
    return Record.from_arrays(0.2 * np.arange(n), u, y)


CLEAN = record_of()
FEW = 40 + 61 * np.arange(15)
FREE = 3.0 * np.exp(-0.4 * CLEAN.t) * np.cos(1.36 * CLEAN.t)
FREELY = {
    "one pole too few": (CLEAN, FIRST_ORDER, "A free choice takes 2 poles, no zero: with --poles 2 "),
    "an integrator": (record_of(INTEGRATING, n=600), KNOWN, "--integrators 1"),
    "a delay outside the range": (record_of(LATE), SEARCHED, "--delay 0:"),
    "an offset": (changed(CLEAN, CLEAN.y + 0.3), KNOWN, "--offset estimate"),
    "one pole too few, two inputs": (
        two_inputs(),
        FIRST_ORDER,
        "A free choice takes 2 poles, no zero: with --poles 2 ",
    ),
}
OBSERVED = {
    "an unstable plant": (record_of(TransferFunction([1.0], [1.0, -0.04])), FIRST_ORDER, "The output diverges"),
    "feedback": (looped(), FIRST_ORDER, "The input follows earlier residuals"),
    "outliers": (spoilt(CLEAN, FEW, 50 * NOISE), KNOWN, "15 output samples are outliers (t = 8, 20.2, 32.4 s, ...)"),
    "saturation": (changed(CLEAN, np.clip(CLEAN.y, -0.9, 0.9)), KNOWN, "exactly at the least or greatest value"),
}


@pytest.mark.parametrize(
    "fault", [pytest.param(name, marks=[pytest.mark.slow] * (name != "one pole too few")) for name in FREELY]
)
def test_a_typed_structure_is_compared_with_a_free_choice(fault):
    record, options, words = FREELY[fault]
    found = identify([record], options)
    (first,) = (warning for warning in found.warnings if warning.startswith("A free choice takes"))
    assert words in first
    better, worse = re.search(r"the held-back fit is (\S+) instead of (\S+) %", first).groups()
    assert float(better) > float(worse)
    assert len(found.warnings) <= MOST


def test_a_chosen_structure_is_not_chosen_again():
    loud = changed(CLEAN, CLEAN.y + 20 * NOISE * np.random.default_rng(7).standard_normal(1000))
    found = identify(loud, Given(poles=(1, 2), zeros=0, delay_bounds=(0.0, 0.0)))
    (low,) = (warning for warning in found.warnings if warning.startswith("The fit is "))
    assert f"{found.fit.fit_percent:.1f} %" in low
    assert not any("A free choice" in warning for warning in found.warnings)


@pytest.mark.parametrize("fault", OBSERVED)
def test_what_has_no_remedy_is_said_without_one(fault):
    record, options, words = OBSERVED[fault]
    (found,) = (warning for warning in identify([record], options).warnings if words in warning)
    assert "--" not in found


def test_halves_that_differ_are_named_by_a_fit_and_by_its_warnings():
    one, late = record_of(seed=4, n=600), np.arange(600) >= 300
    stronger = HeldSignal(one.t, np.where(late, 1.25, 1.0) * one.input.values)
    record = Record(one.t, one.y + simulate(SYSTEM, stronger, one.t) - simulate(SYSTEM, one.input, one.t), one.input)
    mark = KNOWN.fit(record).marks()[-1]
    assert mark.startswith("The halves of the record differ (p < 0.0001): static gain ")
    assert mark in identify([record], KNOWN).warnings
    assert not KNOWN.fit(one).marks()


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_a_clean_record_needs_no_words(hold):
    assert identify([record_of(seed=3, hold=hold)], KNOWN).warnings == ()


def test_an_integrator_that_a_zero_cancels_is_a_drift():
    record = record_of(TransferFunction([2.0, 0.002], [1.0, 0.8, 2.0, 0.0]))
    found = identify([record], DelayProfile(2, 1, (0, 0), integrators=1))
    (drift,) = (warning for warning in found.warnings if "cancels the integrator" in warning)
    assert drift.endswith("without both the static gain is 1.")
    without = identify([record_of(INTEGRATING)], DelayProfile(2, 0, (0, 0), integrators=1))
    assert not any("cancels" in warning for warning in without.warnings)


def test_the_held_back_fit_is_that_of_fits_that_did_not_see_the_blocks():
    record = record_of(n=440)
    fit = KNOWN.fit(record)
    blocks = block_numbers(fit.used)
    assert np.bincount(blocks[0] + 1).tolist() == [40] * 11
    (errors,) = held_back_errors(Candidate(KNOWN, "zoh", fit, 3), [record], blocks)
    held = np.isin(blocks[0], [1, 5])
    other = KNOWN.fit(Record(record.t, np.where(held, np.nan, record.y), record.input))
    expected = record.y - simulate(other.model, record.input, record.t)
    np.testing.assert_allclose(errors[held], expected[held], atol=1e-5)


def test_blocks_begin_with_the_samples_that_are_used():
    # The first ones determine the initial state, and are never held back.
    use = np.arange(130) >= 20
    (numbers,) = block_numbers([use])
    assert np.bincount(numbers + 1).tolist() == [30, *[10] * 10]


def test_several_records_say_which_one():
    warnings = identify([CLEAN, spoilt(record_of(seed=1), [500], 2.0)], KNOWN).warnings
    assert warnings[0].startswith("1 output sample is an outlier (t = 100 s of experiment 2)")


def test_feedback_that_is_known_is_no_warning():
    record = looped()
    said = [identify(each, SEARCHED).warnings for each in (record, replace(record, feedback=True))]
    assert [any("as in a loop" in text for text in each) for each in said] == [True, False]


def test_of_a_search_that_did_not_end_nothing_else_is_said():
    found = identify(record_of(), FIRST_ORDER)
    unfinished = replace(found, fit=replace(found.fit, status=Status.MAX_ITERATIONS))
    (text,) = fit_warnings(unfinished)
    assert text.startswith("The iterations stopped at max_iterations")


def test_a_sum_with_a_pole_at_a_bound_has_warnings():
    """A submodel too many: its poles run to a bound, and the free directions are those of coefficients."""
    found = identify([record_of(TransferFunction([2.0], [1.0, 2.0]), n=300)], AdditiveOutputError((Term(2, 0),) * 2))
    assert found.fit.held_poles
    assert any(text.startswith("Held at the border") for text in found.warnings)
