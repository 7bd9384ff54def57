"""Quantiles, estimates with their intervals, and the interval of the delay from the profile of the cost."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np

from ctid_cli.arrays import Array


def normal_quantile(level: float = 0.95) -> float:
    """Return the half-width of a two-sided normal interval of given probability [standard errors]."""
    return NormalDist().inv_cdf(0.5 + level / 2)


def student_quantiles(degrees_of_freedom: Array, level: float = 0.95) -> Array:
    """Return the half-widths of two-sided intervals of Student's t distribution [standard errors]."""
    from scipy.special import stdtrit

    known = np.isinf(degrees_of_freedom)
    return np.where(known, normal_quantile(level), stdtrit(np.where(known, 1.0, degrees_of_freedom), 0.5 + level / 2))


def student_quantile(degrees_of_freedom: float, level: float = 0.95) -> float:
    """Return the half-width of a two-sided interval of Student's t distribution [standard errors]."""
    return float(student_quantiles(np.array([degrees_of_freedom]), level)[0])


def robust_deviation(x: Array) -> float:
    """Return a robust standard deviation from the median absolute value."""
    return 1.4826 * float(np.median(np.abs(x)))


#: Half-width of a 95 % interval of a normal estimate [standard errors].
NORMAL = normal_quantile()
#: Mark of a quantity that the record does not determine.
NOT_DETERMINED = "Not determined"
#: Reason why a fit that ignores the loop of its record has no standard errors.
BIASED = (
    "There are no standard errors: the input responds to the output through a loop that this fit ignores, and the "
    "residuals are coloured, so that the estimate is biased."
)


@dataclass(frozen=True)
class UncertainValue:
    """An estimate with its accuracy, all in its unit; NaN if not defined."""

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
    #: Separate intervals, if there are several; ``low`` and ``high`` are then NaN.
    intervals: tuple[tuple[float, float], ...] = ()
    #: Values of an undetermined quantity that fit as well.
    alternatives: tuple[float, ...] = ()

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
        """Return an estimate with the interval ``estimate -+ quantile standard_error``."""
        reach = quantile * standard_error
        return cls(name, estimate, standard_error, estimate - reach, estimate + reach, unit, reason=reason)

    @property
    def in_logarithm(self) -> UncertainValue:
        """The estimate with an interval of the same probability for the logarithm of its size, so of one sign."""
        with np.errstate(all="ignore"):
            factor = float(np.exp((self.high - self.estimate) / np.abs(np.float64(self.estimate))))
        low, high = sorted((self.estimate / factor, self.estimate * factor))
        return replace(self, low=low, high=high)

    @property
    def shown(self) -> float:
        """The estimate; NaN if it is not determined, and therefore no result."""
        return math.nan if self.is_undetermined else self.estimate

    @property
    def is_undetermined(self) -> bool:
        """Whether the record does not determine it, so that its value is not a result."""
        return self.status == "undetermined"

    def undetermined(self, reason: str, alternatives: tuple[float, ...] = ()) -> UncertainValue:
        """Return it as not determined."""
        return replace(
            self,
            standard_error=math.nan,
            low=math.nan,
            high=math.nan,
            status="undetermined",
            reason=reason,
            alternatives=alternatives,
        )

    def with_intervals(self, intervals: tuple[tuple[float, float], ...]) -> UncertainValue:
        """Return it with other intervals; the standard error is scaled with the length of a single one."""
        if len(intervals) > 1:
            return replace(self, standard_error=math.nan, low=math.nan, high=math.nan, intervals=intervals)
        ((low, high),) = intervals
        half, length = 0.5 * (self.high - self.low), 0.5 * (high - low)
        error = self.standard_error * length / half if half > 0.0 else math.nan
        return replace(self, standard_error=error, low=low, high=high, intervals=())

    @property
    def relative_percent(self) -> float:
        """Standard error relative to the estimate [%]."""
        return 100 * self.standard_error / abs(self.estimate) if self.estimate else math.nan


#: Largest relative error of the square root of the cost rise at two standard errors for a quadratic profile.
QUADRATIC_TOLERANCE = 0.1


@dataclass(frozen=True)
class DelayInterval:
    """Confidence interval of the delay; open ends are at the bounds of the search."""

    #: Ends [s].
    low: float
    high: float
    open_low: bool
    open_high: bool


@dataclass(frozen=True)
class CostOfDelay:
    r"""Profile of the squared error over the delay near an estimate."""

    squared_error_at: Callable[[float], float]
    #: The delay of least squared error [s], and that [output unit^2].
    estimate: float
    squared_error: float
    count: int
    parameters: int
    bounds: tuple[float, float]
    #: Factor by which coloured noise increases the variance of the delay [-].
    inflation: float = 1.0

    def interval(self, quantile: float) -> DelayInterval:
        r"""Return the interval of delays around the estimate whose best fits are not significantly worse.

        The delays with

        .. math:: S(\tau) \le S_{\min} \Big(1 + \frac{c \, t^2}{N - p}\Big),

        c the inflation and t the quantile [standard errors]: with that of Student's t for ``N - p`` degrees of freedom
        the F version of ``N ln(S/S_min) <= chi2_1(level)``, which it becomes for large N. Where S is a parabola, this
        is the interval ``estimate +- t se`` exactly. Each end is bracketed by growing steps outward, then found by
        Brent's method to 1e-6 of its distance from the estimate. Separate regions further away are not searched.
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
            # The square root is linear in the delay for a quadratic cost: Brent's method then needs a step or two.
            return float(np.sqrt(max(value / self.squared_error - 1.0, 0.0) / allowed)) - 1.0

        low, at_low = _crossing(excess, self.estimate, self.bounds[0])
        high, at_high = _crossing(excess, self.estimate, self.bounds[1])
        return DelayInterval(low, high, at_low, at_high)

    def allowed(self, quantile: float) -> float:
        """Return the relative rise of the squared error at the ends of the interval; NaN without degrees of freedom."""
        freedom = self.count - self.parameters
        return self.inflation * quantile**2 / freedom if freedom > 0 else float("nan")

    def quadratic_is_doubtful(self, standard_error: float) -> bool:
        r"""Return whether the interval ``estimate +- z se`` of the delay is unreliable.

        A quadratic profile rises by ``c (2 se)^2 s^2 / se^2 = 4 c s^2`` at ``estimate +- 2 se``, ``s^2 = S_min / (N -
        p)``, c the inflation. The interval is unreliable if the square root of the actual rise, which determines its
        length, differs from that by more than 10 % on either side: a 95 % interval would cover below 93 % or above
        97 %.
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
    """Return the first point towards the bound at which the excess becomes positive, or the bound and True."""
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
