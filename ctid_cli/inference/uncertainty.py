"""Standard errors and intervals of an estimate, by what its noise is taken for."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.bootstrap import BootstrapT, Progress, bootstrap_t
from ctid_cli.inference.covariance import white_noise_covariance
from ctid_cli.inference.quantile import normal_quantile, student_quantile
from ctid_cli.inference.residuals import all_white
from ctid_cli.inference.robust import robust_covariance

#: What standard errors take the noise for; ``auto`` is ``white`` unless the residuals are not, ``sandwich`` an earlier
#: name of ``robust``.
Covariance = Literal["auto", "white", "robust", "bootstrap", "sandwich"]
#: Draws of a bootstrap that is asked for.
DRAWS = 500
#: Student's t of fewer degrees of freedom has no variance.
LEAST_FREEDOM = 2.0
#: With fewer degrees of freedom the noise is hardly known.
ENOUGH_FREEDOM = 5.0


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariance of the parameters, and how many standard errors their intervals reach."""

    kind: Literal["white", "robust", "bootstrap"]
    #: Directions in which the parameters are free, shape (p, f), and the covariance along them, shape (f, f).
    tangent: Array
    free_covariance: Array
    #: How many independent samples the record is worth [-].
    effective_count: float
    bootstrap: BootstrapT | None = None

    @property
    def covariance(self) -> Array:
        """Of all parameters, NaN for those that are held, shape (p, p)."""
        covariance = self.tangent @ self.free_covariance @ self.tangent.T
        held = ~self.tangent.any(axis=1)
        covariance[held] = covariance[:, held] = np.nan
        return np.asarray(covariance)

    @property
    def spare(self) -> float:
        """Independent samples beyond the number of parameters [-]."""
        return self.effective_count - len(self.free_covariance)

    @property
    def degrees_of_freedom(self) -> float:
        """Of Student's t [-]."""
        return max(LEAST_FREEDOM, self.spare)

    @property
    def short(self) -> bool:
        """Whether the record is too short for the colour of its noise."""
        return self.kind != "white" and self.spare < ENOUGH_FREEDOM

    def quantile(self, gradient: Array, level: float = 0.95) -> float:
        """Standard errors to each side of a quantity with this gradient by the leading parameters."""
        if self.bootstrap is None:
            return student_quantile(self.degrees_of_freedom, level)
        return self.bootstrap.quantile(gradient @ self.tangent[: gradient.size], level)

    def widened(self) -> Array:
        """Covariance whose normal intervals of the parameters are those of the bootstrap."""
        covariance = self.covariance
        if self.bootstrap is None:
            return covariance
        factors = np.array([self.quantile(row) for row in np.eye(len(covariance))]) / normal_quantile()
        return covariance * np.outer(factors, factors)


def estimate_uncertainty(
    psi: Sequence[Array],
    residuals: Sequence[Array],
    kind: Covariance,
    draws: int = DRAWS,
    *,
    regular: bool,
    tangent: Array | None = None,
    progress: Progress | None = None,
) -> Uncertainty:
    """Uncertainty of a least output-error estimate from its sensitivities and residuals, an array each per experiment.

    With a tangent, shape (p, f), the parameters were free along its columns only, as at a bound.
    """
    basis = np.eye(psi[0].shape[1]) if tangent is None else tangent
    free = psi if tangent is None else [block @ tangent for block in psi]
    count = sum(block.size for block in residuals)
    effective, bootstrap = float(count), None
    if kind == "white" or (kind == "auto" and all_white(residuals)):
        hessian = np.sum([block.T @ block for block in free], axis=0)
        found = white_noise_covariance(hessian, sum(float(e @ e) for e in residuals), count)
        kind = "white"
    else:
        found, noise = robust_covariance(free, residuals, regular=regular)
        effective = noise.effective_count(count)
        if kind == "bootstrap" and np.isfinite(found).all():
            bootstrap = bootstrap_t(free, noise, draws, regular=regular, progress=progress)
        kind = "robust" if bootstrap is None else "bootstrap"
    return Uncertainty(kind, basis, found, effective, bootstrap)
