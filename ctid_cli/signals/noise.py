"""What is added to the output."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ctid_cli.errors import DataError
from ctid_cli.signals.checks import require_finite, require_not_negative


@dataclass(frozen=True)
class WhiteNoise:
    """Independent Gaussian samples of one standard deviation.

    Parameters
    ----------
    snr_db : float, optional
        Signal-to-noise ratio [dB]: ten times the decimal logarithm of the mean square of the noise-free
        output over the variance of the noise.
    standard_deviation : float, optional
        Standard deviation [output unit]; 0 for no noise. Exactly one of the two is given.

    Notes
    -----
    The same standard normal samples are drawn at every level and then scaled, so levels differ by a factor
    only. The mean square is that of the record at hand, its mean value included.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli.signals import WhiteNoise
    >>> output = np.sin(np.arange(10_000))
    >>> noise = WhiteNoise(snr_db=20.0).generate(output, np.random.default_rng(0))
    >>> round(10 * np.log10(np.mean(output**2) / np.mean(noise**2)), 1)
    np.float64(20.0)
    """

    kind: ClassVar[str] = "white"

    snr_db: float | None = field(
        default=None,
        metadata={"doc": "mean square of the noise-free output over the variance of the noise", "unit": "dB"},
    )
    standard_deviation: float | None = field(
        default=None, metadata={"doc": "standard deviation of the noise", "unit": "output unit"}
    )

    def __post_init__(self) -> None:
        if (self.snr_db is None) == (self.standard_deviation is None):
            given = "neither was" if self.snr_db is None else "both were"
            raise ValueError(f"noise needs either snr_db [dB] or standard_deviation [output unit]; {given} given.")
        if self.snr_db is not None:
            require_finite("snr_db", self.snr_db, "dB")
        if self.standard_deviation is not None:
            require_not_negative("standard_deviation", self.standard_deviation, "output unit")

    def generate(self, noise_free: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Noise for one record.

        Parameters
        ----------
        noise_free : ndarray, shape (N,)
            The output without noise [output unit].
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
        assert self.snr_db is not None
        power = float(np.mean(noise_free**2))
        if power == 0.0:
            raise DataError(
                "the noise-free output is zero, so no noise has a signal-to-noise ratio to it; "
                "is the delay longer than the record? Give noise.standard_deviation, or a longer record"
            )
        return float(np.sqrt(power / 10 ** (self.snr_db / 10))) * shape


Noise = WhiteNoise

#: Kinds of noise by the word that selects them in a specification.
NOISES: dict[str, type[Noise]] = {WhiteNoise.kind: WhiteNoise}
