"""A custom estimator and a custom noise: variable projection, and a hum of which only the phase is random."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from ctid_cli import Estimator, Noise, TransferFunction, simulate


@dataclass(frozen=True)
class Projection(Estimator):
    """Least output error of b0 / (s^2 + a1 s + a2) with a delay; b0 is linear, and projected out.

    Parameters
    ----------
    longest_delay : float
        The delay is sought up to this [s].
    starts : int, default 3
        Delays to start from, evenly spaced.
    """

    longest_delay: float
    starts: int = 3

    def fit(self, record, start):
        used, y = record.valid, record.y[record.valid]

        def projected(x):
            shape = simulate(TransferFunction([1.0], [1.0, *np.exp(x[:2])], x[2]), record.input, record.t)[used]
            return shape, shape @ y / (shape @ shape)

        def error(x):
            shape, b0 = projected(x)
            return y - b0 * shape

        bounds = [-3.0, -3.0, 0.0], [3.0, 3.0, self.longest_delay]
        delays = self.longest_delay * (np.arange(self.starts) + 0.5) / self.starts
        best = min((least_squares(error, [0, 0, d], bounds=bounds) for d in delays), key=lambda found: found.cost)
        a1, a2, delay = *np.exp(best.x[:2]), best.x[2]
        return {"parameters": {"b0": projected(best.x)[1], "a1": a1, "a2": a2, "delay": delay}}


@dataclass(frozen=True)
class Hum(Noise):
    """A sinusoid that begins at a random phase."""

    snr_db: float
    frequency: float = 5.0

    def generate_at(self, times, output, rng):
        amplitude = np.sqrt(2.0 * np.mean(output**2) / 10 ** (self.snr_db / 10))
        return amplitude * np.sin(self.frequency * times + rng.uniform(0.0, 2.0 * np.pi))
