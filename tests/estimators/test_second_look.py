"""What ``identify`` says of faults that are planted in a record, and that it says nothing where there are none.

What was tried for bad residuals is what a fit with it gives.
"""

import numpy as np
import pytest

from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.hold_comparison import best_other_hold
from ctid_cli.estimators.identification import identify
from ctid_cli.estimators.measured_submodels import MeasuredSubmodels
from ctid_cli.estimators.residual_causes import another_delay, another_order, clock_evidence
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.additive import Term
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

SYSTEM = TransferFunction([2.0], [1.0, 0.8, 2.0], 0.0)
LATE = TransferFunction([2.0], [1.0, 0.8, 2.0], 2.5)
KNOWN, SEARCHED = DelayProfile(2, 0, (0, 0)), DelayProfile(2, 0, (0, 1))
FIRST_ORDER = DelayProfile(1, 0, (0, 0))
NOISE = 0.1


def record_of(model=SYSTEM, *, seed=0, interval=0.2, hold="zoh", read_as=None, late=0.0):
    """A record of steps of random length, or of a random walk that is followed along straight lines.

    Samples are taken ``late`` after their time stamps.
    """
    rng, n = np.random.default_rng(seed), 1000
    t = interval * np.arange(n)
    u = np.repeat(rng.choice([-1.0, 1.0], n), rng.integers(3, 12, n))[:n] if hold == "zoh" else rng.standard_normal(n)
    y = simulate(model, HeldSignal(t, u, hold), np.sort(np.maximum(t + late, 0.0))) + NOISE * rng.standard_normal(n)
    return Record(t, y, HeldSignal(t, u, read_as or hold))


def changed(record, y):
    return Record(record.t, y, record.input)


def spoilt(record, samples, size):
    y = record.y.copy()
    y[samples] += size
    return changed(record, y)


def stopped(record, first, last):
    y = record.y.copy()
    y[first:last] = y[first]
    return changed(record, y)


def jittered(seed):
    return record_of(seed=seed, late=0.1 * np.random.default_rng(1000 + seed).standard_normal(1000))


