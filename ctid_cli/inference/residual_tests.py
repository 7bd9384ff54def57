"""Tests of the residuals: whether they are white, and whether they still depend on the input."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.intervals import normal_quantile, robust_deviation
from ctid_cli.inference.noise_model import NoiseModel, Rows, autoregress, fit_noise_model, row_blocks
from ctid_cli.signals.record import Record


def normal_tail(z: float) -> float:
    """Probability that a standard normal variable exceeds z."""
    return 0.5 * math.erfc(z / math.sqrt(2.0))


def chi_square_tail(degrees_of_freedom: int, x: float) -> float:
    """Probability that a chi-square variable exceeds x."""
    from scipy.special import chdtrc

    return float(chdtrc(degrees_of_freedom, x))


@dataclass(frozen=True, eq=False)
class SideBySide:
    """The columns of several."""

    parts: tuple[Rows, ...]

    def __len__(self) -> int:
        return len(self.parts[0])

    def __getitem__(self, rows: slice, /) -> Array:
        return np.column_stack([part[rows] for part in self.parts])


@dataclass(frozen=True, eq=False)
class Rest:
    """What others leave of columns, by least squares."""

    columns: Rows
    beside: Rows
    weights: Array

    @classmethod
    def of(cls, columns: Rows, beside: Rows) -> "Rest":
        """Project columns on others."""
        combined = orthonormal(beside)
        along = [(beside[rows] @ combined).T @ columns[rows] for rows in row_blocks(len(beside))]
        return cls(columns, beside, combined @ np.sum(along, axis=0))

    def __len__(self) -> int:
        return len(self.columns)

    def __getitem__(self, rows: slice, /) -> Array:
        rest: Array = self.columns[rows] - self.beside[rows] @ self.weights
        return rest


def constant(count: int) -> Array:
    """A column of ones that takes no memory."""
    return np.broadcast_to(1.0, (count, 1))


def rest_of(e: Array, beside: Rows) -> Array:
    """What columns leave of one."""
    rest = Rest.of(e[:, None], beside)
    return np.concatenate([rest[rows][:, 0] for rows in row_blocks(e.size)])


def orthonormal(columns: Rows, least: float | None = None) -> Array:
    """Weights with which columns become orthonormal ones of the same span, shape (columns, rank).

    Directions with less than a least share of the largest singular value are rounding.
    """
    triangle = columns[:0]
    for rows in row_blocks(len(columns)):
        triangle = np.asarray(np.linalg.qr(np.vstack((triangle, columns[rows])), mode="r"))
    lengths = np.linalg.norm(triangle, axis=0)
    # A column of zeros has no length to divide by: the rounding of its weights would grow beyond bounds.
    lengths[lengths == 0] = 1.0
    _, values, vectors = np.linalg.svd(triangle / lengths, full_matrices=False)
    kept = values > (len(columns) * np.finfo(float).eps if least is None else least) * values[0]
    return np.asarray(vectors[kept].T / values[kept] / lengths[:, None])


#: Fewer residuals than this are not tested.
FEWEST_TESTED = 20
#: Directions of the lagged inputs with less than this share of the largest variance are repetitions of the others.
NEGLIGIBLE_VARIANCE = 1e-8
#: What projections leave of a column that they should take away altogether, as a share of its power.
ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class ResidualTests:
    """Correlations of the residuals with themselves and with the input, with what they mean."""

    count: int
    #: Largest lag L [samples].
    lags: int
    #: Confidence level of both tests and of the bands [-].
    level: float
    #: Of the residuals, at the lags 1 … L [-], shape (L,).
    autocorrelation: Array = field(repr=False)
    #: A white sequence stays within plus or minus this at each single lag, with probability ``level`` [-].
    autocorrelation_band: float
    #: Ljung and Box's portmanteau statistic [-].
    whiteness_statistic: float
    whiteness_degrees_of_freedom: int
    #: Probability of a larger statistic if the residuals are white [-]; NaN where it cannot be computed.
    whiteness_p_value: float
    #: Between ``residual(t)`` and ``input(t - k)``, k = -L … L [-], shape (2 L + 1,).
    cross_correlation: Array = field(repr=False)
    #: Residuals of their colour that are independent of the input stay within plus or minus this at each single lag,
    #: with probability ``level`` [-].
    cross_correlation_band: float
    #: Portmanteau statistic of all these lags [-].
    cross_statistic: float
    cross_degrees_of_freedom: int
    #: Probability of a larger statistic if the residuals are independent of the input [-]; NaN where it cannot be
    #: computed.
    cross_p_value: float
    #: What drives the system, and the residuals are tested against: the input, or the reference of a loop.
    driver: str = "input"

    @property
    def white(self) -> bool:
        """Whether they pass as white; no evidence is no rejection, and the sentence says what could not be tested."""
        return not self.whiteness_p_value < 1 - self.level

    @property
    def uncorrelated(self) -> bool:
        """Whether they pass as independent of the input."""
        return not self.cross_p_value < 1 - self.level

    @property
    def sentence(self) -> str:
        """What the tests mean."""
        if np.isnan(self.whiteness_p_value):
            return "The residuals are exactly zero: there is nothing to test."
        first = f"The residuals pass as white at the {100 * self.level:g} % level (p = {self.whiteness_p_value:.2g})."
        if not self.white:
            first = first.replace("pass as white", "are not white").removesuffix(".")
            first += ": the noise is coloured, so that standard errors for white noise do not hold."
        if np.isnan(self.cross_p_value):
            second = f"Their correlation with the {self.driver} cannot be tested: it does not vary enough."
        elif self.uncorrelated:
            second = f"They are not seen to depend on the {self.driver} (p = {self.cross_p_value:.2g})."
        elif int(np.argmax(np.abs(self.cross_correlation))) < self.lags:
            why = "as with feedback from the output, a delay that is too long, or clocks that differ"
            second = f"They depend on the {self.driver}, most on later values (p = {self.cross_p_value:.2g}), {why}."
        else:
            what = "the model misses a part of the response"
            second = f"They depend on the {self.driver} (p = {self.cross_p_value:.2g}): {what}."
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
    residuals a combination of psi; with ``sensitivities`` the lagged inputs are replaced by what is left of them
    beside psi, on which that has no effect.

    Samples are taken as equally spaced; with an irregular clock the lags count samples.
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
    """Whether the residuals of all experiments pass as white; too few to be tested pass.

    A false alarm is as likely as with one experiment.
    """
    least = (1.0 - level) / len(residuals)
    return not any(e.size >= FEWEST_TESTED and whiteness(e, _lags(e.size))[2] < least for e in residuals)


def whiteness(e: Array, lags: int) -> tuple[Array, float, float]:
    """Autocorrelation at the lags from 1 on, Ljung and Box's statistic and its p-value; NaN where all is zero."""
    count, power = e.size, float(e @ e)
    if not power > 0:
        return np.full(lags, np.nan), float("nan"), float("nan")
    autocorrelation = np.array([e[k:] @ e[:-k] for k in range(1, lags + 1)]) / power
    statistic = float(count * (count + 2) * np.sum(autocorrelation**2 / (count - np.arange(1, lags + 1))))
    return autocorrelation, statistic, chi_square_tail(lags, statistic)


