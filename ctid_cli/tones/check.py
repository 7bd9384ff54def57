"""Readings of the tones of all windows at given instants, and their tests against the residuals."""

from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IndexArray
from ctid_cli.tones import constants as c
from ctid_cli.tones.window_fit import WindowTones


class Readings(NamedTuple):
    """Estimates at given instants: one entry for each instant, window and tone."""

    #: Index of the instant.
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
    #: Length and middle of the window [samples].
    window: IndexArray
    middle: Array
    #: Whether the window resolves the tone from its neighbours, and whether its amplitude is significant.
    resolved: BoolArray
    significant: BoolArray
    #: Line spacing of the tone's comb, 0 if it belongs to none, and limits of the comb's band [rad/sample].
    gap: Array
    low: Array
    high: Array
    #: Index of the tone in its window.
    tone: IndexArray

    def at(self, which: IndexArray) -> "Readings":
        """Return a subset of the readings."""
        return Readings(**{name: getattr(self, name)[which] for name in self._fields})


def readings_of(tones: WindowTones, length: int, places: Array) -> Readings:
    """Evaluate windows of one length at all places [samples] inside them, the windows nearest to a place first."""
    half = 0.5 * length
    low = np.searchsorted(tones.middle, places - half, side="right")
    count = np.searchsorted(tones.middle, places + half, side="right") - low
    row = np.repeat(np.arange(places.size), count)
    window = np.repeat(low, count) + np.arange(row.size) - np.repeat(np.cumsum(count) - count, count)
    near = np.argsort(np.abs(places[row] - tones.middle[window]), kind="stable")
    row, window = row[near], window[near]
    pair, tone = np.nonzero(_sound(tones, length)[window])
    row, window = row[pair], window[pair]

    def of(values: Array) -> Array:
        return np.asarray(values[window, tone])

    x = places[row] - tones.middle[window]
    growth, rate = of(tones.growth), of(tones.rate)
    omega, error = _frequency(tones, length, window, tone, x)
    # The amplitude at the end of a window depends on its growth; if it has decayed, the error is not scaled down, or a
    # decay that is not exponential would get an error below that of the noise.
    grown = np.exp(np.clip(growth * x, -20.0, 20.0))
    amplitude = of(tones.amplitude) * grown
    relative = of(tones.amplitude_error) / of(tones.amplitude)
    relative = _error_at(x, relative, of(tones.height_with_growth), of(tones.growth_error))
    amplitude_error = of(tones.amplitude) * relative * np.maximum(1.0, grown)
    significant = (amplitude > c.SIGNIFICANT * amplitude_error) & (of(tones.omega) * length > c.PERIODS * 2.0 * np.pi)
    phase = of(tones.phase) + of(tones.omega) * x + 0.5 * rate * x**2
    resolved = of(_distance(tones) * length / (2.0 * np.pi)) >= c.RESOLVED
    lengths, middle = np.full(row.size, length), tones.middle[window]
    combs = [of(each) for each in _combs(tones)]
    return Readings(
        *(row, omega, error, amplitude, amplitude_error, phase, growth, rate),
        *(lengths, middle, resolved, significant, *combs, tone),
    )


