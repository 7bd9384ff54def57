"""All tones of many windows of a signal: one line after the other joins the fit until noise alone is left."""

from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IndexArray
from ctid_cli.frequency.frequency_kernels import NUMBERS, ToneWindows, fit_windows
from ctid_cli.frequency.tone_tests import Line, find_changes, strongest_line
from ctid_cli.frequency.whitening import Left, whiten
from ctid_cli.processors import in_threads

#: Noise alone shows a line, or a change, in this share of the windows.
LEVEL = 5e-4
#: Tail of the test of changes under noise: chance = 3.6 c exp(-c/2), measured on windows of 64 to 1000 samples.
CHANGE_TAIL = 3.6
#: Lines closer than so many bins to a tone are changes of it, or another one that the window does not tell apart.
APART = 1.5
#: A phase c P3(u), P3 = (5 u^3 - 3 u)/2, that is left has taken 3/2 c from the slope of the tone's phase at u = 0.
TURNED_BY_CUBE = 1.5
#: Samples for each number that is fitted.
SAMPLES_PER_NUMBER = 3
#: Tones of shorter windows are taken over if their amplitude is so many times its standard error.
SURE = 6.0
#: Samples of the windows that are fitted together, of which so much is in memory for each thread. Nothing that is found
#: depends on it.
BLOCK_SAMPLES = 2**17


class ToneRows(NamedTuple):
    """The tones of windows of one length."""

    #: Middle of each window [samples], shape (R,).
    middle: Array
    #: Number of tones, shape (R,).
    used: IndexArray
    #: At the middle: frequency [rad/sample], its standard error, amplitude, its standard error, phase [rad],
    #: growth [1/sample], rate of change of frequency [rad/sample^2]; NaN beyond the count; each of shape (R, n).
    omega: Array
    omega_error: Array
    amplitude: Array
    amplitude_error: Array
    phase: Array
    growth: Array
    rate: Array
    rate_error: Array
    #: Error of omega that a curved frequency makes, estimated from what is left, and its standard error [rad/sample].
    bend: Array
    bend_error: Array
    #: Chance of noise to change as much within the window, shape (R, n).
    change_chance: Array
    #: Chance of noise to show as strong a line as is left, and where it stands [rad/sample], shape (R,).
    line_chance: Array
    line: Array
    #: Energy of that line in units of the noise, shape (R,).
    line_energy: Array
    #: Energy that a change of each tone would explain, in units of the noise, shape (R, n).
    change_energy: Array
    #: Whether the iterations reached a minimum, shape (R,).
    converged: BoolArray


