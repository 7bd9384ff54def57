"""ESPRIT, nonlinear least squares, and the amplitudes that belong to known frequencies."""

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.frequency.amplitudes import fit_sinusoids, frequency_errors
from ctid_cli.frequency.esprit import Esprit
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.nonlinear_least_squares import NonlinearLeastSquares
from tests.frequency.signals import AMPLITUDES, INTERVAL, OMEGA, PHASES, tones

COUNT = 1500


@pytest.mark.parametrize("n", range(1, 6))
@pytest.mark.parametrize("averaging", [0.0, 0.05])
def test_both_are_exact_without_noise(n, averaging):
    y = tones(n, COUNT).sum(axis=1)
    for options in (Esprit(tones=n, averaging=averaging), NonlinearLeastSquares(tones=n, averaging=averaging)):
        estimate = options.estimate(y, INTERVAL)
        np.testing.assert_allclose(estimate.omega, OMEGA[n], atol=1e-8)
        assert estimate.valid


def test_nonlinear_least_squares_stands_at_a_stationary_point():
    y = tones(2, COUNT).sum(axis=1) + 0.5 * np.random.default_rng(0).standard_normal(COUNT)
    omega = NonlinearLeastSquares(tones=2, averaging=0.05).estimate(y, INTERVAL).omega

    def cost(frequencies):
        return fit_sinusoids(y, INTERVAL, frequencies, bias=False).residual_rms

    for change in (1e-3 * np.array([1.0, 0.0]), 1e-3 * np.array([0.0, 1.0])):
        up, down = cost(omega + change), cost(omega - change)
        # A parabola with its vertex here.
        assert min(up, down) > cost(omega)
        assert abs(up - down) < 1e-2 * (up + down - 2 * cost(omega))


def test_nonlinear_least_squares_takes_gaps_and_a_bias():
    y = tones(2, COUNT).sum(axis=1) + 0.7
    y[np.random.default_rng(0).random(COUNT) < 0.4] = np.nan
    options = NonlinearLeastSquares(tones=2, initial_frequencies=(1.05, 1.95), bias=True)
    estimate = options.estimate(y, INTERVAL)
    assert estimate.valid
    np.testing.assert_allclose(estimate.omega, OMEGA[2], atol=1e-9)
    # The start of ESPRIT takes the mean out first.
    full = NonlinearLeastSquares(tones=2, bias=True).estimate(tones(2, COUNT).sum(axis=1) + 0.7, INTERVAL)
    np.testing.assert_allclose(full.omega, OMEGA[2], atol=1e-9)


def test_order_of_the_start_does_not_matter():
    y = tones(2, COUNT).sum(axis=1)
    estimate = NonlinearLeastSquares(tones=2, initial_frequencies=(1.95, 1.05)).estimate(y, INTERVAL)
    np.testing.assert_allclose(estimate.omega, OMEGA[2], atol=1e-9)


def test_step_and_uncertainty_are_those_of_the_whole_jacobian():
    # Against all unknowns at once: amplitudes, bias and frequencies in one matrix.
    rng = np.random.default_rng(1)
    t = np.sort(rng.uniform(0, 15, 400))
    omega = OMEGA[2] * 1.01
    y = (AMPLITUDES[:2] * np.sin(np.outer(t, OMEGA[2]) + PHASES[:2])).sum(axis=1) + 0.1 * rng.standard_normal(400) + 0.3
    step, uncertainty, misfit = frequency_errors(y, t, omega, bias=True)
    angles = np.outer(t, omega)
    linear = np.column_stack([np.sin(angles), np.cos(angles), np.ones(400)])
    a = np.linalg.lstsq(linear, y, rcond=None)[0]
    slopes = t[:, None] * (np.cos(angles) * a[:2] - np.sin(angles) * a[2:4])
    J = np.column_stack([slopes, linear])
    residual = y - linear @ a
    np.testing.assert_allclose(step, np.linalg.lstsq(J, residual, rcond=None)[0][:2], rtol=1e-8)
    assert misfit == pytest.approx(residual @ residual)
    expected = np.sqrt(np.diag(np.linalg.inv(J.T @ J))[:2] * misfit)
    np.testing.assert_allclose(uncertainty, expected, rtol=1e-8)


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


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        (np.append(np.ones(500), np.nan), "ESPRIT takes no record with missing samples"),
        (np.ones(8), "8 samples, after the averaging, are too few for 2 tones"),
        (np.full(100, np.nan), "no finite sample"),
    ],
)
def test_records_that_esprit_cannot_use_are_refused(samples, message):
    with pytest.raises(DataError, match=message):
        Esprit(tones=2).estimate(samples, INTERVAL)
    with pytest.raises(DataError, match=message):
        NonlinearLeastSquares(tones=2).estimate(samples, INTERVAL)


def test_averages_that_alias_are_refused():
    with pytest.raises(ValueError, match=r"averages over 0.5 s show frequencies up to 6.28319 rad/s"):
        Esprit(tones=1, averaging=0.5, highest_frequency=7.0).estimate(np.ones(1000), INTERVAL)


def test_a_start_too_far_away_is_not_called_converged_to_the_truth():
    y = tones(2, COUNT).sum(axis=1)
    estimate = NonlinearLeastSquares(tones=2, initial_frequencies=(4.0, 9.0)).estimate(y, INTERVAL)
    assert np.abs(estimate.omega - OMEGA[2]).max() > 0.1
    assert estimate.flags & Flag.UNCERTAIN


def test_too_few_iterations_are_reported():
    y = tones(2, COUNT).sum(axis=1)
    estimate = NonlinearLeastSquares(tones=2, initial_frequencies=(1.1, 1.9), max_iterations=1).estimate(y, INTERVAL)
    assert estimate.flags & Flag.NOT_CONVERGED


def test_options_that_contradict_each_other_are_refused():
    with pytest.raises(ValueError, match=r"lowest_frequency \(5 rad/s\) must be below highest_frequency \(2 rad/s\)"):
        Esprit(tones=1, lowest_frequency=5.0, highest_frequency=2.0)
    with pytest.raises(ValueError, match=r"initial_frequencies must differ"):
        NonlinearLeastSquares(tones=2, initial_frequencies=(2.0, 2.0))


def test_records_too_long_for_esprit_are_told_what_to_average():
    with pytest.raises(DataError, match=r"200,000 samples are more than the 100,000 .* at least 0\.02 s"):
        Esprit(tones=1).estimate(np.zeros(200_000), 0.01)


def test_huge_samples_are_missing_ones():
    with pytest.raises(DataError, match=r"no finite sample of a size up to 1e\+30"):
        NonlinearLeastSquares(tones=1).estimate(np.full(100, 1e200), 0.01)
