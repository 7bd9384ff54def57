"""Summary of each tone of a track over its valid rows."""

import math
from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.frequency.flags import Flag
from ctid_cli.tones.track import Track


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
        standard_error_hz=_error_of_mean(track, used, track.error[:, k], k) / turn,
        spread_hz=float(high / turn - low / turn) / 2.0,
        omega=_median(omega),
        amplitude=_median(amplitudes),
        amplitude_error=_error_of_mean(track, used, track.amplitude_error[:, k], k),
        begins=float(seen[0]) if seen.size else math.nan,
        ends=float(seen[-1]) if seen.size else math.nan,
        valid_percent=100.0 * float(valid.sum() / there.sum()) if there.any() else 0.0,
    )


def _median(values: Array) -> float:
    return float(np.median(values)) if values.size else math.nan


def _error_of_mean(track: Track, used: BoolArray, errors: Array, k: int) -> float:
    """Return the standard error of the mean over rows of a tone; overlapping windows have common errors.

    Windows of length L, every D seconds, are equivalent to a share D/L of independent rows: the mean of N rows has the
    variance ``sum_i s_i^2 min(L_i/D, N)/N^2``.
    """
    known = used & np.isfinite(errors) & np.isfinite(track.window[:, k])
    n = int(known.sum())
    if n == 0:
        return math.nan
    common = np.clip(track.window[known, k] / track.every, 1.0, n)
    return float(np.sqrt(np.sum(errors[known] ** 2 * common))) / n
