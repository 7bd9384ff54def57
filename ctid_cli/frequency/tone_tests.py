"""What tones leave of their windows: the level of the noise, further lines, and changes within the window."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, IndexArray

#: Highest order of the autoregressive model that whitens what is left, and samples for each: colour, not lines.
WHITENING_ORDER = 4
SAMPLES_PER_ORDER = 128
#: Points of a periodogram for each bin of an unpadded one.
PADDING = 2
#: The floor beneath an ordinate is the running median of so many bins, and no more than half of them all.
FLOOR_BINS = 101
#: Ordinates higher than so many times the floor are cut before the floor's colour is modelled.
CUT = 5.0
ROUNDS = 3
#: A floor is never divided by less.
SMALLEST_FLOOR = 1e-300
#: A tapered spectrum so high above its floor shows a line, whatever the colour of the noise.
LINE_HEIGHT = 2e4
#: A whitening filter is taken to let at least this share through.
SMALLEST_GAIN = 1e-12
#: The running median is as sure as the mean of so many bins for each of its own.
MEDIAN_EFFICIENCY = 0.48
#: Independent ordinates in a padded periodogram, for each sample.
INDEPENDENT = 0.8
#: Lines that join together with the strongest one: how many, bins between them, the share of its ordinate that they
#: exceed, and how far, times, they are above the height that noise exceeds with a chance.
FURTHER = 4
LOBES = 8.0
SIDE_LOBE = 0.1
SURELY = 1.5
LEAST_CHANCE = 1e-7
#: A change is looked for in the middle of the window, without this share at each end.
ENDS = 0.05


class Left(NamedTuple):
    """What is left of windows of one length, whitened."""

    #: Whitened residuals of mean square 1 where they are noise; zero where a sample is missing, shape (R, L).
    white: Array
    #: Prediction-error filter of each window, shape (R, p + 1).
    filters: Array
    #: Mean square of the innovations, shape (R,).
    innovations: Array
    #: Where the tapered spectrum has its largest ordinate, as a share of all, and how high that is above the floor
    #: before any whitening, shape (R,).
    peak: Array
    peak_height: Array

    def noise(self, turn: Array) -> Array:
        """Noise at some phases from sample to sample [rad] of each window: mean square of equally strong white noise.

        Both shapes (R, n).
        """
        lags = np.arange(self.filters.shape[1])
        response = (self.filters[:, None, :] * np.exp(-1j * turn[:, :, None] * lags)).sum(axis=2)
        return np.asarray(self.innovations[:, None] / np.abs(response) ** 2)


def whiten(residuals: Array, fitted: IndexArray) -> Left:
    """Whiten rows of residuals, from which ``fitted`` numbers each were fitted, by autoregressive models.

    The models are those of the floor: lines are cut from the spectrum before they are made.
    """
    length = residuals.shape[1]
    there = np.isfinite(residuals)
    present = there.sum(axis=1)
    values = np.where(there, residuals, 0.0)
    taper = np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2
    power = np.abs(np.fft.rfft(values * taper, PADDING * length, axis=1)) ** 2
    orders = min(WHITENING_ORDER, max(1, length // SAMPLES_PER_ORDER))
    cosines = np.cos(np.outer(np.arange(orders + 1), np.linspace(0.0, np.pi, power.shape[1])))
    weights = np.full(power.shape[1], 2.0)
    weights[[0, -1]] = 1.0
    peak = power.argmax(axis=1)
    floor = np.take_along_axis(running_floor(power), peak[:, None], axis=1)[:, 0]
    height = power[np.arange(peak.size), peak] / np.maximum(floor, SMALLEST_FLOOR)
    shape = np.ones_like(power)
    for _ in range(ROUNDS):
        cut = np.minimum(power, CUT * shape * running_floor(power / shape))
        filters = _prediction_errors((cut * weights) @ cosines.T, present)
        # |A|^2 is the cosine series of the filter's own correlation.
        own = np.stack([(filters[:, k:] * filters[:, : orders + 1 - k]).sum(axis=1) for k in range(orders + 1)])
        own[1:] *= 2.0
        shape = 1.0 / np.maximum(own.T @ cosines, SMALLEST_GAIN)
    white = values.copy()
    for lag in range(1, orders + 1):
        white[:, lag:] += filters[:, lag, None] * values[:, : length - lag]
    white[~there] = 0.0
    order = (filters != 0.0).sum(axis=1) - 1
    squares = (white**2).sum(axis=1) / np.maximum(present - fitted - order, 1)
    white /= np.sqrt(np.where(squares > 0.0, squares, 1.0))[:, None]
    return Left(white, filters, squares, peak / (power.shape[1] - 1), height)


def running_floor(power: Array) -> Array:
    """Running median of rows of ordinates, as the mean of exponential variables, shape (R, M)."""
    size = power.shape[1]
    half = floor_bins(size) * PADDING // 2
    hop = max(1, half // 2)
    count = -(-size // hop) + 1
    padded = np.pad(power, ((0, 0), (half, half + (count - 1) * hop + 1 - size)), mode="reflect")
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=1)[:, ::hop, ::PADDING]
    medians = np.median(around, axis=2)
    place = np.arange(size) / hop
    below = place.astype(int)
    share = place - below
    found = (1.0 - share) * medians[:, below] + share * medians[:, below + 1]
    return np.asarray(found / np.log(2.0))


def floor_bins(size: int) -> int:
    """Unpadded bins in one running median of so many ordinates."""
    return min(FLOOR_BINS, size // PADDING // 2) // 2 * 2 + 1


def _prediction_errors(covariances: Array, count: IndexArray) -> Array:
    """Prediction-error filters by Levinson's recursion, each of the order with the least AICc, shape (R, p + 1)."""
    rows, most = covariances.shape[0], covariances.shape[1] - 1
    filters = np.zeros((rows, most + 1))
    filters[:, 0] = 1.0
    scale = np.where(covariances[:, 0] > 0.0, covariances[:, 0], 1.0)
    r = covariances / scale[:, None]
    error = np.ones(rows)
    best, best_score = filters.copy(), np.zeros(rows)
    for order in range(1, most + 1):
        mirrored = filters[:, :order][:, ::-1]
        reflection = np.clip(-(mirrored * r[:, 1 : order + 1]).sum(axis=1) / error, -0.999, 0.999)
        filters[:, 1 : order + 1] += reflection[:, None] * mirrored
        error = error * (1.0 - reflection**2)
        score = count * np.log(error) + 2.0 * order * count / np.maximum(count - order - 2, 1)
        better = score < best_score
        best[better], best_score[better] = filters[better], score[better]
    return best


