"""Options that all estimators on the delay regression share, and what they mean at a sampling interval."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import OptionError
from ctid_cli.frequency.checks import require_bounds
from ctid_cli.frequency.consistency import second_lag
from ctid_cli.frequency.prefilter import impulse_response
from ctid_cli.frequency.regression import MOST_TONES, delay_table, whole_delay
from ctid_cli.frequency.tracking import OnlineEstimator
from ctid_cli.signals.checks import require_integer, require_not_negative, require_positive

#: A delay that rounding to whole sampling intervals changes by a larger fraction is worth a note.
NOTEWORTHY_ROUNDING = 0.01


@dataclass(frozen=True)
class DelayClock:
    """The delay regression at a sampling interval."""

    lag: int
    second_lag: int
    #: The same [s].
    delay: float
    second_delay: float
    #: Cosines of the lowest and of the highest frequency times h [-].
    top: float
    bottom: float
    #: Coefficients of the regression, shape (n + 1, 2 n + 1).
    table: Array
    #: Impulse response of the prefilter, shape (L + 1,).
    weights: Array
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class DelayRegression(OnlineEstimator):
    """Options of an estimator on the delay regression."""

    tones: int
    h: float
    prefilter: float = 0.0
    difference: float = 0.0
    lowest_frequency: float = 0.0
    highest_frequency: float | None = None

    def __post_init__(self) -> None:
        require_integer("tones", self.tones, 1, MOST_TONES)
        require_positive("h", self.h, "s")
        require_not_negative("prefilter", self.prefilter, "s")
        require_not_negative("difference", self.difference, "s")
        require_not_negative("lowest_frequency", self.lowest_frequency, "rad/s")
        if self.highest_frequency is not None:
            require_positive("highest_frequency", self.highest_frequency, "rad/s")
        self._check_bounds(self.h)

    def clock(self, interval: float) -> DelayClock:
        """The regression at a sampling interval."""
        lag = whole_delay("h", self.h, interval)
        delay = lag * interval
        highest = self._check_bounds(delay)
        notes = []
        if abs(delay - self.h) > NOTEWORTHY_ROUNDING * self.h:
            notes.append(
                f"h = {self.h:g} s is no whole number of sampling intervals of {interval:g} s; {delay:g} s is used."
            )
        if self.prefilter > 0:
            whole_delay("prefilter", self.prefilter, interval)
        if self.difference > 0:
            whole_delay("difference", self.difference, interval)
        second = second_lag(lag)
        return DelayClock(
            lag,
            second,
            delay,
            second * interval,
            float(np.cos(self.lowest_frequency * delay)),
            float(np.cos(highest * delay)),
            delay_table(self.tones).astype(float),
            impulse_response(self.prefilter, self.difference, interval),
            tuple(notes),
        )

    def _check_bounds(self, delay: float) -> float:
        """Upper bound of the frequencies at a delay [s], if the bounds make sense."""
        unique = np.pi / delay
        highest = unique if self.highest_frequency is None else float(self.highest_frequency)
        if highest > unique * (1.0 + 1e-12):
            raise OptionError(
                "h",
                f"with h = {delay:g} s, frequencies above pi/h = {unique:g} rad/s are seen as lower ones, but "
                f"highest_frequency is {highest:g} rad/s; use an h below {np.pi / highest:g} s.",
            )
        require_bounds(self.lowest_frequency, highest)
        return min(highest, unique)
