"""Frequencies from the mixed regressions (DREM) of a sliding window: finite time after every change of the signal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ctid_cli.arrays import Array, IntArray
from ctid_cli.errors import OptionError
from ctid_cli.frequency.consistency import (
    DETECTOR_SPAN,
    USUAL_SPANS,
    contradicts,
    observe_second_delay,
    samples_between_verdicts,
)
from ctid_cli.frequency.decoding import decode
from ctid_cli.frequency.delay_options import DelayRegression
from ctid_cli.frequency.flags import GAP, STARTING, UNDETERMINED
from ctid_cli.frequency.regression import form_row, minor_plan, mix_rows, whole_delay
from ctid_cli.frequency.scalar_regressions import (
    CHECK_SPANS,
    LONG_AGO,
    MIXING_ROUNDING,
    ROWS_PER_TONE,
    check_mixing,
    judge_mixed,
    rows_before_valid,
)
from ctid_cli.frequency.tracking import Recursion

#: A scatter of the scalar regressions below this fraction of their square is rounding.
SCATTER_ROUNDING = 1e-14


@dataclass(frozen=True, kw_only=True)
class DremWindow(DelayRegression):
    r"""Frequencies by least squares on each mixed regression over a sliding window.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.
    h : float
        Delay of the regression [s], below pi over the highest frequency; rounded to whole sampling intervals.
    d : float
        Distance of the stacked rows [s]; rounded to whole sampling intervals.
    memory : float
        Length of the window [s]; rounded to whole sampling intervals.
    first_row : int, default 1
        Number of the first stacked row; 1 as published, 0 is exact one d earlier.
    prefilter : float, default 0.0
        Length of a Hann low-pass in front of the regression [s]; 0 for none.
    difference : float, default 0.0
        If positive, the signal this much earlier is subtracted [s], which removes a constant bias.
    lowest_frequency : float, default 0.0
        Lower bound of the frequencies [rad/s].
    highest_frequency : float, optional
        Upper bound of the frequencies [rad/s]; by default pi/h, beyond which they cannot be told apart.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    ``theta_k(t) = sum Delta Psi_k / sum Delta^2`` over the last ``memory`` seconds. It is the limit for small gains of
    ``(theta_k(t) - theta_k(t - T) W)/(1 - W)``, ``W = exp(-gamma int_(t-T)^t Delta^2)``, the finite-time estimate that
    starts anew at every instant; there is no gain to choose. Exact, without noise, from
    ``2 n h + (first_row + n - 1) d`` on, and again that much and one ``memory`` after a change. The sums are those of
    the samples in the window alone: a block of old samples is summed backwards once, and the newer ones forwards, so no
    rounding error accumulates.

    References
    ----------
    R. Ortega, S. Aranovskiy, A. Pyrkin, A. Astolfi and A. Bobtsov, "New results on parameter estimation via dynamic
    regressor extension and mixing: continuous and discrete-time cases", *IEEE Trans. Automatic Control* 66 (2021)
    2265-2272. doi:10.1109/TAC.2020.3003651
    """

    kind: ClassVar[str] = "drem_window"

    d: float
    memory: float
    first_row: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        check_mixing(self.d, self.first_row)

    def recursion(self, interval: float) -> Recursion:
        """The compiled recursion for a sampling interval.

        Parameters
        ----------
        interval : float
            Sampling interval [s].

        Returns
        -------
        Recursion
            With the state before the first sample.

        Raises
        ------
        ValueError
            If the options make no sense at this sampling interval.
        """
        n = self.tones
        clock = self.clock(interval)
        spacing = whole_delay("d", self.d, interval)
        length = whole_delay("memory", self.memory, interval)
        if length < ROWS_PER_TONE * n:
            raise OptionError(
                "memory",
                f"memory = {self.memory:g} s holds {length} samples of {interval:g} s, fewer than the "
                f"{ROWS_PER_TONE * n} that {n} tones need.",
            )
        constants = (
            clock.table,
            minor_plan(n),
            clock.lag,
            min(rows_before_valid(n, clock), length),
            self.first_row,
            spacing,
            float(interval),
            clock.delay,
            clock.top,
            clock.bottom,
            clock.second_lag,
            clock.second_delay,
            samples_between_verdicts(clock.lag),
        )
        state = {
            "samples": np.full(2 * n * clock.lag + 1, np.nan),
            "rows": np.full(((self.first_row + n - 1) * spacing + 1, n + 1), np.nan),
            "window": np.zeros((length, 2 * n + 3)),
            "newer": np.zeros(2 * n + 3),
            "check": np.zeros((n + 1, n + 1)),
            "counters": np.zeros(4, np.int64),
            "doubts": np.array([0, 0, LONG_AGO], np.int64),
            "levels": np.zeros(4),
            "possible_errors": np.full(n, np.nan),
        }
        return Recursion(advance_window, constants, state, clock.weights, np.nan, clock.notes)


@njit(cache=True, nogil=True)
def slide(window: Array, newer: Array, place: int, sums: Array) -> int:
    """Put an entry into a sliding window and sum the window."""
    length, width = window.shape
    for i in range(width):
        newer[i] += window[place, i]
        sums[i] = newer[i]
    if place + 1 < length:
        for i in range(width):
            sums[i] += window[place + 1, i]
        return place + 1
    for j in range(length - 2, -1, -1):
        for i in range(width):
            window[j, i] += window[j + 1, i]
    for i in range(width):
        newer[i] = 0.0
    return 0


@njit(cache=True, nogil=True)
def advance_window(
    samples: Array,
    omega: Array,
    uncertainty: Array,
    flags: NDArray[np.uint16],
    table: Array,
    plan: IntArray,
    lag: int,
    enough: int,
    first_row: int,
    spacing: int,
    interval: float,
    delay: float,
    top: float,
    bottom: float,
    check_lag: int,
    check_delay: float,
    every: int,
    history: Array,
    rows: Array,
    window: Array,
    newer: Array,
    check: Array,
    counters: IntArray,
    doubts: IntArray,
    levels: Array,
    possible_errors: Array,
) -> None:
    """Least squares on every mixed regression over a sliding window."""
    n = omega.shape[1]
    row, check_row = np.empty(n + 1), np.empty(n + 1)
    matrix, minors, mixed = np.empty((n, n + 1)), np.empty(2 ** (n + 1)), np.empty(n + 1)
    theta, errors, rounding, roots, slopes = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    polynomial, work, sensitivities = np.empty(n + 1), np.empty(n + 1), np.empty((n, n))
    sums = np.empty(2 * n + 3)
    keep = 1.0 - every / (CHECK_SPANS * n * lag)
    fast, slow = 1.0 / max(1.0, DETECTOR_SPAN * lag), 1.0 / (USUAL_SPANS * n * lag)
    for k in range(samples.size):
        counters[0] = counters[0] + 1 if counters[0] + 1 < history.size else 0
        counters[1] = counters[1] + 1 if counters[1] + 1 < rows.shape[0] else 0
        history[counters[0]] = samples[k]
        form_row(history, counters[0], lag, table, row)
        for i in range(n + 1):
            rows[counters[1], i] = row[i]
        if counters[0] % every == 0:
            observe_second_delay(history, counters[0], check_lag, table, check_row, check, keep)
        scale = mix_rows(rows, counters[1], first_row, spacing, plan, matrix, minors, mixed)
        delta = mixed[n]
        flag = 0
        entry = window[counters[2]]
        if np.isfinite(scale * scale) and np.isfinite(delta * delta):
            counters[3] += 1
            for i in range(n):
                entry[i] = delta * mixed[i]
                entry[n + i] = mixed[i] * mixed[i]
            entry[2 * n] = delta * delta
            entry[2 * n + 1] = (MIXING_ROUNDING * scale) ** 2
            entry[2 * n + 2] = 1.0
        else:
            flag = GAP if counters[3] > 0 else STARTING
            for i in range(2 * n + 3):
                entry[i] = 0.0
        counters[2] = slide(window, newer, counters[2], sums)
        if sums[2 * n + 2] < enough:
            flag |= STARTING
        if sums[2 * n] > 0.0:
            for i in range(n):
                theta[i] = sums[i] / sums[2 * n]
            flag |= decode(theta, delay, top, bottom, polynomial, work, roots, omega[k])
            started = sums[2 * n + 2] >= enough
            contradicted = started and contradicts(row, theta, levels, fast, slow)
            if doubts[0] == 0 or contradicted:
                relative = np.sqrt(sums[2 * n + 1] / sums[2 * n])
                for i in range(n):
                    square = sums[n + i] / sums[2 * n]
                    scatter = square - theta[i] * theta[i]
                    errors[i] = np.sqrt(scatter) if scatter > SCATTER_ROUNDING * square else 0.0
                span = (rows.shape[0] + 2 * n * lag + sums[2 * n + 2]) * interval
                elapsed = (rows.shape[0] + 2 * n * lag + counters[3]) * interval
                doubts[1] = judge_mixed(
                    theta,
                    roots,
                    errors,
                    relative,
                    delay,
                    span,
                    elapsed,
                    interval,
                    started,
                    contradicted,
                    check,
                    check_delay,
                    doubts,
                    sensitivities,
                    slopes,
                    rounding,
                    omega[k],
                    possible_errors,
                )
            doubts[0] = (doubts[0] + 1) % every if started else 0
            doubts[2] += 1
            for i in range(n):
                uncertainty[k, i] = possible_errors[i]
        else:
            for i in range(n):
                omega[k, i] = uncertainty[k, i] = np.nan
            if counters[3] > 0:
                flag |= UNDETERMINED
        flags[k] = flag | doubts[1]
