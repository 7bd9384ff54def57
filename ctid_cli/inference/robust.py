"""Covariance of an output-error estimate whose residuals are coloured: the sandwich."""

from collections.abc import Sequence

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.covariance import sandwich, unit_inverse
from ctid_cli.inference.noise_model import fit_noise_model


def sandwich_covariance(psi: Sequence[Array], residuals: Sequence[Array], *, regular: bool) -> Array:
    r"""Covariance ``M^-1 Sigma M^-1`` of an unweighted output-error estimate under coloured output noise.

    With noise v independent of the input (open loop) and ``M = sum psi psi'`` [1]_,

    .. math:: \Sigma = \operatorname{cov} \sum_t \psi_t v_t
              = \sum_\tau R_v(\tau) \sum_t \psi_{t+\tau} \psi_t'.

    *Regular clock*: ``R_v`` is that of an autoregressive model of the residuals (:func:`fit_noise_model`), common to
    all experiments. Fitting takes from the residuals the part of the noise that the sensitivities explain,
    ``sum eps^2 = N R_v(0) - trace(M^-1 Sigma)`` on average; Sigma is divided by the share that is left, which is
    ``(N - p)/N`` for white residuals. With missing samples lags count the samples that are left: those of a stationary
    noise at random places, or around a few long gaps, are nearly stationary again.

    *Irregular clock*: a heteroskedasticity and autocorrelation consistent Sigma of ``psi eps`` in the order of the
    samples: each column is whitened by an autoregression whose order Akaike's criterion chooses, and the covariance of
    the whitened columns is divided by the autoregressions' gains [2]_, times ``N/(N - p)``. It does not ask the noise
    to be stationary from sample to sample, at the price of precision: with noise correlated over some ten samples,
    2000 samples give standard errors right to within 30 %, more often too large than too small.

    With feedback from the output to the input the noise is not independent of psi, and neither form holds.
    """
    size, count = psi[0].shape[1], sum(block.size for block in residuals)
    found = unit_inverse(sum((block.T @ block for block in psi), np.zeros((size, size)))) if count > size else None
    if found is None:
        return np.full((size, size), np.nan)
    inverse, scale = found
    scaled = [block * scale for block in psi]
    if regular:
        noise = fit_noise_model(residuals)
        sigma = sum((block.T @ noise.covariance_times(block) for block in scaled), np.zeros((size, size)))
        variance = float(noise.first_autocovariances[0])
        left = 1.0 - float(np.trace(inverse @ sigma)) / (count * variance) if variance > 0 else 1.0
    else:
        sigma = _long_run_covariance([block * error[:, None] for block, error in zip(scaled, residuals, strict=True)])
        left = 1.0 - size / count
    return sandwich(inverse, scale, sigma, left) if left > 0 else np.full((size, size), np.nan)


def _long_run_covariance(scores: Sequence[Array]) -> Array:
    """Covariance of the sum of the rows of independent blocks, an autoregression for every column."""
    from scipy.signal import lfilter  # slow to import

    models = [fit_noise_model([block[:, j] for block in scores]) for j in range(scores[0].shape[1])]
    start = max(model.order for model in models)
    white = [
        np.column_stack([lfilter(m.coefficients, [1.0], block[:, j]) for j, m in enumerate(models)])[start:]
        for block in scores
    ]
    used = sum(block.shape[0] for block in white)
    if used == 0:
        return np.full((len(models), len(models)), np.nan)
    gain = np.array([model.coefficients.sum() for model in models])
    total = sum((block.T @ block for block in white), np.zeros((len(models), len(models))))
    return np.asarray(total / np.outer(gain, gain) * sum(block.shape[0] for block in scores) / used)
