"""The signal that the rows of a track describe."""

import numpy as np

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.record_track import RecordTrack

#: Instants that are computed at once.
PIECE = 2**18
#: The logarithm of an amplitude changes by no more than this on the way from its row.
MOST_GROWTH = 1.0


def synthesised(track: RecordTrack, t: Array) -> Array:
    """Sum of the tones of a track at some instants [s], shape (N,); NaN where a tone or its row is not known.

    Each row describes sinusoids whose phase is known at its instant; between two rows the signal goes over from those
    of one to those of the other. Before the first row and after the last, each is followed for half of its window.
    """
    pieces = [_piece(track, t[first : first + PIECE]) for first in range(0, t.size, PIECE)]
    return np.concatenate(pieces or [np.empty(0)])


def _piece(track: RecordTrack, t: Array) -> Array:
    if not track.t.size:
        return np.full(t.size, np.nan)
    last = track.t.size - 1
    before = np.clip(np.searchsorted(track.t, t, side="right") - 1, 0, last)
    after = np.minimum(before + 1, last)
    step = np.where(after > before, track.t[after] - track.t[before], 1.0)
    share = np.clip((t - track.t[before]) / step, 0.0, 1.0)
    total = np.zeros(t.size)
    for k in range(track.omega.shape[1]):
        total += (1.0 - share) * _tone(track, k, before, t) + share * _tone(track, k, after, t)
    outside = np.maximum(track.t[0] - t, t - track.t[-1])
    window = track.window[np.isfinite(track.window)]
    reach = 0.5 * max(float(np.median(window)) if window.size else 0.0, track.every)
    return np.where(outside <= reach, total, np.nan)


def _tone(track: RecordTrack, k: int, row: IndexArray, t: Array) -> Array:
    """One tone as some rows describe it, each at one instant."""
    passed = t - track.t[row]
    growth, rate = (np.nan_to_num(values[row, k]) for values in (track.growth, track.rate))
    phase = track.phase[row, k] + track.omega[row, k] * passed + 0.5 * rate * passed**2
    amplitude = track.amplitudes[row, k] * np.exp(np.clip(growth * passed, -MOST_GROWTH, MOST_GROWTH))
    absent = (track.flags[row, k] & int(Flag.ABSENT)) != 0
    return np.asarray(np.where(absent & ~np.isfinite(track.omega[row, k]), 0.0, amplitude * np.sin(phase)))
