"""All tones of many windows of a signal: one line after the other joins the fit until noise alone is left."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctid_cli.arrays import Array, BoolArray, IndexArray
from ctid_cli.frequency.tone_fit import NUMBERS, Windows, fit_windows, windows_at
from ctid_cli.frequency.tone_tests import Left, change, cubic_phase, strongest_line, whiten

#: Noise alone shows a line, or a change, in this share of the windows.
LEVEL = 5e-4
#: Tail of the test of changes under noise: chance = 3.6 c exp(-c/2), measured on windows of 64 to 1000 samples.
CHANGE_TAIL = 3.6
#: Lines closer than so many bins to a tone are changes of it, or another one that the window does not tell apart.
APART = 1.5
#: A phase c P3(u), P3 = (5 u^3 - 3 u)/2, is left where the phase c' u^3 has turned the tone: its line has 3/2 c more slope.
TURNED_BY_CUBE = 1.5
#: Samples for each number that is fitted.
SAMPLES_PER_NUMBER = 3
#: Tones of shorter windows are taken over if their amplitude is so many times its standard error.
SURE = 6.0
#: Windows that are fitted together: their residuals are in memory at once.
BLOCK_SAMPLES = 2_000_000


class ToneRows(NamedTuple):
    """The tones of windows of one length."""

    #: Middle of each window [samples], shape (R,).
    middle: Array
    #: Number of tones, shape (R,).
    count: IndexArray
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
    blocks = [_block(samples, length, first[k : k + size], most, shorter) for k in range(0, first.size, size)]
    return ToneRows(*(np.concatenate(parts) for parts in zip(*blocks, strict=True)))


def _begun(windows: Windows, length: int, shorter: ToneRows) -> None:
    """Put into windows the tones of the shorter windows nearest to their middles, where nothing is wrong with them."""
    half = 0.5 * (length - 1)
    middle = windows.first + half
    between = 0.5 * (shorter.middle[1:] + shorter.middle[:-1])
    nearest = np.searchsorted(between, middle)
    clean = shorter.converged & (shorter.line_chance >= LEVEL) & ~(shorter.change_chance < LEVEL).any(axis=1)
    sure = shorter.amplitude > SURE * shorter.amplitude_error
    for j in range(min(shorter.omega.shape[1], windows.numbers.shape[1])):
        rows = np.flatnonzero((clean & sure[:, j])[nearest])
        of, place = nearest[rows], windows.count[rows]
        omega = shorter.omega[of, j] + shorter.rate[of, j] * (middle[rows] - shorter.middle[of])
        windows.numbers[rows, place] = 0.0
        windows.numbers[rows, place, 3] = omega * half
        windows.numbers[rows, place, 4] = 0.5 * shorter.rate[of, j] * half**2
        windows.count[rows] += 1


def _block(samples: Array, length: int, first: IndexArray, most: int, shorter: ToneRows | None) -> ToneRows:
    windows = windows_at(first, most)
    if shorter is not None:
        _begun(windows, length, shorter)
    residuals = np.empty((first.size, length))
    left: Left | None = None
    chance, line, height = np.ones(first.size), np.zeros(first.size), np.zeros(first.size)
    half = 0.5 * (length - 1)
    todo = np.arange(first.size)
    whole = np.empty((first.size, length))
    filters: list[Array] = []
    for round_ in range(most + 1):
        fit_windows(samples, length, windows, todo, residuals)
        part = whiten(residuals[todo], NUMBERS * windows.count[todo] + 1)
        if left is None:
            left = part
        else:
            for name in Left._fields:
                getattr(left, name)[todo] = getattr(part, name)
        chance[todo], line[todo], height[todo] = strongest_line(part)
        if round_ == most:
            break
        apart = np.abs(windows.numbers[todo, :, 3] / half - line[todo, None])
        apart[np.arange(most) >= windows.count[todo, None]] = np.inf
        new = (chance[todo] < LEVEL) & (apart.min(axis=1) * length > APART * 2.0 * np.pi)
        todo = todo[new]
        todo = todo[~_rather_changed(windows, left, todo, length)]
        if not todo.size:
            break
        windows.numbers[todo, windows.count[todo]] = 0.0
        windows.numbers[todo, windows.count[todo], 3] = line[todo] * half
        windows.count[todo] += 1
    assert left is not None
    return _rows(windows, left, chance, line, height, length)


def _rather_changed(windows: Windows, left: Left, rows: IndexArray, length: int) -> BoolArray:
    """Whether the change of a tone that is fitted explains more than a further line would, for some rows."""
    most = windows.numbers.shape[1]
    largest = np.zeros(rows.size)
    for k in range(most):
        here = np.flatnonzero(windows.count[rows] > k)
        if here.size:
            part = Left(*(field[rows[here]] for field in left))
            c = change(part, _phasors(windows.numbers[rows[here], k], length))
            largest[here] = np.maximum(largest[here], c)
    white = left.white[rows]
    line = 2.0 * (np.abs(np.fft.rfft(white, 2 * length, axis=1)) ** 2).max(axis=1) / length
    return np.asarray(largest > line)


def _phasors(numbers: Array, length: int) -> NDArray[np.complex128]:
    """What turns a tone of each row back to phase zero, shape (R, L)."""
    u = np.linspace(-1.0, 1.0, length)
    phase = np.arctan2(-numbers[:, 1], numbers[:, 0])
    return np.asarray(np.exp(-1j * (numbers[:, 3, None] * u + numbers[:, 4, None] * u * u + phase[:, None])))


def _rows(windows: Windows, left: Left, chance: Array, line: Array, height: Array, length: int) -> ToneRows:
    half = 0.5 * (length - 1)
    rows, most = windows.numbers.shape[:2]
    empty = np.arange(most) >= windows.count[:, None]
    cosine, sine, growth, turn, bend = (np.where(empty, np.nan, windows.numbers[:, :, j]) for j in range(NUMBERS))
    errors = np.full((5, rows, most), np.nan)
    changes, energies = np.full((rows, most), np.nan), np.full((rows, most), np.nan)
    for k in range(most):
        here = np.flatnonzero(~empty[:, k])
        if not here.size:
            continue
        part = Left(*(field[here] for field in left))
        noise = part.noise(turn[here, k] / half)
        inverse = windows.inverse[here][:, NUMBERS * k : NUMBERS * (k + 1), NUMBERS * k : NUMBERS * (k + 1)]
        with np.errstate(invalid="ignore"):
            errors[0, here, k] = np.sqrt(noise * inverse[:, 3, 3]) / half
            errors[4, here, k] = 2.0 * np.sqrt(noise * inverse[:, 4, 4]) / half**2
            errors[1, here, k] = np.sqrt(noise * 0.5 * (inverse[:, 0, 0] + inverse[:, 1, 1]))
        phasors = _phasors(windows.numbers[here, k], length)
        c = change(part, phasors)
        with np.errstate(invalid="ignore"):
            cubic, uncertain = cubic_phase(part, phasors, np.hypot(cosine[here, k], sine[here, k]), noise)
        errors[2, here, k], errors[3, here, k] = TURNED_BY_CUBE * cubic / half, TURNED_BY_CUBE * uncertain / half
        energies[here, k] = 0.5 * c
        changes[here, k] = np.minimum(1.0, CHANGE_TAIL * c * np.exp(-0.5 * c))
    return ToneRows(
        windows.first + half,
        windows.count.copy(),
        turn / half,
        errors[0],
        np.hypot(cosine, sine),
        errors[1],
        np.arctan2(-sine, cosine),
        growth / half,
        2.0 * bend / half**2,
        errors[4],
        errors[2],
        errors[3],
        changes,
        chance,
        line,
        height,
        energies,
        windows.converged.copy(),
    )
