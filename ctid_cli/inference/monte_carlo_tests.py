"""Tests of Monte Carlo measures of an estimator against asymptotic theory.

Theory is approximate for finite records: each test has a tolerance, and the null hypothesis is a smaller departure.
"""

import math
from collections.abc import Iterator, Mapping
from statistics import NormalDist
from typing import Literal, NamedTuple

from scipy.special import bdtr, stdtr

from ctid_cli.inference.monte_carlo import QUANTILE, Measured

#: Fewest data sets for a test.
FEWEST = 50
#: Tolerances: bias in standard deviations of one estimate; factors by which standard errors are too small or too large;
#: factor of the RMSE above theory.
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
    #: Bias in standard errors, factor of the error of standard errors, intervals that miss the true value [%], or RMSE
    #: over its theoretical value: the larger, the worse.
    size: float
    p_value: float


def departures(measured: Mapping[str, Measured], n: int, with_widths: int) -> Iterator[Departure]:
    """Yield tests of the measures of one parameter from n estimates, ``with_widths`` of them with standard errors."""
    value = {name: each.value for name, each in measured.items()}
    error = {name: each.error or 0.0 for name, each in measured.items()}
    bias, deviation = value["bias"], value["deviation"]
    if n < FEWEST or not error["bias"] or bias is None or deviation is None:
        return
    scale = value["standard_error"] or deviation
    yield Departure("bias", abs(bias) / scale, _p_value(bias, BIAS * deviation, error["bias"], n))
    if (ratio := value["error_ratio"]) and with_widths >= FEWEST:
        # For heavy-tailed errors without large ones in the sample, the jackknife error is too small.
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
    """Return the p-value of a value for the null hypothesis that its true magnitude is at most the margin."""
    return _tail((abs(value) - margin) / error, n) + _tail((abs(value) + margin) / error, n)


def _tail(x: float, n: int) -> float:
    return float(stdtr(n - 1, -x))
