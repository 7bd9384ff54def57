"""Options of the estimators on the mixed regressions of dynamic regressor extension and mixing (DREM)."""

from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.frequency.delay_options import DelayRegression
from ctid_cli.frequency.frequency_kernels import (
    DelayClock,
    Front,
    Gains,
    Gradient,
    Mixing,
    Output,
    SlidingWindow,
    advance_mixed,
)
from ctid_cli.frequency.regression import minor_plan, whole_delay
from ctid_cli.frequency.tracking import Recursion
from ctid_cli.signals.checks import require_integer, require_positive

#: Samples since an event that never happened.
LONG_AGO = 1 << 50
# The compiled loop knows both back ends; these stand for the one that is not used.
NO_GAINS = Gains(np.empty(0), np.empty(0), False, 0, 0.0)
NO_GRADIENT = Gradient(np.empty((0, 0)), np.empty(0))
NO_WINDOW = SlidingWindow(np.empty((0, 0)), np.empty(0), np.empty(0), np.empty(0, np.int64))


@dataclass(frozen=True, kw_only=True)
class MixingOptions(DelayRegression):
    """Options of an estimator on the mixed regressions."""

    d: float
    first_row: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("d", self.d, "s")
        require_integer("first_row", self.first_row, 0, 1000)

    def _mixed(
        self,
        clock: DelayClock,
        back: Gradient | SlidingWindow,
        theta: Array,
        *,
        gains: Gains = NO_GAINS,
        normalisation: float = 1.0,
        past: float = np.nan,
        most_rows: int = LONG_AGO,
    ) -> Recursion:
        """The recursion of a back end, given its state, the first theta and its settings."""
        n, interval = self.tones, clock.interval
        spacing = whole_delay("d", self.d, interval)
        enough = min(self._rows_before_valid(clock), most_rows)
        samples = np.full(2 * n * clock.lag + 1, past)
        rows = np.full(((self.first_row + n - 1) * spacing + 1, n + 1), past)
        check, counters, doubts = np.zeros((n + 1, n + 1)), np.zeros(3, np.int64), np.array([0, 0, LONG_AGO], np.int64)
        front = Front(samples, rows, theta.copy(), check, counters, doubts, np.zeros(4), np.full(n, np.nan))
        windowed = isinstance(back, SlidingWindow)
        advance = _advance_window if windowed else _advance_gradient
        settings = (clock, Mixing(minor_plan(n), self.first_row, spacing, normalisation, enough, windowed), gains)
        return Recursion(advance, settings, (front, back), self._weights(interval), past, self._notes(clock))


def _advance_gradient(
    samples: Array, output: Output, clock: DelayClock, mixing: Mixing, gains: Gains, front: Front, back: Gradient
) -> None:
    """Advance by gradient steps."""
    advance_mixed(samples, output, clock, mixing, gains, front, back, NO_WINDOW)


def _advance_window(
    samples: Array, output: Output, clock: DelayClock, mixing: Mixing, gains: Gains, front: Front, back: SlidingWindow
) -> None:
    """Advance by least squares over a window."""
    advance_mixed(samples, output, clock, mixing, gains, front, NO_GRADIENT, back)
