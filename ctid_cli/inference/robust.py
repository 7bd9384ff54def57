"""Covariance of an output-error estimate whose residuals are coloured: the sandwich."""

from collections.abc import Sequence

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.covariance import sandwich, unit_inverse
from ctid_cli.inference.noise_model import NoiseModel, fit_noise_model
from ctid_cli.inference.residual_likelihood import fit_residual_noise

#: A clock of which 95 % of the intervals are this close to their median counts as regular for the noise.
NEARLY_REGULAR = 0.05


def nearly_regular(times: Array) -> bool:
    """Whether lags counted in samples are lags in time, up to jitter."""
    intervals = np.diff(times)
    middle = float(np.median(intervals))
    return bool(np.mean(np.abs(intervals - middle) <= NEARLY_REGULAR * middle) >= 0.95)


def robust_covariance(psi: Sequence[Array], residuals: Sequence[Array], *, regular: bool) -> tuple[Array, NoiseModel]:
    r"""Covariance ``M^-1 Sigma M^-1`` of an unweighted output-error estimate under coloured noise, and that noise.

    With noise v independent of the input (open loop) and ``M = sum psi psi'``,

    .. math:: \Sigma = \operatorname{cov} \sum_t \psi_t v_t
              = \sum_\tau R_v(\tau) \sum_t \psi_{t+\tau} \psi_t'.

    The noise is an autoregression by restricted maximum likelihood (:func:`fit_residual_noise`), common to all
    experiments.

    *Regular clock*: ``R_v`` is that of this autoregression. White residuals give ``s^2 M^-1``. With missing samples
    lags count the samples that are left: those of a stationary noise at random places, or around a few long gaps, are
    nearly stationary again.

    *Irregular clock*: a heteroskedasticity and autocorrelation consistent Sigma of ``psi eps`` in the order of the
    samples: each column is whitened by an autoregression whose order Akaike's criterion chooses, and the covariance of
    the whitened columns is divided by the autoregressions' gains, times ``N/(N - p)``. It does not ask the noise to be
    stationary from sample to sample, at the price of precision: standard errors are more often too large than too
    small, after steps by up to a half. The autoregression then only tells how much the samples are worth.

    With feedback from the output to the input the noise is not independent of psi, and neither form holds.
    """
    size, count = psi[0].shape[1], sum(block.size for block in residuals)
    found = unit_inverse(sum((block.T @ block for block in psi), np.zeros((size, size)))) if count > size else None
    if found is None:
        return np.full((size, size), np.nan), fit_noise_model(residuals, max_order=0)
    inverse, scale = found
    scaled = [block * scale for block in psi]
    noise = fit_residual_noise(scaled, residuals)
    if regular:
        sigma = sum((noise.covariance_of(block) for block in scaled), np.zeros((size, size)))
        return sandwich(inverse, scale, sigma), noise
    sigma = _long_run_covariance([block * error[:, None] for block, error in zip(scaled, residuals, strict=True)])
    return sandwich(inverse, scale, sigma, 1.0 - size / count), noise


def _long_run_covariance(scores: Sequence[Array]) -> Array:
    """Covariance of the sum of the rows of independent blocks, an autoregression for every column."""
    models = [fit_noise_model([block[:, j] for block in scores]) for j in range(scores[0].shape[1])]
    start = max(model.order for model in models)
    white = [np.column_stack([m.innovations(block[:, j]) for j, m in enumerate(models)])[start:] for block in scores]
    used = sum(block.shape[0] for block in white)
    if used == 0:
        return np.full((len(models), len(models)), np.nan)
    gain = np.array([model.coefficients.sum() for model in models])
    total = sum((block.T @ block for block in white), np.zeros((len(models), len(models))))
    return np.asarray(total / np.outer(gain, gain) * sum(block.shape[0] for block in scores) / used)
