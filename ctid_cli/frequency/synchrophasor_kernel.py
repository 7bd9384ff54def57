"""Synchrophasors from samples on any regular clock, compiled: instrumental variables around the tone's own frequency.

Around an instant the signal is ``x(u) = Re[(p0 + p1 u + p2 u^2/2) exp(2 pi j u)]`` with ``u`` the time in cycles of the
tone. The equations ``sum h_i(u) exp(-2 pi j u) (x - model) = 0``, one for each kernel, are solved for ``p0, p1, p2``.
The model is met exactly whatever the clock, and what the kernels do not pass (harmonics, other tones) does not count.
"""

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray, IntArray

#: Frequencies are found again until the kernels are centred on them to this [Hz].
CENTRED = 1e-3
MOST_PASSES = 6
#: Samples of a cycle that are enough to begin with.
COARSE_SAMPLES = 64


@njit(cache=True, nogil=True)
def _reach(place: float, half: float, cycles: float, count: int) -> tuple[int, int]:
    """First sample within the kernels, and the one after the last."""
    first = max(0, int(np.ceil(place - half / cycles)))
    return first, min(count, int(np.floor(place + half / cycles)) + 1)


@njit(cache=True, nogil=True)
def _moments(
    samples: Array, place: float, cycles: float, tables: Array, half: float, points: int, skip: int, sums: ComplexArray
) -> tuple[Array, ComplexArray]:
    """Kernel sums of every ``skip``-th sample (into ``sums``), of the model's powers, and of its image.

    ``cycles`` of the tone pass from one sample to the next.
    """
    count, channels = samples.shape
    first, end = _reach(place, half, cycles, count)
    straight, image = np.zeros((3, 3)), np.zeros((3, 3), np.complex128)
    sums[:] = 0.0
    step = np.exp(-2j * np.pi * cycles * skip)
    turn = np.exp(-2j * np.pi * (first - place) * cycles)
    for k in range(first, end, skip):
        u = (k - place) * cycles
        at = (u + half) * points
        cell = min(max(int(at), 0), tables.shape[0] - 2)
        part = at - cell
        twice = turn * turn
        for i in range(3):
            h = tables[cell, i] + part * (tables[cell + 1, i] - tables[cell, i])
            h_u = h * u
            h_uu = 0.5 * h_u * u
            straight[i, 0] += h
            straight[i, 1] += h_u
            straight[i, 2] += h_uu
            image[i, 0] += h * twice
            image[i, 1] += h_u * twice
            image[i, 2] += h_uu * twice
            for c in range(channels):
                sums[i, c] += h * samples[k, c] * turn
        turn *= step
    return straight, image


@njit(cache=True, nogil=True)
def _solve(straight: Array, image: ComplexArray, sums: ComplexArray, curved: bool, found: ComplexArray) -> None:
    """Phasor and its derivatives [per cycle] of every channel; not finite where there is no solution."""
    # x = (p e^{ju} + conj(p) e^{-ju})/2, so that S p + J conj(p) = 2 y: six real equations; a column for a channel.
    channels = sums.shape[1]
    rows = np.empty((6, 6 + channels))
    for i in range(3):
        for m in range(3):
            own, other = straight[i, m], image[i, m]
            if i == 0 and m == 2 and not curved:
                own, other = 0.0, 0.0j
            rows[i, m], rows[i, m + 3] = own + other.real, other.imag
            rows[i + 3, m], rows[i + 3, m + 3] = other.imag, own - other.real
        for c in range(channels):
            rows[i, 6 + c], rows[i + 3, 6 + c] = 2.0 * sums[i, c].real, 2.0 * sums[i, c].imag
    for k in range(6):
        pivot = k
        for i in range(k + 1, 6):
            if abs(rows[i, k]) > abs(rows[pivot, k]):
                pivot = i
        for j in range(k, 6 + channels):
            rows[k, j], rows[pivot, j] = rows[pivot, j], rows[k, j]
        scale = 1.0 / rows[k, k] if rows[k, k] != 0.0 else np.nan
        for j in range(k, 6 + channels):
            rows[k, j] *= scale
        for i in range(6):
            factor = rows[i, k]
            if i != k:
                for j in range(k, 6 + channels):
                    rows[i, j] -= factor * rows[k, j]
    for c in range(channels):
        for i in range(3):
            found[i, c] = rows[i, 6 + c] + 1j * rows[i + 3, 6 + c]


