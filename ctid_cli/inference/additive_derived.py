"""Poles, frequencies, damping and gain of the submodels of an estimated sum, with their standard errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.inference.derived import DerivedParameter, pole_rows
from ctid_cli.inference.quantile import normal_quantile
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.factoring import pole_jacobian
from ctid_cli.models.transfer_function import sorted_roots


def additive_derived(
    model: AdditiveModel,
    covariance: ArrayLike,
    *,
    level: float = 0.95,
    gain_unit: str = "output unit/input unit",
) -> tuple[DerivedParameter, ...]:
    r"""What users read off the submodels of a sum, with standard errors by the delta method.

    As :func:`ctid_cli.inference.derived_parameters`. Each quantity depends on the parameters of its own submodel alone,
    so a pole is undetermined only where it cannot be told from another one of the same submodel. With
    ``A = 1 + a_1 p + … + a_n p^n``, a pole moves by ``dp/da_k = -p^k/A'(p)``.
    """
    C = np.asarray(covariance, dtype=float)
    size = model.theta.size
    if C.shape != (size, size):
        raise ValueError(f"the covariance must have a row and a column for each of {size} parameters; got {C.shape}")
    quantile = normal_quantile(level)
    rows: list[DerivedParameter] = []
    first = 0
    for number, (submodel, term) in enumerate(zip(model.submodels, model.terms, strict=True), 1):
        block = C[first : first + term.size, first : first + term.size]
        for row in _rows(submodel, block, quantile, gain_unit):
            rows.append(replace(row, name=f"g{number}_{row.name}"))
        first += term.size
    return tuple(rows)


def _rows(submodel: Submodel, covariance: Array, quantile: float, gain_unit: str) -> list[DerivedParameter]:
    """All quantities of one submodel; covariance of its own parameters."""
    n = submodel.term().poles
    falling = submodel.denominator
    poles = sorted_roots(falling)
    # A = a_n times the monic polynomial, whose derivatives run from p^(n-1) down to 1; here they run from p to p^n.
    with np.errstate(invalid="ignore"):
        jacobian = poles[:, None] * pole_jacobian(falling / falling[0], poles)[:, ::-1] / falling[0]
    A = covariance[:n, :n]
    rows = pole_rows(poles, jacobian, A, quantile, number_lone=False)
    if n == 2 and falling[0] > 0 and not poles.imag.any():
        rows += _overdamped(falling[1], falling[0], A, quantile)
    gradient = np.zeros(len(covariance))
    gradient[n] = 1.0
    reason = "This submodel integrates and has no static gain." if submodel.integrators else ""
    rows.append(
        DerivedParameter.by_delta_method(
            "static_gain", submodel.dc_gain, gradient, covariance, gain_unit, quantile, reason
        )
    )
    return rows


def _overdamped(a1: float, a2: float, A: Array, quantile: float) -> list[DerivedParameter]:
    """Natural frequency ``a_2^(-1/2)`` and damping ``a_1 a_2^(-1/2) / 2`` of two real poles, however close."""
    frequency, slope = a2**-0.5, -0.5 * a2**-1.5
    radial, turning = np.array([0.0, slope]), 0.5 * np.array([frequency, a1 * slope])
    return [
        DerivedParameter.by_delta_method(name, value, gradient, A, unit, quantile)
        for name, value, gradient, unit in (
            ("natural_frequency", frequency, radial, "rad/s"),
            ("natural_frequency_hz", frequency / (2 * np.pi), radial / (2 * np.pi), "Hz"),
            ("damping", 0.5 * a1 * frequency, turning, "-"),
        )
    ]
