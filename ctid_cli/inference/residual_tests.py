"""Tests of residuals: whiteness, and dependence on the input."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.intervals import normal_quantile, robust_deviation
from ctid_cli.inference.noise_model import NoiseModel, Rows, fit_noise_model, row_blocks
from ctid_cli.signals.record import Record
from ctid_cli.text import probability


def normal_tail(z: float) -> float:
    """Return the probability that a standard normal variable exceeds z."""
    return 0.5 * math.erfc(z / math.sqrt(2.0))


def chi_square_tail(degrees_of_freedom: int, x: float) -> float:
    """Return the probability that a chi-square variable exceeds x."""
    from scipy.special import chdtrc

    return float(chdtrc(degrees_of_freedom, x))


@dataclass(frozen=True, eq=False)
class Concatenated:
    """Columns of several blocks."""

    parts: tuple[Rows, ...]

    def __len__(self) -> int:
        return len(self.parts[0])

    def __getitem__(self, rows: slice, /) -> Array:
        return np.column_stack([part[rows] for part in self.parts])


@dataclass(frozen=True, eq=False)
class Projected:
    """Least-squares residuals of columns, with other columns as regressors."""

    columns: Rows
    regressors: Rows
    weights: Array

    @classmethod
    def of(cls, columns: Rows, regressors: Rows) -> "Projected":
        """Compute the regression of columns on others."""
        combined = orthonormal(regressors)
        along = [(regressors[rows] @ combined).T @ columns[rows] for rows in row_blocks(len(regressors))]
        return cls(columns, regressors, combined @ np.sum(along, axis=0))

    def __len__(self) -> int:
        return len(self.columns)

    def __getitem__(self, rows: slice, /) -> Array:
        rest: Array = self.columns[rows] - self.regressors[rows] @ self.weights
        return rest


def constant(count: int) -> Array:
    """Return a column of ones that uses no memory."""
    return np.broadcast_to(1.0, (count, 1))


def regression_residuals(e: Array, regressors: Rows) -> Array:
    """Return the least-squares residuals of one column."""
    rest = Projected.of(e[:, None], regressors)
    return np.concatenate([rest[rows][:, 0] for rows in row_blocks(e.size)])


def orthonormal(columns: Rows, least: float | None = None) -> Array:
    """Return weights that transform columns to an orthonormal basis of their span, shape (columns, rank).

    Directions with less than a share ``least`` of the largest singular value are ignored.
    """
    triangle = columns[:0]
    for rows in row_blocks(len(columns)):
        triangle = np.asarray(np.linalg.qr(np.vstack((triangle, columns[rows])), mode="r"))
    lengths = np.linalg.norm(triangle, axis=0)
    # A column of zeros cannot be normalised.
    lengths[lengths == 0] = 1.0
    _, values, vectors = np.linalg.svd(triangle / lengths, full_matrices=False)
    kept = values > (len(columns) * np.finfo(float).eps if least is None else least) * values[0]
    return np.asarray(vectors[kept].T / values[kept] / lengths[:, None])


#: Fewer residuals than this are not tested.
FEWEST_TESTED = 20
#: Directions of the lagged inputs with less than this share of the largest variance are linearly dependent.
NEGLIGIBLE_VARIANCE = 1e-8
#: Rounding error of the projection of a linearly dependent column, as a share of its power.
ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class ResidualTests:
    """Autocorrelation of the residuals, their cross-correlation with the input, and tests."""

    count: int
    #: Largest lag L [samples].
    lags: int
    #: Confidence level of both tests and of the bands [-].
    level: float
    #: Autocorrelation of the residuals at the lags 1 … L [-], shape (L,).
    autocorrelation: Array = field(repr=False)
    #: Pointwise half-width of the band of a white sequence, with probability ``level`` [-].
    autocorrelation_band: float
    #: Ljung and Box's portmanteau statistic [-].
    whiteness_statistic: float
    whiteness_degrees_of_freedom: int
    #: p-value of whiteness [-]; NaN if not computable.
    whiteness_p_value: float
    #: Cross-correlation of ``residual(t)`` and ``input(t - k)``, k = -L … L [-], shape (2 L + 1,).
    cross_correlation: Array = field(repr=False)
    #: Pointwise half-width of the band of residuals of this colour that are independent of the input, with probability
    #: ``level`` [-].
    cross_correlation_band: float
    #: Portmanteau statistic of all these lags [-].
    cross_statistic: float
    cross_degrees_of_freedom: int
    #: p-value of independence of the input [-]; NaN if not computable.
    cross_p_value: float
    #: Driving signal of the test: the input, or the reference of a loop.
    driver: str = "input"

    @property
    def white(self) -> bool:
        """Whether whiteness is not rejected, also if it could not be tested."""
        return not self.whiteness_p_value < 1 - self.level

    @property
    def uncorrelated(self) -> bool:
        """Whether independence of the input is not rejected."""
        return not self.cross_p_value < 1 - self.level

    @property
    def sentence(self) -> str:
        """Results of the tests in words."""
        if np.isnan(self.whiteness_p_value):
            return "The residuals are exactly zero: there is nothing to test."
        white, cross = probability(self.whiteness_p_value), probability(self.cross_p_value)
        first = f"The residuals pass as white at the {100 * self.level:g} % level ({white})."
        if not self.white:
            first = first.replace("pass as white", "are not white").removesuffix(".")
            first += ": the noise is coloured, so that standard errors for white noise do not hold."
        if np.isnan(self.cross_p_value):
            second = f"Their correlation with the {self.driver} cannot be tested: it does not vary enough."
        elif self.uncorrelated:
            second = f"They are not seen to depend on the {self.driver} ({cross})."
        elif int(np.argmax(np.abs(self.cross_correlation))) < self.lags:
            why = "as with feedback from the output, a delay that is too long, or clocks that differ"
            second = f"They depend on the {self.driver}, most on later values ({cross}), {why}."
        else:
            what = "the model misses a part of the response"
            second = f"They depend on the {self.driver} ({cross}): {what}."
        return f"{first} {second}"


def residual_tests(
    e: Array, u: Array, *, level: float = 0.95, lags: int | None = None, sensitivities: Array | None = None
) -> ResidualTests:
    r"""Test the residuals of an output-error model for whiteness and for correlation with the input.

    Whiteness: ``r(k) = sum e(t) e(t-k) / sum e(t)^2``, not centred, so that a constant error is not white; the band is
    ``z / sqrt(N)``; ``Q = N (N + 2) sum_k r(k)^2 / (N - k)`` is chi-square with L degrees of freedom [1]_. The
    parameters of an output-error model take none away, as its sensitivities do not depend on the noise.

    Cross-correlation: ``c(k) = sum_t e(t) u(t-k) / (N s_e s_u)`` of the centred sequences. If e is independent of u,

    .. math:: N \operatorname{cov}(c(k), c(l)) = \sum_m \rho_e(m) \rho_u(m + k - l),

    on whose diagonal P, the sum of the products of both autocorrelations, the band ``z sqrt(P/N)`` is built [2]_. The
    autocorrelation of e is that of an autoregressive model of the residuals. The statistic is ``c' cov(c)^+ c``, with
    the exact sums over this input, and its degrees of freedom are the rank of ``cov(c)``. Estimation removes from the
    residuals a combination of psi; with ``sensitivities`` the lagged inputs are projected off psi, so that this has no
    effect.

    Lags count samples, also with an irregular clock.
    """
    count = e.size
    lags = _lags(count) if lags is None else lags
    quantile = normal_quantile(level)

    autocorrelation, statistic, whiteness_p = whiteness(e, lags)

    band = quantile / float(np.sqrt(count))
    cross = _cross_correlation(e, u, lags, quantile, sensitivities)
    return ResidualTests(count, lags, level, autocorrelation, band, statistic, lags, whiteness_p, *cross)


def _lags(count: int) -> int:
    return min(25, count // 4)


def all_white(residuals: Sequence[Array], level: float = 0.95) -> bool:
    """Return whether the residuals of all experiments pass as white; too few to be tested pass.

    The false-alarm probability is that of one experiment.
    """
    least = (1.0 - level) / len(residuals)
    return not any(e.size >= FEWEST_TESTED and whiteness(e, _lags(e.size))[2] < least for e in residuals)


def whiteness(e: Array, lags: int) -> tuple[Array, float, float]:
    """Return autocorrelation from lag 1 on, Ljung and Box's statistic and its p-value; NaN if all are zero."""
    count, power = e.size, float(e @ e)
    if not power > 0:
        return np.full(lags, np.nan), float("nan"), float("nan")
    autocorrelation = np.array([e[k:] @ e[:-k] for k in range(1, lags + 1)]) / power
    statistic = float(count * (count + 2) * np.sum(autocorrelation**2 / (count - np.arange(1, lags + 1))))
    return autocorrelation, statistic, chi_square_tail(lags, statistic)


