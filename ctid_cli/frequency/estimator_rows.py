"""The rows of a track, by any of the estimators of frequencies."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, replace

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.frequency.automatic import Settings
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.record_track import Procedure, RecordTrack
from ctid_cli.frequency.spikes import without_spikes
from ctid_cli.frequency.windows import WindowEstimate, estimate_window, sinusoids_of, wanted_tones

#: Rows of a track if nobody says how many.
USUAL_ROWS = 1000
#: Windows overlap by half if nobody says otherwise, and by more where they would be fewer than this.
OVERLAP = 0.5
FEWEST_WINDOWS = 100
#: A window whose middle part, this fraction of it, is missing says nothing of its instant.
MIDDLE = 0.1
#: Samples that an online estimator takes between two reports of progress.
PIECE = 50_000


def track_record(
    samples: Array,
    interval: float,
    settings: Settings,
    *,
    every: float | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> RecordTrack:
    """Follow the frequencies of a recorded signal."""
    thinned = settings.decimation.apply(without_spikes(samples), settings.offset)
    thin, online = settings.interval, settings.estimator.online
    wanted_step = samples.size * interval / USUAL_ROWS
    if every is not None:
        wanted_step = every
    elif not online:
        wanted_step = max(wanted_step, min(OVERLAP * settings.window_seconds, thinned.size * thin / FEWEST_WINDOWS))
    step = max(1, round(min(wanted_step / thin, float(thinned.size))))
    rows = []
    for place, found, part, middle in (_online if online else _windows)(
        thinned, settings, step, on_progress or (lambda done, total: None)
    ):
        # An estimate of the newest sample is one of an instant that the filter has not reached.
        ahead = settings.lag * interval if online else 0.0
        rows.append((place, found, *sinusoids_of(part, thin, found.omega, found.everything, middle * thin + ahead)))
    omega = np.array([found.omega for _, found, _, _ in rows])
    flags = np.array([int(found.flags) for _, found, _, _ in rows], np.uint16)
    with np.errstate(invalid="ignore"):
        gain = settings.decimation.gain(omega.ravel(), interval).reshape(omega.shape)
        amplitudes = np.where(gain > 0.0, np.array([row[2] for row in rows]) / np.where(gain > 0.0, gain, 1.0), np.nan)
    # The middle of the filter lies before its newest sample; an online estimate is that of the newest sample.
    t = np.array([place for place, _, _, _ in rows]) * thin + settings.lag * interval
    if online:
        t += settings.lag * interval
    return RecordTrack.of(
        *(t, omega, flags, step * thin),
        amplitudes=amplitudes,
        phase=np.array([row[3] for row in rows]),
        window=np.full(omega.shape, np.nan if online else settings.window_seconds),
    )


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


_Follow = Iterator[tuple[float, WindowEstimate, Array, float]]


def _windows(thinned: Array, settings: Settings, step: int, tell: Callable[[int, int], None]) -> _Follow:
    """Middle of each window, what is estimated, the samples that its amplitudes are found from, the middle of these."""
    length, total = settings.window, thinned.size
    middle = max(1, int(MIDDLE * length))
    for first in range(0, total - length + 1, step):
        part = thinned[first : first + length]
        found = estimate_window(settings.estimator, part, settings.interval, settings.expected, settings.tones)
        if not np.isfinite(part[(length - middle) // 2 :][:middle]).any():
            found = replace(found, flags=found.flags | Flag.GAP)
        yield first + 0.5 * (length - 1), found, part, 0.5 * (length - 1)
        tell(first + length, total)
    tell(total, total)


def _online(thinned: Array, settings: Settings, step: int, tell: Callable[[int, int], None]) -> _Follow:
    """Every so many samples what is estimated, the samples that its amplitudes are found from, the newest of these."""
    tracker = settings.estimator.start(settings.interval)
    for first in range(0, thinned.size, PIECE):
        track = tracker.run(thinned[first : first + PIECE], fft=True)
        last = first + track.flags.size
        for place in range(first + (-first - 1) % step, last, step):
            found = wanted_tones(track[place - first], settings.expected, settings.tones)
            begin = max(0, place + 1 - settings.window)
            if found.flags & (Flag.STARTING | Flag.GAP | Flag.CHANGED):
                begin = place + 1
            yield float(place), found, thinned[begin : place + 1], float(place - begin)
        tell(last, thinned.size)
