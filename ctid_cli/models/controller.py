"""Discrete-time controllers that close a loop around a continuous-time model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.errors import DataError
from ctid_cli.models.transfer_function import monic, polynomials, sorted_roots
from ctid_cli.signals.checks import freeze, require_finite, require_positive


@dataclass(frozen=True, eq=False)
class DiscreteController:
    """``C(q) = numerator / denominator`` with coefficients in descending powers of the shift operator q.

    Parameters
    ----------
    numerator : array_like, shape (m + 1,)
        Coefficients in descending powers; leading zeros are dropped.
    denominator : array_like, shape (n + 1,)
        Coefficients in descending powers; both polynomials are divided by the leading one.

    Raises
    ------
    DataError
        If a coefficient is not finite, the leading denominator coefficient is zero, or there are more zeros than poles.

    Examples
    --------
    >>> c = DiscreteController([0.2, -0.1], [2.0, -2.0])
    >>> c.numerator, c.denominator, c.direct
    (array([ 0.1 , -0.05]), array([ 1., -1.]), 0.1)
    """

    numerator: Array
    denominator: Array

    def __init__(self, numerator: ArrayLike, denominator: ArrayLike) -> None:
        b, a = monic(*polynomials(numerator, denominator, "the controller", "q"))
        if b.size > a.size:
            counts = f"more zeros ({b.size - 1}) than poles ({a.size - 1})"
            raise DataError(f"a controller with {counts} would need samples of the future; give fewer numerator terms")
        freeze(self, numerator=b, denominator=a)

    @classmethod
    def from_pid(cls, kp: float, ki: float, kd: float) -> DiscreteController:
        """``kp + ki q/(q - 1) + kd (q - 1)/q``: proportional, integrating (backward Euler) and differencing action.

        Parameters
        ----------
        kp : float
            Proportional gain [input unit/output unit].
        ki : float
            Gain of the running sum of the error, the present sample included [input unit/output unit].
        kd : float
            Gain of the difference between this sample and the last [input unit/output unit].

        Returns
        -------
        DiscreteController
            With a pole at 1 only if `ki` is not zero, and one at 0 only if `kd` is not zero.

        Raises
        ------
        ValueError
            If a gain is not a finite number.

        Notes
        -----
        The sampling interval h is part of the gains: those of a continuous-time controller with integral time Ti and
        derivative time Td are ``ki = kp h/Ti`` and ``kd = kp Td/h``.
        """
        for name, gain in (("kp", kp), ("ki", ki), ("kd", kd)):
            require_finite(name, gain, "input unit/output unit")
        summing = np.array([1.0, -1.0]) if ki else np.ones(1)
        lag = np.array([1.0, 0.0]) if kd else np.ones(1)
        denominator = np.polymul(summing, lag)
        integrating, differencing = np.polymul([ki, 0.0], lag), np.polymul([kd, -kd], summing)
        return cls(np.polyadd(np.polyadd(kp * denominator, integrating), differencing), denominator)

    @property
    def order(self) -> int:
        """Number of poles."""
        return int(self.denominator.size - 1)

    @property
    def poles(self) -> ComplexArray:
        """Roots of the denominator [-], largest magnitude first, shape (n,)."""
        return sorted_roots(self.denominator)

    @property
    def direct(self) -> float:
        """``C`` at infinite q: by how much the present sample moves the controller's output at once."""
        return float(self.numerator[0]) if self.numerator.size == self.denominator.size else 0.0

    def state_space(self) -> tuple[Array, Array, Array, Array]:
        """Companion realisation ``s_(k+1) = A s_k + B e_k``, ``C s_k + D e_k``.

        Returns
        -------
        A : ndarray, shape (n, n)
            Dynamics.
        B : ndarray, shape (n, 1)
            From the input.
        C : ndarray, shape (1, n)
            To the output.
        D : ndarray, shape (1, 1)
            Direct feedthrough.
        """
        n = self.order
        a = self.denominator[1:]
        b = np.concatenate((np.zeros(n + 1 - self.numerator.size), self.numerator))
        A = np.eye(n, k=-1)
        A[:1] -= a
        return A, np.eye(n, 1), (b[1:] - b[0] * a)[None, :], b[None, :1].copy()

    def frequency_response(self, frequencies: ArrayLike, interval: float) -> ComplexArray:
        """``C(exp(j w h))``.

        Parameters
        ----------
        frequencies : array_like
            Angular frequencies w [rad/s].
        interval : float
            Sampling interval h [s].

        Returns
        -------
        ndarray
            Complex gain at each frequency.

        Raises
        ------
        ValueError
            If the interval is not positive.
        """
        require_positive("the sampling interval", interval, "s")
        q = np.exp(1j * np.asarray(frequencies, dtype=float) * interval)
        return np.asarray(np.polyval(self.numerator, q) / np.polyval(self.denominator, q), dtype=complex)
