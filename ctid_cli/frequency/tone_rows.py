"""The tones at each of many instants, read from the longest window around it in which nothing speaks against them."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, BoolArray, IndexArray
from ctid_cli.frequency.tone_combs import COVERED, find_combs, refute
from ctid_cli.frequency.tone_search import LEVEL, ToneRows, nearest, tones_of_windows

#: Shortest window [samples]; the others are twice as long as one another, up to the whole signal.
SHORTEST = 64
#: Windows of a length overlap by the inverse of this.
HOPS = 2
#: Energy that is left by a change or a line d bins away, in units of the noise, disturbs a tone if it exceeds d^2.
NEAR = 1.0
#: A window that takes no more lines and leaves one of more than this share of a tone's energy says nothing of the tone,
#: which may be one of many that are really one.
COMPARABLE = 0.1
#: Lines of one window that are closer than so many bins may be one tone that changes.
RESOLVED = 1.7
#: A window shows so many periods of a tone.
PERIODS = 4.0
#: A tone is there if its amplitude at the instant is so many times its standard error.
SIGNIFICANT = 5.0
#: A line of a comb that is refuted at more than this share of the instants is none at the others either.
REFUTED = 0.25
#: Readings closer than so many bins of the shorter window, or so many standard errors, are of one tone.
SAME_BINS = 1.5
SAME_ERRORS = 5.0
#: A curvature of the frequency of more than so many of its standard errors adds to the error of the reading; one of
#: more than so many is taken from the reading too.
QUIET = 2.0
BENT = 4.0
#: Frequencies that move by more than so many errors over their window may move otherwise than along a line. A kink that
#: no test would find moves the frequency at its place by this share of the fitted sweep, and by no more than so many
#: errors.
MOVES = 2.5
KINK = 0.27
HIDDEN_KINK = 18.0
#: Steps of the phase that noise alone shows no more often than this may be there, and are worth so many errors.
DOUBTFUL = 0.1
DOUBT = 2.3
#: Two tones in one line, which no test would tell from one that grows by so many errors but less than this over half a
#: window, pull its frequency by no more than its growth [rad/sample].
GROWS = 2.0
BLENDED_GROWTH = 1.0
#: Standard error of the growth over half a window, in relative errors of the amplitude.
GROWTH_ERROR = 3.0**0.5


class Readings(NamedTuple):
    """What windows say of the tones at many instants: one entry for each instant and tone, in order of the instants."""

    #: Which of the instants.
    row: IndexArray
    #: Frequency and its standard error [rad/sample].
    omega: Array
    error: Array
    amplitude: Array
    amplitude_error: Array
    #: Phase at the instant [rad].
    phase: Array
    #: Logarithmic growth of the amplitude [1/sample] and rate of change of the frequency [rad/sample^2].
    growth: Array
    rate: Array
    #: Length of the window, and where its middle is [samples].
    window: IndexArray
    middle: Array
    #: Whether the window tells the tone from its neighbours, and whether the tone is there beyond doubt.
    resolved: BoolArray
    significant: BoolArray
    #: Distance of the lines of a comb that the tone belongs to, 0 if to none, and the band of that [rad/sample].
    gap: Array
    low: Array
    high: Array
    #: Which tone of its window it is.
    tone: IndexArray

    def at(self, which: IndexArray | slice) -> "Readings":
        """Some of the readings."""
        return Readings(**{name: getattr(self, name)[which] for name in self._fields})


def window_lengths(longest: int) -> list[int]:
    """Lengths of windows, doubled from the shortest one to the longest."""
    lengths = []
    length = SHORTEST
    while length < longest:
        lengths.append(length)
        length *= 2
    return [*lengths, longest]


def readings_at(
    samples: Array, places: Array, most: int, longest: int, tell: Callable[[int, int], None] | None = None
) -> Readings:
    """Tones of a signal at some places [samples], ascending: of each tone the reading of its longest sound window."""
    parts: list[Readings] = []
    tones: ToneRows | None = None
    lengths = window_lengths(longest)
    for done, (length, first) in enumerate(zip(lengths, _windows(lengths, samples.size, places), strict=True)):
        if tell is not None:
            tell(done, len(lengths))
        tones = tones_of_windows(samples, length, first, most, tones)
        parts.append(_readings(tones, length, places))
    # The longest windows first, and of those of one length the one whose middle is nearest.
    everything = Readings(
        **{name: np.concatenate([getattr(part, name) for part in parts[::-1]]) for name in Readings._fields}
    )
    order = np.argsort(everything.row, kind="stable")
    everything = everything.at(order)
    bounds = np.searchsorted(everything.row, np.arange(places.size + 1))
    kept = np.zeros(everything.row.size, np.bool_)
    _keep(everything.omega, everything.error, everything.window, bounds, _moving(everything, bounds), kept)
    everything = everything.at(np.flatnonzero(kept))
    return everything.at(np.lexsort((everything.omega, everything.row)))


def _windows(lengths: list[int], count: int, places: Array) -> list[IndexArray]:
    """First samples of the windows of each length that are read at any place, or that others begin from.

    Where places are far apart, most of the short windows lie between them.
    """
    chosen: list[IndexArray] = []
    longer: Array = np.empty(0)
    for length in reversed(lengths):
        first = np.unique(np.append(np.arange(0, count - length + 1, length // HOPS), count - length))
        wanted = np.searchsorted(places, first + length - 0.5) > np.searchsorted(places, first - 0.5)
        wanted[nearest(first + 0.5 * (length - 1), longer)] = True
        chosen.append(first[wanted])
        longer = np.asarray(chosen[-1] + 0.5 * (length - 1), dtype=np.float64)
    return chosen[::-1]


def _readings(tones: ToneRows, length: int, places: Array) -> Readings:
    """Readings of windows of one length at all places that lie in them, the windows nearest to a place first."""
    half = 0.5 * length
    order = np.argsort(tones.middle)
    low = np.searchsorted(tones.middle[order], places - half, side="right")
    count = np.searchsorted(tones.middle[order], places + half, side="right") - low
    row = np.repeat(np.arange(places.size), count)
    window = order[np.repeat(low, count) + np.arange(row.size) - np.repeat(np.cumsum(count) - count, count)]
    near = np.argsort(np.abs(places[row] - tones.middle[window]), kind="stable")
    row, window = row[near], window[near]
    sound = _sound(tones, length)
    gap, low_end, high_end = np.zeros((3, *tones.omega.shape))
    find_combs(tones.omega, np.argsort(tones.omega, axis=1), tones.omega_error, gap, low_end, high_end)
    pair, tone = np.nonzero(sound[window])
    row, window = row[pair], window[pair]

    def of(values: Array) -> Array:
        return np.asarray(values[window, tone])

    x = places[row] - tones.middle[window]
    u = x / half
    growth, rate, omega_error = of(tones.growth), of(tones.rate), of(tones.omega_error)
    relative = of(tones.amplitude_error) / of(tones.amplitude)
    # The amplitude at the end of a window depends on its growth.
    grown = np.exp(np.clip(growth * x, -20.0, 20.0))
    amplitude = of(tones.amplitude) * grown
    # Where the amplitude has vanished, an exponential that is none would seem surer than the noise allows.
    amplitude_error = of(tones.amplitude_error) * np.hypot(1.0, GROWTH_ERROR * u) * np.maximum(1.0, grown)
    omega = of(tones.omega) + rate * x
    error = np.hypot(omega_error, of(tones.rate_error) * x)
    # A phase c P3(u) that was left out changes the frequency at u by (7.5 u^2 - 1.5) c; `bend` is that at the middle.
    share, bend = 1.0 - 5.0 * u * u, np.abs(of(tones.bend)) / of(tones.bend_error)
    error = np.where(bend > QUIET, np.hypot(error, 0.5 * share * of(tones.bend)), error)
    bent = bend > BENT
    omega = np.where(bent, omega - share * of(tones.bend), omega)
    error = np.where(bent, np.hypot(error, share * of(tones.bend_error)), error)
    hidden = np.minimum(KINK * np.abs(rate) * length, HIDDEN_KINK * omega_error) / COVERED
    error = np.where(np.abs(rate) > MOVES * of(tones.rate_error), np.hypot(error, hidden), error)
    error = np.where(of(tones.change_chance) < DOUBTFUL, DOUBT * error, error)
    growing = np.abs(growth) * half
    blended = (growing > GROWS * GROWTH_ERROR * relative) & (growing < BLENDED_GROWTH)
    error = np.where(blended, np.hypot(error, np.abs(growth) / COVERED), error)
    return Readings(
        row,
        omega,
        error,
        amplitude,
        amplitude_error,
        of(tones.phase) + of(tones.omega) * x + 0.5 * rate * x**2,
        growth,
        rate,
        np.full(row.size, length),
        tones.middle[window],
        (_distance(tones, length) >= RESOLVED)[window, tone],
        (amplitude > SIGNIFICANT * amplitude_error) & (of(tones.omega) * length > PERIODS * 2.0 * np.pi),
        of(gap),
        of(low_end),
        of(high_end),
        tone,
    )


def _moving(readings: Readings, bounds: IndexArray) -> BoolArray:
    """Which readings are lines that one moving tone makes, as shorter windows show."""
    r = readings
    refuted = np.zeros(r.row.size, np.bool_)
    if not r.row.size:
        return refuted
    refute(r.omega, r.error, r.window, r.gap, r.low, r.high, bounds, refuted)
    line = np.unique(np.column_stack((r.window, r.middle, r.tone)), axis=0, return_inverse=True)[1].ravel()
    share: Array = np.bincount(line, refuted) / np.bincount(line)
    return np.asarray(refuted | (share[line] > REFUTED))


def _sound(tones: ToneRows, length: int) -> BoolArray:
    """Tones that nothing which is left of their window disturbs, shape (R, n)."""
    bins = length / (2.0 * np.pi)
    own = tones.change_chance < LEVEL
    sound = np.isfinite(tones.omega_error) & tones.converged[:, None] & ~own
    line = np.where(tones.line_chance < LEVEL, tones.line_energy, 0.0)
    sound &= line[:, None] <= NEAR * ((tones.omega - tones.line[:, None]) * bins) ** 2
    full: BoolArray = np.asarray(np.isfinite(tones.omega).all(axis=1))
    sound &= ~(full[:, None] & (line[:, None] > COMPARABLE * 0.5 * (tones.amplitude / tones.amplitude_error) ** 2))
    for j in range(own.shape[1]):
        energy = np.where(own[:, j], tones.change_energy[:, j], 0.0)
        disturbed = energy[:, None] > NEAR * ((tones.omega - tones.omega[:, j, None]) * bins) ** 2
        disturbed[:, j] = False
        sound &= ~disturbed
    return sound


def _distance(tones: ToneRows, length: int) -> Array:
    """Distance of each tone from the nearest other one of its window [bins], shape (R, n)."""
    apart = np.abs(tones.omega[:, :, None] - tones.omega[:, None, :])
    n = apart.shape[1]
    apart[:, np.arange(n), np.arange(n)] = np.inf
    return np.asarray(np.where(np.isnan(apart), np.inf, apart).min(axis=2) * length / (2.0 * np.pi))


@njit(cache=True, nogil=True)
def _keep(
    omega: Array, error: Array, window: IndexArray, bounds: IndexArray, closed: BoolArray, kept: BoolArray
) -> None:
    """Which readings of each instant are kept: none that is near to one of a longer, or nearer, window."""
    for row in range(bounds.size - 1):
        for best in range(bounds[row], bounds[row + 1]):
            if closed[best]:
                continue
            kept[best] = True
            for k in range(best, bounds[row + 1]):
                reach = SAME_ERRORS * math.hypot(error[k], error[best])
                near = abs(omega[k] - omega[best]) < max(SAME_BINS * 2.0 * math.pi / window[k], reach)
                closed[k] |= near and not math.isnan(reach)
