"""A number that was estimated, and how far it may be off."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ctid_cli.inference.quantile import normal_quantile

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
        """An interval that reaches so many standard errors to both sides."""
        reach = quantile * standard_error
        return cls(name, estimate, standard_error, estimate - reach, estimate + reach, unit, reason=reason)

    @property
    def relative_percent(self) -> float:
        """Standard error relative to the estimate [%]."""
        return 100 * self.standard_error / abs(self.estimate) if self.estimate else math.nan
