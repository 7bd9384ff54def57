"""Autoregressive model of stationary output noise, from residuals on a regular clock."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit

from ctid_cli.arrays import Array

#: Rows of a block: a few dozen columns of them stay in the processor's cache.
ROWS = 4096


class Rows(Protocol):
    """Columns that are made, or looked up, a block of rows at a time."""

    def __len__(self) -> int:
        """Number of rows."""

    def __getitem__(self, rows: slice, /) -> Array:
        """Some rows, shape (count, columns)."""


def row_blocks(count: int) -> Iterator[slice]:
    """Slices that cover so many rows."""
    return (slice(first, min(first + ROWS, count)) for first in range(0, count, ROWS))


#: Share of the energy of a noise that is rounding.
ROUNDING = 1e-17


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
        white: Array = np.convolve(v, self.coefficients)[: v.size]
        return white

    def autocovariance(self, count: int) -> Array:
        """Autocovariances at the lags 0, 1 … count - 1 intervals."""
        result = np.zeros((max(count, self.order + 1), 1))
        result[: self.order + 1, 0] = self.first_autocovariances
        # The Yule-Walker recursion: autocovariances beyond the order follow the noise-free difference equation.
        autoregress(result[1:], self.coefficients)
        return result[:count, 0]

    def covariance_of(self, columns: Rows) -> Array:
        r"""Covariance of the products of successive samples of v with columns.

        R is symmetric in time, so ``columns' R columns = s^2 sum g g'`` with ``g = c(q)^{-1} columns``, over all times,
        those after the last row included: there the last r rows go on by themselves.
        """
        r = self.order
        if not len(columns):
            return np.zeros((0, 0))
        width = columns[:1].shape[1]
        before, total = np.zeros((r, width)), np.zeros((width, width))
        for rows in row_blocks(len(columns)):
            block = np.ascontiguousarray(np.vstack((before, columns[rows])))
            autoregress(block, self.coefficients)
            total += block[r:].T @ block[r:]
            before = block[block.shape[0] - r :]
        if r:
            # Each step of the recursion moves the rows on; doubling the step sums the energy of all to come.
            step = np.eye(r, k=1)
            step[-1] = -self.coefficients[:0:-1]
            energy = np.outer(step[-1], step[-1])
            # Rounding may leave poles of a very slow noise outside the unit circle: then nothing is finite.
            with np.errstate(over="ignore", invalid="ignore"):
                while (more := step.T @ energy @ step).max() > ROUNDING * energy.max():
                    energy, step = energy + more, step @ step
                total += before.T @ energy @ before
        return np.asarray(self.innovation_variance * total)


@njit(cache=True, nogil=True)
def autoregress(columns: Array, coefficients: Array) -> None:
    """Columns behind ``1/c(q)``, in place; the first r rows are outputs already."""
    r = coefficients.size - 1
    for t in range(r, columns.shape[0]):
        # Row by row, so that all columns advance side by side in memory.
        for i in range(1, r + 1):
            for j in range(columns.shape[1]):
                columns[t, j] -= coefficients[i] * columns[t - i, j]


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
