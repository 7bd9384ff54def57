"""Accuracy on a record of given length, from the sensitivities that its own input brings about."""

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.filtering.bank import second_moments, standard_rows
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.simulate import feedthrough
from ctid_cli.filtering.submodels import SubmodelFilter
from ctid_cli.inference.covariance import sandwich, unit_inverse, white_noise_covariance
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record


def sensitivities(
    model: AdditiveModel | TransferFunction,
    signal: HeldSignal,
    times: ArrayLike,
    zeros: int | None = None,
    *,
    estimate_delay: bool = False,
) -> Array:
    """Derivatives of a model's output at given times by its parameters, of a fraction also by its delay."""
    instants = np.asarray(times, dtype=float)
    data = filter_data(Record(instants, np.zeros(instants.size), signal), start=-np.inf)
    if isinstance(model, AdditiveModel):
        found = SubmodelFilter(data, model.terms, model.delay).rows(model.theta)
        if found is None:
            raise DataError("the response of the system is not finite")
        return found[0]
    structure = Structure(model.order, model.numerator.size - 1 if zeros is None else zeros, estimate_delay)
    if model.order == 0:
        return np.column_stack([signal.at(instants - model.delay), *[np.zeros(instants.size)] * estimate_delay])
    n, (direct, rest) = model.order, feedthrough(model)
    rows = standard_rows(data, model.denominator, rest if direct else model.numerator, model.delay)
    if structure.zeros == n:
        # p^n/A u = u - sum of a_i p^(n-i)/A u, and x is what passes at once besides. Between the breaks of a held input
        # the derivative by the delay has nothing of that.
        rows[:, n + 1 : 2 * n + 1] += direct * rows[:, :n]
        rows[:, n] -= rows[:, n - 1 :: -1] @ model.denominator[1:]
    return np.asarray(rows[:, structure.sensitivity_rows] * structure.signs)


def finite_record_covariance(psi: Array, autocovariances: ArrayLike) -> Array:
    r"""Covariance of an unweighted output-error estimate from one record with noise of known autocovariances.

    With ``M = psi' psi`` and the covariance matrix R of the noise, ``M^-1 psi' R psi M^-1``, to first order in the
    noise: ``sigma^2 M^-1`` for white noise. Unlike the limit of long records it knows the start from rest, which counts
    as long as the memory of the system or of its loop is not short against the record.
    """
    from scipy.linalg import matmul_toeplitz

    lags = np.atleast_1d(np.asarray(autocovariances, dtype=float))
    count, size = psi.shape
    found = unit_inverse(psi.T @ psi) if count >= size else None
    if found is None:
        return np.full((size, size), np.nan)
    inverse, scale = found
    scaled = psi * scale
    first_column = np.zeros(count)
    first_column[: lags.size] = lags[:count]
    coloured = lags[0] * scaled if lags.size == 1 else matmul_toeplitz(first_column, scaled)
    return sandwich(inverse, scale, scaled.T @ coloured)


def cramer_rao_bound(
    model: TransferFunction,
    record: Record,
    noise_standard_deviation: float,
    start: float = 0.0,
    estimate_delay: bool = True,
) -> Array:
    """Cramér-Rao bound for white Gaussian output noise.

    Parameters
    ----------
    model : TransferFunction
        The true, strictly proper system.
    record : Record
        Instants and input; its outputs are not used, but missing ones count as missing.
    noise_standard_deviation : float
        Standard deviation of the noise [output unit].
    start : float, default 0.0
        Samples earlier than this after the first input break [s] are not used.
    estimate_delay : bool, default True
        Whether the delay is unknown too.

    Returns
    -------
    ndarray, shape (p, p)
        Lower bound of the covariance of ``(a_1 … a_n, b_0 … b_m[, delay])``.

    Notes
    -----
    ``sigma^2 (sum psi psi')^-1`` with the exact sensitivities psi of the simulated output at these instants.
    """
    structure = Structure(model.order, model.numerator.size - 1, estimate_delay)
    data = filter_data(record, start)
    moments = second_moments(data, model.denominator, model.numerator, model.delay)
    # N - p and the sum of squares are chosen so that their ratio is the known variance.
    squared_error = noise_standard_deviation**2 * (data.count - structure.size)
    return white_noise_covariance(structure.hessian(moments), squared_error, data.count)