@njit(cache=True, nogil=True)
def _left_over(
    samples: Array,
    place: float,
    cycles: float,
    tables: Array,
    half: float,
    points: int,
    checks: Array,
    found: ComplexArray,
    weights: ComplexArray,
) -> float:
    """Largest phasor of what the model leaves, at instants around its own."""
    count, channels = samples.shape
    largest = 0.0
    step = np.exp(-2j * np.pi * cycles)
    for away in checks:
        # Around other instants, with a shorter kernel: within the window all the same.
        first, end = _reach(place + away / cycles, half - abs(away), cycles, count)
        turn = np.exp(-2j * np.pi * (first - place) * cycles)
        total, weight = 0.0j, 0.0
        for k in range(first, end):
            u = (k - place) * cycles
            at = (u - away + half) * points
            cell = min(max(int(at), 0), tables.shape[0] - 2)
            h = tables[cell, 3] + (at - cell) * (tables[cell + 1, 3] - tables[cell, 3])
            left = 0.0j
            for c in range(channels):
                model = (found[0, c] + u * (found[1, c] + 0.5 * u * found[2, c])) * turn.conjugate()
                left += weights[c] * (samples[k, c] - model.real)
            total += h * turn * left
            weight += h
            turn *= step
        largest = max(largest, 2.0 * abs(total) / weight)
    return largest


@njit(cache=True, nogil=True)
def measure_phasors(
    samples: Array,
    places: Array,
    rate: float,
    nominal: float,
    furthest: float,
    tables: Array,
    half: float,
    points: int,
    checks: Array,
    curved: bool,
    weights: ComplexArray,
) -> tuple[ComplexArray, Array, Array, Array, IntArray]:
    """Phasors of the channels, frequency [Hz], its rate [Hz/s], the relative phasor left over, and what went wrong.

    ``samples`` has shape (N, C), ``places`` are the instants in samples, and the ``weights`` make of the channels the
    phasor whose frequency counts. What went wrong: 1, a sample is missing; 2, there is no tone.
    """
    count, channels = places.size, samples.shape[1]
    phasors = np.full((count, channels), np.nan + 0j)
    frequency, rocof = np.full(count, np.nan), np.full(count, np.nan)
    left, wrong = np.full(count, np.nan), np.zeros(count, np.int64)
    sums, found = np.empty((3, channels), np.complex128), np.empty((3, channels), np.complex128)
    p = np.empty(3, np.complex128)
    coarse = max(1, int(rate / nominal / COARSE_SAMPLES))
    for row in range(count):
        centre = nominal
        for passes in range(MOST_PASSES):
            # The first pass only finds where to centre the kernels: some of the samples will do.
            skip = coarse if passes == 0 else 1
            cycles = centre / rate
            straight, image = _moments(samples, places[row], cycles, tables, half, points, skip, sums)
            _solve(straight, image, sums, curved, found)
            for i in range(3):
                p[i] = 0.0
                for c in range(channels):
                    p[i] += weights[c] * found[i, c]
            # Where there is no tone its phasor is zero, and what is divided by it no number.
            power = p[0].real ** 2 + p[0].imag ** 2
            reciprocal = np.conj(p[0]) * (1.0 / power if power > 0.0 else np.nan)
            slope = p[1] * reciprocal
            estimate = centre * (1.0 + slope.imag / (2.0 * np.pi))
            if not np.isfinite(estimate):
                break
            nearest = min(max(estimate, nominal - furthest), nominal + furthest)
            if skip == 1 and abs(nearest - centre) < CENTRED:
                break
            centre = nearest
        if not np.isfinite(estimate):
            wrong[row] = 2 if np.isfinite(sums[0].real.sum()) else 1
            continue
        phasors[row] = found[0]
        frequency[row] = estimate
        # The phase is the argument of p: its second derivative is Im(p2/p0) - 2 Re(p1/p0) Im(p1/p0), per cycle squared.
        rocof[row] = ((p[2] * reciprocal).imag - 2.0 * slope.real * slope.imag) * centre * centre / (2.0 * np.pi)
        rest = _left_over(samples, places[row], cycles, tables, half, points, checks, found, weights)
        left[row] = rest * abs(reciprocal)
    return phasors, frequency, rocof, left, wrong
