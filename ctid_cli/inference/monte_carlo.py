"""Measures of an estimator from simulated data sets, with their Monte Carlo errors.

The Monte Carlo standard errors are those of T. P. Morris, I. R. White and M. J. Crowther, Using simulation studies to
evaluate statistical methods, Statistics in Medicine 38 (2019) 2074-2102, Table 6, with one change. Their formula for an
empirical standard deviation is valid for normal errors only: for exponential errors its 95 % intervals cover the true
value in 67 % of the cases, for any number of data sets. The jackknife needs no such assumption, and equals their
formulas for bias, mean square error and coverage. Intervals of positive quantities are those of the logarithm, so that
the interval of a reciprocal or a root is the reciprocal or the root of the interval; intervals of quantiles are between
order statistics.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import UsageError
from ctid_cli.inference.intervals import normal_quantile, student_quantile
from ctid_cli.text import did_you_mean

#: Half-width of a 95 % interval of a normal estimate [standard errors].
QUANTILE = normal_quantile()
#: Standard deviation of normal values over their median absolute value.
NORMAL_MAD = 1.4826
#: Largest factor from a positive value to an end of its interval. Wider intervals cover the true value in 98 to 100 %
#: of the cases (normal, t5, t3 and exponential errors, 5 to 300 data sets) but span more than two decades: one error
#: 100 times as large as 59 others gives a factor of 2.5e4 for their mean square.
LARGEST_FACTOR = 10.0


class Measured(NamedTuple):
    """A measure, its Monte Carlo standard error, and its 95 % interval; None if there are too few data sets."""

    value: float | None = None
    error: float | None = None
    low: float | None = None
    high: float | None = None


class Sample(NamedTuple):
    """Errors of one parameter over the data sets that have a value for it."""

    #: Shape (n,).
    errors: Array
    #: Standard errors from the estimator; NaN if missing, shape (n,).
    widths: Array
    #: Least variance of an unbiased estimator; NaN if unknown.
    bound: float = math.nan
    #: Half-widths of the 95 % intervals in standard errors, shape (n,).
    quantiles: Array | float = QUANTILE

    def with_widths(self) -> "Sample":
        """Return the sample of the data sets with a standard error."""
        known = np.isfinite(self.widths)
        reach = np.broadcast_to(self.quantiles, known.shape)
        return self._replace(errors=self.errors[known], widths=self.widths[known], quantiles=reach[known])


def complete(values: Array) -> BoolArray:
    """Return which values count: those of data sets with all parameters that any data set has.

    All parameters thus use the same data sets. NaN marks missing values, shape (R, p).
    """
    known: BoolArray = np.isfinite(values)
    return known & known[:, known.any(axis=0)].all(axis=1, keepdims=True)


def wilson_interval(k: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """Return Wilson's score interval for a proportion.

    With z the normal quantile and p = k / n, the limits are
    ``(p + z^2 / 2n -+ z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)``. They stay inside [0, 1] and are useful for
    few trials and for proportions of 0 and 1.
    """
    if not 0 <= k <= n:
        raise ValueError(f"successes must lie between 0 and the number of trials; got {k} of {n}")
    if n == 0:
        return math.nan, math.nan
    z = normal_quantile(level)
    p = k / n
    centre = p + z**2 / (2 * n)
    half = z * math.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    scale = 1 + z**2 / n
    # Exactly 0 or 1 without rounding errors.
    low = 0.0 if k == 0 else (centre - half) / scale
    high = 1.0 if k == n else (centre + half) / scale
    return low, high


def share(hits: BoolArray) -> Measured:
    """Return the share of true values [%], with Wilson's interval."""
    n, k = hits.size, int(hits.sum())
    if not n:
        return Measured()
    p, (low, high) = k / n, wilson_interval(k, n)
    return Measured(100 * k / n, 100 * math.sqrt(p * (1 - p) / n), 100 * low, 100 * high)


def total(values: Array) -> Measured:
    """Return the sum of the finite values, without an error."""
    known = values[np.isfinite(values)]
    return Measured(float(known.sum()) if known.size else None)


