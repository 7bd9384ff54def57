"""Fits of decaying chirps to windows: lines are added until the residual is noise."""

from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IndexArray
from ctid_cli.processors import in_threads
from ctid_cli.tones import constants as c
from ctid_cli.tones.find import Left, Lines, new_lines, spectrum_of, strongest_lines, whiten
from ctid_cli.tones.tone_kernels import PARAMETERS, find_changes, fit_windows


class WindowTones(NamedTuple):
    """The tones of windows of one length."""

    #: Middle of each window [samples], shape (R,).
    middle: Array
    #: At the middle: frequency [rad/sample], its standard error, amplitude, its standard error, phase [rad],
    #: growth [1/sample], rate of change of frequency [rad/sample^2] and its error; NaN without a tone, (R, n).
    omega: Array
    omega_error: Array
    amplitude: Array
    amplitude_error: Array
    phase: Array
    growth: Array
    rate: Array
    rate_error: Array
    #: Standard error of the growth, and covariances of the frequency with its rate of change, and of the logarithm of
    #: the amplitude with the growth.
    growth_error: Array
    omega_with_rate: Array
    height_with_growth: Array
    #: Error of omega due to curvature of the frequency, from the residual, and its standard error [rad/sample].
    bend: Array
    bend_error: Array
    #: p-value of a change within the window, and the energy of the change in units of the noise, (R, n).
    change_chance: Array
    change_energy: Array
    #: p-value of the strongest line in the residual, its frequency [rad/sample] and its energy, shape (R,).
    line_chance: Array
    line: Array
    line_energy: Array
    #: Whether the iterations reached a minimum, shape (R,).
    converged: BoolArray


class _Fits(NamedTuple):
    """Windows and the parameters of their tones, modified by the compiled fit."""

    first: IndexArray
    used: IndexArray
    parameters: Array
    covariances: Array
    converged: BoolArray


class _Limits(NamedTuple):
    """Largest numbers of lines of a window, of rounds that add lines, and of steps of a stage in each round."""

    lines: int
    rounds: int
    steps: int


_STEADY = _Limits(c.STEADY_LINES, c.STEADY_ROUNDS, c.STEADY_STEPS)


class _Tests(NamedTuple):
    """Residuals of windows and the tests on them."""

    left: Left
    lines: Lines
    #: Energy that a change would explain, and P3 component of the residual phase, shape (R, n).
    change: Array
    cube: Array
    #: Lines that may be added [rad/sample], the strongest first, NaN if missing, shape (R, K).
    joining: Array


