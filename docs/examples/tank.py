"""A system: a tank that empties through a hole, which is not linear."""

from dataclasses import dataclass

import numpy as np

from ctid_cli import System


@dataclass(frozen=True)
class Tank(System):
    """Level of a tank: ``h' = (1 + u - sqrt(h)) / area``, at rest at ``h = 1``; the output is ``h - 1``.

    Parameters
    ----------
    area : float, default 2.0
        Area of the tank [m^2].
    """

    area: float = 2.0

    def simulate(self, input, times):
        h, levels = 1.0, np.empty(times.size)
        u = input.at(times)
        for k in range(times.size):
            levels[k] = h - 1.0
            step = np.diff(times[k : k + 2]).sum() / 10
            for _ in range(10):
                h += step * (1.0 + u[k] - np.sqrt(max(h, 0.0))) / self.area
        return levels
