"""Frequencies from an adaptive observer: a comparator, derived, not the published algorithm."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import OptionError
from ctid_cli.frequency.frequency_kernels import Adaptation, Observer, advance_observer
from ctid_cli.frequency.inputs import samples_in
from ctid_cli.frequency.tracking import OnlineEstimator, Recursion
from ctid_cli.signals.checks import require_not_negative, require_positive


@dataclass(frozen=True, kw_only=True)
class AdaptiveObserver(OnlineEstimator):
    r"""Frequencies by prediction errors of an observer that adapts them; derived, not the published algorithm.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.
    initial_frequencies : tuple of float
        Frequencies to begin with [rad/s], ascending and at least ``smallest_gap`` apart.
    pole : float, default 2.0
        Slowest rate of the observer [rad/s], near the frequencies.
    ratio : float, default 1.2
        Ratio of one rate to the next [-], 1 or more.
    rate : float, default 0.3
        Rate of the adaptation [1/s].
    hold : float, default 2.0
        No adaptation before this time [s].
    smallest_gap : float, default 0.3
        Frequencies are kept this far apart [rad/s].
    lowest_frequency : float, default 0.2
        Lower bound of the frequencies [rad/s].
    highest_frequency : float, default 8.0
        Upper bound of the frequencies [rad/s].

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    Derived, not the published algorithm: an adaptive observer with direct estimates of the squared frequencies is known
    from the literature, but this adaptation law is our own.

    The state holds each tone and its derivative. With ``e = y - sum s_i``, ``s_i' = v_i + l_i1 e``,
    ``v_i' = -w_i^2 s_i + l_i2 e``; the gains put the observer's poles at ``-pole ratio^k``, k = 0 ... 2n - 1, for the
    present frequencies. The sensitivities of the prediction error to the squared frequencies are integrated beside it
    (Runge-Kutta, signal linear between samples) and drive recursive Gauss-Newton steps with exponential forgetting.
    Convergence is local.
    """

    kind: ClassVar[str] = "adaptive_observer"

    initial_frequencies: tuple[float, ...]
    pole: float = 2.0
    ratio: float = 1.2
    rate: float = 0.3
    hold: float = 2.0
    smallest_gap: float = 0.3
    lowest_frequency: float = 0.2
    highest_frequency: float = 8.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("pole", "smallest_gap", "lowest_frequency", "highest_frequency"):
            require_positive(name, getattr(self, name), "rad/s")
        require_positive("ratio", self.ratio, "-")
        require_positive("rate", self.rate, "1/s")
        require_not_negative("hold", self.hold, "s")
        if self.ratio < 1.0:
            raise OptionError("ratio", f"ratio must be 1 or more, not {self.ratio!r}.")
        if self.highest_frequency < self.lowest_frequency + (self.tones - 1) * self.smallest_gap:
            bounds = f"between {self.lowest_frequency:g} and {self.highest_frequency:g} rad/s"
            apart = f"{self.tones} frequencies, {self.smallest_gap:g} rad/s apart,"
            raise OptionError("highest_frequency", f"{apart} do not fit {bounds}.")
        self._keep_one_for_each("initial_frequencies", "rad/s")
        edges = np.concatenate(([self.lowest_frequency - self.smallest_gap], self.initial_frequencies))
        if (np.diff(edges) < self.smallest_gap - 1e-12).any() or edges[-1] > self.highest_frequency:
            rising = "must rise from lowest_frequency to highest_frequency in steps of at least smallest_gap"
            raise OptionError("initial_frequencies", f"initial_frequencies {rising}, not {self.initial_frequencies!r}.")

    def _recursion(self, interval: float) -> Recursion:
        n = self.tones
        poles: Array = self.pole * self.ratio ** np.arange(2 * n, dtype=float)
        if poles[-1] * interval > 1.0:
            fastest = f"the fastest pole of the observer, {poles[-1]:g} rad/s,"
            raise OptionError("pole", f"{fastest} needs a sampling interval below {1.0 / poles[-1]:g} s.")
        if self.rate * interval >= 1.0:
            needed = f"a sampling interval below {1.0 / self.rate:g} s"
            raise OptionError("rate", f"rate = {self.rate:g} 1/s needs {needed}.")
        limits = (float(self.smallest_gap), float(self.lowest_frequency), float(self.highest_frequency))
        settings = Adaptation(interval, poles, float(self.rate), samples_in(self.hold, interval), *limits)
        initial = np.asarray(self.initial_frequencies, dtype=float)
        states, moments = np.zeros((n + 1, 2 * n)), np.zeros((n + 1, n + 1))
        state = Observer(initial**2, states, moments, np.full(1, np.nan), initial, np.zeros(1, np.int64))
        return Recursion(advance_observer, (settings,), (state,))
