"""Poles, time constants, frequencies, damping and gain of an estimated model, with their standard errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import norm

from ctid_cli.models.transfer_function import TransferFunction

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

NAN = float("nan")


@dataclass(frozen=True)
class DerivedParameter:
    """A quantity computed from the coefficients, and its accuracy.

    Parameters
    ----------
    name : str
        For example ``time_constant_1``; poles are numbered from the fastest, a complex pair has one number.
    estimate : float
        Value [unit].
    standard_error : float
        By the delta method [unit]; NaN where it is not defined.
    low, high : float
        Confidence interval [unit]; NaN where it is not defined.
    unit : str
        For example ``s`` or ``rad/s``; ``-`` if there is none.
    reason : str
        Why the accuracy is not defined, in a sentence; empty otherwise.
    """

    name: str
    estimate: float
    standard_error: float
    low: float
    high: float
    unit: str
    reason: str = ""


def pole_jacobian(denominator: ArrayLike, poles: ArrayLike) -> NDArray[np.complex128]:
    """Derivatives of the poles with respect to the denominator coefficients: ``dp/da_i = -p^(n-i) / A'(p)``.

    Parameters
    ----------
    denominator : array_like, shape (n + 1,)
        Monic A in descending powers.
    poles : array_like, shape (n,)
        Its roots [rad/s].

    Returns
    -------
    ndarray, shape (n, n)
        Row: pole; column: ``a_1 … a_n``; not finite for repeated poles.
    """
    a = np.asarray(denominator, dtype=float)
    p = np.asarray(poles, dtype=complex)
    n = a.size - 1
    # A'(p) as a product over the other poles: exact where the polynomial form would cancel.
    distances = p[:, None] - p[None, :]
    np.fill_diagonal(distances, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        jacobian: ComplexArray = -(p[:, None] ** np.arange(n - 1, -1, -1)) / np.prod(distances, axis=1)[:, None]
    return jacobian


def derived_parameters(
    model: TransferFunction,
    covariance: ArrayLike,
    *,
    level: float = 0.95,
    gain_unit: str = "output unit/input unit",
) -> tuple[DerivedParameter, ...]:
    r"""What users read off a model, with standard errors by the delta method.

    Parameters
    ----------
    model : TransferFunction
        The estimate.
    covariance : array_like, shape (n + m + 1, n + m + 1)
        Covariance of ``a_1 … a_n, b_0 … b_m``: the first rows and columns of that of all parameters.
    level : float, default 0.95
        Confidence level of the intervals [-].
    gain_unit : str, default "output unit/input unit"
        Unit of the static gain.

    Returns
    -------
    tuple of DerivedParameter
        For each real pole ``pole_k`` [rad/s] and ``time_constant_k`` [s]; for each complex pair ``pole_k_real``,
        ``pole_k_imag`` [rad/s], ``natural_frequency_k`` [rad/s], ``natural_frequency_k_hz`` [Hz], ``damping_k`` [-];
        and ``static_gain``.

    Raises
    ------
    ValueError
        If the covariance does not fit the model.

    Notes
    -----
    ``var g = (dg/dtheta) C (dg/dtheta)'`` with analytic derivatives, those of the poles from :func:`pole_jacobian`, and
    ``g +- z se``. The linearisation only holds where a pole moves little compared with its distance to the others. A
    pole whose ``z`` standard errors, ``sqrt(var Re p + var Im p)``, reach another pole is called undetermined: its
    accuracy is NaN and the reason is given. Natural frequency and damping of a pair only need it to be far
    from the *other* poles: they are regular where the pair meets on the real axis.

    Examples
    --------
    >>> model = TransferFunction([2.0], [1.0, 0.5])
    >>> for row in derived_parameters(model, np.diag([0.05, 0.1]) ** 2):
    ...     print(row.name, row.estimate, round(row.standard_error, 3), row.unit)
    pole_1 -0.5 0.05 rad/s
    time_constant_1 2.0 0.2 s
    static_gain 4.0 0.447 output unit/input unit
    """
    C = np.asarray(covariance, dtype=float)
    n = model.order
    coefficients = C.shape[0] - n
    if C.shape != (C.shape[0],) * 2 or coefficients < model.numerator.size:
        raise ValueError(
            f"the covariance must be square, with a row for each of {n} denominator and at least "
            f"{model.numerator.size} numerator coefficients; got shape {C.shape}"
        )
    quantile = float(norm.ppf(0.5 + level / 2))
    poles = model.poles
    jacobian = pole_jacobian(model.denominator, poles)
    A = C[:n, :n]
    rows: list[DerivedParameter] = []

    def row(name: str, estimate: float, gradient: Array, block: Array, unit: str, reason: str = "") -> None:
        variance = float(gradient @ block @ gradient) if np.isfinite(gradient).all() else NAN
        error = float(np.sqrt(variance)) if variance >= 0 and not reason else NAN
        if not reason and not np.isfinite(error):
            reason = "The covariance of the coefficients is not defined."
        reach = quantile * error
        rows.append(DerivedParameter(name, estimate, error, estimate - reach, estimate + reach, unit, reason))

    number = 0
    for k, pole in enumerate(poles):
        if pole.imag < 0:
            continue
        number += 1
        slope = jacobian[k]
        reason = _undetermined(poles, k, slope, A, quantile, np.arange(n) != k)
        if pole.imag == 0:
            p = float(pole.real)
            row(f"pole_{number}", p, slope.real, A, "rad/s", reason)
            if p == 0:
                reason = "The pole lies at the origin: it integrates and has no time constant."
                row(f"time_constant_{number}", float("inf"), slope.real, A, "s", reason)
            else:
                row(f"time_constant_{number}", -1.0 / p, slope.real / p**2, A, "s", reason)
            continue
        x, y = float(pole.real), float(pole.imag)
        frequency = abs(complex(pole))
        row(f"pole_{number}_real", x, slope.real, A, "rad/s", reason)
        row(f"pole_{number}_imag", y, slope.imag, A, "rad/s", reason)
        # d(x^2 + y^2) = 2 Re(conj(p) dp)
        radial = (x * slope.real + y * slope.imag) / frequency
        turning = y * (x * slope.imag - y * slope.real) / frequency**3
        others = (np.arange(n) != k) & (poles != np.conj(pole))
        reason = _undetermined(poles, k, slope, A, quantile, others)
        row(f"natural_frequency_{number}", frequency, radial, A, "rad/s", reason)
        row(f"natural_frequency_{number}_hz", frequency / (2 * np.pi), radial / (2 * np.pi), A, "Hz", reason)
        row(f"damping_{number}", -x / frequency, turning, A, "-", reason)

    gradient = np.zeros(C.shape[0])
    last = float(model.denominator[-1])
    if last == 0:
        reason = "The model integrates (a pole at the origin) and has no static gain."
        row("static_gain", float("inf"), gradient, C, gain_unit, reason)
    else:
        gradient[-1] = 1.0 / last
        if n:
            gradient[n - 1] = -model.dc_gain / last
        row("static_gain", model.dc_gain, gradient, C, gain_unit)
    return tuple(rows)


def _undetermined(
    poles: ComplexArray, k: int, slope: ComplexArray, A: Array, quantile: float, others: NDArray[np.bool_]
) -> str:
    """Reason for which pole k has no standard error, or nothing."""
    if not others.any():
        return ""
    distance = float(np.abs(poles[others] - poles[k]).min())
    size = float(np.abs(poles).max())
    text = (
        "This pole lies so close to another that these data cannot tell them apart: its standard error is not defined; "
        "fewer poles may do."
    )
    if distance <= 1e-7 * size or not np.isfinite(slope).all():
        return text
    with np.errstate(invalid="ignore"):
        spread = float(np.sqrt(slope.real @ A @ slope.real + slope.imag @ A @ slope.imag))
    return text if quantile * spread >= distance else ""
