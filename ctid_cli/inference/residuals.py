"""Tests of the residuals: whether they are white, and whether they still depend on the input."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.beside import Rest, Rows, SideBySide, constant, row_blocks
from ctid_cli.inference.noise_model import NoiseModel, fit_noise_model
from ctid_cli.inference.quantile import chi_square_tail, normal_quantile

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
    #: Whether the output is seen to answer to the input at all; else no dynamics can be missed.
    answered: bool = True

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
        correlated = f"They are correlated with the input (p = {self.cross_p_value:.2g})"
        if np.isnan(self.cross_p_value):
            second = "Their correlation with the input cannot be tested: the input does not vary enough."
        elif self.uncorrelated:
            second = f"{correlated.replace('are', 'are not')}{': no missing dynamics are seen' * self.answered}."
        elif int(np.argmax(np.abs(self.cross_correlation))) < self.lags:
            why = "feedback from the output, the delay is too long, or the clocks of input and output differ"
            second = f"{correlated}, most with later inputs: there is {why}."
        else:
            why = "more poles or zeros, another delay, or a nonlinear model may be needed"
            second = f"{correlated}: the model misses a part of the response; {why}."
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
