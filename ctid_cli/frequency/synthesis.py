"""The signal that the rows of a track describe."""

from functools import partial

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.record_track import RecordTrack
from ctid_cli.processors import in_threads

#: Instants that are computed at once.
PIECE = 2**18
#: Evenly spaced instants that are computed from one another, and how much their distances differ by rounding.
TOGETHER = 256
UNEVEN = 1e-6
#: The logarithm of an amplitude changes by no more than this on the way from its row.
MOST_GROWTH = 1.0


def synthesised(track: RecordTrack, t: Array) -> Array:
    """Sum of the tones of a track at some instants [s], shape (N,); NaN where a tone or its row is not known.

    Each row describes sinusoids whose phase is known at its instant; between two rows the signal goes over from those
    of one to those of the other. Before the first row and after the last, each is followed for half of its window.
    """
    steps = np.diff(t)
    even = t.size > 1 and float(np.ptp(steps)) <= UNEVEN * abs(float(steps[0]))
    together = TOGETHER if even else 1
    pieces = in_threads(
        partial(_piece, track, together), [t[first : first + PIECE] for first in range(0, t.size, PIECE)]
    )
    return np.concatenate(pieces or [np.empty(0)])


def _piece(track: RecordTrack, together: int, t: Array) -> Array:
    if not track.t.size:
        return np.full(t.size, np.nan)
    last = track.t.size - 1
    before = np.clip(np.searchsorted(track.t, t, side="right") - 1, 0, last)
    after = np.minimum(before + 1, last)
    step = np.where(after > before, track.t[after] - track.t[before], 1.0)
    share = np.clip((t - track.t[before]) / step, 0.0, 1.0)
    absent = ((track.flags & int(Flag.ABSENT)) != 0) & ~np.isfinite(track.omega)
    # Where a tone is absent its numbers do not matter.
    omega, amplitudes, phase = (
        np.where(absent, 0.0, values) for values in (track.omega, track.amplitudes, track.phase)
    )
    growth, rate = np.nan_to_num(track.growth), np.nan_to_num(track.rate)
    total = np.zeros(t.size)
    for k in range(track.omega.shape[1]):
        numbers = np.column_stack((amplitudes[:, k], phase[:, k], omega[:, k], rate[:, k], growth[:, k]))
        _add_tone(numbers, track.t, before, 1.0 - share, t, together, total)
        _add_tone(numbers, track.t, after, share, t, together, total)
    outside = np.maximum(track.t[0] - t, t - track.t[-1])
    window = track.window[np.isfinite(track.window)]
    reach = 0.5 * max(float(np.median(window)) if window.size else 0.0, track.every)
    return np.where(outside <= reach, total, np.nan)


@njit(cache=True, nogil=True)
def _add_tone(
    numbers: Array, rows: Array, row: IndexArray, share: Array, t: Array, together: int, total: Array
) -> None:
    """Add a share of one tone as some rows describe it, each at one instant; a row is what `_piece` puts into it.

    So many instants at a time are evenly spaced: from one to the next a phasor turns.
    """
    i = 0
    while i < t.size:
        k = row[i]
        omega, rate, growth = numbers[k, 2], numbers[k, 3], numbers[k, 4]
        passed, end = t[i] - rows[k], i + 1
        while end < min(t.size, i + together) and row[end] == k and abs(growth * (t[end] - rows[k])) <= MOST_GROWTH:
            end += 1
        dt = (t[end - 1] - t[i]) / (end - i - 1) if end > i + 1 else 0.0
        grown = min(max(growth * passed, -MOST_GROWTH), MOST_GROWTH)
        z = numbers[k, 0] * np.exp(complex(grown, numbers[k, 1] + (omega + 0.5 * rate * passed) * passed))
        q = np.exp(complex(growth * dt, (omega + rate * (passed + 0.5 * dt)) * dt))
        p = np.exp(complex(0.0, rate * dt * dt))
        # Where the growth is cut at the first instant, only that one is of this amplitude.
        if abs(growth * passed) > MOST_GROWTH:
            end = i + 1
        for j in range(i, end):
            total[j] += share[j] * z.imag
            z *= q
            q *= p
        i = end
