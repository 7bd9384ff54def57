"""Poles, time constants, frequencies, damping and gain of an estimated model, with their standard errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, BoolArray, ComplexArray
from ctid_cli.inference.quantile import normal_quantile
from ctid_cli.models.factoring import pole_jacobian
from ctid_cli.models.transfer_function import TransferFunction

NAN = float("nan")


@dataclass(frozen=True)
class DerivedParameter:
    """A quantity computed from the coefficients, and its accuracy."""

    name: str
    #: Value [unit].
    estimate: float
    #: By the delta method [unit]; NaN where it is not defined.
    standard_error: float
    #: Confidence interval [unit]; NaN where it is not defined.
    low: float
    high: float
    unit: str
    reason: str = ""

    @classmethod
    def by_delta_method(
        cls,
        name: str,
        estimate: float,
        gradient: Array,
        covariance: Array,
        unit: str,
        quantile: float,
        reason: str = "",
    ) -> DerivedParameter:
        """A quantity and its accuracy from its gradient: ``var g = (dg/dtheta) C (dg/dtheta)'``."""
        variance = float(gradient @ covariance @ gradient) if np.isfinite(gradient).all() else NAN
        error = float(np.sqrt(variance)) if variance >= 0 and not reason else NAN
        if not reason and not np.isfinite(error):
            reason = "The covariance of the coefficients is not defined."
        reach = quantile * error
        return cls(name, estimate, error, estimate - reach, estimate + reach, unit, reason)


def derived_parameters(
    model: TransferFunction,
    covariance: ArrayLike,
    *,
    level: float = 0.95,
    gain_unit: str = "output unit/input unit",
) -> tuple[DerivedParameter, ...]:
    r"""What users read off a model, with standard errors by the delta method.

    ``var g = (dg/dtheta) C (dg/dtheta)'`` with analytic derivatives, those of the poles from :func:`pole_jacobian`, and
    ``g +- z se``. The linearisation only holds where a pole moves little compared with its distance to the others. A
    pole whose ``z`` standard errors, ``sqrt(var Re p + var Im p)``, reach another pole is called undetermined: its
    accuracy is NaN and the reason is given. Natural frequency and damping of a pair only need it to be far
    from the *other* poles: they are regular where the pair meets on the real axis.
    """
    C = np.asarray(covariance, dtype=float)
    n = model.order
    coefficients = C.shape[0] - n
    if C.shape != (C.shape[0],) * 2 or coefficients < model.numerator.size:
        raise ValueError(
            f"the covariance must be square, with a row for each of {n} denominator and at least "
            f"{model.numerator.size} numerator coefficients; got shape {C.shape}"
        )
    quantile = normal_quantile(level)
    poles = model.poles
    rows = pole_rows(poles, pole_jacobian(model.denominator, poles), C[:n, :n], quantile)
    gradient = np.zeros(C.shape[0])
    last = float(model.denominator[-1])
    reason = ""
    if last == 0:
        reason = "The model integrates (a pole at the origin) and has no static gain."
    else:
        gradient[-1] = 1.0 / last
        if n:
            gradient[n - 1] = -model.dc_gain / last
    gain = DerivedParameter.by_delta_method("static_gain", model.dc_gain, gradient, C, gain_unit, quantile, reason)
    return (*rows, gain)


def pole_rows(
    poles: ComplexArray, jacobian: ComplexArray, covariance: Array, quantile: float, *, number_lone: bool = True
) -> list[DerivedParameter]:
    """Poles, time constants, natural frequencies and damping, for whatever parameters the poles depend on."""
    rows: list[DerivedParameter] = []

    def row(name: str, estimate: float, gradient: Array, unit: str, reason: str) -> None:
        rows.append(DerivedParameter.by_delta_method(name, estimate, gradient, covariance, unit, quantile, reason))

    upper = [k for k, pole in enumerate(poles) if pole.imag >= 0]
    for number, k in enumerate(upper, 1):
        label = f"_{number}" if number_lone or len(upper) > 1 else ""
        pole, slope = poles[k], jacobian[k]
        everyone_else = np.arange(poles.size) != k
        reason = _undetermined(poles, k, slope, covariance, quantile, everyone_else)
        if pole.imag == 0:
            p = float(pole.real)
            row(f"pole{label}", p, slope.real, "rad/s", reason)
            if p == 0:
                reason = "The pole lies at the origin: it integrates and has no time constant."
                row(f"time_constant{label}", float("inf"), slope.real, "s", reason)
            else:
                row(f"time_constant{label}", -1.0 / p, slope.real / p**2, "s", reason)
            continue
        x, y = float(pole.real), float(pole.imag)
        frequency = abs(complex(pole))
        row(f"pole{label}_real", x, slope.real, "rad/s", reason)
        row(f"pole{label}_imag", y, slope.imag, "rad/s", reason)
        # d(x^2 + y^2) = 2 Re(conj(p) dp)
        radial = (x * slope.real + y * slope.imag) / frequency
        turning = y * (x * slope.imag - y * slope.real) / frequency**3
        others = everyone_else & (poles != np.conj(pole))
        reason = _undetermined(poles, k, slope, covariance, quantile, others)
        row(f"natural_frequency{label}", frequency, radial, "rad/s", reason)
        row(f"natural_frequency{label}_hz", frequency / (2 * np.pi), radial / (2 * np.pi), "Hz", reason)
        row(f"damping{label}", -x / frequency, turning, "-", reason)
    return rows


def _undetermined(
    poles: ComplexArray, k: int, slope: ComplexArray, A: Array, quantile: float, others: BoolArray
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
