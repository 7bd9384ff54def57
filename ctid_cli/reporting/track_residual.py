"""What the tones of a track leave of its record, as amplitude spectra."""

from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.frequency.record_track import RecordTrack
from ctid_cli.frequency.spectrum import MOST_MISSING, PADDING, SHORTEST_SEGMENT, median_spectrum
from ctid_cli.frequency.synthesis import synthesised
from ctid_cli.signals.sampled_signal import SampledSignal

#: A spectrum is a median over about so many half-overlapping segments of at most so many samples.
SEGMENTS = 16
LONGEST = 2**15


class Spectra(NamedTuple):
    """Amplitude spectra of a signal and of what tones leave of it."""

    #: Frequencies [Hz], shape (N,).
    hertz: Array
    #: Amplitude of a steady tone that would stand so high [signal unit]; medians over segments.
    signal: Array
    residual: Array
    #: Length of a segment [s].
    segment: float
    #: Root mean squares of what is compared, about the mean of the signal [signal unit].
    signal_rms: float
    residual_rms: float
    #: Share of the record in which all tones are known.
    known: float


def spectra_of(signal: SampledSignal, track: RecordTrack) -> Spectra | None:
    """Spectra of a signal and of what its tones leave, where all tones are known; None where they never are."""
    t = signal.interval * np.arange(signal.samples.size, dtype=np.float64)
    present = np.isfinite(signal.samples)
    centred = signal.samples - float(np.mean(signal.samples[present]))
    left = centred - synthesised(track, t)
    missing = ~np.isfinite(left)
    if missing.all():
        return None
    size = min(LONGEST, max(SHORTEST_SEGMENT, 2 * t.size // (SEGMENTS + 1)), t.size)
    while size >= min(SHORTEST_SEGMENT, t.size):
        parts = [
            median_spectrum(np.where(missing, 0.0, each), missing, size, MOST_MISSING[0]) for each in (centred, left)
        ]
        if parts[0] is not None and parts[1] is not None:
            hertz = np.arange(parts[0].size) / (PADDING * size * signal.interval)
            whole, rest = (float(np.sqrt(np.mean(each[~missing] ** 2))) for each in (centred, left))
            return Spectra(hertz, parts[0], parts[1], size * signal.interval, whole, rest, float(np.mean(~missing)))
        size //= 2
    return None