def tones_of_windows(
    samples: Array, length: int, first: IndexArray, most: int, shorter: ToneRows | None = None
) -> ToneRows:
    """Tones of windows of one length, in blocks; what was found in shorter windows is where the search begins."""
    most = max(1, min(most, (length // SAMPLES_PER_NUMBER - 1) // NUMBERS))
    size = max(1, BLOCK_SAMPLES // length)
    parts = [first[k : k + size] for k in range(0, first.size, size)]
    blocks = in_threads(lambda part: _block(samples, length, part, most, shorter), parts)
    return ToneRows(**{name: np.concatenate([getattr(block, name) for block in blocks]) for name in ToneRows._fields})


def windows_at(first: IndexArray, most_tones: int) -> ToneWindows:
    """ToneWindows without a tone yet."""
    rows = first.size
    return ToneWindows(
        first=np.ascontiguousarray(first, dtype=np.int64),
        used=np.zeros(rows, np.int64),
        numbers=np.zeros((rows, most_tones, NUMBERS)),
        variances=np.zeros((rows, most_tones, NUMBERS)),
        converged=np.zeros(rows, np.bool_),
    )


def nearest(middles: Array, places: Array) -> IndexArray:
    """Which of some middles, ascending, is the nearest to each place."""
    return np.asarray(np.searchsorted(0.5 * (middles[1:] + middles[:-1]), places))


def _begun(windows: ToneWindows, length: int, shorter: ToneRows) -> None:
    """Put into windows the tones of the shorter windows nearest to their middles, where nothing is wrong with them."""
    half = 0.5 * (length - 1)
    middle = np.asarray(windows.first + half, dtype=np.float64)
    beginning = nearest(shorter.middle, middle)
    clean = shorter.converged & (shorter.line_chance >= LEVEL) & ~(shorter.change_chance < LEVEL).any(axis=1)
    sure = shorter.amplitude > SURE * shorter.amplitude_error
    for j in range(min(shorter.omega.shape[1], windows.numbers.shape[1])):
        rows = np.flatnonzero((clean & sure[:, j])[beginning])
        of, place = beginning[rows], windows.used[rows]
        omega = shorter.omega[of, j] + shorter.rate[of, j] * (middle[rows] - shorter.middle[of])
        windows.numbers[rows, place] = 0.0
        windows.numbers[rows, place, 3] = omega * half
        windows.numbers[rows, place, 4] = 0.5 * shorter.rate[of, j] * half**2
        windows.used[rows] += 1


def _block(samples: Array, length: int, first: IndexArray, most: int, shorter: ToneRows | None) -> ToneRows:
    windows = windows_at(first, most)
    if shorter is not None:
        _begun(windows, length, shorter)
    residuals = np.empty((first.size, length))
    tests: _Tests | None = None
    todo = np.arange(first.size)
    for round_ in range(most + 1):
        fit_windows(samples, length, windows, todo, residuals)
        new = _tested(residuals[todo], windows, todo)
        tests = new if tests is None else tests.replaced(todo, new)
        if round_ == most:
            break
        # What a change explains better is no line.
        changed = np.where(np.isnan(new.change), 0.0, new.change).max(axis=1)
        further = np.where(new.line.further_energy >= changed[:, None], new.line.further, np.nan)
        lines = np.column_stack((new.line.omega, further)) * 0.5 * (length - 1)
        new_one = (new.line.chance < LEVEL) & (changed <= new.line.energy)
        todo, lines = todo[new_one], lines[new_one]
        joined = _join(windows, todo, lines[:, 0])
        todo, lines = todo[joined], lines[joined]
        if not todo.size:
            break
        for turns in lines.T[1:]:
            _join(windows, todo, turns)
    assert tests is not None
    return _rows(windows, tests, length)


def _join(windows: ToneWindows, rows: IndexArray, turns: Array) -> BoolArray:
    """Add a line to each of some windows, and tell where: where it is one, there is room, and no tone is beside it."""
    most = windows.numbers.shape[1]
    apart = np.abs(windows.numbers[rows, :, 3] - turns[:, None])
    apart[np.arange(most) >= windows.used[rows, None]] = np.inf
    fits = (apart.min(axis=1) > APART * np.pi) & (windows.used[rows] < most)
    rows, turns = rows[fits], turns[fits]
    windows.numbers[rows, windows.used[rows]] = 0.0
    windows.numbers[rows, windows.used[rows], 3] = turns
    windows.used[rows] += 1
    return np.asarray(fits)


class _Tests(NamedTuple):
    """What is left of windows, and what it shows."""

    left: Left
    line: Line
    #: Energy that a change would explain, and P3 in the phase that is left, as `find_changes` tells, shape (R, n).
    change: Array
    cube: Array

    def replaced(self, rows: IndexArray, new: "_Tests") -> "_Tests":
        """With other tests of some windows."""
        for old, now in (
            (self.left, new.left),
            (self.line, new.line),
            ((self.change, self.cube), (new.change, new.cube)),
        ):
            for field, values in zip(old, now, strict=True):
                field[rows] = values
        return self


def _tested(residuals: Array, windows: ToneWindows, rows: IndexArray) -> _Tests:
    """Tests of what is left of some windows, which lose it on the way."""
    left = whiten(residuals, NUMBERS * windows.used[rows] + 1)
    change, cube = (np.full((rows.size, windows.numbers.shape[1]), np.nan) for _ in range(2))
    find_changes(left.white, left.filters, windows.numbers[rows], windows.used[rows], change, cube)
    line = strongest_line(left)
    return _Tests(left._replace(white=np.empty((rows.size, 0))), line, change, cube)


def _rows(windows: ToneWindows, tests: _Tests, length: int) -> ToneRows:
    half = 0.5 * (length - 1)
    most = windows.numbers.shape[1]
    empty = np.arange(most) >= windows.used[:, None]
    cosine, sine, growth, turn, bend = (np.where(empty, np.nan, windows.numbers[:, :, j]) for j in range(NUMBERS))
    noise = np.where(empty, np.nan, tests.left.noise(np.where(empty, 0.0, turn / half)))
    amplitude = np.hypot(cosine, sine)
    with np.errstate(invalid="ignore", divide="ignore"):
        errors = np.sqrt(noise[:, :, None] * windows.variances)
        # A sin(phi) of unit square is left by a phase of 1 rad: half of the square of the tone, twice its demodulation.
        per_unit = np.sqrt(noise) / amplitude * TURNED_BY_CUBE / half
        bent, uncertain = 2.0 * tests.cube / (length / 7.0) * per_unit, np.sqrt(2.0 / (length / 7.0)) * per_unit
    chances = np.minimum(1.0, CHANGE_TAIL * 2.0 * tests.change * np.exp(-tests.change))
    return ToneRows(
        np.asarray(windows.first + half, dtype=np.float64),
        windows.used,
        turn / half,
        errors[:, :, 3] / half,
        amplitude,
        np.sqrt(0.5 * (errors[:, :, 0] ** 2 + errors[:, :, 1] ** 2)),
        np.arctan2(-sine, cosine),
        growth / half,
        2.0 * bend / half**2,
        2.0 * errors[:, :, 4] / half**2,
        bent,
        uncertain,
        chances,
        tests.line.chance,
        tests.line.omega,
        tests.line.height,
        tests.change,
        windows.converged,
    )
