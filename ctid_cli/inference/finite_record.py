"""Accuracy on a record of given length, from the sensitivities that its own input brings about."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.filtering.bank import standard_rows
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.covariance import condition_number
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record


def additive_sensitivities(model: AdditiveModel, signal: HeldSignal, times: ArrayLike) -> Array:
    r"""Derivatives of the output of an additive model with respect to its parameters.

    Each is the exact response of a transfer function: ``-p^k B/(p^l A^2)`` for ``a_k`` and ``p^k/(p^l A)`` for
    ``b_k``.
    """
    instants = np.asarray(times, dtype=float)
    columns = []
    for submodel in model.submodels:
        b, a = np.asarray(submodel.numerator, dtype=float), np.asarray(submodel.denominator, dtype=float)
        origin = np.zeros(submodel.integrators)
        single = np.concatenate([a, origin])
        double = np.concatenate([np.convolve(a, a), origin])
        filters = [(np.concatenate([-b, np.zeros(k)]), double) for k in range(1, a.size)]
        filters += [(np.eye(1, k + 1)[0], single) for k in range(b.size)]
        columns += [simulate(TransferFunction(*parts, model.delay), signal, instants) for parts in filters]
    return np.column_stack(columns)


def unfactored_sensitivities(
    model: TransferFunction,
    signal: HeldSignal,
    times: ArrayLike,
    zeros: int | None = None,
    *,
    estimate_delay: bool = False,
) -> Array:
    """Derivatives of the output of a transfer function with respect to its coefficients and its delay."""
    own = model.numerator.size - 1
    degree = own if zeros is None else zeros
    if not own <= degree < model.order:
        raise ValueError(f"zeros must be from {own}, as the model has, to below its {model.order} poles; got {zeros}")
    instants = np.asarray(times, dtype=float)
    structure = Structure(model.order, degree, estimate_delay)
    data = filter_data(Record(instants, np.zeros(instants.size), signal), start=-np.inf)
    rows = standard_rows(data, model.denominator, model.numerator, model.delay)
    return np.asarray(rows[:, structure.sensitivity_rows] * structure.signs)


def finite_record_covariance(psi: ArrayLike, autocovariances: ArrayLike) -> Array:
    r"""Covariance of an unweighted output-error estimate from one record with noise of known autocovariances.

    With ``M = psi' psi`` and the covariance matrix R of the noise, ``M^-1 psi' R psi M^-1``, to first order in the
    noise: ``sigma^2 M^-1`` for white noise. Unlike the limit of long records it knows the start from rest, which counts
    as long as the memory of the system or of its loop is not short against the record.
    """
    from scipy.linalg import matmul_toeplitz

    sensitivities = np.asarray(psi, dtype=float)
    lags = np.atleast_1d(np.asarray(autocovariances, dtype=float))
    count, size = sensitivities.shape
    hessian = sensitivities.T @ sensitivities
    if count < size or not condition_number(hessian) <= 1e14:
        return np.full((size, size), np.nan)
    scale = 1.0 / np.sqrt(np.diag(hessian))
    scaled = sensitivities * scale
    inverse = np.linalg.inv(hessian * np.outer(scale, scale))
    first_column = np.zeros(count)
    first_column[: lags.size] = lags[:count]
    coloured = lags[0] * scaled if lags.size == 1 else matmul_toeplitz(first_column, scaled)
    covariance: Array = inverse @ (scaled.T @ coloured) @ inverse * np.outer(scale, scale)
    return 0.5 * (covariance + covariance.T)
