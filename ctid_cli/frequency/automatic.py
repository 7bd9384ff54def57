"""Settings of an online estimator for a recorded signal, chosen from the record alone, with the reasons."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.frequency.decimation import PIECE, Decimation, low_pass, without_low
from ctid_cli.frequency.esprit import Esprit
from ctid_cli.frequency.inputs import LARGEST_SAMPLE, MOST_TONES
from ctid_cli.frequency.spectrum import Peaks, find_peaks
from ctid_cli.frequency.spikes import find_spikes, spikes_told
from ctid_cli.frequency.windows import estimate_window
from ctid_cli.kinds import ONLINE, resolve
from ctid_cli.signals.checks import require_choice, require_integer, require_positive

#: Samples in a period of the highest tone, and how many tones more than the wanted ones may share the band, for
#: estimators that integrate, and for the others, that delay.
INTEGRATING = dict.fromkeys(("adaptive_observer", "filter_regression"), (60, 0))
DELAYING = (12, 2)
#: Fewest samples for each tone.
SAMPLES_PER_TONE = 8
#: A signal that varies by less than this fraction of itself is constant.
CONSTANT = 1e-12
#: Powers of smaller samples would vanish.
SMALLEST_SAMPLE = 1e-60
#: Tones of the record of less than this fraction of the weakest wanted one (amplitudes) disturb nobody.
HARMLESS = 0.05
#: A constant part of less than this fraction disturbs nobody either.
HARMLESS_OFFSET = 0.02
#: The low-pass keeps so much more than the highest tone, and stops another tone if that is so many times higher.
PASS = 1.1
STOP = 1.25
#: A high-pass, with these edges as fractions of the lowest tone, is used if there is enough of the record.
LOW_STOP = 0.4
LOW_PASS = 0.8
HIGH_PASS_SHARE = 0.1
#: What the filters leave in their stop bands [dB].
STOP_BAND = 60.0
LOW_STOP_BAND = 40.0
#: Gaps shorter than this fraction of the shortest period are bridged.
BRIDGED = 0.05
#: A window begins with so many beats of its two closest tones, and doubles until the frequencies change by no more than
#: this share from window to window, at so many places of the record, or else is the one where they change least; it
#: never exceeds this fraction of the record, unless the record is shorter than those beats.
BEATS = 3.0
DOUBLINGS = 4
STILL = 3e-4
TRIALS = 8
LARGEST_SHARE = 1.0 / 3.0
#: Samples of a window for each tone that is estimated.
WINDOW_SAMPLES_PER_TONE = 8
#: Length of the prefilter in delays.
PREFILTER_DELAYS = 2.0
#: Share of the Nyquist frequency above which a tone may be the image of one that the sampling has folded.
SUSPICIOUS = 0.9


@dataclass(frozen=True, eq=False)
class Settings:
    """What to do with a record to find the frequencies of its tones."""

    estimator: Any
    tones: int
    #: Where the spectrum shows the tones of the estimator [rad/s], the wanted ones first, shape (m,).
    expected: Array
    #: Constant that is subtracted first [signal unit].
    offset: float
    decimation: Decimation
    #: Sampling interval of what the estimator gets [s].
    interval: float
    window: int
    reasons: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def window_seconds(self) -> float:
        """Length of a window [s]."""
        return self.window * self.interval

    @property
    def lag(self) -> float:
        """Time by which the middle of the filter lies behind its newest sample, in samples of the record."""
        return 0.5 * (self.decimation.weights.size - 1)


@dataclass(frozen=True, eq=False)
class _Band:
    """Which tones the estimator gets, the wanted ones first, and how the others are kept away."""

    expected: Array
    amplitudes: Array
    decimation: Decimation
    sentences: list[str]


def choose_settings(
    samples: Array, interval: float, tones: int, *, method: str, window: float | None = None
) -> Settings:
    """Choose everything that an online estimator needs.

    The tones are the strongest peaks of the median spectrum of the record's segments. A low-pass whose stop band begins
    before what would fold onto them, and before the next strong tone, allows to keep only some samples in each period
    of the highest tone. Tones that no filter can keep away are estimated too. The delay h of the regressions is the one
    at which noise moves the wanted tones least, below ``pi/(1.1 w_max)`` (frequencies become ambiguous at pi/w_max),
    with a prefilter of 2 h. The memory begins with three beats of the closest tones and is doubled until frequencies
    in windows as long, by ESPRIT, hardly differ from window to window.
    """
    spikes = find_spikes(samples)
    samples = np.where(spikes, np.nan, samples)
    require_integer("tones", tones, 1, MOST_TONES)
    require_positive("interval", interval, "s")
    require_choice("method", method, ONLINE)
    if window is not None:
        require_positive("window", window, "s")
    refuse_unusable(samples, SAMPLES_PER_TONE * tones, f" for {tones} tones")
    peaks = find_peaks(samples, interval, tones)
    seconds = f"{samples.size * interval:.4g} s"
    if peaks.omega.size == 0:
        raise DataError(f"no tone stands out of {seconds}; use a longer record, with fewer gaps or steadier tones")
    offset = _offset(samples, float(peaks.amplitudes[:tones][-1]))
    bridge = int(BRIDGED * 2.0 * np.pi / (peaks.omega[:tones].max() * interval))
    gaps = bool((~np.isfinite(samples)).any())
    band = _choose_band(samples.size * interval, interval, tones, peaks, method, bridge)
    thinned = band.decimation.apply(samples, offset)
    thin = interval * band.decimation.factor
    if np.isfinite(thinned).sum() < SAMPLES_PER_TONE * tones:
        filtered = f"{band.decimation.weights.size * interval:.4g} s of filter"
        raise DataError(f"the record is too short or has too many gaps: {seconds} for {filtered}; use a longer one")
    length = _choose_window(thinned, thin, tones, band, window)
    options, how = _options(method, band, tones, thin, length * thin)
    estimator = resolve("frequency_estimator", method)(tones=band.expected.size, **options)
    reasons = [*_preparation(peaks, tones, offset, bridge * interval if gaps else 0.0), *band.sentences]
    reasons += [how, f"Amplitudes are found from the last {length * thin:.4g} s before each row.", *spikes_told(spikes)]
    warnings = tuple(_doubts(peaks, tones, interval))
    return Settings(estimator, tones, band.expected, offset, band.decimation, thin, length, tuple(reasons), warnings)


def _hertz(omega: Array) -> str:
    return ", ".join(f"{frequency:.5g}" for frequency in np.sort(omega) / (2.0 * np.pi)) + " Hz"


def _preparation(peaks: Peaks, tones: int, offset: float, bridged: float) -> Iterator[str]:
    found = _hertz(peaks.omega[:tones])
    yield f"Strongest tones: {found} (median spectrum of segments of {peaks.segment:.4g} s)."
    if offset:
        yield f"The mean, {offset:.4g}, is subtracted."
    if bridged:
        yield f"Gaps of up to {bridged:.3g} s are bridged by straight lines."


def refuse_unusable(samples: Array, fewest: int, what: str = "") -> None:
    """Raise DataError for a signal that is too short, constant, or out of range."""
    present = np.isfinite(samples)
    count = np.count_nonzero(present)
    if count < fewest:
        raise DataError(f"{count} samples are too few{what}: there must be {fewest}")
    low, high = samples.min(where=present, initial=np.inf), samples.max(where=present, initial=-np.inf)
    largest = max(abs(low), abs(high))
    if high - low <= CONSTANT * largest:
        raise DataError(f"the signal is constant ({low:.6g}): it has no tones")
    if not SMALLEST_SAMPLE <= largest <= LARGEST_SAMPLE:
        raise DataError(f"the square of the largest sample, {largest:.3g}, is no normal number; use another unit")


def _doubts(peaks: Peaks, tones: int, interval: float) -> Iterator[str]:
    if peaks.omega.size < tones:
        closer = f"closer than {peaks.resolution / (2 * np.pi):.4g} Hz"
        yield f"Only {peaks.omega.size} of {tones} tones stand out: use fewer, or a longer record if they are {closer}."
    yield from image_doubt(float(peaks.omega[:tones].max()) / (2 * np.pi), 0.5 / interval)


def image_doubt(highest: float, nyquist: float) -> Iterator[str]:
    """What to know of a tone near the Nyquist frequency [Hz]."""
    if highest > SUSPICIOUS * nyquist:
        yield f"The tone at {highest:.6g} Hz may be the image of one above the Nyquist frequency, {nyquist:.6g} Hz."


def _offset(samples: Array, weakest: float) -> float:
    """Constant part, if it matters; a Hann window keeps the tones out of the mean."""
    total = weight = 0.0
    for first in range(0, samples.size, PIECE):
        part = samples[first : first + PIECE]
        present = np.isfinite(part)
        places = first + np.arange(part.size) + 0.5
        window = np.where(present, np.sin(np.pi * places / samples.size) ** 2, 0.0)
        total += float(window @ np.where(present, part, 0.0))
        weight += float(window.sum())
    mean = total / weight
    return mean if abs(mean) > HARMLESS_OFFSET * weakest else 0.0


def _choose_band(duration: float, interval: float, tones: int, peaks: Peaks, kind: str, bridge: int) -> _Band:
    omega, wanted = peaks.omega, peaks.omega[:tones]
    low, top = float(wanted.min()), float(wanted.max())
    weakest = float(peaks.amplitudes[:tones][-1])
    if wanted.size < tones:
        top += peaks.resolution
    top = min(top, np.pi / interval / PASS)
    per_period, most_spares = INTEGRATING.get(kind, DELAYING)
    factor = max(1, int(2.0 * np.pi / (per_period * top * interval)))
    pass_edge = PASS * top
    stop_edge = min(2.0 * np.pi / (factor * interval) - pass_edge, np.pi / interval)
    # Whatever disturbs and is not kept away by a filter is estimated too.
    disturbing = peaks.amplitudes > HARMLESS * weakest
    disturbing[:tones] = False
    above = disturbing & (omega >= STOP * top)
    stop_edge = float(np.min(omega[above], initial=stop_edge))
    sentences, weights = [], np.ones(1)
    if (factor > 1 or above.any()) and stop_edge > pass_edge:
        weights = low_pass(pass_edge, stop_edge, STOP_BAND, interval)
        edges = f"below {pass_edge / (2.0 * np.pi):.4g} Hz and stops what is above {stop_edge / (2.0 * np.pi):.4g} Hz"
        sentences.append(f"A low-pass of {weights.size * interval:.3g} s keeps what is {edges}.")
        if factor > 1:
            sentences[-1] += f" One of {factor} samples is kept, every {factor * interval:.4g} s."
        disturbing &= ~above
    high_pass = 2.0 * np.pi * (LOW_STOP_BAND - 7.95) / (2.285 * 2.0 * np.pi * (LOW_PASS - LOW_STOP) * low)
    below = disturbing & (omega <= LOW_PASS * low)
    if below.any() and high_pass < HIGH_PASS_SHARE * duration:
        weights = without_low(weights, LOW_STOP * low, LOW_PASS * low, LOW_STOP_BAND, interval)
        edge = f"{LOW_STOP * low / (2.0 * np.pi):.4g} Hz"
        sentences.append(f"A high-pass of {high_pass:.3g} s keeps away what is below {edge}.")
        disturbing &= omega > LOW_STOP * low
    spares = np.flatnonzero(disturbing)[: min(most_spares, MOST_TONES - tones)]
    if spares.size:
        sentences.append(f"Estimated too, since they disturb, but not shown: tones at {_hertz(omega[spares])}.")
    missing = tones - wanted.size
    # Tones that the spectrum does not tell apart are somewhere beside the strongest one.
    guessed = omega[0] + peaks.resolution / (missing + 1.0) * np.arange(1, missing + 1)
    expected = np.concatenate((wanted, guessed, omega[spares]))
    amplitudes = np.concatenate((peaks.amplitudes[:tones], np.full(missing, weakest), peaks.amplitudes[spares]))
    return _Band(expected, amplitudes, Decimation(weights, factor, bridge), sentences)


def _choose_window(thinned: Array, thin: float, tones: int, band: _Band, window: float | None) -> int:
    """Samples that the estimator should remember."""
    least = WINDOW_SAMPLES_PER_TONE * band.expected.size
    if window is not None:
        length = round(min(window / thin, thinned.size + 1.0))
        if not least <= length <= thinned.size:
            allowed = f"from {least * thin:.4g} s to {thinned.size * thin:.4g} s"
            raise ValueError(f"window must be {allowed}, not {window:g}.")
        return length
    # Smallest distance of a wanted tone from any other, from zero, and from its own image above Nyquist [rad/s].
    wanted = band.expected[:tones]
    distance = np.abs(wanted[:, None] - np.concatenate(([0.0], band.expected)))
    distance[np.arange(tones), 1 + np.arange(tones)] = np.inf
    closest = float(min(distance.min(), 2.0 * (np.pi / thin - wanted.max())))
    length = max(least, int(np.ceil(BEATS * 2.0 * np.pi / (closest * thin))))
    best, least_change = min(length, thinned.size), np.inf
    for _ in range(DOUBLINGS + 1):
        if length > LARGEST_SHARE * thinned.size:
            break
        change = _change(thinned, thin, tones, band, length)
        if change < least_change:
            best, least_change = length, change
        if change <= STILL:
            break
        length *= 2
    return best


def _change(thinned: Array, thin: float, tones: int, band: _Band, length: int) -> float:
    """By what share frequencies change over half a window: the median of the tones that change most."""
    firsts = np.linspace(0, thinned.size - length - length // 2, TRIALS).astype(int)
    estimator = Esprit(tones=band.expected.size)
    found = [
        [
            estimate_window(estimator, thinned[k:][:length], thin, band.expected, tones).omega
            for k in (first, first + length // 2)
        ]
        for first in firsts
    ]
    changes = [np.abs(after - before).max() / before.min() if before.min() > 0.0 else np.inf for before, after in found]
    return float(np.median(np.where(np.isnan(changes), np.inf, changes)))


def _options(kind: str, band: _Band, wanted: int, thin: float, window: float) -> tuple[dict[str, Any], str]:
    """Options of an estimator for windows of a length [s], and a sentence about them."""
    expected = np.sort(band.expected)
    start: dict[str, Any] = {"initial_frequencies": tuple(expected)}
    low, top = float(expected[0]), float(expected[-1])
    if kind == "adaptive_observer":
        ratio = min(1.2, (0.5 / (low * thin)) ** (1.0 / max(1, 2 * expected.size - 1)))
        rate = min(0.1 * low, 3.0 / window)
        gap = 0.3 * float(np.diff(expected, prepend=0.0).min())
        start |= {"pole": low, "ratio": max(1.0, ratio), "rate": rate, "hold": 2.0 * np.pi / low, "smallest_gap": gap}
        start |= {"lowest_frequency": 0.1 * low, "highest_frequency": 2.0 * top}
        return start, f"Slowest pole {low:.4g} rad/s, adaptation rate {rate:.4g} 1/s, from the spectrum's frequencies."
    if kind == "filter_regression":
        pole = float(np.sqrt(low * top))
        start |= {"pole": pole, "forgetting": 2.0 / window, "hold": 0.5 * window}
        return start, f"Filter pole {pole:.4g} rad/s; data older than {window / 2:.4g} s are forgotten."
    h = _best_delay(band.expected, band.amplitudes, wanted, thin)
    common = {"h": h, "prefilter": PREFILTER_DELAYS * h}
    told = f"Delay h = {h:.4g} s ({h * top:.3g} rad of the highest tone), prefilter {PREFILTER_DELAYS * h:.4g} s"
    if kind == "restarting_least_squares":
        return common | {"memory": window}, f"{told}, memory {window:.4g} s."
    spacing, square = _best_spacing(band.expected, band.amplitudes, h, thin)
    common |= {"d": spacing, "first_row": 0}
    told += f", rows d = {spacing:.4g} s apart"
    if kind == "drem_window":
        return common | {"memory": window}, f"{told}, window {window:.4g} s."
    rate = 5.0 / window
    options = common | start | {"epsilon": float(square**-0.5), "gamma": rate}
    return options, f"{told}, gain for a rate of {rate:.4g} 1/s."


def _best_delay(omega: Array, amplitudes: Array, wanted: int, thin: float) -> float:
    """Delay of the regression at which the same noise moves the worst of the wanted tones least, against its room."""
    longest = max(1, int(np.pi / (PASS * float(omega.max()) * thin)))
    others = ~np.eye(omega.size, dtype=bool)
    apart = np.where(others, np.abs(omega[:, None] - omega), omega)

    def least_moved(h: float) -> float:
        cosines = np.cos(omega * h)
        # Slope of prod_j (c - c_j) over w_i, at w_i.
        distances = np.where(others, 2.0 * np.abs(cosines[:, None] - cosines), 1.0)
        slopes = h * np.sin(omega * h) * distances.prod(axis=1)
        return float((amplitudes * slopes * apart.min(axis=1))[:wanted].min())

    return float(max(thin * np.arange(1, longest + 1), key=least_moved))


def _best_spacing(omega: Array, amplitudes: Array, h: float, thin: float) -> tuple[float, float]:
    """Distance of the stacked rows for which their determinant is largest, and its mean square."""
    n = omega.size
    c = np.cos(omega * h)
    factor = 2.0 ** (n * n) * np.prod([c[i] - c[j] for i in range(n) for j in range(i + 1, n)])
    # Phases spread evenly over all their combinations.
    phases = 2.0 * np.pi * np.mod(np.outer(np.arange(1, 401), np.sqrt([2, 3, 5, 7, 11, 13, 17, 19][:n])), 1.0)

    def mean_square(spacing: float) -> float:
        rows = np.arange(n)[:, None] * spacing * omega
        parts = amplitudes * np.sin(phases[:, None, :] - rows)
        return float(np.mean((factor * np.linalg.det(parts)) ** 2))

    spacings = np.unique(np.maximum(1, np.round(np.linspace(0.3, 2.0, 18) * h / thin))) * thin
    best = float(max(spacings, key=mean_square))
    return best, mean_square(best)
