"""Frequencies by least squares on the delay regression, restarted when the signal changes: the recommended tracker."""

from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, get_args

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, IntArray
from ctid_cli.frequency.consistency import ALARM_RATIO, DETECTOR_SPAN, ROUNDING_FLOOR, check_consistency
from ctid_cli.frequency.decoding import (
    FIRST_PERIODS,
    Decoding,
    cosine_sensitivities,
    decode,
    decoding_memory,
    flag_uncertain,
    still_doubtful,
)
from ctid_cli.frequency.delay_options import ROWS_PER_TONE, DelayClock, DelayRegression
from ctid_cli.frequency.flags import CHANGED, GAP, STARTING, UNDETERMINED
from ctid_cli.frequency.moments import accumulate_row, factorise, least_squares, moment_uncertainty, squared_residual
from ctid_cli.frequency.regression import following, form_row
from ctid_cli.frequency.tracking import Output, Recursion
from ctid_cli.signals.checks import require_choice, require_positive

Solution = Literal["least_squares", "total_least_squares"]

#: The estimate is computed anew with every row at first, later every so many.
REFRESH = 10
EAGER_ROWS = 40
#: Rows for each tone before the first estimate.
FIRST_ROWS_PER_TONE = 2
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


class Restarting(NamedTuple):
    """Settings of the tracker, counted in samples."""

    #: Time constant of the detector.
    detector: int
    #: Rows before it may raise an alarm, before the first comparison of halves, and before an estimate can be valid.
    armed: int
    compared: int
    enough: int
    #: Samples that the delays and the prefilter hold.
    flush: int
    memory: float
    #: Inverse of the lower factor of the noise covariance of a row; empty for plain least squares.
    whitener: Array


class Fit(NamedTuple):
    """State of the tracker."""

    #: Ring of samples, shape (2 n lag + 1,).
    samples: Array
    #: Second moments of the rows since the last comparison of halves, of those before, and at the second delay.
    newer: Array
    older: Array
    check: Array
    #: theta, frequencies and their possible errors, shape (3, n).
    estimate: Array
    #: Rows in ``older`` and in ``newer``, less what was forgotten; newest mean squared residual, and alarm level.
    levels: Array
    #: Place of the newest sample, rows since the restart, rows at the next comparison of halves, samples still to
    #: flush, verdict (flags), whether the residual may be compared with the alarm level.
    counters: IntArray


class Workspace(NamedTuple):
    """Memory for one sample."""

    gram: Array
    factor: Array
    scales: Array
    #: As the estimate of the state, shape (3, n).
    trial: Array
    decoding: Decoding


OLDER, NEWER, RESIDUAL, ALARM = range(4)
PLACE, ROWS, NEXT, FLUSH, VERDICT, JUDGES = range(6)


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

    def _recursion(self, interval: float) -> Recursion:
        n, clock, weights = self.tones, self._clock(interval), self._weights(interval)
        length = weights.size - 1
        memory = DEFAULT_MEMORY * clock.delay if self.memory is None else self.memory
        self._require_samples(memory, memory / interval, interval)
        arming = max(round(ARMING_SPAN * clock.lag), 2 * ROWS_PER_TONE * n)
        whitener = np.empty((0, 0))
        if self.solution == "total_least_squares":
            covariance = noise_covariance(clock.table, weights, clock.lag)
            whitener = np.ascontiguousarray(np.linalg.inv(np.linalg.cholesky(covariance)))
        settings = Restarting(
            max(1, round(DETECTOR_SPAN * clock.lag)),
            max(arming, ARMING_PREFILTERS * length),
            max(arming, MIXED_PREFILTERS * length),
            self._rows_before_valid(clock),
            length + 2 * n * clock.lag + 1,
            memory / interval,
            whitener,
        )
        samples, estimate = np.full(2 * n * clock.lag + 1, np.nan), np.full((3, n), np.nan)
        newer, older, check = np.zeros((3, n + 1, n + 1))
        fit = Fit(samples, newer, older, check, estimate, np.zeros(4), np.zeros(6, np.int64))
        return Recursion(advance_restarting, (clock, settings), (fit,), weights, notes=self._notes(clock))


def noise_covariance(table: Array, weights: Array, lag: int) -> Array:
    """Covariance of the regression rows of filtered white noise."""
    places = np.arange(table.shape[1])
    correlation = np.array([weights[j * lag :] @ weights[: max(weights.size - j * lag, 0)] for j in places])
    R = correlation[np.abs(places[:, None] - places)] / correlation[0]
    return np.ascontiguousarray(table @ R @ table.T)


