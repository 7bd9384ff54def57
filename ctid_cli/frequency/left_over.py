"""What the tones of a track leave of its record, and the lines that stand out of it."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.frequency.record_track import MissingLine, RecordTrack
from ctid_cli.frequency.spectrum import MOST_MISSING, SHORTEST_SEGMENT, median_spectrum, significant
from ctid_cli.frequency.spikes import without_spikes
from ctid_cli.frequency.synthesis import synthesised
from ctid_cli.processors import in_threads

#: A spectrum is a median over about so many half-overlapping segments of at most so many samples.
SEGMENTS = 16
LONGEST = 2**15
#: A line so many bins from where a tone has been may be what its rows do not follow of it.
BESIDE = 4.0
#: A line of the signal is left if one is there so few bins away, and no smaller by more than this factor.
SAME = 0.5
MOST_SHRUNK = 2.0
#: Lines that are named.
MOST_LINES = 5
#: Where a tone has been leaves out so much on both sides [%].
ASIDE = 1.0


class LeftOver(NamedTuple):
    """A signal without its mean, what tones leave of it, and the amplitude spectra of both."""

    signal: Array
    residual: Array
    #: Where not all tones are known, or the sample is missing or a spike, shape (N,).
    unknown: BoolArray
    #: Samples in a segment of the spectra.
    size: int
    #: Amplitude of a steady tone that would stand so high, medians over segments [signal unit].
    signal_spectrum: Array
    residual_spectrum: Array


def left_over(samples: Array, interval: float, track: RecordTrack) -> LeftOver | None:
    """What the tones of a track leave; None where their rows are nowhere known for a segment."""
    samples = without_spikes(samples)
    present = np.isfinite(samples)
    centred = samples - float(np.mean(samples[present]))
    left = centred - synthesised(track, interval * np.arange(samples.size, dtype=np.float64))
    unknown = ~np.isfinite(left)
    least = min(SHORTEST_SEGMENT, samples.size)
    size = min(LONGEST, max(SHORTEST_SEGMENT, 2 * samples.size // (SEGMENTS + 1)), samples.size)
    while size >= least and not unknown.all():
        spectra = in_threads(partial(_spectrum, unknown, size), (centred, left))
        if spectra[0] is not None and spectra[1] is not None:
            return LeftOver(centred, left, unknown, size, spectra[0], spectra[1])
        size //= 2
    return None


def _spectrum(unknown: BoolArray, size: int, values: Array) -> Array | None:
    return median_spectrum(np.where(unknown, 0.0, values), unknown, MOST_MISSING[0], size)


def with_lines_left(track: RecordTrack, samples: Array, interval: float) -> RecordTrack:
    """A track whose method names no lines, with those that stand out of what its tones leave."""
    left = None if track.missing else left_over(samples, interval, track)
    return track if left is None else replace(track, missing=tuple(islice(_lines(left, interval, track), MOST_LINES)))


def _lines(left: LeftOver, interval: float, track: RecordTrack) -> Iterator[MissingLine]:
    """Lines of what is left that the signal has too, the strongest first: rows that are wrong leave others."""
    turn = 2.0 * np.pi / (left.size * interval)
    bins, amplitudes = significant(left.residual_spectrum)
    own_bins, own_amplitudes = significant(left.signal_spectrum)
    ranges = [
        np.percentile(column[np.isfinite(column)], [ASIDE, 100.0 - ASIDE]) / turn
        for column in track.omega.T
        if np.isfinite(column).any()
    ]
    for place, amplitude in zip(bins.tolist(), amplitudes.tolist(), strict=True):
        beside = any(low - BESIDE <= place <= high + BESIDE for low, high in ranges)
        same = (np.abs(own_bins - place) < SAME) & (own_amplitudes < MOST_SHRUNK * amplitude)
        if same.any() and not beside:
            yield MissingLine(place * turn, np.nan, amplitude)