def _frequency(tones: WindowTones, length: int, window: IndexArray, tone: IndexArray, x: Array) -> tuple[Array, Array]:
    """Return frequencies at a distance from the middles, and standard errors that include undetectable changes."""

    def of(values: Array) -> Array:
        return np.asarray(values[window, tone])

    half = 0.5 * length
    omega_error, rate, growth, bend = of(tones.omega_error), of(tones.rate), of(tones.growth), of(tones.bend)
    omega = of(tones.omega) + rate * x
    error = _error_at(x, omega_error, of(tones.omega_with_rate), of(tones.rate_error))
    # An unmodelled phase c P3(u) changes the frequency at u by (7.5 u^2 - 1.5) c; `bend` is its value at the middle.
    share, curved = 1.0 - 5.0 * (x / half) ** 2, np.abs(bend) / of(tones.bend_error)
    error = np.where(curved > c.QUIET, np.hypot(error, 0.5 * share * bend), error)
    bent = curved > c.BENT
    omega = np.where(bent, omega - share * bend, omega)
    error = np.where(bent, np.hypot(error, share * of(tones.bend_error)), error)
    error = error * of(_raised(tones, length))
    hidden = np.minimum(c.KINK * np.abs(rate) * length, c.HIDDEN_KINK * omega_error) / c.COVERED
    error = np.where(np.abs(rate) > c.MOVES * of(tones.rate_error), np.hypot(error, hidden), error)
    blended = (np.abs(growth) > c.GROWS * of(tones.growth_error)) & (np.abs(growth) * half < c.BLENDED_GROWTH)
    return omega, np.where(blended, np.hypot(error, np.abs(growth) / c.COVERED), error)


def _error_at(x: Array, error: Array, covariance: Array, slope_error: Array) -> Array:
    """Return the standard error of a value at distance x from the point at which it and its slope are estimated."""
    return np.asarray(np.sqrt(np.maximum(error**2 + 2.0 * covariance * x + (slope_error * x) ** 2, 0.0)))


def _leaked(tones: WindowTones, length: int) -> Array:
    """Return the energy of the residual lines and changes at each tone, in units of the noise, shape (R, n).

    It is infinite for a line within the width of the tone.
    """
    bins = length / (2.0 * np.pi)
    away = np.abs(tones.omega - tones.line[:, None]) * bins
    line = np.where(tones.line_chance < c.LEVEL, tones.line_energy, 0.0)[:, None]
    leaked = np.where((line > 0.0) & (away < c.APART), np.inf, line / np.maximum(away, c.APART) ** 2)
    changed = np.where(tones.change_chance < c.LEVEL, tones.change_energy, 0.0)
    for j in np.flatnonzero(changed.any(axis=0)):
        away = np.maximum(np.abs(tones.omega - tones.omega[:, j, None]) * bins, c.SMALLEST_FLOOR)
        away[:, j] = np.inf
        leaked = np.fmax(leaked, changed[:, j, None] / away**2)
    return np.asarray(leaked)


def _raised(tones: WindowTones, length: int) -> Array:
    """Return the factor by which the residuals of windows increase the errors of frequencies, shape (R, n)."""
    own = c.STEP**2 * np.where(tones.change_chance < c.DOUBTFUL, tones.change_energy, 0.0)
    changed = tones.change_chance < c.LEVEL
    own[changed] = c.KINKED**2 * tones.change_energy[changed]
    own[changed & (tones.change_energy > c.SMALL_CHANGE * _energy(tones))] = np.inf
    return np.asarray(np.sqrt(1.0 + (own + c.LEAKAGE**2 * _leaked(tones, length)) / c.COVERED**2))


def _energy(tones: WindowTones) -> Array:
    """Return the energy of tones in units of the noise, shape (R, n)."""
    return 0.5 * (tones.amplitude / tones.amplitude_error) ** 2


def _sound(tones: WindowTones, length: int) -> BoolArray:
    """Return which tones are not disturbed by the residual of their window, shape (R, n)."""
    sound = np.isfinite(tones.omega_error) & tones.converged[:, None] & (_raised(tones, length) < c.MOST_RAISED)
    full = np.isfinite(tones.omega).all(axis=1, keepdims=True)
    line = np.where(tones.line_chance < c.LEVEL, tones.line_energy, 0.0)[:, None]
    return np.asarray(sound & ~(full & (line > c.COMPARABLE * _energy(tones))))


def explained(tones: WindowTones, length: int) -> bool:
    """Return whether no window has a residual that shorter windows could explain."""
    resolved = _distance(tones) * length / (2.0 * np.pi) >= c.RESOLVED
    clean = _sound(tones, length) & resolved & (tones.change_chance >= c.DOUBTFUL)
    return bool((clean | np.isnan(tones.omega)).all())


