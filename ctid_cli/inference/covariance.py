"""Asymptotic covariance of an output-error estimate with white residuals."""

from __future__ import annotations

import numpy as np

from ctid_cli.arrays import Array


def white_noise_covariance(hessian: Array, squared_error: float, count: int) -> Array:
    r"""Covariance ``s^2 (sum psi psi')^-1`` with ``s^2 = sum eps^2 / (N - p)``.

    Valid for a converged estimate of a model that contains the system, and white output noise. Refined instrumental
    variables then are as good as maximum likelihood, so this is also the Cramér-Rao bound with the estimated variance.
    """
    size = hessian.shape[0]
    undefined = np.full((size, size), np.nan)
    diagonal = np.diag(hessian)
    if count <= size or not np.isfinite(hessian).all() or (diagonal <= 0).any():
        return undefined
    scale = 1.0 / np.sqrt(diagonal)
    correlation = hessian * np.outer(scale, scale)
    # Beyond 1/eps the inverse holds no correct digit: NaN says so, a tidy number would not.
    if condition_number(hessian) > 1e14:
        return undefined
    try:
        inverse = np.linalg.inv(correlation)
    except np.linalg.LinAlgError:
        return undefined
    covariance: Array = inverse * np.outer(scale, scale) * squared_error / (count - size)
    return 0.5 * (covariance + covariance.T)


def condition_number(hessian: Array) -> float:
    """Condition number of ``sum psi psi'`` with unit diagonal, whatever the units of the parameters."""
    diagonal = np.diag(hessian)
    if not np.isfinite(hessian).all() or (diagonal <= 0).any():
        return float("inf")
    scale = 1.0 / np.sqrt(diagonal)
    values = np.linalg.eigvalsh(hessian * np.outer(scale, scale))
    return float(values[-1] / values[0]) if values[0] > 0 else float("inf")