class Line(NamedTuple):
    """The strongest line that is left of each window."""

    #: Chance of noise to have one as strong, shape (R,).
    chance: Array
    #: Its phase from sample to sample [rad], shape (R,).
    omega: Array
    #: Its height over the floor, shape (R,).
    height: Array
    #: Sum of squares that the largest line would take away, in units of all the noise, shape (R,).
    energy: Array
    #: Further lines, too far from any stronger one to be its side lobes [rad]; NaN where none is, shape (R, K).
    further: Array
    #: The sum of squares that each would take away, shape (R, K).
    further_energy: Array


def strongest_line(left: Left) -> Line:
    """The strongest line of each row, in the ratio of the periodogram to its running median."""
    rows, length = left.white.shape
    ordinates = np.abs(np.fft.rfft(left.white, PADDING * length, axis=1)) ** 2
    ratio = ordinates / np.maximum(running_floor(ordinates), SMALLEST_FLOOR)
    ratio[:, :PADDING] = 0.0
    place = ratio.argmax(axis=1)
    height = ratio[np.arange(rows), place]
    # The floor is uncertain: a ratio of exponential variables.
    sure = MEDIAN_EFFICIENCY * floor_bins(ordinates.shape[1])
    one = (1.0 + height / sure) ** -sure
    chance = -np.expm1(INDEPENDENT * length * np.log1p(-np.minimum(one, 1.0 - 1e-16)))
    turn = 2.0 * np.pi / (PADDING * length)
    omega = place * turn
    further, energies = np.full((rows, FURTHER), np.nan), np.zeros((rows, FURTHER))
    bins, top = np.arange(ordinates.shape[1]), ordinates.max(axis=1)
    near = np.abs(bins - place[:, None]) < LOBES * PADDING
    for k in range(FURTHER):
        left_over = np.where(near, 0.0, ratio)
        other = left_over.argmax(axis=1)
        surely = left_over[np.arange(rows), other] > SURELY * sure * (LEAST_CHANCE ** (-1.0 / sure) - 1.0)
        surely &= ordinates[np.arange(rows), other] > SIDE_LOBE * top
        if not surely.any():
            break
        further[surely, k] = other[surely] * turn
        energies[surely, k] = ordinates[surely, other[surely]] / length
        near |= np.abs(bins - other[:, None]) < LOBES * PADDING
    # The models of the noise have taken the skirts of a very strong line for its colour.
    plain = left.peak_height > LINE_HEIGHT
    chance, omega = np.where(plain, 0.0, chance), np.where(plain, np.pi * left.peak, omega)
    energy = np.where(plain, left.peak_height, ordinates.max(axis=1) / length)
    return Line(chance, omega, np.where(plain, left.peak_height, height), energy, further, energies)


