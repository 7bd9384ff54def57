"""Rational transfer functions in the Laplace variable, with a pure delay."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.errors import DataError
from ctid_cli.signals.checks import freeze

#: Relative distance of a pole and a zero that cancel: the rounding of double roots.
CANCELLED = 1e-7


class ContinuousModel(ABC):
    """A linear model in continuous time."""

    @abstractmethod
    def frequency_response(self, frequencies: ArrayLike) -> ComplexArray:
        """Return ``G(j w)``, delay included.

        Parameters
        ----------
        frequencies : array_like
            Angular frequencies w [rad/s].

        Returns
        -------
        ndarray
            Complex gain at each frequency.
        """


@dataclass(frozen=True, eq=False)
class TransferFunction(ContinuousModel):
    r"""``G(s) = B(s)/A(s) exp(-delay s)`` with coefficients in descending powers of s.

    Parameters
    ----------
    numerator : array_like, shape (m + 1,)
        Coefficients of B in descending powers; leading zeros are dropped.
    denominator : array_like, shape (n + 1,)
        Coefficients of A in descending powers; both polynomials are divided by its leading one,
        so that ``denominator[0] == 1`` afterwards.
    delay : float, default 0.0
        Pure delay [s].

    Raises
    ------
    DataError
        If a coefficient is not finite, the leading denominator coefficient is zero, or the delay is negative.

    Examples
    --------
    >>> g = TransferFunction([2], [0.25, 0.7, 1], delay=8.0)
    >>> g.numerator, g.denominator, round(g.dc_gain, 6)
    (array([8.]), array([1. , 2.8, 4. ]), 2.0)
    """

    numerator: Array
    denominator: Array
    delay: float = 0.0

    def __init__(self, numerator: ArrayLike, denominator: ArrayLike, delay: float = 0.0) -> None:
        b, a = monic(*polynomials(numerator, denominator, "the transfer function", "s"))
        freeze(self, numerator=b, denominator=a, delay=checked_delay(delay))

    @property
    def order(self) -> int:
        """Number of poles."""
        return int(self.denominator.size - 1)

    @property
    def relative_degree(self) -> int:
        """Number of poles minus number of zeros."""
        return int(self.denominator.size - self.numerator.size)

    @property
    def poles(self) -> ComplexArray:
        """Roots of A [rad/s], fastest first, shape (n,)."""
        return sorted_roots(self.denominator)

    @property
    def zeros(self) -> ComplexArray:
        """Roots of B [rad/s], fastest first, shape (m,)."""
        return sorted_roots(self.numerator)

    @property
    def parameters(self) -> dict[str, float]:
        """Coefficients by name, without the 1 of the denominator: ``a1 …``, then ``b0 …``, in descending powers."""
        found = {f"a{k}": float(value) for k, value in enumerate(self.denominator[1:], start=1)}
        return found | {f"b{k}": float(value) for k, value in enumerate(self.numerator)}

    @property
    def is_stable(self) -> bool:
        """Whether every pole lies strictly in the left half-plane."""
        return bool((self.poles.real < 0).all())

    @property
    def dc_gain(self) -> float:
        """``G(0)``; infinite with a pole at the origin."""
        return float(self.numerator[-1] / self.denominator[-1]) if self.denominator[-1] else float("inf")

    def frequency_response(self, frequencies: ArrayLike) -> ComplexArray:
        """Return ``B(j w) / A(j w) exp(-j w delay)``."""
        s = 1j * np.asarray(frequencies, dtype=float)
        gain = np.polyval(self.numerator, s) / np.polyval(self.denominator, s) * np.exp(-s * self.delay)
        return np.asarray(gain, dtype=complex)


def cancelled(numerator: Array, denominator: Array) -> str:
    """Return a pole that a zero cancels, as text; empty without any."""
    zeros = sorted_roots(numerator)
    for pole in sorted_roots(denominator):
        if (np.abs(zeros - pole) <= CANCELLED * np.abs(pole)).any():
            return f"{pole.real:.4g}" if pole.imag == 0 else f"{pole.real:.4g} ± {abs(pole.imag):.4g}j"
    return ""


def sorted_roots(coefficients: Array) -> ComplexArray:
    """Return the roots of a polynomial, largest magnitude first."""
    roots = np.asarray(np.roots(coefficients), dtype=complex)
    return roots[np.lexsort((roots.imag, -np.abs(roots)))]


def polynomials(numerator: ArrayLike, denominator: ArrayLike, owner: str, variable: str) -> tuple[Array, Array]:
    """Return the checked coefficients of a fraction."""
    b, a = (np.atleast_1d(np.array(part, dtype=float)) for part in (numerator, denominator))
    if a.ndim != 1 or b.ndim != 1 or not a.size or not b.size:
        raise DataError(f"numerator and denominator must be lists of coefficients in descending powers of {variable}")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise DataError(f"a coefficient of {owner} is not a finite number")
    if a[0] == 0:
        raise DataError(f"the first denominator coefficient of {owner} is zero; drop leading zeros", "denominator")
    return b, a


def monic(b: Array, a: Array) -> tuple[Array, Array]:
    """Return a fraction with monic denominator and without leading zeros of the numerator."""
    b = b[np.argmax(b != 0) :] if b.any() else b[:1]
    return b / a[0], a / a[0]


def checked_delay(delay: float) -> float:
    """Return a delay, checked to be finite and not negative."""
    if not (np.isfinite(delay) and delay >= 0):
        raise DataError(f"a delay must be a finite number of seconds, zero or more; got {delay}")
    return float(delay)
