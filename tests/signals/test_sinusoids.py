"""Sums of sinusoids with steps, and their disturbances."""

import numpy as np
import pytest

from ctid_cli.signals.noise import WhiteNoise
from ctid_cli.signals.sinusoids import Piece, SineDisturbance, SumOfSinusoids, Tone, UniformDisturbance, disturb

T = 0.001 * np.arange(60_000)
STEPPED = (
    Tone((Piece(1.8, until=30.0), Piece(2.0))),
    Tone((Piece(3.2, until=30.0), Piece(3.0)), phase=np.pi / 2),
)


def test_constant_frequencies_are_a_sum_of_sinusoids_however_the_phase_is_read():
    tones = (Tone(2.0, 1.5, 0.3), Tone(3.0))
    expected = 1.5 * np.sin(2 * T + 0.3) + np.sin(3 * T) - 0.25
    for phase in ("jump", "continuous"):
        assert np.allclose(SumOfSinusoids(tones, -0.25, phase).generate(T), expected, rtol=0, atol=1e-12)


def test_a_jump_and_a_continuous_phase():
    after = T >= 30.0
    jump = np.sin(np.where(after, 2.0, 1.8) * T) + np.cos(np.where(after, 3.0, 3.2) * T)
    assert np.allclose(SumOfSinusoids(STEPPED, phase_at_steps="jump").generate(T), jump, rtol=0, atol=1e-12)
    smooth = SumOfSinusoids(STEPPED, phase_at_steps="continuous")
    first, second = np.where(after, 2 * T - 6.0, 1.8 * T), np.where(after, 3 * T + 6.0, 3.2 * T)
    assert np.allclose(smooth.generate(T), np.sin(first) + np.cos(second), rtol=0, atol=1e-12)


def test_a_piece_begins_at_its_instant_whatever_the_last_bits():
    signal = SumOfSinusoids((Tone(1.0, (Piece(1.0, until=0.3), Piece(2.0))),))
    times = np.array([3 * 0.1, 0.3, np.nextafter(0.3, 0)])
    assert np.allclose(signal.generate(times), 2 * np.sin(0.3))
    assert signal.steps == (0.3,)
    assert signal.frequency_steps == ()


def test_true_frequencies_are_ascending():
    signal = SumOfSinusoids((Tone(3.0), Tone((Piece(1.0, until=5.0), Piece(4.0)))))
    assert np.array_equal(signal.frequencies_at([0.0, 5.0]), [[1.0, 3.0], [3.0, 4.0]])
    assert signal.highest_frequency == 4.0


def test_disturbances():
    signal, rng = np.sin(T), np.random.default_rng(0)
    added = disturb(signal, T, UniformDisturbance(0.2), rng) - signal
    assert np.abs(added).max() <= 0.2
    assert np.std(added) == pytest.approx(0.2 / np.sqrt(3), rel=0.01)
    assert np.allclose(disturb(signal, T, SineDisturbance(0.25, 15.0), rng) - signal, 0.25 * np.sin(15 * T))
    white = disturb(signal, T, WhiteNoise(standard_deviation=0.1), rng) - signal
    assert np.std(white) == pytest.approx(0.1, rel=0.02)
    assert disturb(signal, T, None, rng) is signal
