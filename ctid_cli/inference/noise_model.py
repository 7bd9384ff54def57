"""Autoregressive model of stationary output noise, from residuals on a regular clock."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from ctid_cli.arrays import Array


@dataclass(frozen=True, eq=False)
class NoiseModel:
    r"""``v(k) + c_1 v(k-1) + ... + c_r v(k-r) = e(k)``, e white."""

    #: ``(1, c_1 ... c_r)`` [-], shape (order + 1,).
    coefficients: Array
    #: ``R_v(0) ... R_v(r)`` [output unit^2]; they determine the coefficients, and all later autocovariances, shape
    #: (order + 1,).
    first_autocovariances: Array
    #: Variance of e [output unit^2].
    innovation_variance: float

    @property
    def order(self) -> int:
        """Order r; 0 is white noise."""
        return int(self.coefficients.size - 1)

    def effective_count(self, count: int) -> float:
        """How many independent samples have a mean as uncertain as so many of these, and not more than these."""
        gain = float(self.coefficients.sum()) ** 2
        ratio = gain * float(self.first_autocovariances[0]) / self.innovation_variance if self.order else 1.0
        return count * min(ratio, 1.0)

    def innovations(self, v: Array) -> Array:
        """The white noise e behind successive samples of v, which is taken as zero before."""
        from scipy.signal import lfilter  # slow to import

        white: Array = lfilter(self.coefficients, [1.0], v)
        return white

    def autocovariance(self, count: int) -> Array:
        """Autocovariances at the lags 0, 1 … count - 1 intervals."""
        result = np.zeros(max(count, self.order + 1))
        result[: self.order + 1] = self.first_autocovariances
        if self.order:
            from scipy.signal import lfilter, lfiltic  # slow to import

            # The Yule-Walker recursion: autocovariances beyond the order follow the noise-free difference equation.
            state = lfiltic([1.0], self.coefficients, self.first_autocovariances[:0:-1])
            rest = np.zeros(result.size - self.order - 1)
            result[self.order + 1 :] = lfilter([1.0], self.coefficients, rest, zi=state)[0]
        return result[:count]

    def covariance_times(self, columns: Array) -> Array:
        """Product of the covariance matrix of successive samples, ``R_v(t - s)``, and given columns."""
        count = columns.shape[0]
        covariances = self.autocovariance(count)
        length = next_fast_len(2 * count - 1, real=True)
        circular = np.zeros(length)
        circular[:count] = covariances
        circular[length - count + 1 :] = covariances[:0:-1]
        product: Array = irfft(rfft(circular)[:, None] * rfft(columns, length, axis=0), length, axis=0)[:count]
        return product


def fit_noise_model(blocks: Sequence[Array], max_order: int | None = None) -> NoiseModel:
    """Yule-Walker model of the noise, of the order that Akaike's criterion chooses.

    The autocovariances are ``sum v(t) v(t - lag) / N``, about a mean of zero; no product reaches from one experiment
    into another. An ARMA noise is approximated: the order grows with the record.
    """
    count = sum(block.size for block in blocks)
    if max_order is None:
        max_order = min(int(10 * np.log10(max(count, 1))), count // 4)
    lags = range(max_order + 1)
    products = [sum(float(block[k:] @ block[: max(block.size - k, 0)]) for block in blocks) for k in lags]
    covariances = np.array(products) / max(count, 1)
    coefficients = np.ones(1)
    variance = float(covariances[0])
    best = NoiseModel(coefficients, covariances[:1], variance)
    if variance <= 0:
        return best
    best_criterion = count * np.log(variance)
    for order in range(1, covariances.size):
        # Levinson's recursion
        reflection = -float(coefficients @ covariances[order:0:-1]) / variance
        variance *= 1.0 - reflection**2
        if variance <= 0:
            break
        coefficients = np.append(coefficients, 0.0)
        coefficients = coefficients + reflection * coefficients[::-1]
        criterion = count * np.log(variance) + 2 * order
        if criterion < best_criterion:
            best, best_criterion = NoiseModel(coefficients, covariances[: order + 1], variance), criterion
    return best
