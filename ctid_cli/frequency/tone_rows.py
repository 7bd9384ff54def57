"""The tones at each of many instants: of all windows around it, the longest that the shorter ones allow."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.frequency.tone_search import LEVEL, ToneRows, tones_of_windows

#: Shortest window: so many periods of the lowest frequency that is looked for, and so many samples.
PERIODS = 4.0
SHORTEST = 64
#: Windows of a length begin so many times in one of them, at most.
OVERLAPPING = 16
#: An interval reaches so many standard errors to both sides.
REACH = 2.5
#: A curvature, or a rate, below so many of its standard errors may be nothing.
QUIET = 2.0
#: Two estimates this many standard errors apart, or half a bin, may be those of one tone.
GATE = 5.0
#: Lines of one window that are closer than so many bins may be one tone that changes.
RESOLVED = 4.0
#: Lines so many bins of its window beside a tone that moves are part of it.
BESIDE = 3.0
#: A line is a tone if its amplitude is so many times its standard error.
SIGNIFICANT = 4.0


@dataclass(frozen=True)
class Tone:
    """A tone at an instant."""

    #: Frequency and its standard error [rad/sample].
    omega: float
    error: float
    amplitude: float
    amplitude_error: float
    phase: float
    growth: float
    rate: float
    #: Samples of the window that it was taken from.
    window: int
    #: What the intervals of all windows up to this one have in common [rad/sample].
    low: float
    high: float
    #: Whether a longer window was refused by the shorter ones: the tone moves.
    frozen: bool = False


@dataclass(frozen=True)
class Row:
    """All tones at an instant, ascending."""

    place: float
    tones: tuple[Tone, ...]
    #: Longest window in which noise alone was left; zero if there was none.
    clean: int
    #: Strongest line that the shortest window left [rad/sample]; NaN if none.
    missing: float


def window_lengths(count: int, lowest: float) -> list[int]:
    """Lengths of windows, doubled from the shortest one to the whole signal; odd, so that there is a middle."""
    lengths = []
    length = min(SHORTEST, count)
    while length < count:
        lengths.append(length - 1 + length % 2)
        length *= 2
    return [*lengths, count - 1 + count % 2]


def rows_of(samples: Array, places: Array, lengths: list[int], most: int) -> list[Row]:
    """Tones at each of some places [samples]."""
    found = []
    for length in lengths:
        first = _firsts(samples.size, places, length)
        found.append((length, first, tones_of_windows(samples, length, first, most)))
    rows = []
    for place in places:
        row = Row(float(place), (), 0, np.nan)
        for length, first, tones in found:
            row = _longer(row, tones, _nearest(first, length, place), length)
        rows.append(row)
    return rows


def _firsts(count: int, places: Array, length: int) -> IndexArray:
    """First samples of the windows of a length that are nearest to the places."""
    hop = max(1, length // OVERLAPPING)
    wanted = np.clip(np.round((places - 0.5 * (length - 1)) / hop) * hop, 0, count - length)
    return np.unique(wanted.astype(np.int64))


def _nearest(first: IndexArray, length: int, place: float) -> int:
    after = int(np.searchsorted(first, place - 0.5 * (length - 1)))
    near = [k for k in (after - 1, after) if 0 <= k < first.size]
    return min(near, key=lambda k: abs(first[k] + 0.5 * (length - 1) - place))


def _longer(row: Row, found: ToneRows, k: int, length: int) -> Row:
    """What a window adds to what the shorter ones have shown."""
    if not found.converged[k] or found.line_chance[k] < LEVEL:
        return row if row.clean else replace(row, missing=float(found.line[k]))
    tones = list(row.tones)
    apart = row.place - float(found.middle[k])
    count = int(found.count[k])
    for j in range(count):
        others = np.abs(np.delete(found.omega[k, :count], j) - found.omega[k, j])
        if others.min(initial=np.inf) * length < RESOLVED * 2.0 * np.pi:
            continue
        if found.omega[k, j] * length < PERIODS * 2.0 * np.pi:
            continue
        if found.change_chance[k, j] < LEVEL or not found.amplitude[k, j] > SIGNIFICANT * found.amplitude_error[k, j]:
            continue
        tones = _joined(tones, list(_candidates(found, k, j, apart, length)))
    return Row(row.place, tuple(tones), length, np.nan)


def _candidates(found: ToneRows, k: int, j: int, apart: float, length: int) -> Iterator[Tone]:
    """Estimates of one tone from one window: less and less of it is assumed to move."""
    omega, rate = float(found.omega[k, j]), float(found.rate[k, j])
    moved = omega + rate * apart
    error = float(found.omega_error[k, j])
    straight = float(np.hypot(error, found.rate_error[k, j] * apart))
    bent = float(np.hypot(straight, found.bend_error[k, j]))
    common = {
        "amplitude": float(found.amplitude[k, j] * np.exp(np.clip(found.growth[k, j] * apart, -20.0, 20.0))),
        "amplitude_error": float(found.amplitude_error[k, j]),
        "phase": float(found.phase[k, j] + omega * apart + 0.5 * rate * apart**2),
        "growth": float(found.growth[k, j]),
        "rate": rate,
        "window": length,
    }
    reach = QUIET * found.bend_error[k, j]
    options = [(moved - float(found.bend[k, j]), bent)]
    if abs(found.bend[k, j]) < reach:
        options.append((moved, straight))
        if straight > 1.2 * error and abs(rate) < QUIET * found.rate_error[k, j]:
            options.append((omega, error))
    for value, uncertain in options:
        if np.isfinite(uncertain):
            reach = REACH * uncertain
            yield Tone(value, uncertain, low=value - reach, high=value + reach, **common)


def _joined(tones: list[Tone], estimates: list[Tone]) -> list[Tone]:
    """The tones with further estimates of one of them, or with a further one."""
    if not estimates:
        return tones
    new = estimates[0]

    def distance(tone: Tone) -> float:
        return abs(tone.omega - new.omega)

    # What stands beside a tone that moves is its side bands.
    if any(tone.frozen and distance(tone) < BESIDE * 2.0 * np.pi / tone.window for tone in tones):
        return tones
    near = [tone for tone in tones if distance(tone) < max(GATE * np.hypot(tone.error, new.error), np.pi / tone.window)]
    if not near:
        old, better = None, new
    else:
        old = min(near, key=distance)
        better = _narrowed(old, new)
    for estimate in estimates[1:]:
        if not better.frozen:
            narrower = _narrowed(better, estimate)
            # A bolder reading of the same window that does not agree is left out.
            better = better if narrower.frozen else narrower
    return [*(tone for tone in tones if tone is not old), better]


def _narrowed(old: Tone, new: Tone) -> Tone:
    """A tone with a further estimate: the surer one of both if their intervals, and all before, have a point in common."""
    low, high = max(old.low, new.low), min(old.high, new.high)
    if low > high:
        return replace(old, frozen=True, error=max(old.error, 0.5 * abs(old.omega - new.omega)))
    return replace(new if new.error <= old.error else old, low=low, high=high)
