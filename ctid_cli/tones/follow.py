"""Tracking of tones over time: readings of the longest undisturbed windows, connected from row to row."""

import numpy as np
from scipy.optimize import linear_sum_assignment

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.progress import report
from ctid_cli.tones import constants as c
from ctid_cli.tones.check import Readings, explained, moving, readings_of
from ctid_cli.tones.find import floor_bins
from ctid_cli.tones.tone_kernels import PARAMETERS, keep_readings
from ctid_cli.tones.window_fit import WindowTones, fit_steady, fit_tones, nearest

#: Reported step.
LENGTH = "window length"


def readings_at(samples: Array, places: Array, longest: int) -> Readings:
    """Return the tones of a signal at ascending places [samples], each from its longest undisturbed window."""
    if longest == samples.size and (steady := fit_steady(samples)) is not None:
        found = readings_of(steady, longest, places)
        if explained(steady, longest) and not (found.gap > 0.0).any():
            return found.at(np.lexsort((found.omega, found.row)))
    parts: list[Readings] = []
    tones: WindowTones | None = None
    lengths = [c.SHORTEST * 2**k for k in range(64) if c.SHORTEST * 2**k < longest] + [longest]
    for done, (length, first) in enumerate(zip(lengths, _windows(lengths, samples.size, places), strict=True), 1):
        tones = fit_tones(samples, length, first, c.MOST_LINES, tones)
        parts.append(readings_of(tones, length, places))
        report(LENGTH, done, len(lengths))
    # The longest windows first; at equal length, the one with the nearest middle.
    found = Readings(*(np.concatenate(each) for each in zip(*parts[::-1], strict=True)))
    found = found.at(np.argsort(found.row, kind="stable"))
    bounds = np.searchsorted(found.row, np.arange(places.size + 1))
    relative = found.amplitude_error / found.amplitude
    table: Array = np.stack((found.omega, found.error, relative, found.window, found.middle))
    kept = keep_readings(table, bounds, c.SAME_BINS, c.SAME_ERRORS, c.COVERED, moving(found, bounds))
    found = found.at(np.flatnonzero(kept))
    return found.at(np.lexsort((found.omega, found.row)))


