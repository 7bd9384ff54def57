"""Estimation problems of a single transfer function: the signals behind the refined instrumental variable iteration."""

from __future__ import annotations

import numpy as np
from numba import njit

from ctid_cli.arrays import Array
from ctid_cli.estimation.refined_iv import Equations, scaled_solve
from ctid_cli.filtering.bank import second_moments
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.inference.sensitivity import Structure


@njit(cache=True, nogil=True)
def is_hurwitz(a: Array) -> bool:
    """Whether every root of a monic polynomial lies in the open left half-plane (Routh's criterion)."""
    n = a.size - 1
    for k in range(n + 1):
        if not a[k] > 0.0:
            return False
    if n <= 2:
        return True
    upper = np.zeros(n // 2 + 2)
    lower = np.zeros(n // 2 + 2)
    for k in range(n + 1):
        if k % 2 == 0:
            upper[k // 2] = a[k]
        else:
            lower[k // 2] = a[k]
    for _ in range(n - 1):
        ratio = upper[0] / lower[0]
        for k in range(n // 2 + 1):
            upper[k] = upper[k + 1] - ratio * lower[k + 1]
        upper, lower = lower, upper
        if not lower[0] > 0.0:
            return False
    return True


def reflect_unstable(a: Array) -> Array:
    """Mirror right-half-plane roots into the left half-plane."""
    if is_hurwitz(a):
        return a
    roots = np.roots(a)
    scale = float(np.abs(roots).max()) or 1.0
    # A root on the axis is moved off it by a little: filters need strict stability.
    damping = np.maximum(np.abs(roots.real), 1e-6 * scale)
    return np.asarray(np.real(np.poly(-damping + 1j * roots.imag)), dtype=float)


def with_stable_denominator(theta: Array, poles: int) -> Array:
    """Reflect the denominator at the head of a parameter vector if it is unstable."""
    a = np.concatenate(([1.0], theta[:poles]))
    if not np.isfinite(theta).all() or is_hurwitz(a):
        return theta
    return np.concatenate((reflect_unstable(a)[1:], theta[poles:]))


class CoefficientProblem:
    """Coefficients at a fixed delay: ``theta = (a_1 … a_n, b_0 … b_m)``."""

    def __init__(self, data: FilterData, structure: Structure, delay: float) -> None:
        self.data = data
        # A structure carries index tables, which cost as much as a pass over a short record: take it as it is.
        self.structure = Structure(structure.poles, structure.zeros) if structure.delay else structure
        self.delay = delay

    def split(self, theta: Array) -> tuple[Array, Array, float]:
        """Denominator, numerator and delay [s] of a parameter vector."""
        n = self.structure.poles
        return np.concatenate(([1.0], theta[:n])), theta[n:], self.delay

    def admissible(self, theta: Array) -> Array:
        """Reflect unstable denominators."""
        return with_stable_denominator(theta, self.structure.poles)

    def moments(self, theta: Array) -> Array | None:
        """Second moments of the standard rows."""
        a, b, delay = self.split(theta)
        if not np.isfinite(theta).all():
            return None
        moments = second_moments(self.data, a, b, delay)
        return moments if np.isfinite(moments).all() else None

    def equations(self, theta: Array) -> Equations | None:
        """Second moments of the iteration."""
        moments = self.moments(theta)
        if moments is None:
            return None
        structure = self.structure
        n = structure.poles
        return Equations(
            structure.instrument_regressor(moments),
            structure.instrument_error(moments),
            structure.hessian(moments),
            structure.squared_error(moments),
            structure.output_power(moments, theta[n : n + structure.zeros + 1]),
        )


class DelayProblem(CoefficientProblem):
    """Coefficients and delay together: ``theta = (a_1 … a_n, b_0 … b_m, delay)``."""

    def __init__(self, data: FilterData, structure: Structure, bounds: tuple[float, float]) -> None:
        super().__init__(data, structure, 0.0)
        self.structure = Structure(structure.poles, structure.zeros, delay=True)
        self.bounds = bounds

    def split(self, theta: Array) -> tuple[Array, Array, float]:
        """Denominator, numerator and delay [s] of a parameter vector."""
        n = self.structure.poles
        return np.concatenate(([1.0], theta[:n])), theta[n:-1], float(theta[-1])

    def moments(self, theta: Array) -> Array | None:
        """Second moments of the standard rows."""
        if not self.bounds[0] <= theta[-1] <= self.bounds[1]:
            return None
        return super().moments(theta)


def least_squares_start(data: FilterData, structure: Structure, delay: float, svf_cutoff: float) -> Array | None:
    """Least-squares estimate with the state-variable filter ``1/(p + w)^n``."""
    n, m = structure.poles, structure.zeros
    filter_denominator = np.asarray(np.poly(np.full(n, -svf_cutoff)), dtype=np.float64)
    # With a zero numerator the "output error" row is y itself.
    moments = second_moments(data, filter_denominator, np.zeros(1), delay)
    rows = structure.regressor_rows[: n + m + 1]
    signs = np.ones(n + m + 1)
    signs[:n] = -1.0
    gram = moments[np.ix_(rows, rows)] * np.outer(signs, signs)
    error_row = 3 * n + 1
    # p^n/A_svf y = y - sum a_i p^(n-i)/A_svf y holds exactly at the samples.
    highest = moments[error_row, rows] - sum(
        filter_denominator[i] * moments[3 * n + 1 - i, rows] for i in range(1, n + 1)
    )
    diagonal = np.diag(gram)
    theta = scaled_solve(gram, highest * signs, diagonal, diagonal)
    if theta is None:
        return None
    stable = reflect_unstable(np.concatenate(([1.0], theta[:n])))
    return np.concatenate((stable[1:], theta[n:]))


def refit_numerator(data: FilterData, structure: Structure, theta: Array, delay: float) -> Array:
    """Best numerator for a given denominator, by linear least squares on the output error."""
    n, m = structure.poles, structure.zeros
    moments = second_moments(data, np.concatenate(([1.0], theta[:n])), np.zeros(1), delay)
    rows = structure.sensitivity_rows[n : n + m + 1]
    gram = moments[np.ix_(rows, rows)]
    diagonal = np.diag(gram)
    numerator = scaled_solve(gram, moments[rows, 3 * n + 1], diagonal, diagonal)
    return theta if numerator is None else np.concatenate((theta[:n], numerator))
