"""Tones with an identity: readings at many instants, followed from each to the next and put into columns."""

from dataclasses import dataclass, field

import numpy as np

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.frequency.tone_rows import Readings
from ctid_cli.frequency.tone_tests import MEDIAN_EFFICIENCY
from ctid_cli.frequency.whitening import FLOOR_BINS

#: A reading goes on with a tone if it is no more than so many standard errors, or bins of the shorter window, off.
GATE_ERRORS = 5.0
GATE_BINS = 1.0
#: A tone without readings for so many rows, or for one of its windows, has ended.
PATIENCE = 3
#: A tone that ends and one that begins later are the same if their frequencies differ by less than this share, and
#: nothing that is nearer can be either.
LARGEST_JUMP = 0.25
#: Cost of a pause, as a share of the frequency, if it lasts for the whole signal.
PAUSE = 0.25
#: What is never known better than to this share of its frequency is no tone.
COARSE = 0.01
#: A tone is one if what it explains of some window exceeds the description length of five numbers.
NUMBERS = 5


@dataclass
class Path:
    """Readings of one tone, ascending in time."""

    #: Which of the readings.
    readings: list[int] = field(default_factory=list)
    #: Row of the last one.
    last: int = 0


def paths_of(found: Readings, places: Array) -> list[IndexArray]:
    """The readings of each tone, the strongest tone first."""
    step = float(np.median(np.diff(places))) if places.size > 1 else 1.0
    paths = _joined(_followed(found, places, step), found, places.size)
    paths = [path for path in paths if _described(found, path, places, step)]
    # What lasts counts more than what is loud for a moment.
    return sorted(paths, key=lambda path: -float(found.amplitude[path].sum()))


def _followed(found: Readings, places: Array, step: float) -> list[IndexArray]:
    """Readings of adjacent rows, paired so that the least is left to explain."""
    ended: list[Path] = []
    open_: list[Path] = []
    bounds = np.searchsorted(found.row, np.arange(places.size + 1))
    for row in range(places.size):
        still = [p for p in open_ if row - p.last <= max(PATIENCE, found.window[p.readings[-1]] / step)]
        ended += [p for p in open_ if p not in still]
        open_ = still
        here = np.arange(bounds[row], bounds[row + 1])
        if not here.size:
            continue
        free = np.ones(here.size, np.bool_)
        if open_:
            before = np.array([p.readings[-1] for p in open_])
            cost = _misfit(found, before, here, places)
            for old, new in _paired(cost):
                open_[old].readings.append(int(here[new]))
                open_[old].last = row
                free[new] = False
        open_ += [Path([int(k)], row) for k in here[free]]
    return [np.array(p.readings) for p in ended + open_]


def _paired(cost: Array) -> list[tuple[int, int]]:
    """Pairs of the least sum of costs, of those below 1."""
    able = cost < 1.0
    if able.sum(axis=0).max() > 1 or able.sum(axis=1).max() > 1:
        from scipy.optimize import linear_sum_assignment  # slow to import, and needed only where there is a choice

        chosen = np.zeros_like(able)
        chosen[linear_sum_assignment(np.minimum(cost, 1.0))] = True
        able &= chosen
    return [(int(old), int(new)) for old, new in np.argwhere(able)]


def _misfit(found: Readings, before: IndexArray, here: IndexArray, places: Array) -> Array:
    """How far readings are off what tones would be by now, as a share of what is allowed, shape (tones, readings)."""
    passed = places[found.row[here]][None, :] - places[found.row[before]][:, None]
    moved = 0.5 * (found.rate[before][:, None] + found.rate[here][None, :]) * passed
    off = np.abs(found.omega[here][None, :] - found.omega[before][:, None] - moved)
    bin_ = 2.0 * np.pi / np.minimum(found.window[before][:, None], found.window[here][None, :])
    errors = np.hypot(found.error[before][:, None], found.error[here][None, :])
    return np.asarray(off / np.maximum(GATE_BINS * bin_, GATE_ERRORS * errors))


def _joined(paths: list[IndexArray], found: Readings, rows: int) -> list[IndexArray]:
    """Paths with the pieces of one tone put together: the nearest pieces first."""
    ends = np.array([(found.row[p[0]], found.row[p[-1]]) for p in paths]).reshape(-1, 2)
    omega = np.array([(found.omega[p[0]], found.omega[p[-1]]) for p in paths]).reshape(-1, 2)
    pause = ends[None, :, 0] - ends[:, None, 1]
    jump = np.abs(omega[None, :, 0] / omega[:, None, 1] - 1.0)
    cost = np.where(pause > 0, jump + PAUSE * pause / rows, np.inf)
    after: dict[int, int] = {}
    taken: set[int] = set()
    for pair in np.argsort(cost, axis=None):
        a, b = divmod(int(pair), len(paths))
        if not cost[a, b] < LARGEST_JUMP:
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
    """Whether a tone lasts for one of its windows, and is worth its numbers and the saying in which window it is.

    That is the minimum description length of a tone of a signal.
    """
    sure = found.resolved[path] & found.significant[path] & (found.error[path] < COARSE * found.omega[path])
    window = found.window[path]
    # The noise beneath a line is uncertain too, as it is for the test that finds lines.
    known = MEDIAN_EFFICIENCY * np.minimum(FLOOR_BINS, 0.5 * window)
    gain = known * np.log1p(0.5 * (found.amplitude[path] / found.amplitude_error[path]) ** 2 / known)
    worth = gain > 0.5 * NUMBERS * np.log(window) + np.log(np.maximum(1.0, places[-1] / window))
    long_enough = np.minimum(window, places[-1] - places[0])
    lasting = places[found.row[path[-1]]] - places[found.row[path[0]]] + 2.0 * step >= long_enough
    return bool((sure & worth & lasting).any())