def _cross_correlation(
    e: Array, u: Array, lags: int, quantile: float, psi: Array | None
) -> tuple[Array, float, float, int, float]:
    """Cross-correlation at -lags … lags, its band, the portmanteau statistic, its degrees of freedom and p-value."""
    e, u = e - e.mean(), u - u.mean()
    count = e.size
    # A constant leaves rounding behind when its mean is taken off.
    scale = float(np.sqrt((e @ e) * (u @ u)))
    if not scale > 0 or np.ptp(u) <= 1e-12 * np.abs(u).max(initial=0.0):
        return np.full(2 * lags + 1, np.nan), np.nan, np.nan, 0, np.nan
    # Column k + lags is u(t - k): a look at the input between zeros, backwards.
    shifted = np.lib.stride_tricks.sliding_window_view(np.pad(u, lags), 2 * lags + 1)[:, ::-1]
    cross = np.sum([shifted[rows].T @ e[rows] for rows in row_blocks(count)], axis=0) / scale

    noise = fit_noise_model([e])
    # sum over all lags, both signs
    spread = float(noise.covariance_of(u[:, None])[0, 0]) / (float(noise.first_autocovariances[0]) * float(u @ u))
    band = quantile * float(np.sqrt(max(spread, 0.0) / count))

    # Beside the constant and psi, whatever was subtracted from the noise along them does not count.
    constants = constant(count)
    found = dependence(e, shifted, noise, constants if psi is None else SideBySide((constants, psi)))
    return cross, band, found.statistic, found.freedom, found.p_value


class Dependence(NamedTuple):
    """Whether residuals follow given columns."""

    statistic: float
    freedom: int
    #: Probability of a larger statistic if they do not; NaN without anything to follow.
    p_value: float


def dependence(e: Array, columns: Rows, noise: NoiseModel, beside: Rows) -> Dependence:
    """Chi-square statistic ``c' cov(c)^+ c`` of the products c of the residuals with what others leave of columns."""
    rest, blocks = Rest.of(columns, beside), list(row_blocks(e.size))
    power = float(np.max(np.sum([np.sum(columns[rows] ** 2, axis=0) for rows in blocks], axis=0), initial=0.0))
    products = np.sum([rest[rows].T @ e[rows] for rows in blocks], axis=0)
    covariance = noise.covariance_of(rest) * e.size / max(e.size - beside[:1].shape[1], 1)
    values, vectors = np.linalg.eigh(covariance)
    # What others leave of a repetition of theirs is rounding.
    least = NEGLIGIBLE_VARIANCE * max(float(values[-1]), ROUNDING * power * noise.innovation_variance)
    kept = values > least
    statistic = float(np.sum((vectors[:, kept].T @ products) ** 2 / values[kept]))
    freedom = int(kept.sum())
    return Dependence(statistic, freedom, chi_square_tail(freedom, statistic) if freedom else np.nan)


