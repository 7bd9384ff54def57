"""Warnings of ``identify`` about planted faults, and none without faults."""

from dataclasses import replace

import numpy as np
import pytest

from ctid_cli.estimators.additive_output_error import AdditiveOutputError
from ctid_cli.estimators.delay_profile import DelayProfile, InputModel
from ctid_cli.filtering.simulate import simulate
from ctid_cli.identification.fit_warnings import MOST, fit_warnings
from ctid_cli.identification.held_back import block_numbers, compared, held_back_errors
from ctid_cli.identification.identify import identify
from ctid_cli.identification.remedies import tried_remedies
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
DRIFTING = changed(CLEAN, CLEAN.y + 5.0 + 10 * NOISE * np.linspace(0, 1, 1000))
REMEDIED = {
    "one pole too few": (CLEAN, FIRST_ORDER, "with --poles 2 --zeros 0 the held-back fit is"),
    "two poles too few": (
        record_of(TransferFunction([8.0, 4.0, 20.0], np.polymul([1.0, 0.4, 2.0], [1.0, 0.8, 12.0]))),
        KNOWN,
        "with --poles 4 --zeros",
    ),
    "an integrator": (record_of(INTEGRATING, n=600), KNOWN, "with --integrators 1 the held-back fit is"),
    "a delay that is not searched": (record_of(LATE), KNOWN, "The delay is taken as 0 s: with --delay 0:20 "),
    "a delay outside the range": (
        record_of(LATE),
        SEARCHED,
        "The delay is at the end of its range, 1 s: with --delay ",
    ),
    "the wrong hold": (record_of(hold="foh", read_as="zoh", interval=0.8), KNOWN, "with --hold foh the held-back"),
    "outliers": (spoilt(CLEAN, FEW, 50 * NOISE), KNOWN, "15 output samples are outliers (t = 8, 20.2, 32.4 s, ...)"),
    "an offset": (changed(CLEAN, CLEAN.y + 0.3), KNOWN, "with --offset estimate the held-back fit is"),
    "a drift": (DRIFTING, KNOWN, "with --offset drift the held-back fit is"),
    "a step of one pole too few": (step_of(20.0), FIRST_ORDER, "with --poles 2 --zeros 0 BIC of the innovations is"),
    "one pole too few, two inputs": (two_inputs(), FIRST_ORDER, "with --poles 2 --zeros 0 the held-back fit is"),
    "a delay of the second input": (two_inputs(2.5), SEARCHED, "with --delay u2=0:12 the held-back fit is"),
    "one pole too few for the first input": (
        two_inputs(),
        replace(FIRST_ORDER, inputs=(InputModel("u1", poles=1), InputModel("u2", poles=2))),
        "with --poles u1=2 --zeros u1=0 the held-back fit is",
    ),
}
OBSERVED = {
    "an unstable plant": (record_of(TransferFunction([1.0], [1.0, -0.04])), FIRST_ORDER, "The output diverges"),
    "feedback": (looped(), FIRST_ORDER, "The input follows earlier residuals"),
    "saturation": (changed(CLEAN, np.clip(CLEAN.y, -0.9, 0.9)), KNOWN, "exactly at the least or greatest value"),
}


#: Several inputs with several structures to try, and treatments that are tried after other remedies.
LONG = (
    "a delay of the second input",
    "one pole too few for the first input",
    "one pole too few, two inputs",
    "a drift",
    "a delay outside the range",
)


@pytest.mark.parametrize("fault", [pytest.param(name, marks=[pytest.mark.slow] * (name in LONG)) for name in REMEDIED])
def test_a_planted_fault_is_named_first_with_a_remedy_that_was_tried(fault):
    record, options, words = REMEDIED[fault]
    warnings = identify([record], options).warnings
    assert words in warnings[0]
    assert len(warnings) <= MOST


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


def test_a_pole_that_is_as_slow_as_the_record_names_no_remedy_that_was_not_tried():
    record = record_of(TransferFunction([1.0], [1.0, 1e-4]), n=300)
    found = identify([record], DelayProfile(1, 0, (0, 0), initial_state="estimate"))
    options = {str(each.option) for each in tried_remedies([record], found.options, found.fit).remedies}
    (slow,) = (warning for warning in found.warnings if "integrator" in warning)
    assert "--" not in slow or any(option in slow for option in options)


def test_an_integrator_that_a_zero_cancels_is_a_drift():
    record = record_of(TransferFunction([2.0, 0.002], [1.0, 0.8, 2.0, 0.0]))
    found = identify([record], DelayProfile(2, 1, (0, 0), integrators=1))
    (drift,) = (warning for warning in found.warnings if "cancels the integrator" in warning)
    assert drift.endswith("without both the static gain is 1.")
    without = identify([record_of(INTEGRATING)], DelayProfile(2, 0, (0, 0), integrators=1))
    assert not any("cancels" in warning for warning in without.warnings)


def test_a_low_fit_says_what_was_tried_without_gain():
    loud = changed(CLEAN, CLEAN.y + 10 * NOISE * np.random.default_rng(7).standard_normal(1000))
    result = identify([loud], KNOWN)
    (low,) = (warning for warning in result.warnings if warning.startswith("The fit is "))
    assert f"{result.fit.fit_percent:.1f} %" in low
    assert "tried without gain: other values of --poles, --zeros, " in low


@pytest.mark.slow
def test_another_remedy_is_named_in_addition_to_the_first():
    record = changed(CLEAN, CLEAN.y + 0.6)
    found = tried_remedies([record], FIRST_ORDER, FIRST_ORDER.fit([record])).remedies
    assert [remedy.in_addition for remedy in found] == [False, True]
    assert [remedy.kind for remedy in found] == ["structure", "treatment"]
    assert found[1].before == pytest.approx(found[0].after, abs=0.01)
    assert found[1].options == replace(found[0].options, offset="estimate")


def test_the_held_back_fit_is_that_of_fits_that_did_not_see_the_blocks():
    record = record_of(n=440)
    (numbers,) = block_numbers([record])
    assert np.bincount(numbers + 1).tolist() == [40] * 11
    fit = KNOWN.fit(record)
    (errors,) = held_back_errors(KNOWN, [record], (fit.model.denominator, 0.0))
    held = np.isin(numbers, [1, 5])
    other = KNOWN.fit(Record(record.t, np.where(held, np.nan, record.y), record.input))
    expected = record.y - simulate(other.model, record.input, record.t)
    np.testing.assert_allclose(errors[held], expected[held], atol=1e-5)
    gain = compared([2.0 * errors], [errors], [record])
    assert (100 - gain.before) / (100 - gain.after) == pytest.approx(2.0)
    falls = [3 * np.sum(errors[numbers == block] ** 2) for block in range(10)]
    score = np.mean(falls) / np.std(falls, ddof=1) * np.sqrt(10)
    assert gain.score == pytest.approx(score)
    assert gain.standard_error == pytest.approx((gain.after - gain.before) / score)
    assert (gain.helps, gain.end) == (True, 0.25)


def test_several_records_say_which_one():
    warnings = identify([CLEAN, spoilt(record_of(seed=1), [500], 2.0)], KNOWN).warnings
    assert warnings[0].startswith("1 output sample is an outlier (t = 100 s of experiment 2)")


@pytest.mark.slow
def test_a_long_record_is_tried_on_its_beginning():
    record = record_of(n=12_000)
    (remedy,) = tried_remedies([record], FIRST_ORDER, FIRST_ORDER.fit([record])).remedies
    assert remedy.option == "--poles 2 --zeros 0"


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
