"""The tones that stand out of a record's spectrum: where to look before anything is estimated."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.processors import in_threads

#: Points of the spectrum for each bin of an unpadded one.
PADDING = 4
#: Samples in the shortest segment, and in the longest one; samples in all segments of one length.
SHORTEST_SEGMENT = 64
LONGEST_SEGMENT = 2**18
MOST_SAMPLES = 2**21
#: Points of spectra that are made at once.
TOGETHER = 2**17
#: A segment with a larger fraction of missing samples is left out, or with the second one if no segment had fewer.
MOST_MISSING = (0.1, 0.5)
#: A peak must stand so many times (in amplitude) above the median of the bins around it, so many on each side, and
#: above what leaks from larger ones; two peaks are so many bins apart, and so is the lowest one from zero.
ABOVE_FLOOR = 5.0
FLOOR_BINS = 12
ABOVE_LEAKAGE = 2.0
CLOSEST = 1.5
#: Peaks below this fraction of the largest are rounding of the transform.
ROUNDING = 1e-9
#: The longest segments are taken whose weakest wanted peak comes this close to the largest such peak of any length, if
#: possible no more than this fraction of the record: a median needs some of them.
NEARLY = 0.8
LONGEST_FRACTION = 0.25


@dataclass(frozen=True, eq=False)
class Peaks:
    """Peaks of a spectrum."""

    #: Frequencies [rad/s], the largest peak first, shape (m,).
    omega: Array
    #: Amplitudes, median over the record [signal unit], descending, shape (m,).
    amplitudes: Array
    #: Length of the segments [s]; tones closer than ``4 pi/segment`` make one peak.
    segment: float

    @property
    def resolution(self) -> float:
        """Frequencies closer than this make one peak [rad/s]."""
        return 4.0 * np.pi / self.segment


def find_peaks(samples: Array, interval: float, tones: int, looked_at: int = MOST_SAMPLES) -> Peaks:
    """Peaks of the median spectrum of a record's segments, of a length that shows as many strong ones as wanted.

    The median over segments shows what is there most of the time, not what is loud for a moment. Long segments tell
    close tones apart and short ones stand it if a tone moves: of the lengths N, N/2, N/4, ... the longest is taken that
    shows the weakest of the wanted peaks (nearly) as large as any length does. All segments of one length have no more
    than ``looked_at`` samples.
    """
    missing = ~np.isfinite(samples)
    values = np.asarray(samples, dtype=float)
    if missing.any():
        places = np.arange(values.size)
        values = np.interp(places, places[~missing], values[~missing])
    sizes = [min(values.size, LONGEST_SEGMENT)]
    while sizes[-1] // 2 >= SHORTEST_SEGMENT:
        sizes.append(sizes[-1] // 2)
    found: list[Peaks] = []
    for most_missing in MOST_MISSING:
        if found:
            break
        spectra = in_threads(partial(median_spectrum, values, missing, most_missing, looked_at=looked_at), sizes)
        for size, spectrum in zip(sizes, spectra, strict=True):
            if spectrum is not None:
                bins, amplitudes = significant(spectrum)
                found.append(Peaks(2.0 * np.pi * bins / (size * interval), amplitudes, size * interval))
    if not found:
        return Peaks(np.empty(0), np.empty(0), values.size * interval)
    most = max(min(peaks.omega.size, tones) for peaks in found)
    enough = [peaks for peaks in found if peaks.omega.size >= most]
    if most == 0:
        return enough[0]
    largest = max(peaks.amplitudes[most - 1] for peaks in enough)
    good = [peaks for peaks in enough if peaks.amplitudes[most - 1] >= NEARLY * largest]
    return next((peaks for peaks in good if peaks.segment <= LONGEST_FRACTION * values.size * interval), good[-1])


def median_spectrum(
    values: Array, missing: BoolArray, most_missing: float, size: int, looked_at: int = MOST_SAMPLES
) -> Array | None:
    """Median over segments of the amplitude spectrum, with a Hann window."""
    count = max(1, min(2 * values.size // size - 1, looked_at // size))
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * (np.arange(size) + 0.5) / size)
    window /= window.sum()
    begins = np.linspace(0, values.size - size, count).astype(int)
    if missing.any():
        begins = np.array([k for k in begins if missing[k : k + size].mean() <= most_missing], dtype=int)
    spectra = np.empty((begins.size, PADDING * size // 2 + 1))
    together = max(1, TOGETHER // (PADDING * size))
    for done in range(0, begins.size, together):
        tapered = window * np.array([values[k : k + size] for k in begins[done : done + together]])
        # The mean of a segment, with the weights of the window. (Threads of a linear algebra would be in the way.)
        tapered -= tapered.sum(axis=1, keepdims=True) * window
        spectra[done : done + together] = 2.0 * np.abs(np.fft.rfft(tapered, PADDING * size))
    return np.median(spectra, axis=0) if begins.size else None


def significant(spectrum: Array) -> tuple[Array, Array]:
    """Places [bins] and amplitudes of the peaks that are neither noise nor leakage, the largest first."""
    coarse = spectrum[::PADDING]
    around = np.lib.stride_tricks.sliding_window_view(np.pad(coarse, FLOOR_BINS, mode="reflect"), 2 * FLOOR_BINS + 1)
    floor = np.repeat(np.median(around, axis=1), PADDING)
    inner = spectrum[1:-1]
    places = 1 + np.flatnonzero((inner > spectrum[:-2]) & (inner >= spectrum[2:]))
    places = places[(places >= CLOSEST * PADDING) & (spectrum[places] > ABOVE_FLOOR * floor[places])]
    if places.size:
        places = places[spectrum[places] > ROUNDING * spectrum.max()]
    bins: list[float] = []
    amplitudes: list[float] = []
    for place in places[np.argsort(-spectrum[places])]:
        # The top of a parabola. (That through the logarithms would be far off beside a zero of the spectrum.)
        left, top, right = spectrum[place - 1 : place + 2]
        shift = 0.5 * (left - right) / (left - 2.0 * top + right)
        bin_, amplitude = float(place + shift) / PADDING, float(top - 0.25 * (left - right) * shift)
        distance = np.abs(np.array(bins) - bin_)
        if bins and distance.min() < CLOSEST:
            continue
        # Envelope of the side lobes of the Hann window.
        leakage = np.array(amplitudes) / (np.pi * distance * (distance**2 - 1.0))
        if amplitude > ABOVE_LEAKAGE * leakage.sum():
            bins.append(bin_)
            amplitudes.append(amplitude)
    return np.array(bins), np.array(amplitudes)
