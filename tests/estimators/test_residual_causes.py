"""Causes of bad residuals: a planted one is named first, and what was tried is what a fit with it gives."""

import numpy as np
import pytest

from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.identification import identify
from ctid_cli.estimators.residual_causes import another_delay, another_order, clock_evidence
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

SYSTEM = TransferFunction([2.0], [1.0, 0.8, 2.0], 0.0)
LATE = TransferFunction([2.0], [1.0, 0.8, 2.0], 2.5)
T = 0.2 * np.arange(800)
KNOWN, SEARCHED = DelayProfile(2, 0, (0.0, 0.0)), DelayProfile(2, 0, (0.0, 1.0))


def record_of(seed, model=SYSTEM, *, late=0.0, added=0.0):
    """Steps of random length, samples taken ``late`` after their time stamps."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], T.size), rng.integers(3, 12, T.size))[: T.size]
    instants = np.sort(np.maximum(T + late, 0.0))
    y = simulate(model, HeldSignal(T, u), instants) + added + 0.1 * rng.standard_normal(T.size)
    return Record.from_arrays(T, u, y)


def jittered(seed):
    return record_of(seed, late=0.1 * np.random.default_rng(1000 + seed).standard_normal(T.size))


PLANTED = {
    "a pole too few": (record_of, DelayProfile(1, 0, (0.0, 0.0)), "try --poles 2"),
    "a delay outside the range": (lambda seed: record_of(seed, LATE), SEARCHED, "try --delay 0:"),
    "a delay that is not known": (lambda seed: record_of(seed, LATE), KNOWN, "try --delay 0:"),
    "an offset": (lambda seed: record_of(seed, added=0.3), KNOWN, "use --offset estimate"),
    "a drift": (lambda seed: record_of(seed, added=0.4 * T / T[-1] - 0.2), KNOWN, "drifts by"),
    "jitter": (jittered, KNOWN, "as if the clock were wrong"),
    "a clock that wanders": (lambda s: record_of(s, late=0.2 + 0.2 * np.sin(0.04 * T)), SEARCHED, "clock were wrong"),
}


@pytest.mark.parametrize("cause", PLANTED)
@pytest.mark.parametrize("seed", [51, 52])
def test_the_planted_cause_is_named_first(cause, seed):
    make, options, words = PLANTED[cause]
    warnings = identify(options, [make(seed)]).warnings
    assert words in warnings[0]
    ruled_out = [warning for warning in warnings if "ruled out" in warning]
    assert len(ruled_out) <= 1
    assert warnings.index(ruled_out[0]) <= 3 if ruled_out else cause == "jitter"


def test_coloured_noise_is_told_from_all_of_them():
    """Nothing is to be mended: every cause is in the sentence of those that were ruled out."""
    noise = np.zeros(T.size)
    for k, e in enumerate(0.05 * np.random.default_rng(7).standard_normal(T.size)):
        noise[k] = 0.8 * noise[k - 1] + e
    first, *others = identify(KNOWN, [record_of(53, added=noise)]).warnings
    for cause in ("ruled out", "one more pole", "another delay", "hold", "an offset", "drift", "feedback", "clock"):
        assert cause in first
    assert len(others) == 1


def test_another_order_and_another_delay_are_what_fits_with_them_find():
    record, poor = record_of(54), DelayProfile(1, 0, (0.0, 0.0))
    prepared = poor.prepare([record])
    fit = prepared.fit()
    richer = another_order(prepared.laid_out, fit, poor)
    assert (richer.poles, richer.zeros) == (2, 0)
    assert richer.fall == pytest.approx(1 - KNOWN.fit([record]).cost / fit.cost, abs=1e-4)
    record = record_of(55, LATE)
    prepared = KNOWN.prepare([record])
    fit = prepared.fit()
    elsewhere = another_delay(prepared.laid_out, fit, KNOWN)
    wide = DelayProfile(2, 0, (0.0, 5.0)).fit([record])
    assert elsewhere.delay == pytest.approx(wide.model.delay, abs=1e-3)
    assert elsewhere.fall == pytest.approx(1 - wide.cost / fit.cost, abs=1e-4)


def test_the_size_of_the_jitter_is_told():
    record = jittered(56)
    found = clock_evidence(KNOWN.fit([record]), [record])
    assert found.jitter == pytest.approx(0.1, rel=0.35)
    clean = record_of(57)
    assert clock_evidence(KNOWN.fit([clean]), [clean]).share == 0.0
