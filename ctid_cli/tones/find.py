"""Detection of lines in the residuals of windows: noise spectrum, noise floor and strongest ordinates."""

from typing import NamedTuple

import numpy as np
from scipy.fft import next_fast_len, rfft

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.tones import constants as c


class Left(NamedTuple):
    """Whitened residuals of windows of one length."""

    #: Whitened residuals, of mean square 1 if they are noise; zero for missing samples, shape (R, L).
    white: Array
    #: Prediction-error filter of each window, shape (R, p + 1).
    filters: Array
    #: Mean square of the innovations, shape (R,).
    innovations: Array
    #: Frequency of the largest ordinate before whitening [rad/sample], and its ratio to the noise floor, shape (R,).
    peak: Array
    peak_height: Array

    def noise(self, turn: Array) -> Array:
        """Return the mean square of white noise with the local density at frequencies [rad/sample], shape (R, n)."""
        lags = np.arange(self.filters.shape[1])
        response = (self.filters[:, None, :] * np.exp(-1j * turn[:, :, None] * lags)).sum(axis=2)
        return np.asarray(self.innovations[:, None] / np.abs(response) ** 2)


class Lines(NamedTuple):
    """Strongest line in the residual of each window."""

    #: p-value under noise alone, shape (R,).
    chance: Array
    #: Frequency [rad/sample], ratio to the noise floor, and energy of the largest ordinate in units of the noise,
    #: shape (R,).
    omega: Array
    height: Array
    energy: Array


