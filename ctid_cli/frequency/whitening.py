"""What is left of windows, whitened: levels of noise under lines, and autoregressive models of its colour; compiled."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

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
#: A whitening filter is taken to let at least this share through.
SMALLEST_GAIN = 1e-12
#: The median of exponential variables, as a share of their mean.
MEDIAN = 0.6931471805599453


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


class Floor(NamedTuple):
    """Running medians of rows of ordinates, as the mean of exponential variables: straight lines between some."""

    #: Medians at every so many ordinates, from the first one on, shape (R, B).
    medians: Array
    hop: int

    def at(self, place: IndexArray) -> Array:
        """The floor of each row at one place, shape (R,)."""
        rows, below, share = np.arange(place.size), place // self.hop, place % self.hop / self.hop
        return np.asarray((1.0 - share) * self.medians[rows, below] + share * self.medians[rows, below + 1])


def whiten(residuals: Array, fitted: IndexArray) -> Left:
    """Whiten rows of residuals, from which ``fitted`` numbers each were fitted, by autoregressive models.

    The models are those of the floor: lines are cut from the spectrum before they are made.
    """
    length = residuals.shape[1]
    there = np.isfinite(residuals)
    present = there.sum(axis=1)
    values = np.where(there, residuals, 0.0)
    power = periodogram(values * np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2)
    order = min(WHITENING_ORDER, max(1, length // SAMPLES_PER_ORDER))
    cosine = np.cos(np.linspace(0.0, np.pi, power.shape[1]))
    peak = power.argmax(axis=1)
    floor = running_floor(power)
    height = power[np.arange(peak.size), peak] / np.maximum(floor.at(peak), SMALLEST_FLOOR)
    covariances, gain, ratio = np.empty((peak.size, WHITENING_ORDER + 1)), np.ones_like(power), np.empty_like(power)
    _moments(power, gain, floor.medians, floor.hop, cosine, covariances)
    filters = _prediction_errors(covariances[:, : order + 1], present)
    for _ in range(ROUNDS - 1):
        _flatten(power, filters, cosine, gain, ratio)
        floor = running_floor(ratio)
        _moments(power, gain, floor.medians, floor.hop, cosine, covariances)
        filters = _prediction_errors(covariances[:, : order + 1], present)
    white = np.empty_like(values)
    squares = np.empty(peak.size)
    parts = np.maximum(present - fitted - (filters != 0.0).sum(axis=1) + 1, 1)
    _filter(values, there, filters, parts, white, squares)
    return Left(white, filters, squares, peak / (power.shape[1] - 1), height)


def periodogram(values: Array) -> Array:
    """Squares of the padded transform of rows, shape (R, L + 1) where the padding is twofold."""
    transform = np.fft.rfft(values, PADDING * values.shape[1], axis=1)
    return np.asarray(_squares(transform))


def running_floor(power: Array) -> Floor:
    """Floor beneath rows of ordinates, shape (R, M)."""
    rows, size = power.shape
    half = floor_bins(size) * PADDING // 2
    hop = max(1, half // 2)
    around = np.empty((rows, -(-size // hop) + 1, 2 * half // PADDING + 1))
    _gather(power, half, hop, around)
    middle = around.shape[2] // 2
    around.partition(middle, axis=2)
    upper = around[:, :, middle]
    lower = around[:, :, :middle].max(axis=2) if around.shape[2] % 2 == 0 else upper
    return Floor(0.5 / MEDIAN * (lower + upper), hop)


def floor_bins(size: int) -> int:
    """Unpadded bins in one running median of so many ordinates."""
    return min(FLOOR_BINS, size // PADDING // 2) // 2 * 2 + 1


@njit(cache=True, nogil=True, fastmath={"contract"})
def _squares(transform: NDArray[np.complex128]) -> Array:
    out = np.empty(transform.shape)
    for row in range(transform.shape[0]):
        for m in range(transform.shape[1]):
            out[row, m] = transform[row, m].real ** 2 + transform[row, m].imag ** 2
    return out


@njit(cache=True, nogil=True)
def _gather(power: Array, half: int, hop: int, around: Array) -> None:
    """Put every so many ordinates around each place together; the spectrum is mirrored at its ends."""
    rows, places, bins = around.shape
    last = power.shape[1] - 1
    for row in range(rows):
        for place in range(places):
            first = place * hop - half
            if first >= 0 and first + PADDING * (bins - 1) <= last:
                for j in range(bins):
                    around[row, place, j] = power[row, first + PADDING * j]
                continue
            for j in range(bins):
                m = abs(first + PADDING * j) % (2 * last) if last else 0
                around[row, place, j] = power[row, min(m, 2 * last - m)]


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _moments(power: Array, gain: Array, medians: Array, hop: int, cosine: Array, covariances: Array) -> None:
    """Autocovariances of what is left of a spectrum that is cut above its floor, to the highest order."""
    ramp = np.arange(hop) / hop
    size = power.shape[1]
    for row in range(power.shape[0]):
        s0, s1, s2, s3, s4 = 0.0, 0.0, 0.0, 0.0, 0.0
        for b in range(medians.shape[1] - 1):
            first = b * hop
            here = min(hop, size - first)
            own, next_ = CUT * medians[row, b], CUT * medians[row, b + 1]
            ordinates, gains, c = power[row, first : first + here], gain[row, first : first + here], cosine[first:]
            for j in range(here):
                limit = (own + ramp[j] * (next_ - own)) / gains[j]
                cut = ordinates[j] if ordinates[j] < limit else limit
                # Chebyshev's polynomials are the cosines of multiples.
                t2 = 2.0 * c[j] * c[j] - 1.0
                t3 = 2.0 * c[j] * t2 - c[j]
                t4 = 2.0 * c[j] * t3 - t2
                s0 += cut
                s1 += cut * c[j]
                s2 += cut * t2
                s3 += cut * t3
                s4 += cut * t4
        # The first and the last ordinate are there once, all others twice.
        low = min(power[row, 0], CUT * medians[row, 0] / gain[row, 0])
        b = (size - 1) // hop
        high = medians[row, b] + ramp[size - 1 - b * hop] * (medians[row, b + 1] - medians[row, b])
        high = min(power[row, size - 1], CUT * high / gain[row, size - 1])
        covariances[row, 0] = 2.0 * s0 - low - high
        covariances[row, 1] = 2.0 * s1 - low + high
        covariances[row, 2] = 2.0 * s2 - low - high
        covariances[row, 3] = 2.0 * s3 - low + high
        covariances[row, 4] = 2.0 * s4 - low - high


@njit(cache=True, nogil=True, fastmath={"contract"})
def _flatten(power: Array, filters: Array, cosine: Array, gain: Array, ratio: Array) -> None:
    """Gain of the whitening filters, and the spectrum after them."""
    own = np.zeros(WHITENING_ORDER + 1)
    for row in range(power.shape[0]):
        # |A|^2 is the cosine series of the filter's own correlation.
        own[:] = 0.0
        for lag in range(filters.shape[1]):
            for k in range(filters.shape[1] - lag):
                own[lag] += (1.0 if lag == 0 else 2.0) * filters[row, k] * filters[row, k + lag]
        r0, r1, r2, r3, r4 = own[0], own[1], own[2], own[3], own[4]
        of_gain, of_ratio, ordinates = gain[row], ratio[row], power[row]
        for m in range(ordinates.size):
            c = cosine[m]
            t2 = 2.0 * c * c - 1.0
            t3 = 2.0 * c * t2 - c
            t4 = 2.0 * c * t3 - t2
            value = r0 + r1 * c + r2 * t2 + r3 * t3 + r4 * t4
            of_gain[m] = value if value > SMALLEST_GAIN else SMALLEST_GAIN
        for m in range(ordinates.size):
            of_ratio[m] = ordinates[m] * of_gain[m]


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _filter(
    values: Array, there: NDArray[np.bool_], filters: Array, parts: IndexArray, white: Array, squares: Array
) -> None:
    """Filter rows, and scale them to the mean square 1 of so many parts; the mean squares before."""
    length, order = values.shape[1], filters.shape[1] - 1
    for row in range(values.shape[0]):
        y, out, known = values[row], white[row], there[row]
        for i in range(length):
            out[i] = y[i]
        for lag in range(1, order + 1):
            weight = filters[row, lag]
            for i in range(lag, length):
                out[i] += weight * y[i - lag]
        total = 0.0
        for i in range(length):
            if not known[i]:
                out[i] = 0.0
            total += out[i] * out[i]
        squares[row] = total / parts[row]
        scale = 1.0 / np.sqrt(squares[row]) if squares[row] > 0.0 else 1.0
        for i in range(length):
            out[i] *= scale


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
