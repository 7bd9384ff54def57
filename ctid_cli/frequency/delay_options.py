"""Options that all estimators on the delay regression share, and what they mean at a sampling interval."""

from dataclasses import dataclass
from math import gcd

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import OptionError
from ctid_cli.frequency.frequency_kernels import DelayClock
from ctid_cli.frequency.inputs import require_bounds
from ctid_cli.frequency.prefilter import impulse_response
from ctid_cli.frequency.regression import delay_table, whole_delay
from ctid_cli.frequency.tracking import OnlineEstimator
from ctid_cli.signals.checks import require_not_negative, require_positive

#: The second delay is near this fraction of the first, as far from every simple ratio as can be.
GOLDEN_FRACTION = (np.sqrt(5.0) - 1.0) / 2.0
#: A number without a common divisor lies within this distance of any place, for all delays that are allowed.
SEARCHED = 100
#: Verdicts are given, and rows at the second delay looked at, so many times in a delay h, but at most so many samples
#: apart.
VERDICTS_PER_DELAY = 64
MOST_BETWEEN = 8
#: A delay that rounding to whole sampling intervals changes by a larger fraction is worth a note.
NOTEWORTHY_ROUNDING = 0.01
#: An estimate is valid after this many rows for each tone, and after this fraction of n h: before, the rows are too few
#: or too much alike to show that they disagree.
ROWS_PER_TONE = 4
STARTING_SPAN = 0.25


@dataclass(frozen=True, kw_only=True)
class DelayRegression(OnlineEstimator):
    """Options of an estimator on the delay regression."""

    h: float
    prefilter: float = 0.0
    difference: float = 0.0
    lowest_frequency: float = 0.0
    highest_frequency: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("h", self.h, "s")
        require_not_negative("prefilter", self.prefilter, "s")
        require_not_negative("difference", self.difference, "s")
        require_bounds(self.lowest_frequency, self.highest_frequency)
        self._highest(self.h)

    def _clock(self, interval: float) -> DelayClock:
        """The regression at a sampling interval."""
        lag = whole_delay("h", self.h, interval)
        delay, second = lag * interval, second_lag(lag)
        every = max(1, min(lag // VERDICTS_PER_DELAY, MOST_BETWEEN))
        return DelayClock(
            delay_table(self.tones),
            float(interval),
            lag,
            delay,
            second,
            second * interval,
            float(np.cos(self._highest(delay) * delay)),
            float(np.cos(self.lowest_frequency * delay)),
            every,
        )

    def _weights(self, interval: float) -> Array:
        """Impulse response of the prefilter, shape (L + 1,)."""
        for name in ("prefilter", "difference"):
            if getattr(self, name) > 0:
                whole_delay(name, getattr(self, name), interval)
        return impulse_response(self.prefilter, self.difference, interval)

    def _notes(self, clock: DelayClock) -> tuple[str, ...]:
        """What the sampling interval makes of the delay."""
        if abs(clock.delay - self.h) <= NOTEWORTHY_ROUNDING * self.h:
            return ()
        whole = f"no whole number of sampling intervals of {clock.interval:g} s"
        return (f"h = {self.h:g} s is {whole}; {clock.delay:g} s is used.",)

    def _require_samples(self, memory: float, samples: float, interval: float) -> None:
        """Refuse a memory [s] of fewer samples than an estimate needs."""
        needed = ROWS_PER_TONE * self.tones
        if samples < needed:
            few = f"{samples:.3g} samples of {interval:g} s, fewer than the {needed} that {self.tones} tones need."
            raise OptionError("memory", f"memory = {memory:g} s holds {few}")

    def _rows_before_valid(self, clock: DelayClock) -> int:
        """Rows that must have arrived before an estimate can be valid."""
        return max(ROWS_PER_TONE * self.tones, int(STARTING_SPAN * self.tones * clock.lag))

    def _highest(self, delay: float) -> float:
        """Upper bound of the frequencies at a delay [s], if the bounds make sense."""
        unique = np.pi / delay
        highest = unique if self.highest_frequency is None else float(self.highest_frequency)
        if highest > unique * (1.0 + 1e-12):
            seen = f"frequencies above pi/h = {unique:g} rad/s are seen as lower ones"
            asked = f"highest_frequency is {highest:g} rad/s; use an h below {np.pi / highest:g} s."
            raise OptionError("h", f"with h = {delay:g} s, {seen}, but {asked}")
        require_bounds(self.lowest_frequency, highest)
        return min(highest, unique)


def second_lag(lag: int) -> int:
    """Second delay for a given first one."""
    if lag == 1:
        return 0
    wanted = GOLDEN_FRACTION * lag
    near = range(max(1, round(wanted) - SEARCHED), min(lag, round(wanted) + SEARCHED + 1))
    return min((m for m in near if gcd(m, lag) == 1), key=lambda m: abs(m - wanted))