def _distance(tones: WindowTones) -> Array:
    """Return the distance from each tone to its nearest neighbour in the window [rad/sample], shape (R, n)."""
    order = np.argsort(tones.omega, axis=1)
    steps = np.diff(np.take_along_axis(tones.omega, order, axis=1), axis=1, prepend=-np.inf, append=np.inf)
    steps = np.where(np.isnan(steps), np.inf, steps)
    nearest = np.empty_like(tones.omega)
    np.put_along_axis(nearest, order, np.minimum(steps[:, 1:], steps[:, :-1]), axis=1)
    return nearest


def _combs(tones: WindowTones) -> tuple[Array, Array, Array]:
    """Return the line spacings and bands of the combs of tones, each of shape (R, n), zero without a comb.

    Periodic modulation of amplitude or frequency gives equally spaced lines, each as steady as a tone. Spacings that
    are a large share of the frequencies are those of harmonics.
    """
    gap, low, high = np.zeros((3, *tones.omega.shape))
    if tones.omega.shape[1] < c.COMB:
        return gap, low, high
    order = np.argsort(tones.omega, axis=1)
    omega, error = (np.take_along_axis(each, order, axis=1) for each in (tones.omega, tones.omega_error))
    steps, sure = np.diff(omega, axis=1), np.hypot(error[:, 1:], error[:, :-1])
    allowed = np.maximum(c.EQUAL_ERRORS * np.maximum(sure[:, 1:], sure[:, :-1]), c.UNEQUAL * steps[:, :-1])
    equal = (np.abs(np.diff(steps, axis=1)) <= allowed) & (steps[:, :-1] < c.HARMONIC * omega[:, :-2])
    for row, k in np.argwhere(equal):
        if gap[row, order[row, k + 1]] > 0.0:
            continue
        # All lines at multiples of the spacing belong to the comb, unless too many are missing between them.
        base = steps[row, k]
        away = (omega[row] - omega[row, k + 1]) / base
        lines = np.sort(np.round(away[np.abs(away - np.round(away)) <= c.UNEQUAL * np.maximum(1.0, np.abs(away))]))
        breaks = np.flatnonzero(np.diff(lines) > c.MOST_APART)
        begin = np.searchsorted(breaks, np.searchsorted(lines, 0.0))
        first = lines[breaks[begin - 1] + 1] if begin > 0 else lines[0]
        last = lines[breaks[begin]] if begin < breaks.size else lines[-1]
        inside = order[row, (away > first - c.BESIDE) & (away < last + c.BESIDE)]
        gap[row, inside] = base
        low[row, inside] = omega[row, k + 1] + (first - c.BESIDE) * base
        high[row, inside] = omega[row, k + 1] + (last + c.BESIDE) * base
    return gap, low, high


def moving(r: Readings, bounds: IndexArray) -> BoolArray:
    """Return which readings are lines of one modulated tone, according to shorter windows."""
    refuted = np.zeros(r.row.size, np.bool_)
    for k in np.flatnonzero(r.gap > 0.0):
        row = slice(bounds[r.row[k]], bounds[r.row[k] + 1])
        omega, error, window = r.omega[row], r.error[row], r.window[row]
        shorter = (window < r.window[k]) & (window * r.gap[k] < 2.0 * np.pi)
        shorter &= (r.low[k] < omega) & (omega < r.high[k])
        if shorter.any():
            best = np.where(shorter, error, np.inf).argmin()
            refuted[k] = abs(r.omega[k] - omega[best]) > c.COVERED * error[best]
    if not refuted.any():
        return refuted
    line = np.unique(np.column_stack((r.window, r.middle, r.tone)), axis=0, return_inverse=True)[1].ravel()
    share: Array = np.bincount(line, refuted) / np.bincount(line)
    return np.asarray(refuted | (share[line] > c.REFUTED))
