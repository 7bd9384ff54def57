"""Batch estimators over windows of a record."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctid_cli.errors import DataError
from ctid_cli.frequency.amplitudes import fit_sinusoids
from ctid_cli.frequency.flags import CERTAIN_FRACTION, Flag
from ctid_cli.frequency.nonlinear_least_squares import NonlinearLeastSquares
from ctid_cli.frequency.tracking import FrequencyEstimate

Array = NDArray[np.float64]

#: A window with a larger fraction of missing samples has no estimate.
MOST_MISSING = 0.5
#: An estimate within this fraction of an expected frequency is probably the one of that tone.
NEAR = 0.05


@dataclass(frozen=True, eq=False)
class WindowEstimate:
    """Frequencies of one window.

    Parameters
    ----------
    omega, uncertainty : ndarray, shape (n,)
        Frequencies, ascending, and what may be wrong with them [rad/s]; NaN where there is no estimate.
    flags : Flag
        Why they must not be trusted.
    everything : ndarray, shape (m,)
        Frequencies of all tones that were estimated [rad/s]: those wanted, and those that only share their band.
    """

    omega: Array
    uncertainty: Array
    flags: Flag
    everything: Array


def estimate_window(estimator: Any, samples: Array, interval: float, expected: Array, wanted: int) -> WindowEstimate:
    """Estimate the frequencies of one window, and keep those of the tones that are wanted.

    Parameters
    ----------
    estimator : Esprit or NonlinearLeastSquares
        Batch estimator of m tones.
    samples : ndarray, shape (N,)
        Signal [signal unit]; NaN where missing.
    interval : float
        Sampling interval [s].
    expected : ndarray, shape (m,)
        Frequencies that the spectrum shows [rad/s], those of the wanted tones first.
    wanted : int
        Number n of wanted tones, at most m.

    Returns
    -------
    WindowEstimate
        The estimate. If more tones were estimated than are wanted, those that belong to the wanted ones are kept.
    """
    none = np.full(wanted, np.nan)
    missing = ~np.isfinite(samples)
    if missing.any() and (not isinstance(estimator, NonlinearLeastSquares) or missing.mean() > MOST_MISSING):
        return WindowEstimate(none, none, Flag.GAP, np.empty(0))
    result = WindowEstimate(none, none, Flag.UNDETERMINED, np.empty(0))
    # A tone that only shares the band need not be there in every window.
    for count in range(estimator.tones, wanted - 1, -1):
        fewer = replace(estimator, tones=count)
        if missing.any():
            fewer = replace(fewer, initial_frequencies=tuple(np.sort(expected[:count])))
        try:
            found = fewer.estimate(samples, interval)
        except DataError:
            continue
        result = wanted_tones(found, expected, wanted)
        if not result.flags & Flag.UNDETERMINED:
            break
    return result


def wanted_tones(found: FrequencyEstimate, expected: Array, wanted: int) -> WindowEstimate:
    """Keep the tones that are wanted.

    Parameters
    ----------
    found : FrequencyEstimate
        Estimate of m tones.
    expected : ndarray, shape (M,)
        Frequencies that the spectrum shows [rad/s], those of the wanted tones first; no fewer than were estimated.
    wanted : int
        Number n of wanted tones, at most m.

    Returns
    -------
    WindowEstimate
        What is wrong with a tone that only shares the band does not make the others invalid.
    """
    omega, uncertainty = found.omega, found.uncertainty
    if omega.size == wanted or not np.isfinite(omega).all():
        return WindowEstimate(omega[:wanted], uncertainty[:wanted], found.flags, omega)
    kept = np.sort(belonging(omega, expected, wanted))
    flags = found.flags & ~(Flag.UNCERTAIN | Flag.COMPLEX_ROOTS | Flag.OUT_OF_BOUNDS)
    # The room of a wanted tone is that between the wanted ones.
    apart = np.diff(np.concatenate(([0.0], omega[kept])))
    room = np.minimum(apart, np.append(apart[1:], np.inf))
    if not (uncertainty[kept] <= CERTAIN_FRACTION * room).all():
        flags |= Flag.UNCERTAIN
    return WindowEstimate(omega[kept], uncertainty[kept], flags, omega)


def belonging(found: Array, expected: Array, wanted: int) -> NDArray[np.intp]:
    """Which of the estimated frequencies belong to the wanted tones.

    Parameters
    ----------
    found : ndarray, shape (m,)
        Estimated frequencies [rad/s].
    expected : ndarray, shape (M,)
        Frequencies that the spectrum shows [rad/s], those of the wanted tones first, M at least m.
    wanted : int
        Number n of wanted tones, at most m.

    Returns
    -------
    ndarray of int, shape (n,)
        For each wanted tone the place of its estimate. Every estimate belongs to one of the expected tones; of those
        that only share the band some may have none.

    Notes
    -----
    The sum over all pairs of ``x/(x + NEAR)`` is least, with x the distance of the logarithms: one pair that fits is
    worth more than several that nearly do, and a tone that strayed far is as good as any other that did.

    Examples
    --------
    >>> belonging(np.array([0.1, 2.1, 3.2]), np.array([3.0, 2.0, 9.0]), 3)
    array([2, 1, 0])
    >>> belonging(np.array([1.0, 1.1, 1.5, 3.0]), np.array([1.5, 3.0, 1.1, 1.7, 1.0]), 2)
    array([2, 3])
    """
    from scipy.optimize import linear_sum_assignment

    tiny = 1e-3 * float(expected.min())
    distance = np.abs(np.log(np.maximum(found, tiny)) - np.log(expected)[:, None])
    absent = np.zeros((expected.size, expected.size - found.size))
    absent[:wanted] = expected.size  # more than all others together: wanted tones are always there
    cost = np.hstack((distance / (distance + NEAR), absent))
    return np.asarray(linear_sum_assignment(cost)[1][:wanted])


def amplitudes_of(samples: Array, interval: float, omega: Array, everything: Array) -> Array:
    """Amplitudes of sinusoids of known frequencies in a window.

    Parameters
    ----------
    samples : ndarray, shape (N,)
        Signal [signal unit]; NaN where missing.
    interval : float
        Sampling interval [s].
    omega : ndarray, shape (n,)
        Frequencies [rad/s].
    everything : ndarray, shape (m,)
        Frequencies of all tones of the window, these among them.

    Returns
    -------
    ndarray, shape (n,)
        Amplitudes [signal unit]; NaN where they are not determined.
    """
    frequencies = np.unique(everything[everything > 0])
    if not np.isfinite(omega).all() or not np.isin(omega, frequencies).all():
        return np.full(omega.size, np.nan)
    try:
        fit = fit_sinusoids(samples, interval, frequencies)
    except DataError:
        return np.full(omega.size, np.nan)
    return np.asarray(fit.amplitudes[np.searchsorted(frequencies, omega)])
