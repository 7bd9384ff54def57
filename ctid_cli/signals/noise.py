"""What is added to the output."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.signals.arma_noise import ArmaNoise
from ctid_cli.signals.noise_level import require_one_level, variance_at


@dataclass(frozen=True)
class WhiteNoise:
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
    #: Whether samples at different instants are correlated.
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
        """Variance of the innovations, which are the noise itself.

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
        if self.standard_deviation is not None:
            return self.standard_deviation**2
        if self.variance is not None:
            return self.variance
        assert self.snr_db is not None
        return variance_at(self.snr_db, noise_free)

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
        return self.innovation_variance_of(noise_free)

    def autocovariance(self, lags: ArrayLike, noise_free: Array | None = None) -> Array:
        """Covariance of samples at a distance.

        Parameters
        ----------
        lags : array_like of int, shape (M,)
            Distances [samples].
        noise_free : ndarray, shape (N,), optional
            The output without noise [output unit]; needed with a signal-to-noise ratio.

        Returns
        -------
        ndarray, shape (M,)
            The variance at lag 0, zero elsewhere [output unit^2].
        """
        return np.where(np.asarray(lags) == 0, self.variance_of(noise_free), 0.0)

    def generate(self, noise_free: Array, rng: np.random.Generator) -> Array:
        """Noise for one record.

        Parameters
        ----------
        noise_free : ndarray, shape (N,)
            The output without noise [output unit]; only its length matters without a signal-to-noise ratio.
        rng : numpy.random.Generator
            Source of the N standard normal samples.

        Returns
        -------
        ndarray, shape (N,)
            Noise [output unit].

        Raises
        ------
        DataError
            If a signal-to-noise ratio is asked for and the noise-free output is zero throughout.
        """
        shape = rng.standard_normal(noise_free.size)
        if self.standard_deviation is not None:
            return self.standard_deviation * shape
        return float(np.sqrt(self.variance_of(noise_free))) * shape


Noise = WhiteNoise | ArmaNoise
