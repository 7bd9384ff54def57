"""Amplitudes, phases and bias by linear regression, once the frequencies are known."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.frequency.base import LARGEST_SAMPLE, MOST_TONES, series_of
from ctid_cli.signals.checks import require_positive

#: Below this ratio of the singular values the sinusoids cannot be told apart.
SINGULAR = 1e-10


@dataclass(frozen=True, eq=False)
class Sinusoids:
    """A sum of sinusoids and a bias.

    Parameters
    ----------
    omega : ndarray, shape (n,)
        Frequencies [rad/s].
    amplitudes : ndarray, shape (n,)
        Amplitudes, not negative [signal unit].
    phases : ndarray, shape (n,)
        Phases at the first sample, ``sin(w t + phase)``, within -pi and pi [rad].
    bias : float
        Constant part [signal unit].
    residual_rms : float
        Root mean square of what is left of the samples [signal unit]; NaN if nothing was fitted.
    """

    omega: Array
    amplitudes: Array
    phases: Array
    bias: float = 0.0
    residual_rms: float = np.nan

    def at(self, t: ArrayLike) -> Array:
        """Value at given instants.

        Parameters
        ----------
        t : array_like, shape (N,)
            Time since the first sample [s].

        Returns
        -------
        ndarray, shape (N,)
            Signal [signal unit].
        """
        angles = np.asarray(t, dtype=float)[:, None] * self.omega + self.phases
        return np.asarray(np.sin(angles) @ self.amplitudes + self.bias)


def fit_sinusoids(samples: ArrayLike, interval: float, omega: ArrayLike, *, bias: bool = True) -> Sinusoids:
    """Amplitudes, phases and bias of sinusoids of known frequencies, by least squares.

    Parameters
    ----------
    samples : array_like, shape (N,)
        Signal on a regular clock [signal unit]; NaN where missing.
    interval : float
        Sampling interval [s].
    omega : array_like, shape (n,)
        Frequencies [rad/s], positive and different.
    bias : bool, default True
        Whether a constant part is estimated too.

    Returns
    -------
    Sinusoids
        The fit.

    Raises
    ------
    DataError
        If the samples are too few or too short to tell the sinusoids apart.
    ValueError
        If a frequency is not positive.

    Examples
    --------
    >>> import numpy as np
    >>> t = 0.01 * np.arange(1000)
    >>> fit = fit_sinusoids(3 * np.sin(2 * t + 0.5) + np.cos(3 * t) - 1, 0.01, [2.0, 3.0])
    >>> fit.amplitudes.round(6), fit.phases.round(6), round(fit.bias, 6)
    (array([3., 1.]), array([0.5     , 1.570796]), -1.0)
    """
    y, t = present_samples(samples, interval)
    frequencies = np.asarray(omega, dtype=float)
    if frequencies.ndim != 1 or not 1 <= frequencies.size <= MOST_TONES:
        raise ValueError(f"omega must hold 1 to {MOST_TONES} frequencies, not {omega!r}.")
    for frequency in frequencies:
        require_positive("omega", float(frequency), "rad/s")
    # The middle of the record as origin of time: sines and cosines are then as different as the record allows.
    middle = 0.5 * (t[0] + t[-1])
    coefficients, residual = fit_amplitudes(y, t - middle, frequencies, bias=bias)
    n = frequencies.size
    phases = np.arctan2(coefficients[n : 2 * n], coefficients[:n]) - frequencies * middle
    phases = np.pi - np.mod(np.pi - phases, 2.0 * np.pi)
    amplitudes, constant = np.hypot(coefficients[:n], coefficients[n : 2 * n]), float(coefficients[2 * n :].sum())
    return Sinusoids(frequencies, amplitudes, phases, constant, float(np.sqrt(np.mean(residual**2))))


def present_samples(samples: ArrayLike, interval: float) -> tuple[Array, Array]:
    """Samples that are there, with their instants."""
    require_positive("interval", interval, "s")
    values = series_of(samples)
    places = np.flatnonzero(np.isfinite(values))
    if not places.size:
        raise DataError(f"the record holds no finite sample of a size up to {LARGEST_SAMPLE:g}.")
    return values[places], interval * places.astype(np.float64)


def fit_amplitudes(y: Array, t: Array, omega: Array, *, bias: bool) -> tuple[Array, Array]:
    """Fit sines, cosines and, if asked for, a constant by least squares; return coefficients and residual."""
    angles = t[:, None] * omega
    design = np.hstack([np.sin(angles), np.cos(angles), np.ones((t.size, int(bias)))])
    count, unknowns = design.shape
    if count < unknowns:
        raise DataError(f"{count} samples cannot determine {unknowns} amplitudes; use a longer record.")
    coefficients, _, _, singular_values = np.linalg.lstsq(design, y, rcond=None)
    if singular_values[-1] < SINGULAR * singular_values[0]:
        close = "too close to each other, to zero or to a multiple of the sampling frequency for so short a record"
        raise DataError(f"the samples cannot tell the sinusoids apart: frequencies are {close}.")
    return coefficients, y - design @ coefficients
