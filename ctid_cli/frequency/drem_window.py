"""Frequencies from the mixed regressions (DREM) of a sliding window: finite time after every change of the signal."""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, IntArray
from ctid_cli.frequency.mixing import MIXING_ROUNDING, MixingOptions, back_end
from ctid_cli.frequency.regression import whole_delay
from ctid_cli.frequency.tracking import Recursion

#: A scatter of the scalar regressions below this fraction of their square is rounding.
SCATTER_ROUNDING = 1e-14


class Window(NamedTuple):
    """State of the sliding sums; an entry is ``[Delta Psi, Psi^2, Delta^2, rounding^2, 1]``, of the size 2 n + 3."""

    #: Entries after the place of the next one, each summed with all that follow it; before the place, plain ones.
    entries: Array
    #: Sum of the plain entries.
    newer: Array
    #: Sum of the window.
    sums: Array
    place: IntArray


@dataclass(frozen=True, kw_only=True)
class DremWindow(MixingOptions):
    r"""Frequencies by least squares on each mixed regression over a sliding window.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.
    h : float
        Delay of the regression [s], below pi over the highest frequency; rounded to whole sampling intervals.
    d : float
        Distance of the stacked rows [s]; rounded to whole sampling intervals.
    memory : float
        Length of the window [s]; rounded to whole sampling intervals.
    first_row : int, default 1
        Number of the first stacked row; 1 as published, 0 is exact one d earlier.
    prefilter : float, default 0.0
        Length of a Hann low-pass in front of the regression [s]; 0 for none.
    difference : float, default 0.0
        If positive, the signal this much earlier is subtracted [s], which removes a constant bias.
    lowest_frequency : float, default 0.0
        Lower bound of the frequencies [rad/s].
    highest_frequency : float, optional
        Upper bound of the frequencies [rad/s]; by default pi/h, beyond which they cannot be told apart.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    ``theta_k(t) = sum Delta Psi_k / sum Delta^2`` over the last ``memory`` seconds. It is the limit for small gains of
    ``(theta_k(t) - theta_k(t - T) W)/(1 - W)``, ``W = exp(-gamma int_(t-T)^t Delta^2)``, the finite-time estimate that
    starts anew at every instant; there is no gain to choose. Exact, without noise, from
    ``2 n h + (first_row + n - 1) d`` on, and again that much and one ``memory`` after a change. The sums are those of
    the samples in the window alone: a block of old samples is summed backwards once, and the newer ones forwards, so no
    rounding error accumulates.

    References
    ----------
    R. Ortega, S. Aranovskiy, A. Pyrkin, A. Astolfi and A. Bobtsov, "New results on parameter estimation via dynamic
    regressor extension and mixing: continuous and discrete-time cases", *IEEE Trans. Automatic Control* 66 (2021)
    2265-2272. doi:10.1109/TAC.2020.3003651
    """

    kind: ClassVar[str] = "drem_window"

    memory: float

    def _recursion(self, interval: float) -> Recursion:
        n, clock = self.tones, self._clock(interval)
        length = whole_delay("memory", self.memory, interval)
        self._require_samples(self.memory, length, interval)
        size = 2 * n + 3
        back = Window(np.zeros((length, size)), np.zeros(size), np.zeros(size), np.zeros(1, np.int64))
        return self._mixed(clock, back, np.full(n, np.nan), most_rows=length)


@njit(cache=True, nogil=True, forceinline=True)
def slide(window: Array, newer: Array, place: int, sums: Array) -> int:
    """Sum a sliding window after a new entry at ``place``; the place of the next entry.

    Nothing is ever subtracted, so no rounding error of an entry outlives it.
    """
    length, width = window.shape
    for i in range(width):
        newer[i] += window[place, i]
        sums[i] = newer[i]
    if place + 1 < length:
        # The next place holds the sum of all older entries that are still in the window.
        for i in range(width):
            sums[i] += window[place + 1, i]
        return place + 1
    # The window is full of plain entries: sum them backwards, and begin anew.
    for j in range(length - 2, -1, -1):
        for i in range(width):
            window[j, i] += window[j + 1, i]
    newer[:] = 0.0
    return 0


@njit(cache=True, nogil=True)
def absorb_window(
    scale: float, count: int, tuning: None, back: Window, theta: Array, mixed: Array
) -> tuple[float, float]:
    """Least squares on each scalar regression, ``theta_k = sum Delta Psi_k/sum Delta^2`` over the window."""
    n = theta.size
    entries, newer, sums, place = back
    here = place[0]
    if np.isnan(scale):
        for i in range(sums.size):
            entries[here, i] = 0.0
    else:
        # [Delta Psi, Psi^2, Delta^2, rounding^2, 1]; a missing sample leaves a zero entry, which weighs nothing.
        for i in range(n):
            entries[here, i] = mixed[n] * mixed[i]
            entries[here, n + i] = mixed[i] * mixed[i]
        entries[here, 2 * n] = mixed[n] * mixed[n]
        entries[here, 2 * n + 1] = (MIXING_ROUNDING * scale) ** 2
        entries[here, 2 * n + 2] = 1.0
    place[0] = slide(entries, newer, here, sums)
    # While Delta vanishes there is no estimate, not an old one: the window has forgotten it.
    for i in range(n):
        theta[i] = sums[i] / sums[2 * n] if sums[2 * n] > 0.0 else np.nan
    return sums[2 * n], sums[2 * n + 2]


@njit(cache=True, nogil=True)
def weigh_window(tuning: None, back: Window, theta: Array, errors: Array) -> tuple[float, float]:
    """Scatter of the scalar regressions of the window, rounding of Delta relative to Delta, rows in the window."""
    n, sums = theta.size, back.sums
    for i in range(n):
        # Mean of (Psi - Delta theta)^2 over that of Delta^2; as a difference it is known up to rounding only.
        square = sums[n + i] / sums[2 * n]
        scatter = square - theta[i] * theta[i]
        errors[i] = np.sqrt(scatter) if scatter > SCATTER_ROUNDING * square else 0.0
    return np.sqrt(sums[2 * n + 1] / sums[2 * n]), sums[2 * n + 2]


back_end(Window, absorb_window, weigh_window)
