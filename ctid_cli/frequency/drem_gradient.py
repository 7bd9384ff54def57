"""Gradient estimation of frequencies after dynamic regressor extension and mixing (DREM)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array
from ctid_cli.frequency.mixing import MIXING_ROUNDING, MixingOptions, back_end
from ctid_cli.frequency.regression import theta_of
from ctid_cli.frequency.tracking import Recursion
from ctid_cli.signals.checks import require_integer, require_positive

#: The residuals that show how far an estimate can be trusted are remembered over so many times n h.
RECENT_SPANS = 2


class Gains(NamedTuple):
    """Settings of the gradient."""

    #: ``gamma_k`` times the sampling interval, shape (n,).
    gains: Array
    #: ``theta(0)``, shape (n,).
    initial: Array
    #: Whether the part of the initial value is taken out.
    finite_time: bool
    #: Number of the largest gain.
    fastest: int
    #: What the recent sums keep from one sample to the next.
    keep: float


class Gradient(NamedTuple):
    """State of the gradient."""

    #: z and q, ``theta = z + (1 - q) theta(0)``, shape (2, n).
    sums: Array
    #: Recent sums of the squares of ``Psi_k - Delta theta_k``, of Delta and of its rounding, and of the squared weights
    #: with which the rows enter q, shape (n + 3,).
    recent: Array


@dataclass(frozen=True, kw_only=True)
class DremGradient(MixingOptions):
    r"""Frequencies by gradient descent on each mixed regression: exponential convergence from the initial frequencies.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.
    h : float
        Delay of the regression [s], below pi over the highest frequency; rounded to whole sampling intervals.
    d : float
        Distance of the stacked rows [s]; rounded to whole sampling intervals.
    epsilon : float, default 1.0
        Normalisation of the mixed regression [-].
    gamma : float or tuple of float, default 1.0
        Adaptation gain, one for all parameters or one for each.
    initial_frequencies : tuple of float, optional
        Frequencies to begin with [rad/s]; by default spread over the bounds. Above pi/h they alias, which only moves
        the beginning.
    first_row : int, default 1
        Number of the first stacked row; 1 as published, 0 begins one d earlier.
    power : int or "literal", default 1
        Power of ``epsilon`` in the mixed regression; "literal" for the number of tones.
    gated : bool, default True
        Whether the estimation waits until the delays are filled; False fills them with zeros, which enter the estimate.
    prefilter : float, default 0.0
        Length of a Hann low-pass in front of the regression [s]; 0 for none.
    difference : float, default 0.0
        If positive, the signal this much earlier is subtracted [s], which removes a constant bias.
    lowest_frequency : float, default 0.0
        Lower bound of the frequencies [rad/s].
    highest_frequency : float, optional
        Upper bound of the frequencies [rad/s]; by default pi/h, beyond which they cannot be told apart.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    ``theta_k' = gamma_k Delta (Psi_k - Delta theta_k)``, solved exactly over each sampling interval with Delta and
    Psi_k held, so that no gain is too large. The rate of convergence is ``gamma_k`` times the mean of ``Delta^2``. The
    recursion is that of :class:`~ctid_cli.frequency.drem_finite_time.DremFiniteTime`, which gives the same estimate
    without the part of the initial value.

    References
    ----------
    S. Aranovskiy, A. Bobtsov, R. Ortega and A. Pyrkin, "Performance enhancement of parameter estimators via dynamic
    regressor extension and mixing", *IEEE Trans. Automatic Control* 62 (2017) 3546-3550. doi:10.1109/TAC.2016.2614889
    """

    kind: ClassVar[str] = "drem_gradient"
    _finite_time: ClassVar[bool] = False

    epsilon: float = 1.0
    gamma: float | tuple[float, ...] = 1.0
    initial_frequencies: tuple[float, ...] | None = None
    power: int | Literal["literal"] = 1
    gated: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("epsilon", self.epsilon, "-")
        if isinstance(self.gamma, Sequence):
            self._keep_one_for_each("gamma", "-")
        else:
            require_positive("gamma", self.gamma, "-")
        self._keep_one_for_each("initial_frequencies", "rad/s")
        if self.power != "literal":
            require_integer("power", self.power, 1)

    def _recursion(self, interval: float) -> Recursion:
        n, clock = self.tones, self._clock(interval)
        initial = self.initial_frequencies
        if initial is None:
            lowest, highest = np.arccos((clock.top, clock.bottom)) / clock.delay
            initial = lowest + (highest - lowest) * np.arange(1, n + 1) / (n + 1)
        theta = theta_of(initial, clock.delay)
        gains = np.full(n, 1.0) * np.asarray(self.gamma, dtype=float) * interval
        keep = 1.0 - 1.0 / (RECENT_SPANS * n * clock.lag)
        return self._mixed(
            clock,
            Gradient(np.zeros((2, n)), np.zeros(n + 3)),
            theta,
            tuning=Gains(gains, theta, self._finite_time, int(np.argmax(gains)), keep),
            normalisation=float(self.epsilon) ** (n if self.power == "literal" else int(self.power)),
            past=np.nan if self.gated else 0.0,
        )


@njit(cache=True, nogil=True)
def absorb_gradient(
    scale: float, count: int, tuning: Gains, back: Gradient, theta: Array, mixed: Array
) -> tuple[float, int]:
    """Exact solution of ``theta_k' = gamma_k Delta (Psi_k - Delta theta_k)`` over one interval, Delta and Psi held."""
    n = theta.size
    sums, recent = back
    gains, initial = tuning.gains, tuning.initial
    if np.isnan(scale):
        return recent[n], count
    delta = mixed[n]
    recent[n] = tuning.keep * recent[n] + delta * delta
    recent[n + 1] = tuning.keep * recent[n + 1] + (MIXING_ROUNDING * scale) ** 2
    x, m, gain = 0.0, 0.0, 0.0
    for i in range(n):
        if count > 1:
            # The residual of what was known before this sample: theta moves only below.
            recent[i] = tuning.keep * recent[i] + (mixed[i] - delta * theta[i]) ** 2
        if i == 0 or gains[i] != gains[i - 1]:
            # m = 1 - exp(-x), the share of the new row; gain = gamma m/x without 0/0 where Delta vanishes.
            x = gains[i] * delta * delta
            m = -np.expm1(-x)
            gain = gains[i] * (m / x if x > 1e-8 else 1.0 - 0.5 * x)
        if i == tuning.fastest:
            recent[n + 2] = (1.0 - m) ** 2 * recent[n + 2] + m * m
        # The part of the rows and that of the initial value are kept apart, so that no difference cancels.
        sums[0, i] += gain * delta * mixed[i] - m * sums[0, i]
        sums[1, i] += m * (1.0 - sums[1, i])
        z, q = sums[0, i], sums[1, i]
        theta[i] = z / q if tuning.finite_time and q > 0.0 else z + (1.0 - q) * initial[i]
    return recent[n], count


@njit(cache=True, nogil=True)
def weigh_gradient(tuning: Gains, back: Gradient, theta: Array, errors: Array) -> tuple[float, float]:
    """Errors of theta that the recent residuals show, rounding of Delta relative to Delta, rows that carry weight."""
    n = theta.size
    recent, q = back.recent, back.sums[1, tuning.fastest]
    for i in range(n):
        errors[i] = np.sqrt(recent[i] / recent[n])
    # (sum w)^2/sum w^2 for the weights w with which the rows enter the fastest parameter.
    remembered = q * q / recent[n + 2] if recent[n + 2] > 0.0 else 0.0
    return np.sqrt(recent[n + 1] / recent[n]), remembered


back_end(Gradient, absorb_gradient, weigh_gradient)
