"""Estimates of windows, of which only some tones are wanted."""

from dataclasses import dataclass, replace

import numpy as np

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.errors import DataError
from ctid_cli.frequency.amplitudes import fit_sinusoids
from ctid_cli.frequency.esprit import Esprit
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.frequency_kernels import CERTAIN_FRACTION
from ctid_cli.frequency.tracking import FrequencyEstimate

#: An estimate within this fraction of an expected frequency is probably the one of that tone.
NEAR = 0.05


@dataclass(frozen=True, eq=False)
class WindowEstimate(FrequencyEstimate):
    """Frequencies of one window; NaN where there is no estimate."""

    #: Frequencies of all tones that were estimated [rad/s]: those wanted, and those that only share their band, shape
    #: (m,).
    everything: Array


def estimate_window(estimator: Esprit, samples: Array, interval: float, expected: Array, wanted: int) -> WindowEstimate:
    """Estimate the frequencies of one window, and keep those of the tones that are wanted."""
    none = np.full(wanted, np.nan)
    if not np.isfinite(samples).all():
        return WindowEstimate(none, Flag.GAP, none, np.empty(0))
    result = WindowEstimate(none, Flag.UNDETERMINED, none, np.empty(0))
    # A tone that only shares the band need not be there in every window.
    for count in range(estimator.tones, wanted - 1, -1):
        try:
            found = replace(estimator, tones=count).estimate(samples, interval)
        except DataError:
            continue
        result = wanted_tones(found, expected, wanted)
        if not result.flags & Flag.UNDETERMINED:
            break
    return result


def wanted_tones(found: FrequencyEstimate, expected: Array, wanted: int) -> WindowEstimate:
    """Keep the tones that are wanted."""
    omega, uncertainty = found.omega, found.uncertainty
    if omega.size == wanted or not np.isfinite(omega).all():
        return WindowEstimate(omega[:wanted], found.flags, uncertainty[:wanted], omega)
    kept = np.sort(belonging(omega, expected, wanted))
    flags = found.flags & ~(Flag.UNCERTAIN | Flag.COMPLEX_ROOTS | Flag.OUT_OF_BOUNDS)
    # The room of a wanted tone is that between the wanted ones.
    apart = np.diff(np.concatenate(([0.0], omega[kept])))
    room = np.minimum(apart, np.append(apart[1:], np.inf))
    if not (uncertainty[kept] <= CERTAIN_FRACTION * room).all():
        flags |= Flag.UNCERTAIN
    return WindowEstimate(omega[kept], flags, uncertainty[kept], omega)


def belonging(found: Array, expected: Array, wanted: int) -> IndexArray:
    """Which of the estimated frequencies belong to the wanted tones.

    The sum over all pairs of ``x/(x + NEAR)`` is least, with x the distance of the logarithms: one pair that fits is
    worth more than several that nearly do, and a tone that strayed far is as good as any other that did.
    """
    from scipy.optimize import linear_sum_assignment

    tiny = 1e-3 * float(expected.min())
    distance = np.abs(np.log(np.maximum(found, tiny)) - np.log(expected)[:, None])
    absent = np.zeros((expected.size, expected.size - found.size))
    absent[:wanted] = expected.size  # more than all others together: wanted tones are always there
    cost = np.hstack((distance / (distance + NEAR), absent))
    return np.asarray(linear_sum_assignment(cost)[1][:wanted])


def sinusoids_of(
    samples: Array, interval: float, omega: Array, everything: Array, instant: float
) -> tuple[Array, Array]:
    """Amplitudes of sinusoids of known frequencies in a window, and their phases at an instant [s] of it."""
    frequencies = np.unique(everything[everything > 0])
    unknown = np.full(omega.size, np.nan)
    if not np.isfinite(omega).all() or not np.isin(omega, frequencies).all():
        return unknown, unknown
    try:
        fit = fit_sinusoids(samples, interval, frequencies)
    except DataError:
        return unknown, unknown
    places = np.searchsorted(frequencies, omega)
    return fit.amplitudes[places], np.angle(np.exp(1j * (fit.phases[places] + omega * instant)))
