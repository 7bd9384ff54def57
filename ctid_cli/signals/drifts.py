"""Noise that belongs to time, not to samples: its values at instants of any clock depend on the times between them."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numba import njit

from ctid_cli.arrays import Array
from ctid_cli.errors import OptionError
from ctid_cli.signals.checks import require_positive
from ctid_cli.signals.noise import require_one_level, variance_at

#: First-order processes in a decade of frequencies: with two, their sum has a ripple of 0.1 %.
PER_DECADE = 2
#: Widest band.
MAX_DECADES = 12
#: Samples that are drawn at once, so that long records need little memory.
BLOCK = 65_536


class ContinuousNoise(ABC):
    """What is added to an output: a process in continuous time, at an absolute or a relative level."""

    kind: ClassVar[str]

    snr_db: float | None
    variance: float | None

    @abstractmethod
    def generate_at(self, times: Array, noise_free: Array, rng: np.random.Generator) -> Array:
        """Noise for one record.

        Parameters
        ----------
        times : ndarray, shape (N,)
            Instants of the samples [s], increasing.
        noise_free : ndarray, shape (N,)
            The output without noise [output unit]; it matters with a signal-to-noise ratio only.
        rng : numpy.random.Generator
            Source of standard normal numbers.

        Returns
        -------
        ndarray, shape (N,)
            Noise [output unit].
        """

    def _variance(self, noise_free: Array) -> float | None:
        """Variance that is asked for, absolutely or by a ratio [output unit^2]; None if the level is another one."""
        return self.variance if self.snr_db is None else variance_at(self.snr_db, noise_free)


def noise_at(noise: Any, times: Array, noise_free: Array, rng: np.random.Generator) -> Array:
    """Noise of either sort for one record: one whose samples depend on their instants has `generate_at`."""
    if hasattr(noise, "generate_at"):
        return np.asarray(noise.generate_at(times, noise_free, rng))
    return np.asarray(noise.generate(noise_free, rng))


@dataclass(frozen=True)
class RandomWalk(ContinuousNoise):
    """A drift that has no mean: the integral of white noise, zero at the first sample.

    Parameters
    ----------
    intensity : float, optional
        Growth of the variance with time [output unit^2/s].
    variance : float, optional
        Expected mean square over the record [output unit^2].
    snr_db : float, optional
        Signal-to-noise ratio [dB]: ten times the decimal logarithm of the mean square of the noise-free
        output over the expected mean square of the noise, both over the record. Exactly one of the three is given.

    Notes
    -----
    Increments are independent, with the variance ``intensity (t_k - t_(k-1))``: exact on any clock. The spectral
    density is ``intensity / w^2``. Longer records with the same intensity begin with the shorter ones.
    """

    kind: ClassVar[str] = "random_walk"

    intensity: float | None = None
    variance: float | None = None
    snr_db: float | None = None

    def __post_init__(self) -> None:
        require_one_level(self)

    def generate_at(self, times: Array, noise_free: Array, rng: np.random.Generator) -> Array:
        """The walk from zero on, by independent increments."""
        steps = np.sqrt(np.diff(times)) * rng.standard_normal(times.size - 1)
        walk = np.concatenate(([0.0], np.cumsum(steps)))
        variance = self._variance(noise_free)
        intensity = self.intensity if variance is None else variance / float(np.mean(times - times[0]))
        assert intensity is not None
        return math.sqrt(intensity) * walk


@dataclass(frozen=True)
class OneOverFNoise(ContinuousNoise):
    r"""Noise with a spectral density like ``1 / w^exponent`` over a band, stationary from the first sample on.

    Parameters
    ----------
    lowest_frequency : float
        Lower end of the band [rad/s]; below it the density is constant.
    highest_frequency : float
        Upper end of the band [rad/s]; above it the density falls like ``1 / w^2``.
    exponent : float, default 1.0
        How fast the density falls over the band [-], above 0 and below 2.
    variance : float, optional
        Variance [output unit^2].
    snr_db : float, optional
        Signal-to-noise ratio [dB]: ten times the decimal logarithm of the mean square of the noise-free
        output over the variance. Exactly one of the two is given.

    Notes
    -----
    The noise is a sum of independent first-order (Ornstein-Uhlenbeck) processes, two in a decade, with corner
    frequencies w_i from one end of the band to the other and variances proportional to ``w_i^(1 - exponent)``:

    .. math:: S(w) = \sum_i \sigma_i^2 \frac{2 w_i}{w_i^2 + w^2},\qquad R(\tau) = \sum_i \sigma_i^2 e^{-w_i |\tau|}.

    A first-order process is exact on any clock, ``x_k = a x_(k-1) + sigma sqrt(1 - a^2) e_k`` with
    ``a = exp(-w_i (t_k - t_(k-1)))``, and so is the sum, on irregular instants too; what lies above half the sampling
    frequency is folded back, as of any process that is sampled without a filter. For the exponent 1 the density
    follows ``1 / w`` within 0.1 % in the middle of a wide band and 3.5 % a factor of ten from its ends, where it is two
    thirds of that.

    Examples
    --------
    >>> from ctid_cli.signals.drifts import OneOverFNoise
    >>> corners, shares = OneOverFNoise(lowest_frequency=0.1, highest_frequency=100.0, variance=4.0).processes()
    >>> corners.round(2)
    array([  0.1 ,   0.32,   1.  ,   3.16,  10.  ,  31.62, 100.  ])
    """

    kind: ClassVar[str] = "one_over_f"

    lowest_frequency: float
    highest_frequency: float
    exponent: float = 1.0
    variance: float | None = None
    snr_db: float | None = None

    def __post_init__(self) -> None:
        require_positive("lowest_frequency", self.lowest_frequency, "rad/s")
        require_positive("highest_frequency", self.highest_frequency, "rad/s")
        if self.lowest_frequency >= self.highest_frequency:
            ends = f"{self.lowest_frequency:g} and {self.highest_frequency:g} rad/s"
            raise OptionError("lowest_frequency", f"lowest_frequency must be below highest_frequency; they are {ends}.")
        if self.highest_frequency > 10**MAX_DECADES * self.lowest_frequency:
            raise OptionError("highest_frequency", f"highest_frequency is over {MAX_DECADES} decades up; lower it.")
        require_positive("exponent", self.exponent, "-")
        if self.exponent >= 2:
            raise OptionError("exponent", f"exponent must be below 2 [-], not {self.exponent!r}; 2 is a random_walk.")
        require_one_level(self)

    def processes(self) -> tuple[Array, Array]:
        """Corner frequencies [rad/s], ascending, and the share of each process in the variance [-]."""
        decades = math.log10(self.highest_frequency / self.lowest_frequency)
        corners = np.geomspace(self.lowest_frequency, self.highest_frequency, math.ceil(PER_DECADE * decades) + 1)
        shares = (corners / corners[0]) ** (1 - self.exponent)
        return corners, shares / shares.sum()

    def generate_at(self, times: Array, noise_free: Array, rng: np.random.Generator) -> Array:
        """The sum of the processes; their first states are drawn from the stationary distribution."""
        corners, shares = self.processes()
        # An endless interval before the first sample: it is independent of everything before.
        intervals = np.diff(times, prepend=-math.inf)
        state = np.zeros(corners.size)
        parts = []
        for first in range(0, times.size, BLOCK):
            part = intervals[first : first + BLOCK]
            parts.append(_relax(part, corners, np.sqrt(shares), rng.standard_normal((part.size, corners.size)), state))
        variance = self._variance(noise_free)
        assert variance is not None
        return math.sqrt(variance) * np.concatenate(parts)


@njit(cache=True, nogil=True)
def _relax(intervals: Array, corners: Array, deviations: Array, normals: Array, state: Array) -> Array:
    """Sum of first-order processes with given stationary deviations after each interval; `state` is carried on."""
    total = np.zeros(intervals.size)
    for k in range(intervals.size):
        for i in range(corners.size):
            # What is left of the past, and the innovation that keeps the variance what it is.
            left = math.exp(-corners[i] * intervals[k])
            new = math.sqrt(-math.expm1(-2.0 * corners[i] * intervals[k]))
            state[i] = left * state[i] + deviations[i] * new * normals[k, i]
            total[k] += state[i]
    return total