def fit_tones(
    samples: Array, length: int, first: IndexArray, most: int, shorter: WindowTones | None = None
) -> WindowTones:
    """Fit the tones of windows of one length, starting from those of shorter windows."""
    most = max(1, min(most, (length // c.SAMPLES_PER_PARAMETER - 1) // PARAMETERS))
    size = max(1, c.BLOCK_SAMPLES // length)
    parts = [first[k : k + size] for k in range(0, first.size, size)]
    blocks = in_threads(lambda part: _block(samples, length, part, most, shorter), parts)
    tones = WindowTones(*(np.concatenate(values) for values in zip(*blocks, strict=True)))
    # One empty column is kept if possible: windows without one are full.
    kept = int(np.isfinite(tones.omega).sum(axis=1).max()) + 1
    return WindowTones._make(each[:, :kept] if each.ndim == 2 else each for each in tones)


def fit_steady(samples: Array) -> WindowTones | None:
    """Fit few tones to the whole record; return None if the residual contains lines at any window length.

    A fit that does not converge quickly is also None.
    """
    length = samples.size
    fits, tests, residuals = _fitted(samples, length, np.zeros(1, np.int64), _STEADY, None)
    unexplained = (tests.lines.chance < c.LEVEL) | ~fits.converged
    if unexplained.any() or not fits.used.any():
        return None
    shorter = length // c.STEADY_STEP
    while shorter >= c.SHORTEST:
        parts = residuals[0, : length // shorter * shorter].reshape(-1, shorter)
        together = max(1, c.BLOCK_SAMPLES // shorter)
        for begin in range(0, len(parts), together):
            some = parts[begin : begin + together]
            left = whiten(some, np.zeros(len(some), np.int64))
            if (strongest_lines(left, spectrum_of(left.white)).chance < c.LEVEL / len(parts)).any():
                return None
        shorter //= c.STEADY_STEP
    return _tones(fits, tests, length)


def _block(samples: Array, length: int, first: IndexArray, most: int, shorter: WindowTones | None) -> WindowTones:
    fits, tests, _ = _fitted(samples, length, first, _Limits(most, most, c.MOST_STEPS), shorter)
    return _tones(fits, tests, length)


def _fitted(
    samples: Array, length: int, first: IndexArray, limits: _Limits, shorter: WindowTones | None
) -> tuple[_Fits, _Tests, Array]:
    """Return fits, tests of their residuals, and the residuals, shape (R, L)."""
    most = limits.lines
    rows, shape = first.size, (first.size, most, PARAMETERS)
    fits = _Fits(
        first, np.zeros(rows, np.int64), np.zeros(shape), np.zeros((*shape, PARAMETERS)), np.zeros(rows, np.bool_)
    )
    if shorter is not None:
        _start(fits, length, shorter)
    residuals = np.empty((rows, length))
    tests: _Tests | None = None
    todo = np.arange(rows)
    for round_ in range(limits.rounds + 1):
        fit_windows(samples, length, first, todo, limits.steps, *fits[1:], residuals)
        new = _tested(residuals[todo], fits, todo)
        tests = new if tests is None else _replaced(tests, todo, new)
        if round_ == limits.rounds:
            break
        turns = new.joining * 0.5 * (length - 1)
        joined = np.zeros(todo.size, np.bool_)
        for each in turns.T:
            joined |= _join(fits, todo, each)
        todo = todo[joined]
        if not todo.size:
            break
    assert tests is not None
    return fits, tests, residuals


def nearest(middles: Array, places: Array) -> IndexArray:
    """Return the index of the nearest of the ascending ``middles`` for each place."""
    return np.asarray(np.searchsorted(0.5 * (middles[1:] + middles[:-1]), places))


def _start(fits: _Fits, length: int, shorter: WindowTones) -> None:
    """Start from the significant tones of the nearest shorter windows, if these fits passed all tests."""
    half = 0.5 * (length - 1)
    middle: Array = np.asarray(fits.first + half, dtype=np.float64)
    beginning = nearest(shorter.middle, middle)
    clean = shorter.converged & (shorter.line_chance >= c.LEVEL) & ~(shorter.change_chance < c.LEVEL).any(axis=1)
    sure = clean[:, None] & (shorter.amplitude > c.SURE * shorter.amplitude_error)
    for j in range(min(shorter.omega.shape[1], fits.parameters.shape[1])):
        rows = np.flatnonzero(sure[beginning, j])
        of, place = beginning[rows], fits.used[rows]
        omega = shorter.omega[of, j] + shorter.rate[of, j] * (middle[rows] - shorter.middle[of])
        fits.parameters[rows, place, 3] = omega * half
        fits.parameters[rows, place, 4] = 0.5 * shorter.rate[of, j] * half**2
        fits.used[rows] += 1


def _join(fits: _Fits, rows: IndexArray, turns: Array) -> BoolArray:
    """Add a line to each window that has a candidate and room for it; return the mask of these windows."""
    fits_in: BoolArray = np.isfinite(turns) & (fits.used[rows] < fits.parameters.shape[1])
    rows, turns = rows[fits_in], turns[fits_in]
    fits.parameters[rows, fits.used[rows]] = 0.0
    fits.parameters[rows, fits.used[rows], 3] = turns
    fits.used[rows] += 1
    return fits_in


def _tested(residuals: Array, fits: _Fits, rows: IndexArray) -> _Tests:
    left = whiten(residuals, PARAMETERS * fits.used[rows] + 1)
    change, cube = np.full((2, rows.size, fits.parameters.shape[1]), np.nan)
    find_changes(left.white, left.filters, fits.parameters[rows], fits.used[rows], change, cube)
    spectrum = spectrum_of(left.white)
    half = 0.5 * (residuals.shape[1] - 1)
    empty = np.arange(change.shape[1]) >= fits.used[rows, None]
    joining = new_lines(left, spectrum, np.where(empty, np.nan, fits.parameters[rows, :, 3] / half), change)
    return _Tests(left._replace(white=np.empty((rows.size, 0))), strongest_lines(left, spectrum), change, cube, joining)


def _replaced(old: _Tests, rows: IndexArray, new: _Tests) -> _Tests:
    """Return ``old`` with the tests of the windows ``rows`` replaced by ``new``."""
    for fields, values in zip((*old[:2], old[2:]), (*new[:2], new[2:]), strict=True):
        for field, value in zip(fields, values, strict=True):
            field[rows] = value
    return old


def _tones(fits: _Fits, tests: _Tests, length: int) -> WindowTones:
    """Convert parameters to units per sample, with standard errors from the noise near each tone."""
    half = 0.5 * (length - 1)
    empty = np.arange(fits.parameters.shape[1]) >= fits.used[:, None]
    cosine, sine, growth, turn, bend = np.where(empty, np.nan, fits.parameters.transpose(2, 0, 1))
    noise = np.where(empty, np.nan, tests.left.noise(np.where(empty, 0.0, turn / half)))
    amplitude = np.hypot(cosine, sine)
    with np.errstate(invalid="ignore", divide="ignore"):
        covariances = noise[:, :, None, None] * fits.covariances
        errors = np.sqrt(np.diagonal(covariances, axis1=2, axis2=3))
        # Gradient of the logarithm of the amplitude with respect to both amplitudes.
        weights = np.stack((cosine, sine), axis=2) / amplitude[:, :, None] ** 2
        height_with = np.einsum("rna,rnab->rnb", weights, covariances[:, :, :2])
        height_error = np.sqrt((height_with[:, :, :2] * weights).sum(axis=2))
        # A phase c P3(u), P3 = (5 u^3 - 3 u)/2, takes 3/2 c from the slope of the phase at u = 0; its mean square is
        # c^2/7, and the residual is turned back by a tone of unit amplitude, whose mean square is 1/2.
        per_unit = 1.5 * np.sqrt(noise) / amplitude / half
        bent, uncertain = 2.0 * tests.cube / (length / 7.0) * per_unit, np.sqrt(14.0 / length) * per_unit
    chances = np.minimum(1.0, c.CHANGE_TAIL * 2.0 * tests.change * np.exp(-tests.change))
    return WindowTones(
        middle=np.asarray(fits.first + half, dtype=np.float64),
        omega=turn / half,
        omega_error=errors[:, :, 3] / half,
        amplitude=amplitude,
        amplitude_error=amplitude * height_error,
        phase=np.arctan2(-sine, cosine),
        growth=growth / half,
        rate=2.0 * bend / half**2,
        rate_error=2.0 * errors[:, :, 4] / half**2,
        growth_error=errors[:, :, 2] / half,
        omega_with_rate=2.0 * covariances[:, :, 3, 4] / half**3,
        height_with_growth=height_with[:, :, 2] / half,
        bend=bent,
        bend_error=uncertain,
        change_chance=chances,
        change_energy=tests.change,
        line_chance=tests.lines.chance,
        line=tests.lines.omega,
        line_energy=tests.lines.height,
        converged=fits.converged,
    )