def _cross_correlation(
    e: Array, u: Array, lags: int, quantile: float, psi: Array | None
) -> tuple[Array, float, float, int, float]:
    """Return cross-correlation at -lags … lags, band, portmanteau statistic, degrees of freedom and p-value."""
    e, u = e - e.mean(), u - u.mean()
    count = e.size
    # Subtracting the mean of a constant leaves rounding errors.
    scale = float(np.sqrt((e @ e) * (u @ u)))
    if not scale > 0 or np.ptp(u) <= 1e-12 * np.abs(u).max(initial=0.0):
        return np.full(2 * lags + 1, np.nan), np.nan, np.nan, 0, np.nan
    # Column k + lags is u(t - k): a reversed view of the zero-padded input.
    shifted = np.lib.stride_tricks.sliding_window_view(np.pad(u, lags), 2 * lags + 1)[:, ::-1]
    cross = np.sum([shifted[rows].T @ e[rows] for rows in row_blocks(count)], axis=0) / scale

    noise = fit_noise_model([e])
    # sum over all lags, both signs
    spread = float(noise.covariance_of(u[:, None])[0, 0]) / (float(noise.first_autocovariances[0]) * float(u @ u))
    band = quantile * float(np.sqrt(max(spread, 0.0) / count))

    # Projected off the constant and psi, along which estimation has changed the residuals.
    constants = constant(count)
    found = dependence(e, shifted, noise, constants if psi is None else Concatenated((constants, psi)))
    return cross, band, found.statistic, found.freedom, found.p_value