def of_means(statistic: Callable[..., Array], *columns: Array, positive: bool = True) -> Measured:
    r"""Return a function of means over the data sets and of their number, with its jackknife error.

    With ``r_(i)`` the value of all n data sets but i,

    .. math:: s^2 = \frac{n-1}{n} \sum_i \left(r_{(i)} - \frac1n \sum_j r_{(j)}\right)^2.

    The interval of a positive value is that of its logarithm, with the jackknife of the logarithm: ``s`` over the value
    is unbounded if a reciprocal has an outlier. Ends beyond ``LARGEST_FACTOR`` are None.
    """
    n = columns[0].size
    if not n:
        return Measured()
    sums = [column.sum() for column in columns]
    with np.errstate(all="ignore"):  # undefined values become None
        value = float(statistic(*(total / n for total in sums), n))
        if n == 1:
            return Measured(_finite(value))
        means = [(total - column) / (n - 1) for total, column in zip(sums, columns, strict=True)]
        without = statistic(*means, n - 1)
        error = _jackknife(without)
        if positive and value:
            reach = student_quantile(n - 1) * _jackknife(np.log(without))
            factor = math.exp(reach) if reach <= math.log(LARGEST_FACTOR) else math.nan
            ends = (value / factor, value * factor)
        else:
            reach = student_quantile(n - 1) * error
            ends = (value - reach, value + reach)
    return Measured(*map(_finite, (value, error, *ends)))


def _jackknife(without: Array) -> float:
    """Return the standard error from the n leave-one-out values."""
    n = without.size
    return float(np.sqrt((n - 1) / n * np.sum((without - without.mean()) ** 2)))


def quantile(values: Array, level: float = 0.5) -> Measured:
    """Return a quantile with its distribution-free 95 % interval between order statistics; values may be infinite.

    The number of values below it is binomial. The error is that of a normal interval of the same width.
    """
    from scipy.special import bdtr

    n = values.size
    if not n:
        return Measured()
    ordered, below = np.sort(values), bdtr(np.arange(float(n)), n, level)
    first, last = int(np.searchsorted(below, 0.025, "right")) - 1, int(np.searchsorted(below, 0.975))
    low = _finite(float(ordered[first])) if first >= 0 else None
    high = _finite(float(ordered[last])) if last < n else None
    error = None if low is None or high is None else (high - low) / (2 * QUANTILE)
    before, part = divmod((n - 1) * level, 1.0)
    k = int(before)
    # No interpolation if the quantile is a value of the sample, because the next value may be infinite.
    value = float(ordered[k] if part == 0.0 else (1.0 - part) * ordered[k] + part * ordered[k + 1])
    return Measured(_finite(value), error, low, high)


def bias(sample: Sample) -> Measured:
    """Return the mean error."""
    return of_means(lambda mean, _: mean, sample.errors, positive=False)


def deviation(sample: Sample) -> Measured:
    """Return the standard deviation of the estimates."""
    centred = _centred(sample.errors)
    return of_means(_scatter, centred, centred**2) if centred.size > 1 else Measured()


def mean_square(sample: Sample) -> Measured:
    """Return the mean square error."""
    return of_means(lambda mean, _: mean, sample.errors**2)


def root_mean_square(sample: Sample) -> Measured:
    """Return the root mean square error."""
    return of_means(_root, sample.errors**2)


def robust_deviation(sample: Sample) -> Measured:
    """Return a robust standard deviation from the median absolute deviation."""
    if not sample.errors.size:
        return Measured()
    return quantile(NORMAL_MAD * np.abs(sample.errors - np.median(sample.errors)))


def standard_error(sample: Sample) -> Measured:
    """Return the root mean square of the standard errors from the estimator."""
    return of_means(_root, sample.with_widths().widths ** 2)


def error_ratio(sample: Sample) -> Measured:
    """Return the RMS standard error over the standard deviation of the estimates: below 1, intervals are too short."""
    known = sample.with_widths()
    centred = _centred(known.errors)
    if centred.size < 2:
        return Measured()
    return of_means(lambda m, s, w, n: np.sqrt(w) / _scatter(m, s, n), centred, centred**2, known.widths**2)


def covered(sample: Sample) -> BoolArray:
    """Return which 95 % intervals cover the true value; intervals without a standard error do not."""
    return np.asarray(np.abs(sample.errors) <= sample.quantiles * sample.widths)


def coverage(sample: Sample) -> Measured:
    """Return the coverage of the 95 % intervals [%]."""
    return share(covered(sample)) if np.isfinite(sample.widths).any() else Measured()


def efficiency(sample: Sample) -> Measured:
    """Return the least possible variance over the mean square error [%]."""
    return of_means(lambda mean, _: 100.0 * sample.bound / mean, sample.errors**2)


