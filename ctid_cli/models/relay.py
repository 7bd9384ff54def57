"""A relay as a controller."""

from dataclasses import dataclass

from ctid_cli.signals.checks import require_finite, require_not_negative, require_positive


@dataclass(frozen=True)
class Relay:
    """A controller with two values, which makes a loop oscillate by itself.

    Parameters
    ----------
    amplitude : float
        The relay's output is the bias plus or minus this [input unit].
    hysteresis : float, default 0.0
        The relay switches when the error passes this, up or down [output unit]; above the noise it keeps it from
        switching at every sample.
    bias : float, default 0.0
        Middle of the two values [input unit].

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