@njit(cache=True, nogil=True)
def total_least_squares(gram: Array, whitener: Array, theta: Array) -> None:
    """Parameters for which the noise in all columns of the regression is least."""
    # M G M' with M the inverse of the noise's lower factor: there the noise is the same in all directions. M is lower
    # triangular, and of G the lower triangle is kept.
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
    gram: Array, theta: Array, span: float, elapsed: float, clock: DelayClock, found: Array, work: Workspace
) -> tuple[int, bool]:
    """Frequencies that belong to fitted parameters, flags of how far they can be trusted, and whether they may judge.

    ``gram`` is that of ``work.factor`` and ``work.scales``; ``found`` takes the frequencies and their errors. An
    estimate may judge new samples if it is certain, or has been there for so long that a misfit is no beginner's.
    """
    memory, omega, errors = work.decoding, found[0], found[1]
    flags = decode(theta, clock.delay, clock.bottom, clock.top, memory.polynomial, memory.quotient, memory.roots, omega)
    cosine_sensitivities(memory.roots, clock.delay, memory.slopes, memory.sensitivities)
    misfit = squared_residual(gram, theta)
    moment_uncertainty(gram, work.factor, work.scales, misfit, theta, memory.sensitivities, errors, memory.rounding)
    uncertain = flag_uncertain(omega, errors, memory.rounding, span, elapsed)
    return flags | uncertain, uncertain == 0 or not still_doubtful(omega, elapsed / FIRST_PERIODS)


@njit(cache=True, nogil=True)
def begin_anew(fit: Fit, compared: int) -> None:
    """Forget all rows."""
    fit.older[:] = 0.0
    fit.newer[:] = 0.0
    fit.check[:] = 0.0
    fit.levels[OLDER] = fit.levels[NEWER] = fit.levels[RESIDUAL] = 0.0
    fit.counters[VERDICT] = 0
    # The first comparison needs an older half.
    fit.counters[NEXT] = compared // 2


@njit(cache=True, nogil=True)
def halves_differ(clock: DelayClock, fit: Fit, work: Workspace) -> bool:
    """Whether the newer half alone fits so much better than the whole that the older one is of another signal."""
    n = work.scales.size
    levels, gram, trial = fit.levels, work.gram, work.trial
    if not factorise(fit.newer, 0.0, work.factor, work.scales):
        return False
    least_squares(fit.newer, work.factor, work.scales, trial[0])
    alone = squared_residual(fit.newer, trial[0]) / levels[NEWER]
    span = (2 * n * clock.lag + levels[NEWER]) * clock.interval
    # A fit to so few rows that it says nothing must not condemn the others, unless it is exact.
    judges = judge(fit.newer, trial[0], span, span, clock, trial[1:], work)[1]
    judges = judges or alone * levels[NEWER] <= EXACT * fit.newer[n, n]
    gram[:] = fit.older + fit.newer
    if not (judges and levels[OLDER] > 0.0 and factorise(gram, 0.0, work.factor, work.scales)):
        return False
    # Mean squared residual of one fit to both halves, against that of the newer half alone; then the rounding of sums.
    least_squares(gram, work.factor, work.scales, trial[0])
    weight = levels[OLDER] + levels[NEWER]
    together = squared_residual(gram, trial[0]) / weight
    return bool(together > MIXED_RATIO * alone + 1e-14 * gram[n, n] / weight)


@njit(cache=True, nogil=True)
def join_halves(mixed: bool, compared: int, fit: Fit) -> None:
    """Both halves become the older one, or the newer one alone if they do not belong together."""
    levels, counters = fit.levels, fit.counters
    if mixed:
        counters[ROWS] = int(levels[NEWER])
        levels[OLDER] = levels[RESIDUAL] = 0.0
        fit.older[:] = 0.0
        fit.check[:] = 0.0
    fit.older[:] += fit.newer
    fit.newer[:] = 0.0
    levels[OLDER] += levels[NEWER]
    levels[NEWER] = 0.0
    # At doubling intervals: whatever is mixed is found at the latest when as much again has arrived.
    counters[NEXT] = max(compared, 2 * counters[ROWS])


