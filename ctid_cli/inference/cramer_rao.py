"""The best accuracy that any unbiased estimator can reach on a given record."""

from __future__ import annotations

from ctid_cli.arrays import Array
from ctid_cli.filtering.bank import second_moments
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.inference.covariance import white_noise_covariance
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.record import Record


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
    count = data.count
    return white_noise_covariance(
        structure.hessian(moments), noise_standard_deviation**2 * (count - structure.size), count
    )
