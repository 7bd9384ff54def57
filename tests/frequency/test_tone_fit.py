"""Tones of many windows at once: the same as a dense least-squares fit, with errors that cover."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from ctid_cli.frequency.frequency_kernels import fit_windows
from ctid_cli.frequency.tone_search import tones_of_windows, windows_at
from ctid_cli.frequency.tone_tests import strongest_line
from ctid_cli.frequency.whitening import running_floor, whiten


def model(numbers, constant, length):
    """The sum of tones as its formula says, without any recursion."""
    u = np.linspace(-1.0, 1.0, length)
    y = np.full(length, constant)
    for cosine, sine, growth, turn, bend in numbers:
        z = np.exp(growth * u + 1j * (turn * u + bend * u * u))
        y = y + cosine * z.real + sine * z.imag
    return y


@pytest.mark.parametrize("missing", [0, 40])
def test_the_fit_is_that_of_scipy(missing):
    rng = np.random.default_rng(1)
    truth = np.array([[1.0, 0.4, -0.3, 60.0, 1.5], [0.2, -0.1, 0.5, 95.0, -0.5]])
    y = model(truth, 0.3, 400) + 0.05 * rng.standard_normal(400)
    y[rng.choice(400, missing, replace=False)] = np.nan
    windows = windows_at(np.array([0]), 2)
    windows.numbers[0, :, 3] = truth[:, 3] + [0.5, -0.4]
    windows.used[0] = 2
    residuals = np.empty((1, 400))
    fit_windows(y, 400, windows, np.array([0]), residuals)

    def left(x):
        return (y - model(x[:10].reshape(2, 5), x[10], 400))[np.isfinite(y)]

    peer = least_squares(left, np.append(truth.ravel(), 0.3), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    errors = np.sqrt(np.diag(np.linalg.inv(peer.jac.T @ peer.jac)) * 2 * peer.cost / (400 - missing - 11))
    assert windows.converged[0]
    # Iterations end a small part of a standard error before the minimum.
    assert np.abs(windows.numbers[0].ravel() - peer.x[:10]).max() < 0.02 * errors[:10].max()
    left_over = np.nansum(residuals**2) / (400 - missing - 11)
    own = np.sqrt(left_over * windows.variances[0].ravel())
    # Covariances of the linearised model; distant tones are taken as apart.
    assert own[[2, 3, 4, 7, 8, 9]] == pytest.approx(errors[[2, 3, 4, 7, 8, 9]], rel=0.03)
    assert residuals[0][np.isfinite(y)] == pytest.approx(left(peer.x), abs=0.02)


def test_what_is_left_of_windows_without_a_sample():
    y = np.full(500, np.nan)
    y[:200] = np.sin(0.3 * np.arange(200)) + 1e-3 * np.random.default_rng(1).standard_normal(200)
    tones = tones_of_windows(y, 128, np.array([0, 64, 300]), 3)
    assert tones.used.tolist() == [1, 1, 0]
    assert not tones.converged[2]
    assert tones.omega[:2, 0] == pytest.approx(0.3, abs=1e-4)


@pytest.mark.parametrize("noise", [1e-2, 1e-4, 1e-6])
@pytest.mark.parametrize("length", [256, 2048])
def test_a_model_of_the_noise_takes_no_line_for_it(length, noise):
    y = np.cos(0.7 * np.arange(length)) + 0.01 * np.cos(1.9 * np.arange(length))
    tones = tones_of_windows(y + noise * np.random.default_rng(1).standard_normal(length), length, np.array([0]), 4)
    assert tones.used[0] == 2
    assert np.sort(tones.omega[0])[:2] == pytest.approx([0.7, 1.9], abs=3000 * noise / length**1.5)


@pytest.mark.parametrize(("length", "count"), [(64, 4000), (500, 1500)])
@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_noise_alone_shows_a_line_as_often_as_stated(length, count, pole):
    rng = np.random.default_rng(length)
    noise = rng.standard_normal((count, length + 200))
    for k in range(1, noise.shape[1]):
        noise[:, k] += pole * noise[:, k - 1]
    found = strongest_line(whiten(noise[:, 200:], np.ones(count, np.int64)))
    # The medians of short windows know so little of the floor that the test is a careful one.
    for level, least in ((0.2, 0.3), (0.02, 0.1)):
        seen = np.mean(found.chance < level)
        assert least * level <= seen <= 1.3 * level + 3.0 * np.sqrt(level / count)


def test_the_floor_is_not_raised_by_lines():
    rng = np.random.default_rng(2)
    power = rng.exponential(size=(50, 513))
    power[:, 200] += 1e6
    assert running_floor(power).medians.mean() == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_standard_errors_cover(pole):
    """Two tones, 15 dB and white or coloured noise: 95 of 100 intervals hold the truth."""
    rng = np.random.default_rng(3)
    count, length, omega = 400, 500, (0.6, 1.1)
    noise = rng.standard_normal((count, length + 200))
    for k in range(1, noise.shape[1]):
        noise[:, k] += pole * noise[:, k - 1]
    t = np.arange(length)
    phase = rng.uniform(0, 2 * np.pi, (count, 2))
    y = np.cos(omega[0] * t + phase[:, :1]) + 0.5 * np.cos(omega[1] * t + phase[:, 1:]) + 0.15 * noise[:, 200:]
    tones = tones_of_windows(y.ravel(), length, length * np.arange(count), 4)
    order = np.argsort(tones.omega, axis=1)[:, :2]
    assert (tones.used == 2).mean() > 0.98
    off = (np.take_along_axis(tones.omega, order, 1) - omega) / np.take_along_axis(tones.omega_error, order, 1)
    inside = np.abs(off[tones.used == 2]) < 1.96
    assert inside.mean() == pytest.approx(0.95, abs=3 * np.sqrt(0.95 * 0.05 / inside.size) + 0.01)