@njit(cache=True, nogil=True)
def refresh(clock: DelayClock, settings: Restarting, fit: Fit, work: Workspace) -> None:
    """Estimate, alarm level and verdict from all rows."""
    n = work.scales.size
    theta, frequencies, levels, counters, gram = fit.estimate[0], fit.estimate[1], fit.levels, fit.counters, work.gram
    gram[:] = fit.older + fit.newer
    # Tones that the rows do not tell apart leave a singular matrix; the last estimate is then kept, marked.
    counters[VERDICT] = UNDETERMINED
    if not factorise(gram, 0.0, work.factor, work.scales):
        return
    if settings.whitener.size:
        total_least_squares(gram, settings.whitener, theta)
    else:
        least_squares(gram, work.factor, work.scales, theta)
    weight = levels[OLDER] + levels[NEWER]
    # Residuals of an exact fit are rounding; the floor keeps them from raising an alarm.
    levels[ALARM] = (ALARM_RATIO * squared_residual(gram, theta) + ROUNDING_FLOOR * gram[n, n]) / weight
    span = (2 * n * clock.lag + weight) * clock.interval
    elapsed = (2 * n * clock.lag + counters[ROWS]) * clock.interval
    verdict, judges = judge(gram, theta, span, elapsed, clock, fit.estimate[1:], work)
    counters[JUDGES] = 1 if judges else 0
    counters[VERDICT] = verdict | check_consistency(fit.check, frequencies, clock.second_delay, NEGLIGIBLE)


@njit(cache=True, nogil=True)
def advance_restarting(samples: Array, output: Output, clock: DelayClock, settings: Restarting, fit: Fit) -> None:
    """Least squares with alarm, flush, restart and comparison with the newer data alone."""
    n = output.omega.shape[1]
    row, gram, factor, scales = np.empty(n + 1), np.empty((n + 1, n + 1)), np.empty((n, n)), np.empty(n)
    work = Workspace(gram, factor, scales, np.empty((3, n)), decoding_memory(n))
    # Arrays are taken out of their tuples once: in the loop, each would cost two counts of its references.
    omegas, uncertainty, flags = output
    history, newer, older, check, estimate, levels, counters = fit
    table, theta = clock.table, estimate[0]
    smoothing = 1.0 / settings.detector
    for k in range(samples.size):
        counters[PLACE] = following(counters[PLACE], history.size)
        history[counters[PLACE]] = samples[k]
        complete = form_row(history, counters[PLACE], clock.lag, table, row)
        flag = 0
        if counters[FLUSH] > 0:
            # Samples from before the change are still in the delays: hold the estimate.
            counters[FLUSH] -= 1
            flag = CHANGED if np.isfinite(samples[k]) else CHANGED | GAP
        elif not complete:
            flag = GAP if counters[ROWS] > 0 else STARTING
        else:
            if counters[ROWS] == 0:
                begin_anew(fit, settings.compared)
            elif counters[ROWS] >= settings.armed:
                # The detector sees the row before the fit does.
                residual = row[n]
                for i in range(n):
                    residual -= theta[i] * row[i]
                levels[RESIDUAL] += smoothing * (residual * residual - levels[RESIDUAL])
            counters[ROWS] += 1
            # What exceeds the memory is forgotten exponentially.
            keep = 1.0
            if levels[OLDER] + levels[NEWER] > settings.memory - 0.5:
                keep = 1.0 - 1.0 / settings.memory
                levels[OLDER] *= keep
                for i in range(n + 1):
                    for j in range(i + 1):
                        older[i, j] *= keep
            levels[NEWER] = keep * levels[NEWER] + 1.0
            accumulate_row(row, newer, keep)
            # The row itself is not needed any more: the one at the second delay takes its place.
            checked = counters[PLACE] % clock.every == 0 and clock.second_lag > 0
            if checked and form_row(history, counters[PLACE], clock.second_lag, table, row):
                accumulate_row(row, check, keep**clock.every)
            # A second change while the delays were flushed leaves rows of two signals.
            mixed = False
            if counters[ROWS] >= counters[NEXT]:
                mixed = halves_differ(clock, fit, work)
                join_halves(mixed, settings.compared, fit)
            due = mixed or counters[ROWS] % REFRESH == 0 or counters[ROWS] <= EAGER_ROWS
            if due and counters[ROWS] >= FIRST_ROWS_PER_TONE * n:
                refresh(clock, settings, fit, work)
            # The alarm comes last: an estimate that has just been refreshed is judged by its own level.
            if counters[ROWS] < settings.enough:
                flag = STARTING
            elif counters[ROWS] >= settings.armed and counters[JUDGES] > 0 and levels[RESIDUAL] > levels[ALARM]:
                counters[FLUSH] = settings.flush
                counters[ROWS] = 0
                flag = CHANGED
        for i in range(n):
            omegas[k, i] = estimate[1, i]
            uncertainty[k, i] = estimate[2, i]
        flags[k] = flag | counters[VERDICT]