#: Inputs looked at, in sampling intervals: before the instant at which the model uses them, and after the residual.
PAST, FUTURE = 25, 10
#: A delay that is too long leaves out inputs this many intervals later.
LATE = 3
#: Time constants of a further pole, from the sampling interval to this fraction of the record.
TRIED, LONGEST = 6, 0.2
#: Earlier inputs and simulated outputs from which a controller's next move is told, and the delays of its answer.
ORDER, ANSWERS = 4, 3
#: Steps of the robust regression, and the residual in robust standard deviations from which on it counts no more.
REWEIGHTED, CLIPPED = 8, 1.5


@dataclass(frozen=True)
class InputDependence:
    """Probabilities of a dependence like this if there is none [-]."""

    #: Of the residuals on what one more pole, and a zero, would add to the output.
    pole_p_value: float
    #: Share of the variance of the residuals that these would explain [-].
    pole_share: float
    #: Of the input on residuals before it, and the share of these that its moves foretell.
    feedback_p_value: float
    feedback_share: float


def input_dependence(e: Array, x: Array, psi: Array, t: Array, record: Record, delay: float) -> InputDependence | None:
    r"""Test residuals at instants t against earlier and later inputs; None in too short a record.

    Earlier and later count the samples, whose instants are those at which a controller acts.

    The model is contained in that with one more pole and zero, ``B (s + z) / (A (s + p))`` with z = p; its derivative
    there is the simulated output x behind ``1/(s + p)``, and a few p span what a pole could add.

    Later inputs are freed of what earlier ones tell of them (Sims' test of causality): dynamics that the model misses
    correlate the residuals with the future of an input that is correlated itself, but only by way of its past.
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
    beside = SideBySide((constant(e.size), psi))
    pole = dependence(e, behind[inside], noise, beside)
    share = 1.0 - _power(rest_of(e, SideBySide((beside, behind[inside])))) / _power(rest_of(e, beside))
    del behind  # as large as all that follows

    def inputs(shift: float, steps: range) -> Array:
        """A view of the input at a lag from each residual, without a copy for every column."""
        values = record.input.at(t - shift) - record.input.mean
        looks = np.lib.stride_tricks.sliding_window_view(values, len(steps))
        return looks[inside.start + min(steps) : inside.stop + min(steps), :: steps.step]

    earlier = inputs(delay, range(min(LATE, int(delay / interval)), -past, -1))
    known = SideBySide((beside, earlier))
    # Between its samples an input along straight lines has moved before the residual.
    first = 0 if record.input.hold == "zoh" else 1
    later = dependence(e, inputs(0.0, range(first, first + future)), noise, known)
    found = [(later.p_value, (later.statistic - later.freedom) / e.size)] if later.freedom else []
    if not first:
        z = _feedback_score(rest_of(e, known), x, inputs(0.0, range(0, -ORDER - 1, -1)))
        found.append((2 * ANSWERS * normal_tail(z), z * z / e.size))
    likely, told = min(found, default=(1.0, 0.0))
    return InputDependence(pole.p_value, share, min(1.0, len(found) * likely), told)


def _feedback_score(e: Array, x: Array, u: Array) -> float:
    """How far the input moves with residuals of the last instants, in standard deviations of what chance gives.

    What the input and the simulated output were does not tell all moves: those of a reference that is held are rare
    and large, and would drown the response to the noise. So they are clipped. Residuals that are white and independent
    of the input are independent of any function of it.
    """
    blocks, inputs = list(row_blocks(e.size - ORDER)), u[ORDER:]
    outputs = np.lib.stride_tricks.sliding_window_view(x, ORDER)[1:]
    before = SideBySide((constant(len(inputs)), inputs[:, 1:], outputs))
    weights = orthonormal(before, 1e-10)
    now = rest = inputs[:, 0]
    weight = np.ones(now.size)
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
    moves = np.clip(rest / scale, -CLIPPED, CLIPPED)
    white = fit_noise_model([e]).innovations(e)
    scores = [moves * white[ORDER - k : e.size - k] for k in range(ANSWERS)]
    return max(abs(float(score.sum())) / float(np.sqrt(score @ score)) for score in scores)


def _behind_a_pole(x: Array, time_constants: Array) -> Array:
    """Samples behind first-order filters with the given time constants in samples."""
    columns = np.empty((x.size, time_constants.size))
    for column, p in zip(columns.T, np.exp(-1.0 / time_constants), strict=True):
        behind = (1.0 - p) * x[:, None]
        autoregress(behind, np.array([1.0, -p]))
        column[:] = behind[:, 0]
    return columns


def _power(e: Array) -> float:
    return float(e @ e)
