"""Shifts after which inputs repeat."""

import numpy as np
import pytest

from ctid_cli import HeldSignal
from ctid_cli.inference.repetition import Repetition, range_of, repetitions_of

T = 0.1 * np.arange(300)


def of(u, hold="zoh", t=T, **more):
    return repetitions_of(HeldSignal(t, u, hold), t, **more)


@pytest.mark.parametrize(("low", "level"), [(-1.0, 0.0), (0.0, 0.5)])
def test_half_a_period_of_a_square_wave_has_the_opposite_sign(low, level):
    (found,) = of(np.where(np.arange(300) // 20 % 2, low, 1.0))
    assert (found.shift, found.sign, found.level, found.exact) == pytest.approx((2.0, -1, level, True))
    assert range_of([found]) == pytest.approx(2.0)


def test_a_whole_period_has_the_same_sign():
    (found,) = of(np.resize(np.random.default_rng(0).choice([-1.0, 1.0], 63), 300))
    assert (found.shift, found.sign, found.exact) == pytest.approx((6.3, 1, True))


def test_even_and_odd_harmonics_repeat_after_a_period_only():
    found = of(np.sin(np.pi * T) + 0.5 * np.cos(2 * np.pi * T), "foh")
    assert [(each.sign, each.exact) for each in found] == [(1, True)]
    assert found[0].shift == pytest.approx(2.0)


@pytest.mark.parametrize("regular", [True, False])
def test_edges_that_are_displaced_by_the_clock_repeat_but_not_exactly(regular):
    t = T if regular else np.sort(np.random.default_rng(1).uniform(0, 30, 300))
    found = of(np.sign(np.sin(2 * np.pi * t / 3.7 + 0.3)), t=t)
    half = next(each for each in found if each.sign < 0)
    assert not half.exact
    assert half.shift == pytest.approx(1.85, rel=0.02)


def test_noise_steps_and_random_binary_signals_do_not_repeat():
    rng = np.random.default_rng(2)
    signals = [rng.standard_normal(300), np.where(T > 3.0, 1.0, 0.0)]
    signals += [np.repeat(rng.choice([-1.0, 1.0], 300), held)[:300] for held in range(1, 8) for _ in range(20)]
    assert not any(of(u) for u in signals)


def test_a_stated_period_counts_unless_the_input_repeats_within_it():
    assert of(np.random.default_rng(3).standard_normal(300), period=30.0) == (Repetition(30.0, 1),)
    (found,) = of(np.where(np.arange(300) // 30 % 2, -1.0, 1.0), period=30.0)
    assert (found.shift, found.sign) == pytest.approx((3.0, -1))


def test_an_input_given_by_its_changes_repeats_as_its_samples_do():
    u = np.where(np.arange(300) // 20 % 2, -1.0, 1.0)
    breaks = np.append(True, np.diff(u) != 0)
    assert repetitions_of(HeldSignal(T[breaks], u[breaks]), T) == of(u)
