"""Asymptotic covariance of an output-error estimate with white residuals."""

import numpy as np

from ctid_cli.arrays import Array

#: Beyond this condition number the inverse holds no correct digit: NaN says so, a tidy number would not.
LARGEST_CONDITION = 1e14


def white_noise_covariance(hessian: Array, squared_error: float, count: int) -> Array:
    r"""Covariance ``s^2 (sum psi psi')^-1`` with ``s^2 = sum eps^2 / (N - p)``.

    Valid for a converged estimate of a model that contains the system, and white output noise. Refined instrumental
    variables then are as good as maximum likelihood, so this is also the Cramér-Rao bound with the estimated variance.
    """
    size = hessian.shape[0]
    found = unit_inverse(hessian) if count > size else None
    if found is None:
        return np.full((size, size), np.nan)
    inverse, scale = found
    covariance: Array = inverse * np.outer(scale, scale) * squared_error / (count - size)
    return 0.5 * (covariance + covariance.T)


def sandwich(inverse: Array, scale: Array, middle: Array, left: float = 1.0) -> Array:
    """``M^-1 Sigma M^-1`` over a divisor, from what `unit_inverse` makes of M and from Sigma in its units."""
    covariance: Array = inverse @ middle @ inverse * np.outer(scale, scale) / left
    return 0.5 * (covariance + covariance.T)


def unit_inverse(hessian: Array) -> tuple[Array, Array] | None:
    """Inverse of ``sum psi psi'`` with unit diagonal, and the scales of psi that make it so; None if singular."""
    if not condition_number(hessian) <= LARGEST_CONDITION:
        return None
    scale = 1.0 / np.sqrt(np.diag(hessian))
    return np.asarray(np.linalg.inv(hessian * np.outer(scale, scale))), scale


def condition_number(hessian: Array) -> float:
    """Condition number of ``sum psi psi'`` with unit diagonal, whatever the units of the parameters."""
    diagonal = np.diag(hessian)
    if not np.isfinite(hessian).all() or (diagonal <= 0).any():
        return float("inf")
    scale = 1.0 / np.sqrt(diagonal)
    values = np.linalg.eigvalsh(hessian * np.outer(scale, scale))
    return float(values[-1] / values[0]) if values[0] > 0 else float("inf")
