"""Controllers of a loop around a continuous-time model: discrete time, continuous time, PID and relay."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.errors import DataError, OptionError
from ctid_cli.models.transfer_function import monic, polynomials, sorted_roots
from ctid_cli.signals.checks import freeze, require_choice, require_finite, require_not_negative, require_positive


def companion(numerator: Array, denominator: Array) -> tuple[Array, Array, Array, Array]:
    """Return the companion realisation A, B, C, D of a proper fraction with a monic denominator."""
    n, a = denominator.size - 1, denominator[1:]
    b = np.concatenate((np.zeros(n + 1 - numerator.size), numerator))
    A = np.eye(n, k=-1)
    A[:1] -= a
    return A, np.eye(n, 1), (b[1:] - b[0] * a)[None, :], b[None, :1].copy()


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
        """Return ``kp + ki q/(q - 1) + kd (q - 1)/q``: proportional, integral (backward Euler) and difference action.

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
        # At a sampling interval of 1 s the gains of both forms are equal.
        return ContinuousPid(kp, ki=ki, kd=kd).discrete(1.0)

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
        """Direct feedthrough, ``C`` at infinite q: gain from the present sample to the controller's output."""
        return float(self.numerator[0]) if self.numerator.size == self.denominator.size else 0.0

    def state_space(self) -> tuple[Array, Array, Array, Array]:
        """Return the companion realisation ``s_(k+1) = A s_k + B e_k``, ``C s_k + D e_k``.

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
        return companion(self.numerator, self.denominator)

    def frequency_response(self, frequencies: ArrayLike, interval: float) -> ComplexArray:
        """Return ``C(exp(j w h))``.

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


@dataclass(frozen=True, eq=False)
class ContinuousController:
    """``C(s) = numerator / denominator`` with coefficients in descending powers of s, in continuous time.

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

    Notes
    -----
    A derivative needs a filter: ``kd s`` alone has more zeros than poles.

    Examples
    --------
    >>> ContinuousController([1.0, 2.0], [2.0, 0.0]).numerator
    array([0.5, 1. ])
    """

    continuous: ClassVar[bool] = True

    numerator: Array
    denominator: Array

    def __init__(self, numerator: ArrayLike, denominator: ArrayLike) -> None:
        b, a = monic(*polynomials(numerator, denominator, "the controller", "s"))
        if b.size > a.size:
            counts = f"more zeros ({b.size - 1}) than poles ({a.size - 1})"
            raise DataError(f"a controller with {counts} would differentiate jumps; give its derivative a filter")
        freeze(self, numerator=b, denominator=a)

    def state_space(self) -> tuple[Array, Array, Array, Array]:
        """Return the companion realisation ``s' = A s + B e``, ``C s + D e``."""
        return companion(self.numerator, self.denominator)


@dataclass(frozen=True)
class Relay:
    """A two-valued controller, which causes a limit cycle of the loop.

    Parameters
    ----------
    amplitude : float
        The relay's output is the bias plus or minus this [input unit].
    hysteresis : float, default 0.0
        The relay switches when the error exceeds this in either direction [output unit]; a value above the noise
        level avoids switching at every sample.
    bias : float, default 0.0
        Mean of the two values [input unit].

    Notes
    -----
    The relay feedback experiment of K. J. Astrom and T. Hagglund, *Automatic tuning of simple regulators with
    specifications on phase and amplitude margins*, Automatica 20(5), 1984,
    https://doi.org/10.1016/0005-1098(84)90014-1. It begins at its upper value, and keeps its value while the error is
    within the hysteresis.
    """

    amplitude: float
    hysteresis: float = 0.0
    bias: float = 0.0

    def __post_init__(self) -> None:
        require_positive("amplitude", self.amplitude, "input unit")
        require_not_negative("hysteresis", self.hysteresis, "output unit")
        require_finite("bias", self.bias, "input unit")


Discretisation = Literal["backward_euler", "tustin"]


