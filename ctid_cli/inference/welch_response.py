"""A frequency response by averaging over segments under Hann windows: robust and simple, but leakage stays."""

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.inference.response_lines import ResponseLines

#: Segments that a record is cut into, each overlapping half of the next; twice that number less one.
PARTS = 8
#: What two windows that overlap by one half have in common: the square of the correlation of neighbouring segments.
SHARED = 1 / 36
#: The shortest segment [samples].
SHORTEST = 16
#: Lines on which the input has less than this share of its greatest power do not excite.
EXCITED = 1e-12


def welch(u: Array, y: Array, interval: float, length: int | None, time_unit: str) -> ResponseLines:
    """Response, coherence and variance from segments of a given or a chosen number of samples."""
    size = length or max(SHORTEST, u.size // PARTS)
    half = size // 2
    begins = np.arange(0, u.size - size + 1, half)
    if size < SHORTEST or begins.size < 3:
        raise DataError(
            f"segments of {size} samples are too {'short' if size < SHORTEST else 'long'}: there must be three of "
            f"{SHORTEST} samples or more, each beginning in the middle of the one before; the record has {u.size}"
        )
    window = np.hanning(size + 1)[:-1]
    segments = [np.fft.rfft(window * (x[b : b + size] - x[b : b + size].mean())) for b in begins for x in (u, y)]
    inputs, outputs = np.array(segments[::2]), np.array(segments[1::2])
    uu, yy = (np.mean(np.abs(part) ** 2, axis=0) for part in (inputs, outputs))
    yu = np.mean(outputs * inputs.conj(), axis=0)
    # The window joins the first line with the mean that was removed.
    kept = (np.arange(uu.size) >= 2) & (uu > EXCITED * uu.max()) & (np.arange(uu.size) < size / 2)
    uu, yy, yu = uu[kept], yy[kept], yu[kept]
    coherence = np.minimum(np.abs(yu) ** 2 / np.maximum(uu * yy, np.finfo(float).tiny), 1.0)
    count = begins.size / (1.0 + 2.0 * SHARED * (begins.size - 1) / begins.size)
    variance = (1.0 - coherence) * yy / uu / (count - 1.0)
    note = (
        f"Averages over {begins.size} segments of {size} samples under Hann windows, each overlapping the next by one "
        f"half. No intervals: peaks narrower than {8 * np.pi / (size * interval):.3g} rad/{time_unit} are flattened "
        "and leakage stays, which the scatter of the segments does not show; --method local-polynomial gives intervals."
    )
    frequencies: Array = 2 * np.pi / (size * interval) * np.flatnonzero(kept).astype(np.float64)
    freedom = np.full(frequencies.size, count - 1.0)
    told = np.zeros(frequencies.size, dtype=bool)
    return ResponseLines(frequencies, yu / uu, variance, freedom, coherence, None, (note,), told)
