"""What is added to the output: levels, the contract of every noise, and white noise."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.signals.checks import require_finite, require_not_negative

#: Unit of every way to say how strong noise is.
LEVEL_UNITS = {
    "snr_db": "dB",
    "standard_deviation": "output unit",
    "variance": "output unit^2",
    "innovation_variance": "output unit^2",
}


def require_one_level(levels: Mapping[str, float | None]) -> None:
    """Refuse anything but exactly one level, a signal-to-noise ratio or a number that is not negative."""
    given = [name for name, value in levels.items() if value is not None]
    if len(given) != 1:
        choices = [f"{name} [{LEVEL_UNITS[name]}]" for name in levels]
        found = f"{' and '.join(given)} were" if given else "none was"
        raise ValueError(f"noise needs exactly one of {', '.join(choices)}; {found} given.")
    name = given[0]
    value = levels[name]
    assert value is not None
    check = require_finite if name == "snr_db" else require_not_negative
    check(name, value, LEVEL_UNITS[name])


def variance_at(snr_db: float, noise_free: Array | None) -> float:
    """Variance of noise with a signal-to-noise ratio."""
    if noise_free is None:
        raise DataError("a signal-to-noise ratio says how strong noise is only beside a noise-free output; give that")
    power = float(np.mean(noise_free**2))
    if power == 0.0:
        raise DataError(
            "the noise-free output is zero, so no noise has a signal-to-noise ratio to it; "
            "is the delay longer than the record? Give noise.variance, or a longer record"
        )
    return power / 10 ** (snr_db / 10)


class Noise(ABC):
    """What is added to an output: white innovations through a filter, at an absolute or a relative level."""

    kind: ClassVar[str]
    #: Whether samples at different instants are correlated.
    coloured: ClassVar[bool]

    @property
    @abstractmethod
    def filter(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Numerator and denominator in rising powers of q^-1 of what white innovations pass through."""

    @abstractmethod
    def innovation_variance_of(self, noise_free: Array | None = None) -> float:
        """Variance of the innovations.

        Parameters
        ----------
        noise_free : ndarray, shape (N,), optional
            The output without noise [output unit]; needed with a signal-to-noise ratio.

        Returns
        -------
        float
            Variance [output unit^2].

        Raises
        ------
        DataError
            If a signal-to-noise ratio is asked for and the noise-free output is missing or zero throughout.
        """

    @abstractmethod
    def variance_of(self, noise_free: Array | None = None) -> float:
        """Variance of the noise.

        Parameters
        ----------
        noise_free : ndarray, shape (N,), optional
            The output without noise [output unit]; needed with a signal-to-noise ratio.

        Returns
        -------
        float
            Variance [output unit^2].

        Raises
        ------
        DataError
            If a signal-to-noise ratio is asked for and the noise-free output is missing or zero throughout.
        """

    @abstractmethod
    def autocovariance(self, lags: ArrayLike, noise_free: Array | None = None) -> Array:
        """Covariance of samples at a distance.

        Parameters
        ----------
        lags : array_like of int, shape (M,)
            Distances [samples], of either sign.
        noise_free : ndarray, shape (N,), optional
            The output without noise [output unit]; needed with a signal-to-noise ratio.

        Returns
        -------
        ndarray, shape (M,)
            Covariance [output unit^2].
        """

    @abstractmethod
    def generate(self, noise_free: Array, rng: np.random.Generator) -> Array:
        """Noise for one record.

        Parameters
        ----------
        noise_free : ndarray, shape (N,)
            The output without noise [output unit]; only its length matters without a signal-to-noise ratio.
        rng : numpy.random.Generator
            Source of standard normal numbers: one for each state of the filter, then N.

        Returns
        -------
        ndarray, shape (N,)
            Noise [output unit].

        Raises
        ------
        DataError
            If a signal-to-noise ratio is asked for and the noise-free output is zero throughout.
        """


@dataclass(frozen=True)
class WhiteNoise(Noise):
    """Independent Gaussian samples of one standard deviation.

    Parameters
    ----------
    snr_db : float, optional
        Signal-to-noise ratio [dB]: ten times the decimal logarithm of the mean square of the noise-free
        output over the variance of the noise.
    standard_deviation : float, optional
        Standard deviation [output unit]; 0 for no noise.
    variance : float, optional
        Variance [output unit^2]. Exactly one of the three is given.

    Notes
    -----
    The same standard normal samples are drawn at every level and then scaled, so levels differ by a factor
    only. The mean square is that of the record at hand, its mean value included.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli.signals.noise import WhiteNoise
    >>> output = np.sin(np.arange(10_000))
    >>> noise = WhiteNoise(snr_db=20.0).generate(output, np.random.default_rng(0))
    >>> round(10 * np.log10(np.mean(output**2) / np.mean(noise**2)), 1)
    np.float64(20.0)
    """

    kind: ClassVar[str] = "white"
    coloured: ClassVar[bool] = False

    snr_db: float | None = None
    standard_deviation: float | None = None
    variance: float | None = field(default=None, metadata={"added_later": True})

    def __post_init__(self) -> None:
        require_one_level(
            {"snr_db": self.snr_db, "standard_deviation": self.standard_deviation, "variance": self.variance}
        )

    @property
    def filter(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Numerator and denominator in rising powers of q^-1 of what white innovations pass through."""
        return (1.0,), (1.0,)

    def innovation_variance_of(self, noise_free: Array | None = None) -> float:
        """Variance of the noise itself."""
        if self.standard_deviation is not None:
            return self.standard_deviation**2
        if self.variance is not None:
            return self.variance
        assert self.snr_db is not None
        return variance_at(self.snr_db, noise_free)

    def variance_of(self, noise_free: Array | None = None) -> float:
        """Variance of the innovations."""
        return self.innovation_variance_of(noise_free)

    def autocovariance(self, lags: ArrayLike, noise_free: Array | None = None) -> Array:
        """The variance at lag 0, zero elsewhere."""
        return np.where(np.asarray(lags) == 0, self.variance_of(noise_free), 0.0)

    def generate(self, noise_free: Array, rng: np.random.Generator) -> Array:
        """Independent samples."""
        shape = rng.standard_normal(noise_free.size)
        if self.standard_deviation is not None:
            return self.standard_deviation * shape
        return float(np.sqrt(self.variance_of(noise_free))) * shape