def looped(gain=0.8, n=1000):
    """A record in the loop of a proportional controller."""
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
FAULTS = {
    "15 outliers": (spoilt(CLEAN, FEW, 50 * NOISE), KNOWN, "15 output samples are outliers (t = 8, 20.2, 32.4, ...)"),
    "one outlier": (spoilt(CLEAN, [500], -20 * NOISE), KNOWN, "1 output sample is an outlier (t = 100)"),
    "saturation": (changed(CLEAN, np.clip(CLEAN.y, -0.9, 0.9)), KNOWN, "exactly at the least or greatest value"),
    "a recorder that stood still": (stopped(CLEAN, 300, 320), KNOWN, "keeps one value from t = 60 to 63.8"),
    "drift": (changed(CLEAN, CLEAN.y + 2 * NOISE * np.linspace(0, 1, 1000)), KNOWN, "drifts by"),
    "the wrong hold": (record_of(hold="foh", read_as="zoh", interval=0.8), KNOWN, "use --hold foh"),
    "an integrator": (record_of(TransferFunction([1.0], [1.0, 1.0, 0.0])), KNOWN, "--poles 1 --integrators 1"),
    "an unstable plant": (record_of(TransferFunction([1.0], [1.0, -0.04])), FIRST_ORDER, "The output diverges"),
    "feedback": (looped(), FIRST_ORDER, "The input answers the output"),
    "one pole too few": (CLEAN, FIRST_ORDER, "try --poles 2"),
    "a beginning that is not at rest": (
        changed(CLEAN, CLEAN.y + 3.0 * np.exp(-0.4 * CLEAN.t) * np.cos(1.36 * CLEAN.t)),
        KNOWN,
        "use --initial-state estimate",
    ),
    "a submodel too few": (CLEAN, MeasuredSubmodels((Term(1, 0),)), "try another submodel, --terms 1/0,1/0)"),
    "one pole too few beside an integrator": (
        record_of(TransferFunction([2.0], [1.0, 0.8, 2.0, 0.0])),
        MeasuredSubmodels((Term(1, 0, 1),)),
        "try --poles 2)",
    ),
    "a delay that is not searched": (record_of(LATE), KNOWN, "--delay 0:"),
    "a delay outside the range": (record_of(LATE), SEARCHED, "try --delay 0:"),
    "an offset": (changed(CLEAN, CLEAN.y + 0.3), KNOWN, "use --offset estimate"),
    "jitter": (jittered(51), KNOWN, "as if the clock were wrong"),
    "a clock that wanders": (record_of(late=0.2 + 0.2 * np.sin(0.04 * CLEAN.t)), SEARCHED, "clock were wrong"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_named_first_and_once(fault):
    record, options, words = FAULTS[fault]
    warnings = identify(options, [record]).warnings
    assert words in warnings[0]
    assert sum(words in warning for warning in warnings) == 1


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_a_clean_record_needs_no_words(hold):
    assert identify(KNOWN, [record_of(seed=3, hold=hold)]).warnings == ()


def test_coloured_noise_is_told_from_all_causes():
    """Nothing is to be mended: every cause is in the sentence of those that were ruled out."""
    rng, noise = np.random.default_rng(7), np.zeros(1000)
    for k in range(1, 1000):
        noise[k] = 0.8 * noise[k - 1] + 0.05 * rng.standard_normal()
    clean = record_of(seed=53)
    first, *others = identify(KNOWN, [changed(clean, clean.y + noise)]).warnings
    for cause in ("ruled out", "one more pole", "another delay", "hold", "an offset", "drift", "feedback", "clock"):
        assert cause in first
    assert len(others) == 1


def test_another_order_and_another_delay_are_what_fits_with_them_find():
    prepared = FIRST_ORDER.prepare([CLEAN])
    fit = prepared.fit()
    richer = another_order(prepared.laid_out, fit, FIRST_ORDER)
    assert (richer.poles, richer.zeros) == (2, 0)
    assert richer.fall == pytest.approx(1 - KNOWN.fit([CLEAN]).cost / fit.cost, abs=1e-4)
    record = record_of(LATE, seed=55)
    prepared = KNOWN.prepare([record])
    fit = prepared.fit()
    elsewhere = another_delay(prepared.laid_out, fit, KNOWN)
    wide = DelayProfile(2, 0, (0.0, 5.0)).fit([record])
    assert elsewhere.delay == pytest.approx(wide.model.delay, abs=1e-3)
    assert elsewhere.fall == pytest.approx(1 - wide.cost / fit.cost, abs=1e-4)


def test_the_size_of_the_jitter_is_told():
    record = jittered(56)
    assert clock_evidence(KNOWN.fit([record]), [record]).jitter == pytest.approx(0.1, rel=0.35)
    assert clock_evidence(KNOWN.fit([CLEAN]), [CLEAN]).share == 0.0


def test_gaps_are_named():
    kept = np.delete(np.arange(1000), np.s_[400:430])
    record = Record.from_arrays(CLEAN.t[kept], CLEAN.input.values[kept], CLEAN.y[kept])
    (warning,) = (warning for warning in identify(KNOWN, [record]).warnings if "gap" in warning)
    assert "a gap of 6.2 after t = 79.8" in warning


def test_several_records_say_which_one():
    warnings = identify(KNOWN, [CLEAN, spoilt(record_of(seed=1), [500], 2.0)]).warnings
    assert warnings[0].startswith("Experiment 2: 1 output sample is an outlier")


def test_integrators_are_named_for_several_records_too():
    drives = [record_of(TransferFunction([1.0], [1.0, 1.0, 0.0]), seed=seed) for seed in (0, 1)]
    (words,) = (warning for warning in identify(KNOWN, drives).warnings if "integrat" in warning)
    assert "Use --poles 1 --integrators 1" in words


def test_the_other_hold_is_fitted_as_if_it_had_been_given():
    """The fall of the cost against two fits, the second with the record as it was taken."""
    wrong, right = (record_of(hold="foh", read_as=hold, interval=0.8) for hold in ("zoh", "foh"))
    prepared = KNOWN.prepare([wrong])
    fit = prepared.fit()
    expected = 1 - KNOWN.fit([right]).cost / fit.cost
    other = best_other_hold(prepared.laid_out, fit, [wrong])
    assert other.hold == "foh"
    assert other.fall == pytest.approx(expected, rel=1e-6)


def test_a_band_limited_input_is_named_as_such():
    """Exact samples of a sum of waves, read as held: the better hold is named, and fits when it is given."""
    t = 0.2 * np.arange(1500)
    rng = np.random.default_rng(5)
    w, phases = 2 * np.pi / 300.0 * np.arange(1, 600), rng.uniform(0, 2 * np.pi, 599)
    gain = np.exp(-0.5j * w) * 2 / (1j * w + 1)
    u = np.cos(np.outer(t, w) + phases).sum(axis=1)
    y = (np.abs(gain) * np.cos(np.outer(t, w) + phases + np.angle(gain))).sum(axis=1)
    y = y + 0.02 * y.std() * rng.standard_normal(t.size)
    options = DelayProfile(1, 0, (0, 2), initial_state="estimate")
    warnings = identify(options, [Record.from_arrays(t, u, y)]).warnings
    assert any("Taken as band-limited" in warning and "--hold band-limited" in warning for warning in warnings)
    right = options.fit([Record.from_arrays(t, u, y, "band-limited")])
    assert right.model.delay == pytest.approx(0.5, abs=0.01)
    assert right.model.numerator == pytest.approx([2.0], rel=0.02)