@njit(cache=True, nogil=True)
def find_changes(white: Array, filters: Array, numbers: Array, count: IndexArray, energy: Array, cube: Array) -> None:
    """How much the tones of each window seem to change within it.

    ``energy``, shape (R, n), is the largest sum of squares that a change of phase and amplitude at one instant would
    take away of a whitened residual, in units of the noise. The sum of the demodulated residual up to an instant has of
    the noise what the fitted polynomials (phase 1, u, u^2; amplitude 1, u) leave of it. ``cube``, shape (R, n), is the
    sum of the demodulated residual's quadrature times ``P3(u)``.
    """
    length = white.shape[1]
    begin = max(1, int(ENDS * length))
    # Integrals of the orthonormal Legendre polynomials from -1 to v, squared.
    of_amplitude, of_phase = np.empty(length), np.empty(length)
    for i in range(length):
        x = (i + 1) / length
        v = 2.0 * x - 1.0
        of_amplitude[i] = length * (x - x * x - 3.0 * (0.25 * (v * v - 1.0)) ** 2)
        of_phase[i] = of_amplitude[i] - length * 5.0 * (0.25 * (v**3 - v)) ** 2
    du = 2.0 / (length - 1)
    for row in range(white.shape[0]):
        for k in range(count[row]):
            cosine, sine, turn, bend = numbers[row, k, 0], numbers[row, k, 1], numbers[row, k, 3], numbers[row, k, 4]
            response = 0.0j
            for lag in range(filters.shape[1]):
                response += filters[row, lag] * np.exp(complex(0.0, -turn * du * lag))
            phase = math.atan2(-sine, cosine) + math.atan2(response.imag, response.real)
            z = np.exp(complex(0.0, turn - bend - phase))
            q = np.exp(complex(0.0, -turn * du - bend * (du * du - 2.0 * du)))
            p = np.exp(complex(0.0, -2.0 * bend * du * du))
            real, imag, largest, third = 0.0, 0.0, 0.0, 0.0
            for i in range(length):
                u = du * i - 1.0
                value = white[row, i]
                real += value * z.real
                imag += value * z.imag
                third += value * z.imag * 0.5 * (5.0 * u * u - 3.0) * u
                if begin <= i < length - begin:
                    largest = max(largest, real * real / of_amplitude[i] + imag * imag / of_phase[i])
                z *= q
                q *= p
            energy[row, k] = largest
            cube[row, k] = third
