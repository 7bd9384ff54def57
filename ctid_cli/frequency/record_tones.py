"""All tones of a recorded signal over time: how many there are, and what is known of each at every instant."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.errors import DataError
from ctid_cli.frequency.automatic import image_doubt, refuse_unusable
from ctid_cli.frequency.decimation import Decimation, low_pass
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.record_track import MOST_ASKED, MissingLine, Procedure, RecordTrack
from ctid_cli.frequency.spectrum import find_peaks
from ctid_cli.frequency.spikes import find_spikes, spikes_told
from ctid_cli.frequency.tone_identity import paths_of
from ctid_cli.frequency.tone_rows import SHORTEST, Readings, readings_at
from ctid_cli.signals.checks import require_integer, require_positive

#: Name of the method.
METHOD = "tone_windows"
#: Rows of a track if nobody says how many.
USUAL_ROWS = 1000
#: Fewest samples that show anything.
FEWEST = 32
#: Most lines that are fitted in one window.
MOST_LINES = 16
#: Records are thinned to no fewer samples than this: the weakest tones show only in the longest windows, and those that
#: move only in the shortest.
FEWEST_KEPT = 2**15
#: Of a record that could be thinned to so many samples the strongest tones are no higher than that would leave them.
FEWEST_NEEDED = 2**12
#: Samples of all segments of a length in whose spectra the highest of the strongest tones is looked for.
LOOKED_AT = 2**18
#: Of a thinned record this share of the band is kept, and the highest tone lies in this share of it.
KEPT_BAND = 0.9
TONE_BAND = 0.8
#: What the filter leaves of what would fold into that band [dB].
STOP_BAND = 60.0
#: Gaps shorter than this share of the shortest period are bridged before a filter.
BRIDGED = 0.05
#: Names of readings where those of a track differ.
FIELDS = {"amplitudes": "amplitude"}
#: Noise that is added, as a share of the largest sample.
DITHER = 1e-7
#: Most lines that are named as missing.
MOST_MISSING = 5


def follow_tones(
    samples: Array,
    interval: float,
    tones: int | None = None,
    *,
    every: float | None = None,
    window: float | None = None,
    at: Array | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> tuple[RecordTrack, Procedure]:
    """The strongest tones of a recorded signal, or all of them, ascending in frequency, and how they were found.

    In windows of all lengths, doubled from 64 samples to the whole record, decaying chirps are fitted one by one until
    the residual, whitened, shows no further line. At each instant each tone is read from the longest window in which
    nothing speaks against it: no line left near it, no change within the window, no other tone too close. Missing
    samples are NaN; ``every`` [s] is the time from row to row, or ``at`` [s] holds the instants of the rows, ascending;
    ``window`` [s] is the longest window. Raises DataError for a signal that is too short, constant, or shows no tone.
    """
    require_positive("interval", interval, "s")
    if tones is not None:
        require_integer("tones", tones, 0, MOST_ASKED)
    refuse_unusable(samples, FEWEST)
    spikes = find_spikes(samples)
    samples = np.where(spikes, np.nan, samples)
    decimation, band, reasons = _thinning(samples, interval, tones)
    scale = float(np.nanmax(np.abs(samples)))
    # Rounding leaves no noise by which errors could be told.
    dither = DITHER * np.random.default_rng(0).standard_normal(samples.size)
    thinned = decimation.apply(samples / scale + dither)
    thin = interval * decimation.factor
    longest = _longest(window, thin, thinned.size)
    step = (samples.size * interval / USUAL_ROWS if every is None else every) / thin
    delay = 0.5 * (decimation.weights.size - 1) * interval
    places = np.arange(0.0, thinned.size - 0.5, max(step, 1.0)) if at is None else (at - delay) / thin
    found = readings_at(thinned, places, MOST_LINES, longest, on_progress)
    paths = paths_of(found, places)
    if not paths and tones is None:
        raise DataError(
            f"no tone stands out of {samples.size * interval:.4g} s, in which a tone must turn several times; use a "
            "longer record, or one with less noise"
        )
    # The strongest first, but behind the others what is above their band.
    paths.sort(key=lambda path: _middle(found, path) > band * thin)
    wanted = paths[: MOST_ASKED if tones is None else tones]
    wanted.sort(key=lambda path: _middle(found, path))
    count = len(wanted) if tones is None else tones
    alone = _alone(thinned, places)
    lost = paths[len(wanted) :][:MOST_MISSING]
    omega, flags = _frequencies(found, wanted, alone, count, thin)
    others: dict[str, Any] = _others(found, wanted, omega.shape, thin, scale, decimation)
    others["missing"] = tuple(_missing(found, path, places.size, thin, scale) for path in lost)
    track = RecordTrack.of(places * thin + delay, omega, flags, max(step, 1.0) * thin, **others)
    used = {"interval": thin, "kept_of": decimation.factor, "filter_samples": decimation.weights.size}
    sentences = (*_counted(paths, count, tones), *reasons, *spikes_told(spikes), *_windows_used(found, wanted, thin))
    highest = max((_middle(found, path) for path in wanted), default=0.0) / (2.0 * np.pi * thin)
    doubts = tuple(_doubts(len(paths), tones, highest, 0.5 / interval))
    return track, Procedure(METHOD, False, sentences, doubts, used | {"longest_window": longest * thin})


def _middle(found: Readings, path: IndexArray) -> float:
    """Median frequency of a tone [rad/sample]."""
    return float(np.median(found.omega[path]))


def _thinning(samples: Array, interval: float, tones: int | None) -> tuple[Decimation, float, list[str]]:
    """A filter, how many samples are left out after it where the strongest tones need few, and their band [rad/s].

    The strongest tones are those of the median spectrum first, in which what is loud for a moment is not.
    """
    unthinned = Decimation(np.ones(1))
    fewest = FEWEST_KEPT if tones is None else FEWEST_NEEDED
    if samples.size < 2 * fewest or tones == 0:
        return unthinned, np.inf, []
    peaks = find_peaks(samples, interval, tones or MOST_ASKED, LOOKED_AT)
    if not peaks.omega.size:
        return unthinned, np.inf, []
    top = float(peaks.omega[: tones or MOST_ASKED].max())
    most = max(1, int(np.pi * TONE_BAND / (top * interval)))
    band = np.inf if tones is None else KEPT_BAND * np.pi / (min(most, samples.size // FEWEST_NEEDED) * interval)
    factor = min(most, samples.size // FEWEST_KEPT)
    if factor <= 1:
        return unthinned, band, []
    nyquist = np.pi / (factor * interval)
    weights = low_pass(KEPT_BAND * nyquist, (2.0 - KEPT_BAND) * nyquist, STOP_BAND, interval)
    bridge = int(BRIDGED * 2.0 * np.pi / (top * interval))
    edge = f"{KEPT_BAND * nyquist / (2.0 * np.pi):.4g} Hz"
    kept = f"One of {factor} samples is kept, every {factor * interval:.4g} s"
    return Decimation(weights, factor, bridge), band, [f"{kept}, after a low-pass that keeps what is below {edge}."]


def _longest(window: float | None, thin: float, count: int) -> int:
    """Samples of the longest window."""
    if window is None:
        return count
    length = round(min(window / thin, count + 1.0))
    if not SHORTEST <= length <= count:
        allowed = f"from {SHORTEST * thin:.4g} s to {count * thin:.4g} s"
        raise DataError(f"the longest window must be {allowed}, not {window:g} s")
    return length


_Flags = NDArray[np.uint16]


def _frequencies(
    found: Readings, paths: list[IndexArray], alone: Array, count: int, thin: float
) -> tuple[Array, _Flags]:
    """Frequencies [rad/s] and flags, both of shape (N, n), of rows so far from the nearest sample [samples]."""
    omega = np.full((alone.size, count), np.nan)
    flags = np.full((alone.size, count), int(Flag.ABSENT), np.uint16)
    for k, path in enumerate(paths):
        rows = found.row[path]
        # Between its readings the tone is there, but no window is free of changes.
        flags[rows[0] : rows[-1] + 1, k] = int(Flag.CHANGE)
        omega[rows, k] = found.omega[path] / thin
        unsure = np.where(found.significant[path], 0, int(Flag.ABSENT))
        flags[rows, k] = unsure | np.where(found.resolved[path], 0, int(Flag.UNRESOLVED))
        # A tone may have done anything where there is no sample in a period of it.
        flags[rows, k] |= np.where(alone[rows] * found.omega[path] > 2.0 * np.pi, int(Flag.GAP), 0).astype(np.uint16)
    return omega, flags


def _alone(samples: Array, places: Array) -> Array:
    """How far the nearest sample is from each place [samples]."""
    present = np.flatnonzero(np.isfinite(samples))
    after = np.searchsorted(present, places)
    before, behind = present[np.maximum(after - 1, 0)], present[np.minimum(after, present.size - 1)]
    return np.asarray(np.minimum(np.abs(places - before), np.abs(places - behind)))


def _others(
    found: Readings, paths: list[IndexArray], shape: tuple[int, ...], thin: float, scale: float, filter_: Decimation
) -> dict[str, Array]:
    """What else is known of the tones, in units of the record."""
    factors = {
        "error": 1.0 / thin,
        "amplitudes": scale,
        "amplitude_error": scale,
        "phase": 1.0,
        "growth": 1.0 / thin,
        "rate": 1.0 / thin**2,
        "window": thin,
    }
    values = {name: np.full(shape, np.nan) for name in factors}
    gain = filter_.gain(found.omega / filter_.factor, 1.0)
    for k, path in enumerate(paths):
        for name, factor in factors.items():
            values[name][found.row[path], k] = factor * np.asarray(getattr(found, FIELDS.get(name, name)))[path]
        for name in ("amplitudes", "amplitude_error"):
            values[name][found.row[path], k] /= gain[path]
    # Readings are of cosines, tracks of sines.
    values["phase"] = np.angle(1j * np.exp(1j * values["phase"]))
    return values


def _missing(found: Readings, path: IndexArray, rows: int, thin: float, scale: float) -> MissingLine:
    return MissingLine(_middle(found, path) / thin, path.size / rows, scale * float(np.median(found.amplitude[path])))


def _counted(paths: list[IndexArray], count: int, tones: int | None) -> Iterator[str]:
    """How many tones there are, and how that is known."""
    if tones is None:
        more = f" The strongest {count} of {len(paths)} are followed." if len(paths) > count else ""
        how = "lines join until the whitened residual shows none, and stay if they are worth their numbers"
        yield f"Tones: {count}, from the record ({how}: minimum description length).{more}"


def _windows_used(found: Readings, paths: list[IndexArray], thin: float) -> Iterator[str]:
    """From which windows the tones were read."""
    if paths:
        windows = found.window[np.concatenate(paths)] * thin
        low, middle, high = windows.min(), np.median(windows), windows.max()
        how = "the longest in which no line is left and nothing changes"
        range_ = f"to {high:.4g} s, half of them up to {middle:.4g} s" if low < high else "everywhere"
        yield f"Windows of {low:.4g} s {range_}: {how}."


def _doubts(found: int, tones: int | None, highest: float, nyquist: float) -> Iterator[str]:
    """What the user should know before believing the tones [Hz]."""
    if tones is not None and found < tones:
        if found:
            yield f"Only {found} of {tones} tones stand out of the record: the other columns are empty."
        else:
            yield "No tone stands out of the record: the columns are empty."
    yield from image_doubt(highest, nyquist)