def _root(mean: Array, _: int) -> Array:
    return np.asarray(np.sqrt(mean))


def _centred(errors: Array) -> Array:
    return errors - errors.mean() if errors.size else errors


def _scatter(mean: Array, square: Array, n: int) -> Array:
    # Rounding may make the variance of equal values negative.
    # One value has no standard deviation.
    return np.sqrt(np.maximum(square - mean**2, 0.0) * n / (n - 1) if n > 1 else np.full_like(square, np.nan))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


@dataclass(frozen=True)
class Measure:
    """A measure that can be requested by name."""

    meaning: str
    #: ``""`` means that of the parameter, ``^2`` its square.
    unit: str
    #: Source of its values: ``errors`` of parameters, ``distance`` between models, whether estimates ``converged``,
    #: their ``status``, ``measures`` of tracks, or a column of the estimates.
    source: str
    compute: Callable[..., Measured]
    #: Whether only estimates with a standard error count.
    of_widths: bool = False


def requested(name: str, custom: Mapping[str, Measure] = MappingProxyType({})) -> Measure:
    """Return a measure by name: ``rmse``, ``rmse:delay`` (one parameter), ``rmse:poles``, ``response:1.5`` [rad/s]."""
    base, colon, argument = name.partition(":")
    known = {**MEASURES, **custom}
    if base not in known:
        hint = did_you_mean(base, known) or "."
        raise UsageError(f"there is no measure {base!r}{hint} Known: {', '.join(known)}")
    measure = known[base]
    if base == "response":
        try:
            usable = 0.0 < float(argument) < math.inf
        except ValueError:
            usable = False
        if not usable:
            raise UsageError(f"{name!r} needs a frequency [rad/s] above zero, such as response:1.5")
    elif colon and (measure.source != "errors" or not argument):
        raise UsageError(f"{name!r} must not have a parameter; use {base}")
    return measure


#: All measures by name.
MEASURES: Mapping[str, Measure] = {
    "percent": Measure("estimates that meet the success rule", "%", "converged", share),
    "bias": Measure("mean error", "", "errors", bias),
    "deviation": Measure("empirical standard deviation", "", "errors", deviation),
    "mse": Measure("mean square error", "^2", "errors", mean_square),
    "rmse": Measure("root mean square error", "", "errors", root_mean_square),
    "median_bias": Measure("median error", "", "errors", lambda sample: quantile(sample.errors)),
    "robust_deviation": Measure("1.4826 times the median distance to the median", "", "errors", robust_deviation),
    "standard_error": Measure("root mean square of the model's standard errors", "", "errors", standard_error, True),
    "error_ratio": Measure("the model's standard error over the empirical deviation", "-", "errors", error_ratio, True),
    "coverage": Measure("95 % intervals that hold the true value", "%", "errors", coverage),
    "efficiency": Measure("least possible variance over the mean square error", "%", "errors", efficiency),
    "h2": Measure("median relative error in the H2 norm: of the impulse response", "%", "distance", quantile),
    "hinf": Measure("median largest error of the frequency response over its largest gain", "%", "distance", quantile),
    "response": Measure("median relative error of the frequency response there", "%", "distance", quantile),
    "fresh_fit": Measure(
        "median fit on the output of a fresh data set, without noise", "%", "fresh_fit_percent", quantile
    ),
    "failures": Measure("estimates with each status but success", "%", "status", share),
    "cpu": Measure("median CPU time of one estimate", "s", "cpu_seconds", quantile),
    "cpu_90": Measure("CPU time that 90 % of the estimates stay below", "s", "cpu_seconds", lambda s: quantile(s, 0.9)),
}
#: Data sets of the first block.
AT_LEAST = 200
#: Ratio of the numbers of data sets at the ends of successive blocks.
GROWTH = 1.25


@dataclass(frozen=True)
class Until:
    """Required half-widths of 95 % intervals; None without requirement."""

    #: Of percentages [percentage points].
    percent_half_width: float | None = None
    #: Of root mean square errors, as a fraction of them [-].
    rmse_relative: float | None = None


_NOTHING: Mapping[str, Any] = MappingProxyType({})


