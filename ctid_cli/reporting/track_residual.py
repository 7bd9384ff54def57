"""What the tones of a track leave of its record, as it is shown."""

from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.signals.sampled_signal import SampledSignal
from ctid_cli.tones.constants import SPECTRUM_PADDING
from ctid_cli.tones.residual import left_over
from ctid_cli.tones.track import Track


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


def spectra_of(signal: SampledSignal, track: Track) -> Spectra | None:
    """Spectra of a signal and of what its tones leave, where all tones are known; None where they never are."""
    left = left_over(signal.samples, signal.interval, track)
    if left is None:
        return None
    segment, known = left.size * signal.interval, ~left.unknown
    hertz = np.arange(left.signal_spectrum.size) / (SPECTRUM_PADDING * segment)
    whole, rest = (float(np.sqrt(np.mean(each[known] ** 2))) for each in (left.signal, left.residual))
    return Spectra(hertz, left.signal_spectrum, left.residual_spectrum, segment, whole, rest, float(np.mean(known)))
