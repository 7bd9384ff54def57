"""Summary of each tone of a track over its valid rows."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.frequency.flags import Flag
from ctid_cli.tones.track import Track

#: Places in the shortest window at which the weights of samples are computed; of a window alone any number is exact.
PLACES = 16


@dataclass(frozen=True)
class ToneSummary:
    """One tone over its valid rows; without any, over rows that are only too inaccurate; without these, NaN."""

    tone: int
    #: Median [Hz].
    frequency_hz: float = math.nan
    #: Standard error of the mean frequency [Hz].
    standard_error_hz: float = math.nan
    #: Half the width of the central 68 % of the frequencies: variation of the tone [Hz].
    spread_hz: float = math.nan
    #: Median [rad/s].
    omega: float = math.nan
    #: Median and standard error of the mean [signal unit].
    amplitude: float = math.nan
    amplitude_error: float = math.nan
    #: First and last instant of a row in which the tone has a frequency [s since the first sample].
    begins: float = math.nan
    ends: float = math.nan
    #: Share of the rows in which the tone is present.
    valid_percent: float = 0.0


def summarise(track: Track) -> list[ToneSummary]:
    """Summarise each tone over its valid rows."""
    return [_tone(track, k) for k in range(track.omega.shape[1])]


def _tone(track: Track, k: int) -> ToneSummary:
    valid, there = track.valid[:, k], track.there[:, k]
    used = valid if valid.any() else track.flags[:, k] == int(Flag.INACCURATE)
    omega, seen = track.omega[used, k], track.t[there & np.isfinite(track.omega[:, k])]
    amplitudes = track.amplitudes[used & np.isfinite(track.amplitudes[:, k]), k]
    low, high = np.percentile(omega, [16.0, 84.0]) if omega.size else (math.nan, math.nan)
    turn = 2.0 * math.pi
    return ToneSummary(
        tone=k + 1,
        frequency_hz=_median(omega) / turn,
        standard_error_hz=_error_of_mean(track, used, track.error[:, k], k, [1, 2]) / turn,
        spread_hz=float(high / turn - low / turn) / 2.0,
        omega=_median(omega),
        amplitude=_median(amplitudes),
        amplitude_error=_error_of_mean(track, used, track.amplitude_error[:, k], k, [0, 1]),
        begins=float(seen[0]) if seen.size else math.nan,
        ends=float(seen[-1]) if seen.size else math.nan,
        valid_percent=100.0 * float(valid.sum() / there.sum()) if there.any() else 0.0,
    )


def _median(values: Array) -> float:
    return float(np.median(values)) if values.size else math.nan


def _error_of_mean(track: Track, used: BoolArray, errors: Array, k: int, orders: list[int]) -> float:
    """Return the standard error of the mean over rows of a tone; rows with common samples have common errors.

    The rows of a window lie on a line. The errors of its middle and of its slope are independent sums over the noise of
    the samples, weighted by the Legendre polynomials of ``orders``: P1 and P2 for a frequency, the slope of a quadratic
    phase, and P0 and P1 for an amplitude. The least error of the rows is that of the middle; the excess of any other is
    due to the slope, and has opposite signs in both halves. The mean of all rows is one such sum.
    """
    used = used & np.isfinite(errors + track.window[:, k] + track.middle[:, k])
    if not used.any():
        return math.nan
    error, both = errors[used], np.column_stack((track.middle[used, k], track.window[used, k]))
    windows, of = np.unique(both, axis=0, return_inverse=True)
    of = of.ravel()
    least = np.full(len(windows), np.inf)
    np.minimum.at(least, of, error)
    excess = np.sign(track.t[used] - both[:, 0]) * np.sqrt(error**2 - least[of] ** 2)
    sums = np.column_stack((np.bincount(of) * least, np.bincount(of, excess)))
    middle, length = windows.T * (PLACES / windows[:, 1].min())
    first = np.round(middle - 0.5 * length).astype(int)
    count = np.round(length).astype(int)
    first -= first.min()
    weights = np.zeros((first + count).max())
    for j, size in enumerate(count):
        basis = legvander((2.0 * np.arange(size) + 1.0) / size - 1.0, 2)[:, orders]
        weights[first[j] : first[j] + size] += basis / np.linalg.norm(basis, axis=0) @ sums[j]
    return float(np.linalg.norm(weights)) / error.size