class Replications(NamedTuple):
    """Results of an estimator on the first data sets of a data cell, in order."""

    #: Which meet the success rule, shape (R,); None without a rule.
    hits: BoolArray | None
    #: Errors of the parameters; NaN where there is no value, shape (R, p).
    errors: Array
    #: Names of the parameters, and of the estimator with its swept options and its start.
    parameters: Sequence[str] = ()
    estimator: str = ""
    options: Mapping[str, Any] = _NOTHING
    start: str = "none"

    def first(self, count: int) -> "Replications":
        """Return the results on the first ``count`` data sets."""
        return self._replace(hits=None if self.hits is None else self.hits[:count], errors=self.errors[:count])


@dataclass(frozen=True)
class Widest:
    """The measure of a data cell whose interval exceeds the required one most."""

    estimator: str
    #: Its swept options.
    options: Mapping[str, Any]
    start: str
    #: ``percent`` or ``rmse``.
    measure: str
    parameter: str | None
    #: Half-width of the 95 % interval, [percentage points] or as a fraction [-]; None if unknown.
    half_width: float | None
    #: The required half-width.
    asked: float

    @property
    def excess(self) -> float:
        """Half-width over the required one; at most 1 if sufficient."""
        return math.inf if self.half_width is None else self.half_width / self.asked


@dataclass(frozen=True)
class CellPrecision:
    """Precision of a data cell, and whether it has enough data sets."""

    #: Hash of the data cell, and its swept values.
    cell: str
    swept: Mapping[str, Any]
    #: ``enough``; ``open``: more are needed; ``at_most``: the largest allowed number is not precise enough.
    state: Literal["enough", "open", "at_most"]
    #: Data sets at the end of the last finished block, and number currently known to be needed.
    finished: int
    needed: int
    #: None before the end of the first block, and without any measure.
    widest: Widest | None


def block_ends(at_most: int) -> Iterator[int]:
    """Yield the numbers of data sets after which the intervals are checked, independent of any results."""
    end = AT_LEAST
    while end < at_most:
        yield end
        end = math.ceil(GROWTH * end)
    yield at_most


def decide(
    until: Until, estimators: Sequence[Replications], at_most: int, cell: str = "", swept: Mapping[str, Any] = _NOTHING
) -> CellPrecision:
    """Check the intervals at the end of each block, up to the first block after which all are narrow enough.

    At the end of each block of data sets the 95 % intervals of all measures of all estimators are checked, and the data
    cell has enough data sets once all have the required width. Repeated checks favour samples that seem more precise
    than they are, so that the final intervals cover the true value slightly less often than those of a fixed number of
    data sets (Y. S. Chow and H. Robbins, On the asymptotic theory of fixed-width sequential confidence intervals for
    the mean, Annals of Mathematical Statistics 36 (1965) 457-462). Growing blocks keep the number of checks small, and
    the first block is large enough for reliable widths: for percentages up to 98 and nearly normal errors the intervals
    cover the true value in 93 % of the cases or more, without a correction (docs/measures.md).
    """
    stored = min(len(one.errors) for one in estimators)
    finished, widest = 0, None
    for end in block_ends(at_most):
        if stored < end:
            return CellPrecision(cell, swept, "open", finished, end, widest)
        finished = end
        widths = [width for one in estimators for width in _half_widths(until, one.first(end))]
        widest = max(widths, key=lambda width: width.excess, default=None)
        if widest is None or widest.excess <= 1.0:
            return CellPrecision(cell, swept, "enough", end, end, widest)
    return CellPrecision(cell, swept, "at_most", finished, finished, widest)


def _half_widths(until: Until, found: Replications) -> Iterator[Widest]:
    """Yield the half-width of each measure; parameters without a value in any data set are ignored."""
    of = found.estimator, found.options, found.start
    if until.percent_half_width is not None and found.hits is not None:
        low, high = wilson_interval(int(found.hits.sum()), found.hits.size)
        yield Widest(*of, "percent", None, 100 * (high - low) / 2, until.percent_half_width)
    if until.rmse_relative is not None:
        counted = complete(found.errors)
        names = found.parameters or tuple(map(str, range(counted.shape[1])))
        for k in np.flatnonzero(counted.any(axis=0)).tolist():
            yield Widest(*of, "rmse", names[k], _relative(found.errors[counted[:, k], k]), until.rmse_relative)


def _relative(errors: Array) -> float | None:
    """Return the half-width of the interval of a root mean square error, as a fraction of it [-]."""
    found = root_mean_square(Sample(errors, errors))
    if found.error is None or found.value is None:
        return None
    # Constants over all data sets, such as a given delay, have no Monte Carlo error.
    return QUANTILE * found.error / found.value if found.error else 0.0
