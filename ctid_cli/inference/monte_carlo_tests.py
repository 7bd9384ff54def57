"""Tests of Monte Carlo measures of an estimator against what theory expects of it.

Finite records are not ideal: small departures are allowed for, and each test asks whether one is larger than that.
"""

import math
from collections.abc import Iterator, Mapping
from statistics import NormalDist
from typing import Literal, NamedTuple

from scipy.special import bdtr, stdtr

from ctid_cli.inference.monte_carlo import QUANTILE, Measured

#: Fewer data sets than these say nothing.
FEWEST = 50
#: What is allowed for: a bias in standard deviations of one estimate, standard errors that are too small or too large
#: by a factor, and an RMSE above theory by one.
BIAS, SMALL, LARGE, EXCESS = 0.25, 1.1, 1.25, 1.25
#: Coverage of intervals that are shorter by that factor.
COVERAGE = 2.0 * NormalDist().cdf(QUANTILE / SMALL) - 1.0
#: The measures that are tested.
MEASURED = ("bias", "deviation", "standard_error", "error_ratio", "coverage", "efficiency")

Kind = Literal["bias", "small", "large", "coverage", "rmse"]


class Departure(NamedTuple):
    """One test of one parameter."""

    #: ``small``, ``large``: of the standard errors.
    kind: Kind
    #: Bias in standard errors, the factor by which standard errors are off, intervals that miss the truth [%], or RMSE
    #: over that of theory: the larger, the worse.
    size: float
    p_value: float


def departures(measured: Mapping[str, Measured], n: int, with_widths: int) -> Iterator[Departure]:
    """Test the measures of one parameter, which are of n estimates; some of them have standard errors."""
    value = {name: each.value for name, each in measured.items()}
    error = {name: each.error or 0.0 for name, each in measured.items()}
    bias, deviation = value["bias"], value["deviation"]
    if n < FEWEST or not error["bias"] or bias is None or deviation is None:
        return
    scale = value["standard_error"] or deviation
    yield Departure("bias", abs(bias) / scale, _p_value(bias, BIAS * deviation, error["bias"], n))
    if (ratio := value["error_ratio"]) and with_widths >= FEWEST:
        # Where errors with heavy tails happened to be small, the jackknife believes too much in their deviation.
        uncertain = max(error["error_ratio"] / ratio, 1.0 / math.sqrt(2.0 * with_widths))
        margin = math.log(SMALL if ratio < 1.0 else LARGE)
        p_value = _p_value(math.log(ratio), margin, uncertain, with_widths)
        yield Departure("small" if ratio < 1.0 else "large", max(ratio, 1.0 / ratio), p_value)
    if (covered := value["coverage"]) is not None:
        yield Departure("coverage", 100.0 - covered, float(bdtr(round(0.01 * covered * n), n, COVERAGE)))
    if share := value["efficiency"]:
        excess = math.log(10.0 / math.sqrt(share))
        uncertain = 0.5 * error["efficiency"] / share
        yield Departure("rmse", math.exp(excess), _tail((excess - math.log(EXCESS)) / uncertain, n))


def _p_value(value: float, margin: float, error: float, n: int) -> float:
    """Return the chance of a value as far from zero as this if the true one is at most the margin away."""
    return _tail((abs(value) - margin) / error, n) + _tail((abs(value) + margin) / error, n)


def _tail(x: float, n: int) -> float:
    return float(stdtr(n - 1, -x))