def whiten(residuals: Array, fitted: IndexArray) -> Left:
    """Whiten rows of residuals of fits with ``fitted`` parameters by autoregressive models.

    The models describe the noise only: ordinates far above the noise floor are clipped before they are estimated.
    """
    rows, length = residuals.shape
    there = np.isfinite(residuals)
    values = np.where(there, residuals, 0.0)
    power = periodogram(values * np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2)
    floor = running_floor(power, length)
    peak = power.argmax(axis=1)
    each = np.arange(rows)
    height = power[each, peak] / np.maximum(floor[each, peak], c.SMALLEST_FLOOR)
    order = min(c.WHITENING_ORDER, max(1, length // c.SAMPLES_PER_ORDER))
    cosines = np.cos(np.outer(np.arange(order + 1), np.linspace(0.0, np.pi, power.shape[1])))
    # In the two-sided spectrum the first and the last ordinate occur once, all others twice.
    weighted = cosines.copy()
    weighted[:, 1:-1] *= 2.0
    filters = prediction_errors(np.minimum(power, c.CUT * floor) @ weighted.T)
    for _ in range(c.WHITENING_ROUNDS - 1):
        own = np.array([(filters[:, : order + 1 - k] * filters[:, k:]).sum(axis=1) for k in range(order + 1)])
        own[1:] *= 2.0
        gain = np.maximum(own.T @ cosines, c.SMALLEST_GAIN)
        floor = running_floor(power * gain, length) / gain
        filters = prediction_errors(np.minimum(power, c.CUT * floor) @ weighted.T)
    white = values.copy()
    for lag in range(1, order + 1):
        white[:, lag:] += filters[:, lag, None] * values[:, :-lag]
    white *= there
    squares = (white**2).sum(axis=1) / np.maximum(there.sum(axis=1) - fitted - order, 1)
    white /= np.sqrt(np.where(squares > 0.0, squares, 1.0))[:, None]
    return Left(white, filters, squares, np.pi * peak / (power.shape[1] - 1), height)


def periodogram(values: Array) -> Array:
    """Return the squared magnitudes of the zero-padded transforms of rows; the padded length is even."""
    size = next_fast_len(c.PADDING * values.shape[1], real=True)
    transform = rfft(values, size + size % 2, axis=1)
    return np.asarray(transform.real**2 + transform.imag**2)


def floor_bins(length: int) -> int:
    """Return the width of the running median of the ordinates of a window [bins]."""
    return min(c.FLOOR_BINS, length // 4) // 2 * 2 + 1


def running_floor(power: Array, length: int) -> Array:
    """Return running medians of rows of ordinates, scaled to means of exponential variables, interpolated linearly."""
    half = floor_bins(length) // 2
    hop = max(1, half // 2)
    bins = power[:, :: c.PADDING]
    # The spectrum is mirrored at its ends.
    bins = np.pad(bins, ((0, 0), (half, half + hop)), mode="reflect")
    around = np.lib.stride_tricks.sliding_window_view(bins, 2 * half + 1, axis=1)[:, ::hop]
    medians = np.partition(around, half, axis=2)[:, :, half] / np.log(2.0)
    ramp = np.arange(hop * c.PADDING) / (hop * c.PADDING)
    lines = medians[:, :-1, None] * (1.0 - ramp) + medians[:, 1:, None] * ramp
    return np.asarray(lines.reshape(power.shape[0], -1)[:, : power.shape[1]])


def prediction_errors(covariances: Array) -> Array:
    """Return the prediction-error filters of rows of autocovariances, by the Yule-Walker equations, (R, p + 1)."""
    order = covariances.shape[1] - 1
    r = covariances / np.where(covariances[:, :1] > 0.0, covariances[:, :1], 1.0)
    r[:, 0] = 1.0 + c.LEAST_NOISE
    lags = np.abs(np.subtract.outer(np.arange(order), np.arange(order)))
    solved = np.linalg.solve(r[:, lags], -r[:, 1:, None])[:, :, 0]
    return np.concatenate((np.ones((r.shape[0], 1)), solved), axis=1)


class Spectrum(NamedTuple):
    """Periodograms of whitened residuals."""

    #: Squared magnitudes of the padded transform, and their ratio to the noise floor, shape (R, K).
    ordinates: Array
    ratio: Array
    #: Samples of the window, effective number of ordinates of the noise floor, and frequency step [rad/sample].
    length: int
    known: float
    turn: float

    def chance(self, height: Array) -> Array:
        """Return the p-value of the largest ratio under noise, allowing for the uncertain noise floor."""
        one = (1.0 + height / self.known) ** -self.known
        return np.asarray(-np.expm1(c.INDEPENDENT * self.length * np.log1p(-np.minimum(one, 1.0 - 1e-16))))


def spectrum_of(white: Array) -> Spectrum:
    """Return the periodograms of whitened rows."""
    length = white.shape[1]
    ordinates = periodogram(white)
    ratio = ordinates / np.maximum(running_floor(ordinates, length), c.SMALLEST_FLOOR)
    ratio[:, : c.PADDING] = 0.0
    return Spectrum(
        ordinates, ratio, length, c.MEDIAN_EFFICIENCY * floor_bins(length), np.pi / (ordinates.shape[1] - 1)
    )


def strongest_lines(left: Left, spectrum: Spectrum) -> Lines:
    """Find the strongest line of each row by the ratio of the periodogram to its running median."""
    place = spectrum.ratio.argmax(axis=1)
    height = spectrum.ratio[np.arange(place.size), place]
    # The noise models have absorbed the skirts of a very strong line.
    plain = left.peak_height > c.LINE_HEIGHT
    return Lines(
        np.where(plain, 0.0, spectrum.chance(height)),
        np.where(plain, left.peak, place * spectrum.turn),
        np.where(plain, left.peak_height, height),
        np.where(plain, left.peak_height, spectrum.ordinates.max(axis=1) / spectrum.length),
    )


def new_lines(left: Left, spectrum: Spectrum, tones: Array, change: Array) -> Array:
    """Return lines that do not belong to the tones of windows, the strongest first [rad/sample], shape (R, K).

    Missing ones are NaN. ``tones`` are the frequencies in the window [rad/sample], ``change`` the energies that a
    change of each would explain, (R, n). A peak within the width of a tone, or explained better by its change, is not
    a line.
    """
    bin_ = 2.0 * np.pi / spectrum.length
    ratio = spectrum.ratio.copy()
    plain = left.peak_height > c.LINE_HEIGHT
    ratio[plain, np.round(left.peak[plain] / spectrum.turn).astype(int)] = np.inf
    _clear(ratio, tones / spectrum.turn, int(c.APART * bin_ / spectrum.turn))
    found = np.full((ratio.shape[0], 1 + c.FURTHER), np.nan)
    rows, top = np.arange(ratio.shape[0]), np.zeros(ratio.shape[0])
    for k in range(found.shape[1]):
        place = ratio[rows].argmax(axis=1)
        height = ratio[rows, place]
        energy = spectrum.ordinates[rows, place] / spectrum.length
        line = (spectrum.chance(height) < c.LEVEL) & (energy > c.SIDE_LOBE * top[rows])
        rows, place, energy = rows[line], place[line], energy[line]
        if not rows.size:
            break
        top[rows] = np.maximum(top[rows], energy)
        away = np.maximum(np.abs(place[:, None] * spectrum.turn - tones[rows]) / bin_ / c.CHANGED_BINS, 1.0)
        own = ~(np.nan_to_num(change[rows]) > energy[:, None] * away**2).any(axis=1)
        found[rows[own], k] = place[own] * spectrum.turn
        near = place[:, None] + np.arange(-c.LOBES * c.PADDING + 1, c.LOBES * c.PADDING)
        ratio[rows[:, None], np.clip(near, 0, ratio.shape[1] - 1)] = 0.0
    return found


def _clear(ratio: Array, places: Array, reach: int) -> None:
    """Set the ordinates around ``places``, shape (R, n), to zero; NaN places are ignored."""
    row, column = np.nonzero(np.isfinite(places))
    near = np.round(places[row, column]).astype(int)[:, None] + np.arange(-reach, reach + 1)
    ratio[row[:, None], np.clip(near, 0, ratio.shape[1] - 1)] = 0.0