def _windows(lengths: list[int], count: int, places: Array) -> list[IndexArray]:
    """Return the first samples of the windows of each length that contain a place or provide starts for longer ones.

    If places are far apart, most of the short windows lie between them and are omitted.
    """
    chosen: list[IndexArray] = []
    longer: Array = np.empty(0)
    for length in reversed(lengths):
        first = np.unique(np.append(np.arange(0, count - length + 1, length // c.HOPS), count - length))
        wanted = np.searchsorted(places, first + length - 0.5) > np.searchsorted(places, first - 0.5)
        wanted[nearest(first + 0.5 * (length - 1), longer)] = True
        chosen.append(first[wanted])
        longer = np.asarray(chosen[-1] + 0.5 * (length - 1), dtype=np.float64)
    return chosen[::-1]


def paths_of(found: Readings, places: Array) -> list[IndexArray]:
    """Return the readings of each tone, the strongest tone first."""
    step = float(np.median(np.diff(places))) if places.size > 1 else 1.0
    paths = _joined(_followed(found, places, step), found, places.size)
    paths = [path for path in paths if _described(found, path, places, step)]
    # Sorted by duration times amplitude, so that long tones precede short loud ones.
    return _merged(sorted(paths, key=lambda path: -path.size * float(np.median(found.amplitude[path]))), found)


def _merged(paths: list[IndexArray], found: Readings) -> list[IndexArray]:
    """Merge paths within one bin of their windows: the rows of the stronger one take precedence.

    Paths that mostly coincide in time are compared at common rows, others by their medians.
    """
    merged: list[IndexArray] = []
    for path in paths:
        for k, other in enumerate(merged):
            both_there, one, two = np.intersect1d(found.row[path], found.row[other], return_indices=True)
            apart = abs(_centre(found, path) - _centre(found, other))
            if 2 * both_there.size > path.size:
                apart = float(np.median(np.abs(found.omega[path[one]] - found.omega[other[two]])))
            window = min(float(np.median(found.window[path])), float(np.median(found.window[other])))
            if apart * window < 2.0 * np.pi:
                new = path[~np.isin(found.row[path], found.row[other])]
                both = np.concatenate((other, new))
                merged[k] = both[np.argsort(found.row[both], kind="stable")]
                break
        else:
            merged.append(path)
    return merged


def _centre(found: Readings, path: IndexArray) -> float:
    """Return the median frequency of the more accurate half of the readings of a path [rad/sample]."""
    return float(np.median(found.omega[path][found.error[path] <= np.median(found.error[path])]))


def _followed(found: Readings, places: Array, step: float) -> list[IndexArray]:
    """Connect readings of adjacent rows with the least sum of misfits."""
    ended: list[list[int]] = []
    open_: list[list[int]] = []
    bounds = np.searchsorted(found.row, np.arange(places.size + 1))
    for row in range(places.size):
        pause = [row - found.row[path[-1]] - max(c.PATIENCE, found.window[path[-1]] / step) for path in open_]
        ended += [path for path, late in zip(open_, pause, strict=True) if late > 0]
        open_ = [path for path, late in zip(open_, pause, strict=True) if late <= 0]
        here = np.arange(bounds[row], bounds[row + 1])
        free = np.ones(here.size, np.bool_)
        if open_ and here.size:
            before = np.array([path[-1] for path in open_])
            misfit = np.minimum(_misfit(found, before, here, places), 1.0)
            for old, new in zip(*linear_sum_assignment(misfit), strict=True):
                if misfit[old, new] < 1.0:
                    open_[old].append(int(here[new]))
                    free[new] = False
        open_ += [[int(k)] for k in here[free]]
    return [np.array(path) for path in ended + open_]


def _misfit(found: Readings, before: IndexArray, here: IndexArray, places: Array) -> Array:
    """Return deviations of readings from extrapolated tones, relative to the tolerance, (tones, readings)."""
    passed = places[found.row[here]][None, :] - places[found.row[before]][:, None]
    moved = 0.5 * (found.rate[before][:, None] + found.rate[here][None, :]) * passed
    off = np.abs(found.omega[here][None, :] - found.omega[before][:, None] - moved)
    bin_ = 2.0 * np.pi / np.minimum(found.window[before][:, None], found.window[here][None, :])
    errors = np.hypot(found.error[before][:, None], found.error[here][None, :])
    return np.asarray(off / np.maximum(c.GATE_BINS * bin_, c.GATE_ERRORS * errors))


def _joined(paths: list[IndexArray], found: Readings, rows: int) -> list[IndexArray]:
    """Join the segments of one tone, the closest segments first."""
    ends = np.array([(found.row[p[0]], found.row[p[-1]]) for p in paths]).reshape(-1, 2)
    omega = np.array([(found.omega[p[0]], found.omega[p[-1]]) for p in paths]).reshape(-1, 2)
    pause = ends[None, :, 0] - ends[:, None, 1]
    jump = np.abs(omega[None, :, 0] / omega[:, None, 1] - 1.0)
    cost = np.where(pause > 0, jump + c.PAUSE * pause / rows, np.inf)
    after: dict[int, int] = {}
    taken: set[int] = set()
    for pair in np.argsort(cost, axis=None):
        a, b = divmod(int(pair), len(paths))
        if not cost[a, b] < c.LARGEST_JUMP:
            break
        if a not in after and b not in taken:
            after[a] = b
            taken.add(b)
    joined = []
    for k in range(len(paths)):
        if k in taken:
            continue
        pieces = [k]
        while pieces[-1] in after:
            pieces.append(after[pieces[-1]])
        joined.append(np.concatenate([paths[piece] for piece in pieces]))
    return joined


def _described(found: Readings, path: IndexArray, places: Array, step: float) -> bool:
    """Return whether a tone lasts for one of its windows and reduces the minimum description length.

    The cost of a tone includes its parameters and the position of its window.
    """
    sure = found.resolved[path] & found.significant[path] & (found.error[path] < c.COARSE * found.omega[path])
    window = found.window[path]
    # The noise level near a line is uncertain, as in the test that finds lines.
    known = c.MEDIAN_EFFICIENCY * np.minimum(float(floor_bins(4 * c.FLOOR_BINS)), 0.5 * window)
    gain = known * np.log1p(0.5 * (found.amplitude[path] / found.amplitude_error[path]) ** 2 / known)
    worth = gain > 0.5 * PARAMETERS * np.log(window) + np.log(np.maximum(1.0, places[-1] / window))
    long_enough = np.minimum(window, places[-1] - places[0])
    lasting = places[found.row[path[-1]]] - places[found.row[path[0]]] + 2.0 * step >= long_enough
    return bool((sure & worth & lasting).any())