@dataclass(frozen=True)
class ContinuousPid:
    r"""PID controller whose gains do not depend on the sampling interval.

    Parameters
    ----------
    kp : float, default 0.0
        Proportional gain [input unit/output unit].
    ti : float, optional
        Integral time [s], in place of ki: ``ki = kp/ti``.
    ki : float, optional
        Gain of the integral of the error [input unit/(output unit s)].
    td : float, optional
        Derivative time [s], in place of kd: ``kd = kp td``.
    kd : float, optional
        Gain of the derivative of the error [input unit s/output unit].
    filter_time : float, default 0.0
        Time constant of the low-pass filter of the derivative [s]; often td/10.
    discretisation : {"backward_euler", "tustin"}, default "backward_euler"
        Substitution for s at a sampling interval h: ``(q - 1)/(h q)``, or ``2 (q - 1)/(h (q + 1))``.

    Raises
    ------
    ValueError
        If a gain is given twice, or the Tustin rule is combined with a derivative without filter.

    Notes
    -----
    .. math:: C(s) = k_p + \frac{k_i}{s} + \frac{k_d s}{T_f s + 1}

    With the Tustin rule, a derivative without a filter would oscillate undamped from sample to sample.

    Examples
    --------
    >>> from ctid_cli.models.controller import ContinuousPid
    >>> ContinuousPid(kp=2.0, ti=4.0).discrete(0.1).numerator
    array([ 2.05, -2.  ])
    """

    kp: float = 0.0
    ti: float | None = None
    ki: float | None = None
    td: float | None = None
    kd: float | None = None
    filter_time: float = 0.0
    discretisation: Discretisation = "backward_euler"

    def __post_init__(self) -> None:
        units = {"kp": "input unit/output unit", "ki": "input unit/(output unit s)", "kd": "input unit s/output unit"}
        for name, unit in units.items():
            if getattr(self, name) is not None:
                require_finite(name, getattr(self, name), unit)
        for name, other in (("ti", "ki"), ("td", "kd")):
            if getattr(self, name) is not None:
                (require_positive if name == "ti" else require_not_negative)(name, getattr(self, name), "s")
                if getattr(self, other) is not None:
                    raise OptionError(name, f"{name} and {other} set the same gain; keep one of the two.")
        for name, gain in (("ti", self.integral_gain), ("td", self.derivative_gain)):
            require_finite(name, gain, units["ki" if name == "ti" else "kd"], label=f"the gain from kp and {name}")
        require_not_negative("filter_time", self.filter_time, "s")
        require_choice("discretisation", self.discretisation, get_args(Discretisation))
        if self.discretisation == "tustin" and self.derivative_gain and self.filter_time == 0.0:
            raise OptionError(
                "filter_time", "filter_time must be above 0 s: an unfiltered Tustin derivative oscillates."
            )

    @property
    def integral_gain(self) -> float:
        """Gain of the integral of the error [input unit/(output unit s)]."""
        return self.ki or 0.0 if self.ti is None else self.kp / self.ti

    @property
    def derivative_gain(self) -> float:
        """Gain of the derivative of the error [input unit s/output unit]."""
        return self.kd or 0.0 if self.td is None else self.kp * self.td

    @property
    def does_nothing(self) -> bool:
        """Whether all gains are zero."""
        return not (self.kp or self.integral_gain or self.derivative_gain)

    def discrete(self, interval: float) -> DiscreteController:
        """Return the discrete-time controller, with the poles of the actions whose gain is not zero."""
        # s = rise / fall.
        if self.discretisation == "tustin":
            rise, fall = np.array([2.0, -2.0]), interval * np.ones(2)
        else:
            rise, fall = np.array([1.0, -1.0]), np.array([interval, 0.0])
        numerator, denominator = np.array([self.kp]), np.ones(1)
        parts = ((self.integral_gain * fall, rise), (self.derivative_gain * rise, self.filter_time * rise + fall))
        for over, under in parts:
            if over.any():
                numerator = np.polyadd(np.polymul(numerator, under), np.polymul(over, denominator))
                denominator = np.polymul(denominator, under)
        return DiscreteController(numerator, denominator)
