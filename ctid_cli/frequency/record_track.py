"""Frequencies over time of a recorded signal, by any of the estimators."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.frequency.automatic import Settings
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.tracking import FrequencyEstimate
from ctid_cli.frequency.windows import amplitudes_of, estimate_window, wanted_tones

#: Rows of a track if nobody says how many.
USUAL_ROWS = 1000
#: Windows overlap by half if nobody says otherwise, and by more where they would be fewer than this.
OVERLAP = 0.5
FEWEST_WINDOWS = 100
#: A window whose middle part, this fraction of it, is missing says nothing of its instant.
MIDDLE = 0.1
#: Samples that an online estimator takes between two reports of progress.
PIECE = 50_000


@dataclass(frozen=True, eq=False)
class RecordTrack:
    """Frequencies and amplitudes over time."""

    #: Instants since the first sample of the record [s]: the newest sample of an online estimate, the middle of the
    #: window of a batch estimate, shape (N,).
    t: Array
    #: Frequencies [rad/s], ascending; NaN where there is no estimate, shape (N, n).
    omega: Array
    #: Amplitudes [signal unit]; NaN where they are not determined, shape (N, n).
    amplitudes: Array
    #: Bit field of :class:`~ctid_cli.frequency.flags.Flag`, shape (N,).
    flags: NDArray[np.uint16]
    #: Error that the misfit could make in its worst direction [rad/s]; NaN if unknown, shape (N, n).
    uncertainty: Array
    #: Time from one row to the next [s].
    every: float

    @property
    def valid(self) -> BoolArray:
        """Rows without any flag, shape (N,)."""
        return np.asarray(self.flags == 0)


def track_record(
    samples: Array,
    interval: float,
    settings: Settings,
    *,
    every: float | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> RecordTrack:
    """Follow the frequencies of a recorded signal."""
    thinned = settings.decimation.apply(samples - settings.offset)
    thin = settings.interval
    wanted_step = samples.size * interval / USUAL_ROWS
    if every is not None:
        wanted_step = every
    elif not settings.estimator.online:
        wanted_step = max(wanted_step, min(OVERLAP * settings.window_seconds, thinned.size * thin / FEWEST_WINDOWS))
    step = max(1, round(min(wanted_step / thin, float(thinned.size))))
    tell = on_progress or (lambda done, total: None)
    follow = _online if settings.estimator.online else _windows
    places, omega, amplitudes, flags, uncertainty = follow(thinned, settings, step, tell)
    t = places * thin + settings.lag * interval
    if settings.estimator.online:
        t += settings.lag * interval
    with np.errstate(invalid="ignore"):
        gain = settings.decimation.gain(omega.ravel(), interval).reshape(omega.shape)
        amplitudes = np.where(gain > 0.0, amplitudes / np.where(gain > 0.0, gain, 1.0), np.nan)
    return RecordTrack(t, omega, amplitudes, flags, uncertainty, step * thin)


_Rows = tuple[Array, Array, Array, NDArray[np.uint16], Array]


def _windows(thinned: Array, settings: Settings, step: int, tell: Callable[[int, int], None]) -> _Rows:
    length, n = settings.window, settings.tones
    firsts = np.arange(0, thinned.size - length + 1, step)
    middle = max(1, int(MIDDLE * length))
    omega, amplitudes, uncertainty = (np.full((firsts.size, n), np.nan) for _ in range(3))
    flags = np.zeros(firsts.size, np.uint16)
    for row, first in enumerate(firsts):
        part = thinned[first : first + length]
        found = estimate_window(settings.estimator, part, settings.interval, settings.expected, n)
        omega[row], uncertainty[row], flags[row] = found.omega, found.uncertainty, int(found.flags)
        amplitudes[row] = amplitudes_of(part, settings.interval, found.omega, found.everything)
        if not np.isfinite(part[(length - middle) // 2 :][:middle]).any():
            flags[row] |= int(Flag.GAP)
        tell(int(first) + length, thinned.size)
    tell(thinned.size, thinned.size)
    return np.asarray(firsts + 0.5 * (length - 1), dtype=np.float64), omega, amplitudes, flags, uncertainty


def _online(thinned: Array, settings: Settings, step: int, tell: Callable[[int, int], None]) -> _Rows:
    tracker = settings.estimator.start(settings.interval)
    length, n = settings.window, settings.tones
    places = np.arange(step - 1, thinned.size, step)
    omega, amplitudes, uncertainty = (np.full((places.size, n), np.nan) for _ in range(3))
    flags = np.zeros(places.size, np.uint16)
    for first in range(0, thinned.size, PIECE):
        track = tracker.run(thinned[first : first + PIECE], fft=True)
        last = first + track.flags.size
        here = (places >= first) & (places < last)
        for row in np.flatnonzero(here):
            place = places[row] - first
            estimate = FrequencyEstimate(track.omega[place], Flag(int(track.flags[place])), track.uncertainty[place])
            found = wanted_tones(estimate, settings.expected, n)
            omega[row], uncertainty[row], flags[row] = found.omega, found.uncertainty, int(found.flags)
            if not found.flags & (Flag.STARTING | Flag.GAP | Flag.CHANGED):
                part = thinned[max(0, places[row] + 1 - length) : places[row] + 1]
                amplitudes[row] = amplitudes_of(part, settings.interval, found.omega, found.everything)
        tell(last, thinned.size)
    return places.astype(np.float64), omega, amplitudes, flags, uncertainty
