"""A noise: white, with a few outliers, and some samples are lost."""

from dataclasses import dataclass

import numpy as np

from ctid_cli import Noise


@dataclass(frozen=True)
class FaultySensor(Noise):
    """White noise of which some samples are far larger, and some outputs are missing.

    Parameters
    ----------
    standard_deviation : float
        Of the samples that are no outliers [output unit].
    outliers : float, default 0.05
        Share of the outliers [-].
    size : float, default 10.0
        Standard deviation of the outliers over that of the others [-].
    missing : float, default 0.1
        Share of the outputs that are missing [-].
    """

    coloured = False  # samples at different instants are independent

    standard_deviation: float
    outliers: float = 0.05
    size: float = 10.0
    missing: float = 0.1

    def __post_init__(self):
        if not (0.0 <= self.outliers <= 1.0 and 0.0 <= self.missing < 1.0):
            raise ValueError("outliers and missing are shares: from 0 to 1, and missing below 1 [-]")

    def generate(self, output, rng):
        noise = self.standard_deviation * rng.standard_normal(output.size)
        noise[rng.random(output.size) < self.outliers] *= self.size
        noise[rng.random(output.size) < self.missing] = np.nan  # marks a missing output
        return noise
