"""Frequencies by least squares on the delay regression, restarted when the signal changes: the recommended tracker."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ctid_cli.arrays import Array, IntArray
from ctid_cli.errors import OptionError
from ctid_cli.frequency.consistency import (
    ALARM_RATIO,
    DETECTOR_SPAN,
    ROUNDING_FLOOR,
    check_consistency,
    observe_second_delay,
    samples_between_verdicts,
)
from ctid_cli.frequency.decoding import FIRST_PERIODS, cosine_sensitivities, decode, flag_uncertain, still_doubtful
from ctid_cli.frequency.delay_options import DelayRegression
from ctid_cli.frequency.flags import CHANGED, GAP, STARTING, UNDETERMINED
from ctid_cli.frequency.moments import (
    accumulate_row,
    factorise,
    least_squares,
    moment_uncertainty,
    squared_residual,
)
from ctid_cli.frequency.regression import form_row
from ctid_cli.frequency.tracking import Recursion
from ctid_cli.signals.checks import require_choice, require_positive

Solution = Literal["least_squares", "total_least_squares"]

#: The estimate is computed anew with every row at first, later every so many.
REFRESH = 10
EAGER_ROWS = 40
#: Rows for each tone before the first estimate, and before a valid one; the latter takes this fraction of n h, too.
FIRST_ROWS_PER_TONE = 2
ROWS_PER_TONE = 4
STARTING_SPAN = 0.25
#: The data that the detector needs before it may raise an alarm: so many h, and so many lengths of the prefilter.
ARMING_SPAN = 1.43
ARMING_PREFILTERS = 2
#: Older data are dropped if the whole fit leaves so many times the mean squared residual of the newer data alone; first
#: checked after so many lengths of the prefilter.
MIXED_RATIO = 6.0
MIXED_PREFILTERS = 8
#: A fit that leaves no larger fraction of the regressand's second moment is exact, however short its data are.
EXACT = 1e-13
#: Memory if none is given, in units of h.
DEFAULT_MEMORY = 100.0
#: Fraction of the regressand's second moment that the frequencies may leave at the second delay.
NEGLIGIBLE = 1e-8


@dataclass(frozen=True, kw_only=True)
class RestartingLeastSquares(DelayRegression):
    r"""Frequencies by least squares over all data since the last change of the signal.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.
    h : float
        Delay of the regression [s], below pi over the highest frequency; rounded to whole sampling intervals. The best
        one is 0.7 to 0.8 times pi over the highest frequency.
    memory : float, optional
        Data older than this are forgotten exponentially [s]; by default 100 h. A slow drift, or a step too small
        to be seen in the noise, is followed with a lag of this size and raises no alarm.
    solution : {"least_squares", "total_least_squares"}, default "least_squares"
        Total least squares allows for white noise in the regressors too: no bias without a prefilter.
    prefilter : float, default 0.0
        Length of a Hann low-pass in front of the regression [s]; 0 for none. Least squares is biased by noise without
        one; about 1.5 h is a good length.
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
    ``G = sum [phi psi]' [phi psi]`` and ``theta = G_phiphi^-1 G_phipsi``: without noise exact as soon as the regressors
    are independent, 2 n h and the length L of the prefilter after the start. The squared residual
    ``psi - phi' theta`` of new samples, averaged over h/14, is compared with that of the fit; 30 times as much is an
    alarm. The estimate is then held, marked invalid, for ``L + 2 n h``, until no sample from before the change is left
    in the delays, and starts anew: finite time again after every change. Should the data be mixed nevertheless (a
    second change while the delays were flushed), fits to the newer part alone, compared at doubling intervals, show it.

    Total least squares minimises ``v' G v / v' C v``, ``v = (-theta, 1)``, where C is the covariance of the rows of
    filtered white noise.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares
    >>> t = 0.01 * np.arange(3000)
    >>> w = np.where(t < 15, 1.8, 2.0)
    >>> y = np.sin(w * t) + np.cos(3 * t) + 0.1 * np.random.default_rng(0).standard_normal(3000)
    >>> track = RestartingLeastSquares(tones=2, h=0.7, prefilter=1.0).start(0.01).run(y)
    >>> track.omega[[1400, 2900]].round(2), track.valid[[1400, 1700, 2900]]
    (array([[1.8, 3. ],
           [2. , 3. ]]), array([ True, False,  True]))
    """

    kind: ClassVar[str] = "restarting_least_squares"

    memory: float | None = None
    solution: Solution = "least_squares"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice("solution", self.solution, get_args(Solution))
        if self.memory is not None:
            require_positive("memory", self.memory, "s")

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
        length = clock.weights.size - 1
        memory = DEFAULT_MEMORY * clock.delay if self.memory is None else self.memory
        needed = ROWS_PER_TONE * n
        if memory < needed * interval:
            raise OptionError(
                "memory",
                f"memory = {memory:g} s holds fewer than the {needed} samples of {interval:g} s that {n} tones need.",
            )
        arming = round(ARMING_SPAN * clock.lag)
        settings = np.array(
            [
                max(1, round(DETECTOR_SPAN * clock.lag)),
                max(arming, ARMING_PREFILTERS * length, 2 * needed),
                max(arming, MIXED_PREFILTERS * length, 2 * needed),
                length + 2 * n * clock.lag + 1,
                max(needed, int(STARTING_SPAN * n * clock.lag)),
            ]
        )
        covariance = noise_covariance(clock.table, clock.weights, clock.lag)
        constants = (
            clock.table,
            clock.lag,
            settings,
            memory / interval,
            np.ascontiguousarray(np.linalg.inv(np.linalg.cholesky(covariance))),
            self.solution == "total_least_squares",
            float(interval),
            np.array([clock.delay, clock.top, clock.bottom, clock.second_delay]),
            clock.second_lag,
            samples_between_verdicts(clock.lag),
        )
        state = {
            "samples": np.full(2 * n * clock.lag + 1, np.nan),
            "older": np.zeros((n + 1, n + 1)),
            "newer": np.zeros((n + 1, n + 1)),
            "check": np.zeros((n + 1, n + 1)),
            "estimate": np.full((3, n), np.nan),
            "levels": np.zeros(4),
            "counters": np.zeros(6, np.int64),
        }
        return Recursion(advance_restarting, constants, state, clock.weights, np.nan, clock.notes)


def noise_covariance(table: Array, weights: Array, lag: int) -> Array:
    """Covariance of the regression rows of filtered white noise."""
    width = table.shape[1]
    correlation = [
        float(weights[j * lag :] @ weights[: weights.size - j * lag]) if j * lag < weights.size else 0.0
        for j in range(width)
    ]
    R = np.array([[correlation[abs(i - j)] for j in range(width)] for i in range(width)]) / correlation[0]
    return np.ascontiguousarray(table @ R @ table.T)


@njit(cache=True, nogil=True)
def total_least_squares(gram: Array, whitener: Array, theta: Array) -> None:
    """Parameters for which the noise in all columns of the regression is least."""
    size = gram.shape[0]
    half, full = np.zeros((size, size)), np.zeros((size, size))
    for i in range(size):
        for j in range(size):
            for k in range(i + 1):
                half[i, j] += whitener[i, k] * (gram[k, j] if j <= k else gram[j, k])
    for i in range(size):
        for j in range(size):
            for k in range(j + 1):
                full[i, j] += half[i, k] * whitener[j, k]
    vectors = np.linalg.eigh(full)[1]
    # v = M' u for the eigenvector u of M G M'; theta = -v_phi/v_psi.
    last = vectors[size - 1, 0] * whitener[size - 1, size - 1]
    for k in range(size - 1):
        total = 0.0
        for i in range(k, size):
            total += vectors[i, 0] * whitener[i, k]
        theta[k] = -total / last if last != 0.0 else np.nan


@njit(cache=True, nogil=True)
def judge(
    gram: Array,
    factor: Array,
    scales: Array,
    theta: Array,
    clock: Array,
    span: float,
    elapsed: float,
    frequencies: Array,
    possible_errors: Array,
) -> tuple[int, bool]:
    """Frequencies that belong to fitted parameters, and how far they can be trusted."""
    n = theta.size
    roots, slopes, rounding = np.empty(n), np.empty(n), np.empty(n)
    sensitivities = np.empty((n, n))
    flags = decode(theta, clock[0], clock[1], clock[2], np.empty(n + 1), np.empty(n + 1), roots, frequencies)
    cosine_sensitivities(roots, clock[0], slopes, sensitivities)
    misfit = squared_residual(gram, theta)
    moment_uncertainty(gram, factor, scales, misfit, theta, sensitivities, possible_errors, rounding)
    uncertain = flag_uncertain(frequencies, possible_errors, rounding, span, elapsed)
    return flags | uncertain, uncertain == 0 or not still_doubtful(frequencies, elapsed / FIRST_PERIODS)


@njit(cache=True, nogil=True)
def advance_restarting(
    samples: Array,
    omega: Array,
    uncertainty: Array,
    flags: NDArray[np.uint16],
    table: Array,
    lag: int,
    settings: IntArray,
    memory: float,
    whitener: Array,
    total: bool,
    interval: float,
    clock: Array,
    check_lag: int,
    every: int,
    history: Array,
    older: Array,
    newer: Array,
    check: Array,
    estimate: Array,
    levels: Array,
    counters: IntArray,
) -> None:
    """Least squares with alarm, flush, restart and comparison with the newer data alone."""
    n = omega.shape[1]
    row, check_row = np.empty(n + 1), np.empty(n + 1)
    scales, trial, trial_omega, trial_errors = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    factor, gram = np.empty((n, n)), np.empty((n + 1, n + 1))
    theta, frequencies, possible_errors = estimate[0], estimate[1], estimate[2]
    smoothing = 1.0 / settings[0]
    for k in range(samples.size):
        counters[0] = counters[0] + 1 if counters[0] + 1 < history.size else 0
        history[counters[0]] = samples[k]
        complete = form_row(history, counters[0], lag, table, row)
        flag = 0
        if counters[3] > 0:
            counters[3] -= 1
            flag = CHANGED if np.isfinite(samples[k]) else CHANGED | GAP
        elif not complete:
            flag = GAP if counters[1] > 0 else STARTING
        else:
            if counters[1] == 0:
                # The first comparison needs an older half.
                counters[2] = settings[2] // 2
                for i in range(n + 1):
                    for j in range(n + 1):
                        older[i, j] = newer[i, j] = check[i, j] = 0.0
                levels[0] = levels[1] = levels[2] = 0.0
                counters[4] = 0
            elif counters[1] >= settings[1]:
                residual = row[n]
                for i in range(n):
                    residual -= theta[i] * row[i]
                levels[2] += smoothing * (residual * residual - levels[2])
            counters[1] += 1
            keep = 1.0
            if levels[0] + levels[1] > memory - 0.5:
                keep = 1.0 - 1.0 / memory
                levels[0] *= keep
                for i in range(n + 1):
                    for j in range(i + 1):
                        older[i, j] *= keep
            levels[1] = keep * levels[1] + 1.0
            accumulate_row(row, newer, keep)
            if counters[0] % every == 0:
                observe_second_delay(history, counters[0], check_lag, table, check_row, check, keep**every)
            mixed = False
            if counters[1] >= counters[2]:
                # Does the newer half fit much better than the whole?
                if factorise(newer, 0.0, factor, scales):
                    least_squares(newer, factor, scales, trial)
                    alone = squared_residual(newer, trial) / levels[1]
                    span = (2 * n * lag + levels[1]) * interval
                    _, judges = judge(newer, factor, scales, trial, clock, span, span, trial_omega, trial_errors)
                    judges = judges or alone * levels[1] <= EXACT * newer[n, n]
                    for i in range(n + 1):
                        for j in range(i + 1):
                            gram[i, j] = older[i, j] + newer[i, j]
                    if judges and levels[0] > 0.0 and factorise(gram, 0.0, factor, scales):
                        least_squares(gram, factor, scales, trial)
                        weight = levels[0] + levels[1]
                        together = squared_residual(gram, trial) / weight
                        mixed = together > MIXED_RATIO * alone + 1e-14 * gram[n, n] / weight
                if mixed:
                    counters[1] = int(levels[1])
                    levels[0] = levels[2] = 0.0
                for i in range(n + 1):
                    for j in range(i + 1):
                        older[i, j] = newer[i, j] + (0.0 if mixed else older[i, j])
                        newer[i, j] = 0.0
                        if mixed:
                            check[i, j] = 0.0
                levels[0] += levels[1]
                levels[1] = 0.0
                counters[2] = max(settings[2], 2 * counters[1])
            due = mixed or counters[1] % REFRESH == 0 or counters[1] <= EAGER_ROWS
            if due and counters[1] >= FIRST_ROWS_PER_TONE * n:
                for i in range(n + 1):
                    for j in range(i + 1):
                        gram[i, j] = older[i, j] + newer[i, j]
                weight = levels[0] + levels[1]
                verdict = UNDETERMINED
                if factorise(gram, 0.0, factor, scales):
                    if total:
                        total_least_squares(gram, whitener, theta)
                    else:
                        least_squares(gram, factor, scales, theta)
                    levels[3] = (ALARM_RATIO * squared_residual(gram, theta) + ROUNDING_FLOOR * gram[n, n]) / weight
                    span, elapsed = (2 * n * lag + weight) * interval, (2 * n * lag + counters[1]) * interval
                    verdict, judges = judge(
                        gram, factor, scales, theta, clock, span, elapsed, frequencies, possible_errors
                    )
                    counters[5] = 1 if judges else 0
                    verdict |= check_consistency(check, frequencies, clock[3], NEGLIGIBLE)
                counters[4] = verdict
            if counters[1] < settings[4]:
                flag = STARTING
            elif counters[1] >= settings[1] and counters[5] > 0 and levels[2] > levels[3]:
                counters[3] = settings[3]
                counters[1] = 0
                flag = CHANGED
        for i in range(n):
            omega[k, i] = frequencies[i]
            uncertainty[k, i] = possible_errors[i]
        flags[k] = flag | counters[4]
