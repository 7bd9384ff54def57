"""The amplitudes that belong to known frequencies."""

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.frequency.amplitudes import fit_sinusoids
from tests.frequency.signals import AMPLITUDES, INTERVAL, OMEGA, PHASES, tones

COUNT = 1500


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("n", range(1, 6))
def test_amplitudes_phases_and_bias_are_found(n, bias):
    y = tones(n, COUNT).sum(axis=1) + (0.4 if bias else 0.0)
    y[100:130] = np.nan
    fit = fit_sinusoids(y, INTERVAL, OMEGA[n], bias=bias)
    np.testing.assert_allclose(fit.amplitudes, AMPLITUDES[:n], rtol=1e-9)
    np.testing.assert_allclose(fit.phases, PHASES[:n], atol=1e-9)
    assert fit.bias == pytest.approx(0.4 if bias else 0.0, abs=1e-9)
    assert fit.residual_rms < 1e-12
    np.testing.assert_allclose(fit.at(INTERVAL * np.arange(COUNT))[200:], y[200:], atol=1e-10)


def test_residual_is_what_is_left():
    noise = 0.3 * np.random.default_rng(0).standard_normal(20_000)
    fit = fit_sinusoids(tones(2, 20_000).sum(axis=1) + noise, INTERVAL, OMEGA[2])
    assert fit.residual_rms == pytest.approx(0.3, rel=0.02)


@pytest.mark.parametrize("phase", [-np.pi + 1e-3, -1.0, 0.0, 3.0, np.pi])
def test_phases_lie_within_half_a_turn(phase):
    t = INTERVAL * np.arange(COUNT)
    fit = fit_sinusoids(np.sin(2 * t + phase), INTERVAL, [2.0])
    assert -np.pi < fit.phases[0] <= np.pi
    assert np.exp(1j * fit.phases[0]) == pytest.approx(np.exp(1j * phase), abs=1e-9)


@pytest.mark.parametrize(
    ("samples", "omega", "message"),
    [
        (np.zeros(1000), [2.0, 2.0], "cannot tell the sinusoids apart"),
        (np.zeros(1000), [2.0, 2.0 + 1e-13], "cannot tell the sinusoids apart"),
        (np.zeros(1000), [2 * np.pi / INTERVAL], "cannot tell the sinusoids apart"),
        (np.zeros(3), [1.0, 2.0], "3 samples cannot determine 5 amplitudes"),
        (np.full(10, np.nan), [1.0], "no finite sample"),
        (np.zeros((3, 3)), [1.0], "one series of real numbers"),
    ],
)
def test_amplitudes_that_the_samples_do_not_determine_are_refused(samples, omega, message):
    with pytest.raises(DataError, match=message):
        fit_sinusoids(samples, INTERVAL, omega)


@pytest.mark.parametrize("omega", [[], [0.0], [-1.0], [[1.0]], [np.nan], np.ones(9)])
def test_impossible_frequencies_are_refused(omega):
    with pytest.raises(ValueError, match="omega must"):
        fit_sinusoids(np.ones(100), INTERVAL, omega)
