"""PID controllers by gains in continuous time, and the discrete-time controllers that stand for them."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ctid_cli.errors import OptionError
from ctid_cli.models.controller import DiscreteController
from ctid_cli.signals.checks import require_choice, require_finite, require_not_negative, require_positive

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
        What stands for s at a sampling interval h: ``(q - 1)/(h q)``, or ``2 (q - 1)/(h (q + 1))``.

    Raises
    ------
    ValueError
        If a gain is given twice, or the Tustin rule is to differentiate without a filter.

    Notes
    -----
    .. math:: C(s) = k_p + \frac{k_i}{s} + \frac{k_d s}{T_f s + 1}

    With the Tustin rule a derivative without a filter would oscillate for ever, from sample to sample.

    Examples
    --------
    >>> from ctid_cli.models.pid import ContinuousPid
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
                    raise OptionError(name, f"{name} gives the same as {other}; keep one of the two.")
        for name, gain in (("ti", self.integral_gain), ("td", self.derivative_gain)):
            require_finite(name, gain, units["ki" if name == "ti" else "kd"], label=f"the gain that kp and {name} make")
        require_not_negative("filter_time", self.filter_time, "s")
        require_choice("discretisation", self.discretisation, get_args(Discretisation))
        if self.discretisation == "tustin" and self.derivative_gain and self.filter_time == 0.0:
            raise OptionError(
                "filter_time", "filter_time must be above 0 s: by the Tustin rule a bare derivative rings."
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
        """The controller that acts at every sample, with the poles of those actions only that it has."""
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
