"""How many standard errors intervals need, from simulated noise: a bootstrap-t of the linearised estimate."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.noise_model import NoiseModel
from ctid_cli.inference.robust import robust_covariance
from ctid_cli.signals.noise import ArmaNoise

#: Seed of the noise: one record always gets one answer.
SEED = 20140801
#: Told how many draws of all are done.
Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class BootstrapT:
    """Errors of estimates from simulated noise, each with the covariance that its own residuals give it."""

    #: Shape (draws, p).
    errors: Array
    #: Shape (draws, p, p).
    covariances: Array

    def quantile(self, gradient: Array, level: float) -> float:
        """Standard errors within which the estimate of a quantity stays with that probability, from its gradient."""
        variances = np.einsum("i,kij,j->k", gradient, self.covariances, gradient)
        defined = variances > 0
        if not defined.any():
            return float("nan")
        ratios = np.abs(self.errors[defined] @ gradient) / np.sqrt(variances[defined])
        return float(np.quantile(ratios, level))


def bootstrap_t(
    psi: Sequence[Array], noise: NoiseModel, draws: int, *, regular: bool, progress: Progress | None = None
) -> BootstrapT:
    """Draw noise, and estimate from each draw the parameters, to first order, and their covariance with its own noise.

    To first order ``theta + M^-1 sum psi v`` is the estimate and ``v - psi M^-1 sum psi v`` are the residuals.
    """
    source = ArmaNoise((1.0,), tuple(noise.coefficients.tolist()), innovation_variance=noise.innovation_variance)
    rng = np.random.default_rng(SEED)
    orthonormal, triangle = np.linalg.qr(np.concatenate(psi))
    solve = np.linalg.solve(triangle, orthonormal.T)
    size = psi[0].shape[1]
    errors, covariances = np.empty((draws, size)), np.empty((draws, size, size))
    for k in range(draws):
        drawn = [source.generate(np.empty(len(block)), rng) for block in psi]
        errors[k] = solve @ np.concatenate(drawn)
        left = [v - block @ errors[k] for v, block in zip(drawn, psi, strict=True)]
        covariances[k] = robust_covariance(psi, left, regular=regular)[0]
        if progress is not None:
            progress(k + 1, draws)
    return BootstrapT(errors, covariances)
