"""A noise of one's own whose samples depend on when they are taken."""

from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.simulation.own_components import OwnNoise, _samples


@dataclass(frozen=True)
class OwnClockedNoise(OwnNoise):
    """A noise of one's own that asks for the instants of the samples."""

    def generate_at(self, times: Array, noise_free: Array, rng: np.random.Generator) -> Array:
        """What is added to the output."""
        return _samples(self.options, "generate", (noise_free, times, rng), noise_free.size, missing=True)
