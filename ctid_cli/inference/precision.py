"""When a simulation study has enough data sets: a sequential rule in place of their number.

Data sets come in blocks. At the end of each the 95 % intervals of all measures of all estimators are looked at, and the
data cell has enough data sets once none is wider than asked for. Looking again and again favours samples that seem
more precise than they are, so that an interval at the end holds the truth a little less often than one from a number of
data sets fixed before (Y. S. Chow and H. Robbins, On the asymptotic theory of fixed-width sequential confidence
intervals for the mean, Annals of Mathematical Statistics 36 (1965) 457-462). Blocks that grow keep the looks few, and
the first one is large enough for the widths themselves to be known: of percentages up to 98 and of nearly normal
errors the intervals hold the truth in 93 % of the cases or more, without a correction (docs/measures.md).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.inference.monte_carlo import QUANTILE, Sample, complete, root_mean_square, wilson_interval

#: Data sets of the first block.
AT_LEAST = 200
#: From the end of one block to that of the next: data sets come in steps of a quarter of those that are there.
GROWTH = 1.25


@dataclass(frozen=True)
class Until:
    """Largest half-widths of 95 % intervals that are asked for; None where it does not matter."""

    #: Of percentages [percentage points].
    percent_half_width: float | None = None
    #: Of root mean square errors, as a fraction of them [-].
    rmse_relative: float | None = None


class Replications(NamedTuple):
    """What an estimator gave on the first data sets of a data cell, in their order."""

    #: Which meet the success rule, shape (R,); None without a rule.
    hits: BoolArray | None
    #: Errors of the parameters; NaN where there is no value, shape (R, p).
    errors: Array

    def first(self, count: int) -> "Replications":
        """The same on fewer data sets."""
        return Replications(None if self.hits is None else self.hits[:count], self.errors[:count])


class HalfWidth(NamedTuple):
    """How well a measure is known."""

    #: Which of the estimators.
    estimator: int
    #: Column of the errors; None for the percentage.
    parameter: int | None
    #: Half-width of its 95 % interval, [percentage points] or [-]; None where the data sets do not tell.
    value: float | None
    #: The largest that is asked for.
    asked: float

    @property
    def excess(self) -> float:
        """Half-width over what is asked for; at most 1 where it is narrow enough."""
        return math.inf if self.value is None else self.value / self.asked


@dataclass(frozen=True)
class Decision:
    """Whether the data sets of a data cell are enough."""

    #: ``enough``; ``open``, more are needed; ``at_most``, as many as are allowed and not precise enough.
    state: Literal["enough", "open", "at_most"]
    #: End of the last finished block, and of the block that is needed.
    finished: int
    needed: int
    #: The widest interval at the end of the last finished block; None where there is none.
    widest: HalfWidth | None


def block_ends(at_most: int) -> Iterator[int]:
    """Numbers of data sets after which the intervals are looked at; they depend on nothing that was computed."""
    end = AT_LEAST
    while end < at_most:
        yield end
        end = math.ceil(GROWTH * end)
    yield at_most


def decide(until: Until, estimators: Sequence[Replications], at_most: int) -> Decision:
    """Look at the intervals at the end of each block, up to the first one that leaves none too wide."""
    stored = min(len(one.errors) for one in estimators)
    finished, widest = 0, None
    for end in block_ends(at_most):
        if stored < end:
            return Decision("open", finished, end, widest)
        finished = end
        widths = [
            HalfWidth(k, *width) for k, one in enumerate(estimators) for width in _half_widths(until, one.first(end))
        ]
        widest = max(widths, key=lambda width: width.excess, default=None)
        if widest is None or widest.excess <= 1.0:
            return Decision("enough", end, end, widest)
    return Decision("at_most", finished, finished, widest)


def _half_widths(until: Until, found: Replications) -> Iterator[tuple[int | None, float | None, float]]:
    """Parameter, half-width and what is asked for; parameters that have no value in any data set do not count."""
    if until.percent_half_width is not None and found.hits is not None:
        low, high = wilson_interval(int(found.hits.sum()), found.hits.size)
        yield None, 100 * (high - low) / 2, until.percent_half_width
    if until.rmse_relative is not None:
        counted = complete(found.errors)
        for k in np.flatnonzero(counted.any(axis=0)).tolist():
            yield k, _relative(found.errors[counted[:, k], k]), until.rmse_relative


def _relative(errors: Array) -> float | None:
    """Half-width of the interval of a root mean square error, as a fraction of it [-]."""
    found = root_mean_square(Sample(errors, errors))
    if found.error is None or found.value is None:
        return None
    # What is the same in all data sets, such as a delay that was given, has no Monte Carlo error.
    return QUANTILE * found.error / found.value if found.error else 0.0
