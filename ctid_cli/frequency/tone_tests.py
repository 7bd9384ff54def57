"""What tones leave of their windows: the level of the noise, further lines, and changes within the window."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.frequency.whitening import PADDING, SMALLEST_FLOOR, Left, floor_bins, periodogram, running_floor

#: A tapered spectrum so high above its floor shows a line, whatever the colour of the noise.
LINE_HEIGHT = 2e4
#: The running median is as sure as the mean of so many bins for each of its own.
MEDIAN_EFFICIENCY = 0.48
#: Independent ordinates in a padded periodogram, for each sample.
INDEPENDENT = 0.8
#: Lines that join together with the strongest one: how many, bins between them, the share of its ordinate that they
#: exceed, and how far, times, they are above the height that noise exceeds with a chance.
FURTHER = 4
LOBES = 8
SIDE_LOBE = 0.1
SURELY = 1.5
LEAST_CHANCE = 1e-7
#: A change is looked for in the middle of the window, without this share at each end.
ENDS = 0.05


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
    ordinates = periodogram(left.white)
    floor = running_floor(ordinates)
    # The floor is uncertain: a ratio of exponential variables.
    sure = MEDIAN_EFFICIENCY * floor_bins(ordinates.shape[1])
    least = SURELY * sure * (LEAST_CHANCE ** (-1.0 / sure) - 1.0)
    place, height, top = np.empty(rows, np.int64), np.empty(rows), np.empty(rows)
    others = np.full((rows, FURTHER), -1)
    medians = np.maximum(floor.medians, SMALLEST_FLOOR)
    _find_lines(ordinates, medians, floor.hop, PADDING, least, place, height, top, others)
    one = (1.0 + height / sure) ** -sure
    chance = -np.expm1(INDEPENDENT * length * np.log1p(-np.minimum(one, 1.0 - 1e-16)))
    turn = 2.0 * np.pi / (PADDING * length)
    omega = place * turn
    further = np.where(others >= 0, others * turn, np.nan)
    energies = np.where(others >= 0, np.take_along_axis(ordinates, np.maximum(others, 0), axis=1) / length, 0.0)
    # The models of the noise have taken the skirts of a very strong line for its colour.
    plain = left.peak_height > LINE_HEIGHT
    chance, omega = np.where(plain, 0.0, chance), np.where(plain, np.pi * left.peak, omega)
    energy = np.where(plain, left.peak_height, top / length)
    return Line(chance, omega, np.where(plain, left.peak_height, height), energy, further, energies)


@njit(cache=True, nogil=True)
def _find_lines(
    ordinates: Array,
    medians: Array,
    hop: int,
    padding: int,
    least: float,
    place: IndexArray,
    height: Array,
    top: Array,
    others: IndexArray,
) -> None:
    """Where each row is highest over its floor, how high, and the largest ordinate; and further lines that are sure.

    Those are higher over the floor than ``least``, and no side lobes.
    """
    size = ordinates.shape[1]
    ratio = np.empty(size)
    ramp = np.arange(hop) / hop
    for row in range(ordinates.shape[0]):
        for first in range(0, size, hop):
            own, next_ = medians[row, first // hop], medians[row, first // hop + 1]
            for j in range(min(hop, size - first)):
                floor = own + ramp[j] * (next_ - own)
                ratio[first + j] = ordinates[row, first + j] / floor
        ratio[:padding] = 0.0
        best = np.argmax(ratio)
        place[row], height[row], top[row] = best, ratio[best], ordinates[row].max()
        for k in range(others.shape[1]):
            ratio[max(0, best - LOBES * padding + 1) : best + LOBES * padding] = 0.0
            best = np.argmax(ratio)
            if ratio[best] <= least or ordinates[row, best] <= SIDE_LOBE * top[row]:
                break
            others[row, k] = best


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
