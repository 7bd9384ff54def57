"""Quantiles, estimates with their intervals, and the interval of the delay from the profile of the cost."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from ctid_cli.arrays import Array


def normal_quantile(level: float = 0.95) -> float:
    """Half the width of a two-sided interval of that probability [standard errors]."""
    return NormalDist().inv_cdf(0.5 + level / 2)


def student_quantile(degrees_of_freedom: float, level: float = 0.95) -> float:
    """The same where the standard error itself is known only as well as these degrees of freedom tell."""
    from scipy.special import stdtrit

    return float(stdtrit(degrees_of_freedom, 0.5 + level / 2))


def robust_deviation(x: Array) -> float:
    """Standard deviation from the median size of values about zero, which outliers hardly change."""
    return 1.4826 * float(np.median(np.abs(x)))


#: Standard errors to each side of a normal estimate.
NORMAL = normal_quantile()
#: Why a fit that ignores the loop of its record has no standard errors.
BIASED = (
    "There are no standard errors: the input answers to the output through a loop that this fit ignores, and the "
    "residuals are coloured, so that the estimate is biased."
)


@dataclass(frozen=True)
class UncertainValue:
    """An estimate with its accuracy, all in its unit; NaN stands for what is not defined."""

    name: str
    estimate: float
    standard_error: float = math.nan
    #: Confidence interval.
    low: float = math.nan
    high: float = math.nan
    unit: str = ""
    #: Of a parameter: free, fixed, at bound or undetermined.
    status: str = "free"
    #: Why there is no standard error.
    reason: str = ""

    @classmethod
    def symmetric(
        cls,
        name: str,
        estimate: float,
        standard_error: float,
        unit: str = "",
        quantile: float = NORMAL,
        reason: str = "",
    ) -> UncertainValue:
        """An interval of ``estimate -+ quantile`` standard errors."""
        reach = quantile * standard_error
        return cls(name, estimate, standard_error, estimate - reach, estimate + reach, unit, reason=reason)

    @property
    def relative_percent(self) -> float:
        """Standard error relative to the estimate [%]."""
        return 100 * self.standard_error / abs(self.estimate) if self.estimate else math.nan


#: The rise of the cost two standard errors away is called quadratic if its square root is right to this share.
QUADRATIC_TOLERANCE = 0.1


@dataclass(frozen=True)
class DelayInterval:
    """Delays that the data do not reject."""

    #: Ends [s].
    low: float
    high: float
    open_low: bool
    open_high: bool


@dataclass(frozen=True)
class CostOfDelay:
    r"""The least squared error as a function of the delay, about an estimate."""

    squared_error_at: Callable[[float], float]
    #: The delay of least squared error [s], and that [output unit^2].
    estimate: float
    squared_error: float
    count: int
    parameters: int
    bounds: tuple[float, float]
    #: By what factor coloured noise raises the variance of the delay [-].
    inflation: float = 1.0

    def interval(self, quantile: float) -> DelayInterval:
        r"""Interval of delays around the estimate whose best fits are not significantly worse.

        The delays with

        .. math:: S(\tau) \le S_{\min} \Big(1 + \frac{c \, t^2}{N - p}\Big),

        c the inflation and t the quantile [standard errors]: with that of Student's t for ``N - p`` degrees of freedom
        the F version of ``N ln(S/S_min) <= chi2_1(level)``, which it becomes for large N. Where S is a parabola, this
        is the interval ``estimate +- t se`` exactly. Each end is bracketed by steps that grow from a
        small one outward, then found by Brent's method to 1e-6 of its distance from the estimate. A second basin
        further away is not looked for.
        """
        allowed = self.allowed(quantile)
        if not np.isfinite(allowed) or not self.squared_error >= 0:
            return DelayInterval(float("nan"), float("nan"), False, False)

        def excess(delay: float) -> float:
            value = self.squared_error_at(delay)
            if not np.isfinite(value):
                return 1.0
            if self.squared_error == 0:
                return 1.0 if value > 0 else -1.0
            # The root is linear in the delay where the cost is quadratic: Brent's method then needs a step or two.
            return float(np.sqrt(max(value / self.squared_error - 1.0, 0.0) / allowed)) - 1.0

        low, at_low = _crossing(excess, self.estimate, self.bounds[0])
        high, at_high = _crossing(excess, self.estimate, self.bounds[1])
        return DelayInterval(low, high, at_low, at_high)

    def allowed(self, quantile: float) -> float:
        """By what share the squared error may rise within the interval; NaN where nothing is spare."""
        freedom = self.count - self.parameters
        return self.inflation * quantile**2 / freedom if freedom > 0 else float("nan")

    def quadratic_is_doubtful(self, standard_error: float) -> bool:
        r"""Whether the interval ``estimate +- z se`` of the delay should not be trusted.

        A quadratic profile rises by ``c (2 se)^2 s^2 / se^2 = 4 c s^2`` at ``estimate +- 2 se``, ``s^2 = S_min / (N -
        p)``, c the inflation. The interval is doubtful if the square root of the actual rise, which is the length of
        the interval, differs from that by more than 10 % on either side: a 95 % interval would cover below 93 % or
        above 97 %.
        """
        if self.count <= self.parameters or not (0 < standard_error < np.inf and self.inflation > 0):
            return True
        expected = 4.0 * self.inflation * self.squared_error / (self.count - self.parameters)
        for delay in (self.estimate - 2 * standard_error, self.estimate + 2 * standard_error):
            if not self.bounds[0] <= delay <= self.bounds[1]:
                return True
            rise = self.squared_error_at(delay) - self.squared_error
            if not (rise > 0 and expected > 0 and abs(np.sqrt(rise / expected) - 1.0) <= QUADRATIC_TOLERANCE):
                return True
        return False


def _crossing(excess: Callable[[float], float], start: float, bound: float) -> tuple[float, bool]:
    """First point from the start towards the bound at which the excess becomes positive, or the bound and True."""
    from scipy.optimize import brentq  # slow to import

    room = bound - start
    if room == 0:
        return bound, True
    step = 1e-3
    while excess(start + step * room) > 0:
        step /= 4.0
        if abs(step * room) <= 1e-12 * max(abs(start), abs(room)):
            return start, False
    inside = step
    while inside < 1.0:
        outside = min(1.6 * inside, 1.0)
        if excess(start + outside * room) > 0:
            share = float(brentq(lambda s: excess(start + s * room), inside, outside, xtol=1e-6 * inside, rtol=1e-6))
            return start + share * room, False
        inside = outside
    return bound, True
