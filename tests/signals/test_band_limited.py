"""Band-limited signals as straight lines on a finer clock, against exact responses to periodic inputs."""

import numpy as np
import pytest

from ctid_cli import HeldSignal, TransferFunction, simulate
from ctid_cli.signals.band_limited import FINER, REACH

INTERVAL, PERIOD = 0.2, 400
MODELS = {
    "first order": TransferFunction([1.0], [1.0, 1.0], delay=0.33),
    "resonant": TransferFunction([4.0], [1.0, 0.4, 4.0], delay=0.33),
    "with a zero": TransferFunction([1.0, 1.0], [1.0, 0.4, 4.0]),
}


def period(top, seed=0):
    """Return harmonics up to a fraction of half the sampling frequency: frequencies, phases."""
    harmonics = np.arange(1, int(top * PERIOD / 2))
    phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, harmonics.size)
    return 2 * np.pi * harmonics / (PERIOD * INTERVAL), phases


def waves(t, w, phases, response=None):
    factors = np.ones(w.size) if response is None else response
    return (np.abs(factors) * np.cos(np.outer(t, w) + phases + np.angle(factors))).sum(axis=1)


def exact(model, w):
    s = 1j * w
    return np.polyval(model.numerator, s) / np.polyval(model.denominator, s) * np.exp(-s * model.delay)


@pytest.mark.parametrize("model", MODELS.values(), ids=list(MODELS))
@pytest.mark.parametrize("top", [0.4, 0.85])
def test_answers_are_those_of_the_harmonics(model, top):
    w, phases = period(top)
    t = INTERVAL * np.arange(5 * PERIOD)
    true = waves(t, w, phases, exact(model, w))
    u = waves(t, w, phases)
    middle = slice(3 * PERIOD, 4 * PERIOD)
    off = {}
    for hold in ("foh", "band-limited"):
        off[hold] = np.std((simulate(model, HeldSignal(t, u, hold), t) - true)[middle]) / np.std(true)
    assert off["band-limited"] < 2e-4
    assert off["foh"] > 50 * off["band-limited"]
    # Other instants use another method, with the same result.
    some = t[3 * PERIOD : 4 * PERIOD] + 0.07
    between = simulate(model, HeldSignal(t, u, "band-limited"), some)
    assert np.std(between - waves(some, w, phases, exact(model, w))) < 4e-4 * np.std(true)


def test_a_periodic_signal_is_exact_at_its_ends_too():
    w, phases = period(0.95)
    t = INTERVAL * np.arange(PERIOD)
    signal = HeldSignal(t, waves(t, w, phases), "band-limited")
    lines = signal.periodic_lines
    damped = np.sinc(w * INTERVAL / FINER / (2 * np.pi)) ** 2
    assert lines.t.size == FINER * PERIOD
    assert lines.values == pytest.approx(waves(lines.t, w, phases, 1 / damped), abs=1e-9)


def test_values_between_the_samples():
    w, phases = period(0.5)
    t = INTERVAL * np.arange(PERIOD)
    signal = HeldSignal(t, waves(t, w, phases), "band-limited")
    within = np.random.default_rng(0).uniform(t[REACH], t[-REACH], 200)
    assert signal.at(t) == pytest.approx(signal.values, abs=1e-9)
    assert signal.at(within) == pytest.approx(waves(within, w, phases), abs=0.02 * signal.values.std())
    constant = HeldSignal(t, np.full(t.size, 3.0), "band-limited")
    assert constant.lines.values == pytest.approx(np.full(constant.lines.t.size, 3.0), rel=1e-12)
