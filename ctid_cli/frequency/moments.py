"""Least squares from accumulated second moments, and how certain its result is."""

import numpy as np
from numba import njit

from ctid_cli.arrays import Array

#: Second moments summed over many samples carry relative errors of about this size.
ROUNDING = 4e-15


@njit(cache=True, nogil=True)
def accumulate_row(row: Array, gram: Array, keep: float) -> None:
    """Add a row to the lower triangle of second moments that forget."""
    for i in range(row.size):
        for j in range(i + 1):
            gram[i, j] = keep * gram[i, j] + row[i] * row[j]


@njit(cache=True, nogil=True)
def squared_residual(gram: Array, theta: Array) -> float:
    """Sum of the squared residuals ``psi - phi' theta``."""
    # psi'psi - 2 theta' Phi'psi + theta' Phi'Phi theta, from the lower triangle; a negative sum is rounding.
    n = theta.size
    total = gram[n, n]
    for i in range(n):
        total -= 2.0 * theta[i] * gram[n, i]
        for j in range(i):
            total += 2.0 * theta[i] * theta[j] * gram[i, j]
        total += theta[i] * theta[i] * gram[i, i]
    return float(max(total, 0.0))


@njit(cache=True, nogil=True)
def factorise(gram: Array, ridge: float, factor: Array, scales: Array) -> bool:
    """Cholesky factor of the regressors' second moments, scaled to a unit diagonal."""
    n = scales.size
    # A unit diagonal makes the pivots below comparable with rounding, whatever the units of the columns.
    for i in range(n):
        scales[i] = np.sqrt(gram[i, i])
        if not (np.isfinite(scales[i]) and scales[i] > 0.0):
            return False
    for i in range(n):
        for j in range(i + 1):
            total = gram[i, j] / (scales[i] * scales[j])
            if i == j:
                total += ridge
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                # What is left of a column that the others explain is rounding: not positive definite.
                if not total > 4e-16 * n:
                    return False
                factor[i, i] = np.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    return True


@njit(cache=True, nogil=True)
def substitute(factor: Array, values: Array) -> None:
    """Solve ``L L' x = b`` in place."""
    n = values.size
    # L first, from above; then L', from below.
    for i in range(n):
        total = values[i]
        for k in range(i):
            total -= factor[i, k] * values[k]
        values[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        total = values[i]
        for k in range(i + 1, n):
            total -= factor[k, i] * values[k]
        values[i] = total / factor[i, i]


@njit(cache=True, nogil=True)
def least_squares(gram: Array, factor: Array, scales: Array, theta: Array) -> None:
    """Least-squares parameters from second moments and their factor."""
    n = theta.size
    for i in range(n):
        theta[i] = gram[n, i] / scales[i]
    substitute(factor, theta)
    for i in range(n):
        theta[i] /= scales[i]


@njit(cache=True, nogil=True)
def moment_uncertainty(
    gram: Array, factor: Array, scales: Array, misfit: float, theta: Array, slopes: Array, error: Array, rounding: Array
) -> None:
    r"""Error that the misfit of the equations would make if all of it lay in the worst direction.

    Residuals e at the true parameters move the estimate by ``G^-1 Phi' e`` and a frequency by at most
    ``sqrt(g' G^-1 g e'e)`` (Cauchy-Schwarz), whatever the e: noise, a bias, another tone. The residual left by
    the fit stands for ``e'e``; as a difference of moments it is known up to rounding only, and taken for no less.
    Rounding of G moves a frequency by up to ``|G^-1 g|`` times the rounding errors.
    """
    n = theta.size
    # Size of the terms that cancel in a residual: |psi| + sum |theta_k| |phi_k|.
    size = np.sqrt(gram[n, n])
    for k in range(n):
        size += abs(theta[k]) * scales[k]
    direction = np.empty(n)
    for i in range(n):
        for k in range(n):
            direction[k] = slopes[i, k] / scales[k]
        # G^-1 g with g the sensitivities of this frequency, both in the scaled columns of the factor.
        substitute(factor, direction)
        square, length = 0.0, 0.0
        for k in range(n):
            square += direction[k] * slopes[i, k] / scales[k]
            length += abs(direction[k])
        error[i] = np.sqrt(max(square, 0.0) * max(misfit, ROUNDING * size * size))
        rounding[i] = ROUNDING * size * length