class Dependence(NamedTuple):
    """Test of the dependence of residuals on given columns."""

    statistic: float
    freedom: int
    #: p-value of independence; NaN without independent columns.
    p_value: float


def dependence(e: Array, columns: Rows, noise: NoiseModel, regressors: Rows) -> Dependence:
    """Test residuals by the chi-square statistic ``c' cov(c)^+ c`` of their products c with projected columns."""
    rest, blocks = Projected.of(columns, regressors), list(row_blocks(e.size))
    power = float(np.max(np.sum([np.sum(columns[rows] ** 2, axis=0) for rows in blocks], axis=0), initial=0.0))
    products = np.sum([rest[rows].T @ e[rows] for rows in blocks], axis=0)
    covariance = noise.covariance_of(rest) * e.size / max(e.size - regressors[:1].shape[1], 1)
    values, vectors = np.linalg.eigh(covariance)
    # The projection of a linearly dependent column is rounding error.
    least = NEGLIGIBLE_VARIANCE * max(float(values[-1]), ROUNDING * power * noise.innovation_variance)
    kept = values > least
    statistic = float(np.sum((vectors[:, kept].T @ products) ** 2 / values[kept]))
    freedom = int(kept.sum())
    return Dependence(statistic, freedom, chi_square_tail(freedom, statistic) if freedom else np.nan)


#: Range of tested inputs, in sampling intervals: before the instant at which the model uses them, after the residual.
PAST, FUTURE = 25, 10
#: Further later inputs tested, in case the delay is too long [sampling intervals].
LATE = 3
#: Number of time constants of a further pole, from the sampling interval to this fraction of the record.
TRIED, LONGEST = 6, 0.2
#: Earlier inputs and simulated outputs from which the next input is predicted, and lags of a controller's response.
ORDER, CONTROLLER_LAGS = 4, 3
#: Steps of the robust regression, and limit at which residuals are clipped [robust standard deviations].
REWEIGHTED, CLIPPED = 8, 1.5


@dataclass(frozen=True)
class InputDependence:
    """p-values of tests for missing dynamics and for feedback [-]."""

    #: p-value that one more pole and zero do not improve the output.
    pole_p_value: float
    #: Share of the variance of the residuals that they would explain [-].
    pole_share: float
    #: p-value that the input does not depend on past residuals, and their share explained by later inputs [-].
    feedback_p_value: float
    feedback_share: float


