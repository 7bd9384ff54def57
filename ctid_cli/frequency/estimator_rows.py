"""The rows of a track by an online estimator, each compared with what the record shows around its instant."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, replace

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.frequency.automatic import Settings
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.record_tones import USUAL_ROWS, follow_tones
from ctid_cli.frequency.record_track import MOST_ASKED, Procedure, RecordTrack
from ctid_cli.frequency.spikes import without_spikes
from ctid_cli.frequency.tracking import FrequencyEstimate
from ctid_cli.frequency.windows import WindowEstimate, sinusoids_of, wanted_tones

#: Samples that an estimator takes between two reports of progress.
PIECE = 50_000
#: Doubts of an estimator that a reading settles.
SETTLED = Flag.UNCERTAIN | Flag.INCONSISTENT
#: The error of a row is at least this share of its distance from the reading.
FAR = 0.5


def track_record(
    samples: Array,
    interval: float,
    settings: Settings,
    *,
    every: float | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> RecordTrack:
    """Follow the frequencies of a recorded signal; a row is valid if a reading of its instant confirms it."""
    rows = online_rows(samples, interval, settings, every=every, on_progress=on_progress)
    readings = follow_tones(samples, interval, MOST_ASKED, at=rows.t, on_progress=on_progress)[0]
    return confirmed(rows, readings, settings.window_seconds)


def online_rows(
    samples: Array,
    interval: float,
    settings: Settings,
    *,
    every: float | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> RecordTrack:
    """What an online estimator finds in a record, as it judges itself."""
    thinned = settings.decimation.apply(without_spikes(samples), settings.offset)
    thin, lag = settings.interval, settings.lag * interval
    wanted_step = samples.size * interval / USUAL_ROWS if every is None else every
    step = max(1, round(min(wanted_step / thin, float(thinned.size))))
    rows = []
    for place, found, part in _follow(thinned, settings, step, on_progress or (lambda done, total: None)):
        # An estimate of the newest sample is one of an instant that the filter has not reached.
        instant = (part.size - 1) * thin + lag
        rows.append((place, found, *sinusoids_of(part, thin, found.omega, found.everything, instant)))
    omega = np.array([found.omega for _, found, _, _ in rows])
    flags = np.array([int(found.flags) for _, found, _, _ in rows], np.uint16)
    with np.errstate(invalid="ignore"):
        gain = settings.decimation.gain(omega.ravel(), interval).reshape(omega.shape)
        amplitudes = np.where(gain > 0.0, np.array([row[2] for row in rows]) / np.where(gain > 0.0, gain, 1.0), np.nan)
    # The middle of the filter lies before its newest sample, whose instant is that of the estimate.
    t = np.array([place for place, _, _, _ in rows]) * thin + 2.0 * lag
    phase = np.array([row[3] for row in rows])
    return RecordTrack.of(t, omega, flags, step * thin, amplitudes=amplitudes, phase=phase)


def confirmed(rows: RecordTrack, readings: RecordTrack, memory: float) -> RecordTrack:
    """Rows of an estimator that remembers so long [s], as readings at the same instants see them.

    A tone is confirmed by the reading nearest to it, if it is the tone nearest to that and no farther away than the
    memory tells apart; what made the estimator doubt it is then settled. Its error is that of the reading and the usual
    distance from it, over a memory to both sides.
    """
    apart = np.abs(rows.omega[:, :, None] - readings.omega[:, None, :])
    apart = np.where(np.isnan(apart), np.inf, apart)
    nearest = apart.argmin(axis=2)
    distance = apart.min(axis=2)
    mutual = np.take_along_axis(apart.argmin(axis=1), nearest, axis=1) == np.arange(rows.omega.shape[1])
    found = mutual & (distance <= 2.0 * np.pi / memory)
    distance = np.where(found, distance, np.nan)
    usual = _usual(distance, max(1, round(memory / rows.every)))
    error = np.hypot(np.take_along_axis(readings.error, nearest, axis=1), np.maximum(usual, FAR * distance))
    theirs = np.where(found, np.take_along_axis(readings.flags, nearest, axis=1), int(Flag.UNCONFIRMED))
    own = np.where(found, rows.flags.astype(np.int64) & ~int(SETTLED), rows.flags)
    flags = own | np.where(np.isfinite(rows.omega), theirs, 0)
    return replace(rows, error=np.where(found, error, np.nan), flags=flags.astype(np.uint16))


def _usual(distance: Array, reach: int) -> Array:
    """Root mean square over so many rows before and after each, NaN where there is none."""
    known = np.isfinite(distance)
    sums, counts = (
        np.cumsum(np.pad(each, ((1, 0), (0, 0))), axis=0) for each in (np.where(known, distance, 0.0) ** 2, known)
    )
    places = np.arange(distance.shape[0])
    low, high = np.maximum(places - reach, 0), np.minimum(places + reach + 1, distance.shape[0])
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt((sums[high] - sums[low]) / (counts[high] - counts[low])))


def procedure_of(settings: Settings, interval: float) -> Procedure:
    """What was chosen for an estimator, of a record with this sampling interval [s]."""
    chosen = {
        "estimator": asdict(settings.estimator),
        "interval": settings.interval,
        "kept_one_of": settings.decimation.factor,
        "filter_seconds": (settings.decimation.weights.size - 1) * interval,
        "window_seconds": settings.window_seconds,
        "offset": settings.offset,
        "expected_hz": (settings.expected / (2.0 * np.pi)).tolist(),
    }
    estimator = settings.estimator
    return Procedure(estimator.kind, estimator.online, settings.reasons, settings.warnings, chosen)


def _follow(
    thinned: Array, settings: Settings, step: int, tell: Callable[[int, int], None]
) -> Iterator[tuple[float, WindowEstimate, Array]]:
    """Every so many samples what is estimated, and the samples before that its amplitudes are found from."""
    track = settings.estimator.track(thinned, settings.interval)
    for first in range(0, thinned.size, PIECE):
        last = min(first + PIECE, thinned.size)
        for place in range(first + (-first - 1) % step, last, step):
            flags = Flag(int(track.flags[place]))
            unknown = np.full(track.frequencies.shape[1], np.inf if flags & Flag.UNCERTAIN else 0.0)
            found = wanted_tones(
                FrequencyEstimate(track.frequencies[place], flags, unknown), settings.expected, settings.tones
            )
            begin = max(0, place + 1 - settings.window)
            if found.flags & (Flag.STARTING | Flag.GAP | Flag.CHANGED):
                begin = place + 1
            yield float(place), found, thinned[begin : place + 1]
        tell(last, thinned.size)
