"""Spectrogram of a signal with a resolution that separates its tones."""

from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.tones.residual import without_spikes
from ctid_cli.tones.track import Track

#: Columns of the image, and its largest number of rows.
COLUMNS, MOST_ROWS = 480, 360
#: Distance of the closest tones in a segment, if the record is long enough [bins].
RESOLVED_BINS = 8.0
#: Least and greatest number of samples in a segment.
SHORTEST, LONGEST = 64, 2**15


def spectrogram(
    samples: Array, interval: float, track: Track, top: float, range_db: float
) -> tuple[Array, float, float]:
    """Return levels below the strongest [dB] over frequency, from 0 to `top` [Hz], and time, and its ends [s]."""
    from scipy import signal  # slow to import

    values = np.nan_to_num(without_spikes(samples))
    size = min(_segment(values.size, interval, track), values.size)
    step = max(1, (values.size - size) // COLUMNS)
    segments: dict[str, Any] = {"nperseg": size, "noverlap": size - step, "nfft": 2 * size}
    hertz, t, levels = signal.spectrogram(values, 1.0 / interval, "hann", mode="magnitude", **segments)
    levels = levels[: max(2, int(np.searchsorted(hertz, top, "right")))]
    # A row shows the strongest of its bins.
    together = -(-levels.shape[0] // MOST_ROWS)
    padded = np.pad(levels, ((0, -levels.shape[0] % together), (0, 0)))
    table = padded.reshape(-1, together, t.size).max(axis=1)
    strongest = float(table.max()) or 1.0
    decibels = 20.0 * np.log10(np.maximum(table / strongest, 10.0 ** (-range_db / 20.0)))
    return decibels, float(t[0]), max(float(t[-1]), float(t[0]) + interval)


def _segment(count: int, interval: float, track: Track) -> int:
    """Return the segment length [samples]: long enough to resolve the closest tones, short enough to show changes."""
    columns = [column[np.isfinite(column)] for column in track.omega.T]
    middles = [float(np.median(column)) for column in columns if column.size]
    apart = np.diff(np.sort([0.0, *middles, *(line.omega for line in track.missing)])) / (2.0 * np.pi)
    apart = apart[apart > 0.0]
    wanted = RESOLVED_BINS / (float(apart.min()) * interval) if apart.size else 256.0
    return int(np.clip(2.0 ** np.ceil(np.log2(wanted)), SHORTEST, max(SHORTEST, min(LONGEST, count // 8))))