def input_dependence(e: Array, x: Array, psi: Array, t: Array, record: Record, delay: float) -> InputDependence | None:
    r"""Test residuals at instants t against earlier and later inputs; None if the record is too short.

    Lags count samples, at which a controller acts.

    The model is a special case of ``B (s + z) / (A (s + p))`` with z = p; the derivative there is the simulated output
    x filtered by ``1/(s + p)``, and a few p approximate the effect of any pole.

    Later inputs are projected off earlier ones (Sims' test of causality): missing dynamics correlate the residuals with
    future values of an autocorrelated input, but only through its past.
    """
    interval = float(np.median(np.diff(record.t)))
    past, future = min(PAST, t.size // 8), min(FUTURE, t.size // 16)
    inside = slice(int(np.searchsorted(t, record.t[0] + delay)) + past, t.size - future)
    if future < ORDER or inside.stop - inside.start < 2 * (past + future + psi.shape[1]):
        return None
    behind = _behind_a_pole(x - x[0], np.geomspace(1.0, LONGEST * t.size, TRIED))
    e, x, psi = e[inside] - e[inside].mean(), x[inside], psi[inside]
    noise = fit_noise_model([e])
    if not noise.innovation_variance > 0:
        return None
    model = Concatenated((constant(e.size), psi))
    pole = dependence(e, behind[inside], noise, model)
    extended = Concatenated((model, behind[inside]))
    share = 1.0 - _power(regression_residuals(e, extended)) / _power(regression_residuals(e, model))
    del behind, extended  # large arrays

    def inputs(shift: float, steps: range) -> Array:
        """Return a view of the input at lags from each residual, without copies."""
        values = record.input.at(t - shift) - record.input.mean
        looks = np.lib.stride_tricks.sliding_window_view(values, len(steps))
        return looks[inside.start + min(steps) : inside.stop + min(steps), :: steps.step]

    earlier = inputs(delay, range(min(LATE, int(delay / interval)), -past, -1))
    known = Concatenated((model, earlier))
    # A linearly interpolated input changes before the sample of the residual.
    first = 0 if record.input.hold == "zoh" else 1
    later = dependence(e, inputs(0.0, range(first, first + future)), noise, known)
    found = [(later.p_value, (later.statistic - later.freedom) / e.size)] if later.freedom else []
    if not first:
        u, outputs = inputs(0.0, range(0, -ORDER - 1, -1))[ORDER:], np.lib.stride_tricks.sliding_window_view(x, ORDER)
        before = Concatenated((constant(len(u)), u[:, 1:], outputs[1:]))
        rest = regression_residuals(e, known)
        z = feedback_score(before, u[:, 0], fit_noise_model([rest]).innovations(rest))
        found.append((feedback_p_value(z), z * z / e.size))
    least, explained = min(found, default=(1.0, 0.0))
    return InputDependence(pole.p_value, share, min(1.0, len(found) * least), explained)


def feedback_score(before: Rows, now: Array, white: Array) -> float:
    """Return the standardised correlation of the input now with the last innovations.

    The input is predicted from what was before: inputs and responses. Prediction errors are clipped, because rare large
    changes of a held reference would mask the response to the noise. Without feedback, innovations are independent of
    any function of the input. There are more of them than inputs: those before the first one come first.
    """
    blocks, weights = list(row_blocks(now.size)), orthonormal(before, 1e-10)
    rest, weight = now, np.ones(now.size)
    for _ in range(REWEIGHTED):
        gram, products = np.zeros((weights.shape[1],) * 2), np.zeros(weights.shape[1])
        for rows in blocks:
            basis = before[rows] @ weights
            weighted = weight[rows, None] * basis
            gram += weighted.T @ basis
            products += weighted.T @ now[rows]
        moving = weights @ np.linalg.lstsq(gram, products)[0]
        rest = np.concatenate([now[rows] - before[rows] @ moving for rows in blocks])
        scale = robust_deviation(rest)
        if not scale > 1e-9 * float(np.ptp(now)):
            return 0.0
        weight = 1.0 / np.maximum(np.abs(rest) / scale, 1.0)
    moves, first = np.clip(rest / scale, -CLIPPED, CLIPPED), white.size - now.size
    scores = [moves * white[first - k : white.size - k] for k in range(CONTROLLER_LAGS)]
    return max(abs(float(score.sum())) / max(math.sqrt(score @ score), np.finfo(float).tiny) for score in scores)


def feedback_p_value(score: float) -> float:
    """Return the p-value of the largest score of all lags under the hypothesis of no feedback."""
    return min(1.0, 2 * CONTROLLER_LAGS * normal_tail(score))


def _behind_a_pole(x: Array, time_constants: Array) -> Array:
    """Return samples filtered by first-order low-pass filters with time constants in samples."""
    from ctid_cli.inference.noise_kernels import autoregress  # numba is slow to import

    columns = np.empty((x.size, time_constants.size))
    for column, p in zip(columns.T, np.exp(-1.0 / time_constants), strict=True):
        behind = (1.0 - p) * x[:, None]
        autoregress(behind, np.array([1.0, -p]))
        column[:] = behind[:, 0]
    return columns


def _power(e: Array) -> float:
    return float(e @ e)
