"""Covariance of an output-error estimate whose residuals are coloured: the sandwich."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.covariance import condition_number
from ctid_cli.inference.noise_model import fit_noise_model


def sandwich_covariance(psi: Array | Sequence[Array], residuals: Array | Sequence[Array], *, regular: bool) -> Array:
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
    sensitivities = [psi] if isinstance(psi, np.ndarray) else list(psi)
    errors = [residuals] if isinstance(residuals, np.ndarray) else list(residuals)
    if [block.shape[0] for block in sensitivities] != [block.size for block in errors]:
        raise ValueError("psi and residuals must have one block per experiment, of the same number of samples")
    size = sensitivities[0].shape[1]
    present = [np.isfinite(block) for block in errors]
    sensitivities = [block[use] for block, use in zip(sensitivities, present, strict=True) if use.any()]
    errors = [block[use] for block, use in zip(errors, present, strict=True) if use.any()]
    count = sum(block.size for block in errors)
    undefined = np.full((size, size), np.nan)

    hessian = sum((block.T @ block for block in sensitivities), np.zeros((size, size)))
    if count <= size or not condition_number(hessian) <= 1e14:
        return undefined
    scale = 1.0 / np.sqrt(np.diag(hessian))
    sensitivities = [block * scale for block in sensitivities]
    inverse = np.linalg.inv(hessian * np.outer(scale, scale))
    if regular:
        noise = fit_noise_model(errors)
        sigma = np.zeros((size, size))
        for block in sensitivities:
            sigma += block.T @ noise.covariance_times(block)
        variance = float(noise.first_autocovariances[0])
        left = 1.0 - float(np.trace(inverse @ sigma)) / (count * variance) if variance > 0 else 1.0
    else:
        scores = [block * error[:, None] for block, error in zip(sensitivities, errors, strict=True)]
        sigma = _long_run_covariance(scores)
        left = 1.0 - size / count
    if left <= 0:
        return undefined
    covariance: Array = inverse @ sigma @ inverse * np.outer(scale, scale) / left
    return 0.5 * (covariance + covariance.T)


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
    covariance: Array = total / np.outer(gain, gain) * sum(block.shape[0] for block in scores) / used
    return covariance
