"""Amplitudes, phases and bias by linear regression, once the frequencies are known."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.frequency_kernels import flag_uncertain
from ctid_cli.frequency.inputs import LARGEST_SAMPLE, MOST_TONES, series_of
from ctid_cli.frequency.tracking import FrequencyEstimate
from ctid_cli.signals.checks import require_positive

#: Below this ratio of the singular values the sinusoids cannot be told apart.
SINGULAR = 1e-10
#: A residual below this fraction of the signal (root mean squares) is rounding, and may as well be this large.
ROUNDING = 1e-13
#: Probability with which white noise alone has a tone that is called one.
FALSE_TONE = 1e-6


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
    _, coefficients, residual = fit_amplitudes(y, t - middle, frequencies, bias=bias)
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


def fit_amplitudes(y: Array, t: Array, omega: Array, *, bias: bool) -> tuple[Array, Array, Array]:
    """Sines, cosines and, if asked for, a constant by least squares: columns, coefficients, residual."""
    angles = t[:, None] * omega
    design = np.hstack([np.sin(angles), np.cos(angles), np.ones((t.size, int(bias)))])
    count, unknowns = design.shape
    if count < unknowns:
        raise DataError(f"{count} samples cannot determine {unknowns} amplitudes; use a longer record.")
    coefficients, _, _, singular_values = np.linalg.lstsq(design, y, rcond=None)
    if singular_values[-1] < SINGULAR * singular_values[0]:
        close = "too close to each other, to zero or to a multiple of the sampling frequency for so short a record"
        raise DataError(f"the samples cannot tell the sinusoids apart: frequencies are {close}.")
    return design, coefficients, y - design @ coefficients


def frequency_errors(y: Array, t: Array, omega: Array, *, bias: bool) -> tuple[Array, Array, float]:
    r"""Gauss-Newton step of the frequencies, and the error that the residual could make."""
    n = omega.size
    time = t - 0.5 * (t[0] + t[-1])
    design, coefficients, residual = fit_amplitudes(y, time, omega, bias=bias)
    slopes = time[:, None] * (design[:, n : 2 * n] * coefficients[:n] - design[:, :n] * coefficients[n : 2 * n])
    # What of the slopes the amplitudes cannot follow.
    orthogonal, _ = np.linalg.qr(design)
    slopes -= orthogonal @ (orthogonal.T @ slopes)
    misfit, floor = float(residual @ residual), ROUNDING**2 * float(y @ y)
    scales = np.linalg.norm(slopes, axis=0)
    if not (scales > 0).all():
        return np.zeros(n), np.full(n, np.inf), misfit
    q, r = np.linalg.qr(slopes / scales)
    if np.abs(np.diag(r)).min() < SINGULAR:
        return np.zeros(n), np.full(n, np.inf), misfit
    inverse = np.linalg.inv(r)
    step = inverse @ (q.T @ residual) / scales
    return step, np.linalg.norm(inverse, axis=1) / scales * np.sqrt(misfit + floor), misfit


def estimate_of(y: Array, t: Array, omega: Array, uncertainty: Array, flags: Flag, *, bias: bool) -> FrequencyEstimate:
    r"""The estimate of a whole record, with the flags that its uncertainties and its amplitudes call for.

    The weakest tone is compared with the strongest that white noise of the residual's size would seem to have: each of
    the N/2 ordinates of the periodogram of white noise of variance s^2 exceeds ``N A^2/4 = g s^2`` with the probability
    ``exp(-g)``, the largest with ``N/2 exp(-g)`` (R. A. Fisher, "Tests of significance in harmonic analysis", *Proc.
    Royal Society A* 125 (1929) 54-59, for many samples).
    """
    n, length = omega.size, float(t[-1] - t[0])
    flags |= Flag(flag_uncertain(omega, uncertainty, np.zeros(n), length, length))
    try:
        _, coefficients, residual = fit_amplitudes(y, t - 0.5 * (t[0] + t[-1]), omega, bias=bias)
    except DataError:
        return FrequencyEstimate(omega, flags | Flag.UNDETERMINED, uncertainty)
    variance = float(residual @ residual) / max(y.size - coefficients.size - n, 1)
    weakest = float((coefficients[:n] ** 2 + coefficients[n : 2 * n] ** 2).min())
    strongest_of_noise = 4.0 * variance / y.size * np.log(0.5 * y.size / FALSE_TONE)
    if not weakest > strongest_of_noise:
        flags |= Flag.UNDETERMINED
    return FrequencyEstimate(omega, flags, uncertainty)
