"""An excitation: a sinusoid whose frequency moves by equal factors in equal times."""

from dataclasses import dataclass

import numpy as np

from ctid_cli import Excitation, HeldSignal


@dataclass(frozen=True)
class Chirp(Excitation):
    """Logarithmic sweep over the length of the record, held from sample to sample.

    Parameters
    ----------
    first_frequency : float
        Frequency at the beginning [rad/s].
    last_frequency : float
        Frequency at the end [rad/s], another one than the first.
    amplitude : float, default 1.0
        Peak value [input unit].
    """

    deterministic = True  # nothing is drawn

    first_frequency: float
    last_frequency: float
    amplitude: float = 1.0

    def __post_init__(self):
        if min(self.first_frequency, self.last_frequency) <= 0.0 or self.first_frequency == self.last_frequency:
            raise ValueError("first_frequency and last_frequency must be positive and different [rad/s]")

    def generate(self, times, rng):
        # The phase is the integral of the frequency w1 r^x, where x goes from 0 to 1 over the record.
        duration = times[-1] - times[0]
        rate = np.log(self.last_frequency / self.first_frequency)
        phase = self.first_frequency * duration * np.expm1(rate * (times - times[0]) / duration) / rate
        return HeldSignal(times, self.amplitude * np.sin(phase))
