"""A noise: white, and now and then a burst."""

from dataclasses import dataclass

from ctid_cli import Noise


@dataclass(frozen=True)
class Bursts(Noise):
    """White noise whose standard deviation is larger in bursts.

    Parameters
    ----------
    standard_deviation : float
        Outside the bursts [output unit].
    share : float, default 0.05
        Fraction of samples in bursts [-].
    factor : float, default 5.0
        How much larger the standard deviation is in them [-].
    """

    standard_deviation: float
    share: float = 0.05
    factor: float = 5.0

    def __post_init__(self):
        if not 0.0 <= self.share <= 1.0:
            raise ValueError(f"share must lie from 0 to 1, not {self.share}")

    def generate(self, output, rng):
        in_burst = rng.random(output.size // 10 + 1).repeat(10)[: output.size] < self.share
        scale = self.standard_deviation * (1.0 + (self.factor - 1.0) * in_burst)
        return scale * rng.standard_normal(output.size)
