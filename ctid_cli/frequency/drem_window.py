"""Frequencies from the mixed regressions (DREM) of a sliding window: finite time after every change of the signal."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctid_cli.frequency.frequency_kernels import SlidingWindow
from ctid_cli.frequency.mixing import MixingOptions
from ctid_cli.frequency.regression import whole_delay
from ctid_cli.frequency.tracking import Recursion


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
        back = SlidingWindow(np.zeros((length, size)), np.zeros(size), np.zeros(size), np.zeros(1, np.int64))
        return self._mixed(clock, back, np.full(n, np.nan), most_rows=length)
