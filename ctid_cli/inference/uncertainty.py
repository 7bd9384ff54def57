"""Standard errors and intervals of an estimate, by what its noise is taken for."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.bootstrap import BootstrapT, Progress, bootstrap_t
from ctid_cli.inference.covariance import white_noise_covariance
from ctid_cli.inference.quantile import student_quantile
from ctid_cli.inference.residuals import all_white
from ctid_cli.inference.robust import robust_covariance

#: What standard errors take the noise for; ``auto`` is ``white`` unless the residuals are not, ``sandwich`` an earlier
#: name of ``robust``.
Covariance = Literal["auto", "white", "robust", "bootstrap", "sandwich"]
#: The formula that was used; by ``biased`` there is no standard error (`BIASED`).
Formula = Literal["white", "robust", "bootstrap", "biased"]
#: Draws of a bootstrap that is asked for.
DRAWS = 500
#: Student's t of fewer degrees of freedom has no variance.
LEAST_FREEDOM = 2.0
#: With fewer degrees of freedom the noise is hardly known.
ENOUGH_FREEDOM = 5.0


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariance of the parameters, and how many standard errors their intervals reach."""

    kind: Formula
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
        return self.kind in ("robust", "bootstrap") and self.spare < ENOUGH_FREEDOM

    def quantile(self, gradient: Array, level: float = 0.95) -> float:
        """Standard errors to each side of a quantity with this gradient by the leading parameters."""
        if self.bootstrap is None:
            return student_quantile(self.degrees_of_freedom, level)
        return self.bootstrap.quantile(gradient @ self.tangent[: gradient.size], level)

    def quantiles(self, level: float = 0.95) -> Array:
        """Standard errors to each side of every parameter, shape (p,)."""
        size = len(self.tangent)
        if self.bootstrap is None:
            return np.full(size, self.quantile(np.zeros(size), level))
        return np.array([self.quantile(row, level) for row in np.eye(size)])

    def transformed(self, jacobian: Array) -> "Uncertainty":
        """Uncertainty of parameters with these derivatives by the present ones, shape (q, p)."""
        return replace(self, tangent=jacobian @ self.tangent)

    @property
    def in_ignored_loop(self) -> "Uncertainty":
        """What is left where the fit ignores the loop of its record: nothing, unless the residuals are white."""
        if self.kind == "white" or not np.isfinite(self.free_covariance).all():
            return self
        return replace(self, kind="biased", free_covariance=np.full_like(self.free_covariance, np.nan), bootstrap=None)


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
