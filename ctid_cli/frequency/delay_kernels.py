r"""Compiled loops of the estimators on the delay regression.

A kernel calls only kernels of this file and reads no constant and no type of another: Numba's cache on disk looks only
at the file of a function, and is then never stale. Where a loop carries something from one sample to the next, it is
kept in arrays that the loop changes in place, so that a record may be cut anywhere.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ctid_cli.arrays import Array, IntArray

Flags = NDArray[np.uint16]

# The first bits of ctid_cli.frequency.flags.Flag; a test compares them.
STARTING, GAP, CHANGED, UNDETERMINED = 1, 2, 4, 8
UNCERTAIN, COMPLEX_ROOTS, OUT_OF_BOUNDS, INCONSISTENT = 16, 32, 64, 128

#: Roots must settle within this number of steps; simple ones need fewer than ten, nearly double ones thirty.
ROOT_STEPS = 60
#: Second moments summed over many samples carry relative errors of about this size.
ROUNDING = 4e-15
#: A squared residual below this multiple of that is not known from the moments.
DETERMINED = 10.0
#: Added to the unit diagonal of scaled second moments where the best fit must exist even if it is not unique.
REGULARISATION = 1e-10
#: An estimation younger than this number of periods, or beats of neighbours, is less certain than its misfit shows.
FIRST_PERIODS = 2.0
#: Frequencies are called certain while the error that the misfit of the equations can make stays below this fraction of
#: the frequency itself and of the distance to its neighbours.
CERTAIN_FRACTION = 0.1
#: The frequencies are inconsistent if they leave more than this multiple of the smallest possible squared residual.
WORSE_THAN_BEST = 10.0
#: Residuals of new rows, averaged over this fraction of h, are compared with those of the estimate's own rows.
DETECTOR_SPAN = 1.0 / 14.0
#: The signal changed if they are so much larger (mean squares), and than rounding.
ALARM_RATIO = 30.0
ROUNDING_FLOOR = 1e-18


class Clock(NamedTuple):
    """The delay regression at a sampling interval."""

    #: Sampling interval [s].
    interval: float
    #: The delay h in sampling intervals, and in seconds.
    lag: int
    delay: float
    #: A second delay, at which the frequencies are checked, likewise.
    second_lag: int
    second_delay: float
    #: Samples from one verdict to the next.
    every: int


# --- least squares from second moments -----------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def add_row(row: Array, gram: Array) -> None:
    """Add a row to second moments, unless a sample of it is missing."""
    for i in range(row.size if np.isfinite(row[0]) else 0):
        for j in range(row.size):
            gram[i, j] += row[i] * row[j]


@njit(cache=True, nogil=True)
def residual_of(row: Array, theta: Array) -> float:
    """Residual ``psi - phi' theta`` of a row ``[phi psi]``."""
    residual = row[theta.size]
    for i in range(theta.size):
        residual -= theta[i] * row[i]
    return float(residual)


@njit(cache=True, nogil=True)
def squared_residual(gram: Array, theta: Array) -> float:
    """Sum of the squared residuals ``psi - phi' theta``; a negative one is rounding."""
    return max(residual_of(gram[-1] - theta @ gram[:-1], theta), 0.0)


@njit(cache=True, nogil=True)
def rounding_of(gram: Array, theta: Array) -> float:
    """Rounding of the sum of the squared residuals: terms of the size ``|psi| + sum |theta_k phi_k|`` cancel in it."""
    sizes = np.sqrt(np.diag(gram))
    return float(ROUNDING * (sizes[-1] + np.sum(np.abs(theta) * sizes[:-1])) ** 2)


@njit(cache=True, nogil=True)
def factorise(gram: Array, ridge: float) -> tuple[bool, Array, Array]:
    """Cholesky factor of the regressors' second moments, scaled to a unit diagonal, and the scales; if there is one."""
    n = len(gram) - 1
    # A unit diagonal makes the pivots below comparable with rounding, whatever the units of the columns.
    factor, scales = np.zeros((n, n)), np.sqrt(np.diag(gram)[:n])
    if not (np.isfinite(scales) & (scales > 0.0)).all():
        return False, factor, scales
    for i in range(n):
        for j in range(i + 1):
            total = gram[i, j] / (scales[i] * scales[j])
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = total / factor[j, j]
            elif total + ridge > 4e-16 * n:
                factor[i, i] = np.sqrt(total + ridge)
            else:
                # What is left of a column that the others explain is rounding: not positive definite.
                return False, factor, scales
    return True, factor, scales


@njit(cache=True, nogil=True)
def substitute(factor: Array, scales: Array, values: Array) -> None:
    """Solve ``S L L' S x = b`` in place, with S the scales."""
    n = values.size
    values /= scales
    for i in range(n):
        for k in range(i):
            values[i] -= factor[i, k] * values[k]
        values[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            values[i] -= factor[k, i] * values[k]
        values[i] /= factor[i, i]
    values /= scales


@njit(cache=True, nogil=True)
def least_squares(gram: Array, ridge: float, theta: Array) -> bool:
    """Parameters with the smallest squared residual; False if the second moments do not determine them."""
    determined, factor, scales = factorise(gram, ridge)
    if determined:
        theta[:] = gram[theta.size, : theta.size]
        substitute(factor, scales, theta)
    return determined


# --- from parameters to frequencies --------------------------------------------------------------------------------


# ``prod(c - c_i) = c^n + theta_1 c^(n-1) + ... + theta_n`` has the roots ``c_i = cos(w_i h)``, real and within [-1, 1]
# if theta belongs to sinusoids at all. Noise can move a pair of roots off the real axis, or a root out of the interval.


@njit(cache=True, nogil=True, error_model="numpy")
def real_roots(coefficients: Array, roots: Array) -> bool:
    """Roots of a monic polynomial without its leading coefficient, all at once; False if some are complex.

    Durand and Kerner's iteration takes every root for known to find the others. It begins with Chebyshev's points,
    moved and stretched to the mean and the variance of the roots: with the roots themselves if there are one or two.
    """
    n = roots.size
    mean = -coefficients[0] / n
    squares = coefficients[0] ** 2 - (2.0 * coefficients[1] if n > 1 else 0.0)
    variance = squares / n - mean * mean
    if not variance >= 0.0:
        return False
    for i in range(n):
        roots[i] = mean + np.sqrt(2.0 * variance) * np.cos(np.pi * (i + 0.5) / n)
    for _ in range(ROOT_STEPS):
        settled = True
        for i in range(n):
            value, size, others = 1.0, 1.0, 1.0
            for k in range(n):
                value = value * roots[i] + coefficients[k]
                size = size * abs(roots[i]) + abs(coefficients[k])
                if k != i:
                    others *= roots[i] - roots[k]
            # A value below its own rounding says nothing of where the root is.
            if not abs(value) <= 2e-16 * n * size:
                settled = False
                roots[i] -= value / others
        if settled:
            return True
    return False


@njit(cache=True, nogil=True)
def decode(theta: Array, clock: Clock, roots: Array, omega: Array) -> int:
    """Frequencies that belong to the parameters of the delay regression, ascending; flags what was wrong."""
    flags, n = 0, theta.size
    if not np.isfinite(np.sum(theta)):
        omega[:] = np.nan
        return COMPLEX_ROOTS
    if not real_roots(theta, roots):
        # Real parts of the eigenvalues of the companion matrix.
        flags = COMPLEX_ROOTS
        companion = np.zeros((n, n), np.complex128)
        companion[0] = -theta
        companion[1:, : n - 1] = np.eye(n - 1)
        roots[:] = np.linalg.eigvals(companion).real
    # The largest cosine is that of the lowest frequency, and order survives the bounds.
    if n > 2 or flags:
        roots[:] = np.sort(roots)[::-1]
    for i in range(n):
        if abs(roots[i]) > 1.0:
            roots[i] = 1.0 if roots[i] > 0.0 else -1.0
            flags |= OUT_OF_BOUNDS
        omega[i] = np.arccos(roots[i]) / clock.delay
    return flags


# --- how far frequencies can be trusted ----------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def spacings_of(omega: Array) -> Array:
    """Distances of ascending frequencies to their nearest neighbours, or to zero."""
    spacings = omega.copy()
    spacings[1:] -= omega[:-1]
    spacings[:-1] = np.minimum(spacings[:-1], spacings[1:])
    return spacings


@njit(cache=True, nogil=True)
def lasts_a_period(omega: Array, elapsed: float) -> bool:
    """Whether a time [s] holds a period of every frequency, and a beat of all neighbours."""
    return bool(spacings_of(omega).min() * elapsed >= 2.0 * np.pi)


@njit(cache=True, nogil=True)
def flag_uncertain(
    gram: Array, left: float, theta: Array, roots: Array, omega: Array, clock: Clock, span: float, elapsed: float
) -> int:
    r"""Compare the error that the misfit of the equations can make with the frequencies and their distances.

    Residuals e at the true parameters move a frequency with the sensitivities g by at most ``sqrt(g' G^-1 g e'e)``
    (Cauchy-Schwarz), whatever the e: noise, a bias, another tone. The residual left by the estimate stands for
    ``e'e``. As a difference of moments it is known up to rounding only: below that it is taken for ``left``, the sum of
    residuals seen one by one, or for the rounding, whichever is less. Rounding of G moves a frequency by up to
    ``|G^-1 g|`` times the rounding errors.

    Within a part of a period, or of the beat of two neighbours, a bias, a drift or another tone hardly differs from a
    change of the frequencies, and hardly shows as a misfit. Measured errors grow like the fifth power of the missing
    part: the possible error is multiplied by ``(period/span)^5``. The same holds for the first two periods: after them
    a misfit has shown itself, even if the estimate rests on fewer samples.
    """
    determined, factor, scales = factorise(gram, 0.0)
    if not determined:
        return UNDETERMINED
    n, misfit, rounded = theta.size, squared_residual(gram, theta), rounding_of(gram, theta)
    if misfit < DETERMINED * rounded:
        misfit = min(left, max(misfit, rounded))
    spacings = spacings_of(omega)
    for i in range(n):
        # d c_i/d theta_k = -c_i^(n-k)/prod_j(c_i - c_j), and w = arccos(c)/h.
        others = roots[i] - roots
        others[i] = clock.delay * np.sqrt(max(1.0 - roots[i] * roots[i], 0.0))
        slopes = roots[i] ** np.arange(n - 1, -1, -1) / np.prod(others)
        direction = slopes.copy()
        substitute(factor, scales, direction)
        error = np.sqrt(max(np.sum(direction * slopes), 0.0) * misfit)
        periods = spacings[i] * min(span, elapsed / FIRST_PERIODS) / (2.0 * np.pi)
        if periods < 1.0:
            error /= max(periods, 1e-30) ** 5
        # Rounding does not shrink with time, and is not enlarged by the lack of it. Equal roots leave NaN.
        rounding = np.sqrt(ROUNDING * rounded) * np.sum(np.abs(direction) * scales)
        if not error + rounding <= CERTAIN_FRACTION * spacings[i]:
            return UNCERTAIN
    return 0


@njit(cache=True, nogil=True)
def flag_inconsistent(gram: Array, omega: Array, delay: float, negligible: float) -> int:
    """Compare the residual that the frequencies leave at the second delay with the smallest possible one.

    With the delay h alone, a frequency w and all its aliases ``2 pi k/h - w``, ``2 pi k/h + w`` are the same. At a
    second delay, a whole number of sampling intervals that shares no divisor with the first, they are not.
    """
    n = omega.size
    theta = np.zeros(n)
    # Coefficients of prod(x - cos(w_i delay)) after the leading one.
    for i in range(n):
        c = np.cos(omega[i] * delay)
        theta[1:] -= c * theta[:-1]
        theta[0] -= c
    # Far below the regressand nothing is inconsistent, and the best fit need not be found.
    residual = squared_residual(gram, theta)
    if residual <= negligible * gram[n, n] or not least_squares(gram, REGULARISATION, theta):
        return 0
    return INCONSISTENT if residual > WORSE_THAN_BEST * squared_residual(gram, theta) else 0


# --- estimates judged by recent rows -------------------------------------------------------------------------------


#: Fraction of the regressand's second moment that the frequencies may leave at the second delay.
MIXED_NEGLIGIBLE = 1e-4
#: An estimate is judged by the residuals of this multiple of n h.
JUDGED_SPANS = 4
NEWEST, USUAL, LEFT = range(3)
SINCE_VERDICT, VERDICT, SINCE_DOUBT, SINCE_CHANGE = range(4)


class Judged(NamedTuple):
    """What is remembered of the estimates so far."""

    #: Samples after which nothing is left of a change.
    flush: int
    theta: Array
    #: Newest mean squared residual, what it may be, and the sum of the last squared residuals.
    levels: Array
    #: Samples since the last verdict, the verdict (flags), samples since the last doubt and the last change.
    counters: IntArray


@njit(cache=True, nogil=True)
def judge_rows(
    theta: Array, rows: Array, grams: Array, counts: Array, clock: Clock, judged: Judged, omega: Array, flags: Flags
) -> None:
    """Decode estimates that come with the moments of recent rows at both delays, and say which cannot be trusted.

    ``counts`` holds, for each estimate, its recent rows (an estimate without them is not judged), the samples that it
    rests on and all samples so far; ``flags`` what is known.
    """
    n, before, levels, counters = theta.shape[1], judged.theta, judged.levels, judged.counters
    roots, interval = np.empty(n), clock.interval
    smoothing, forgotten = 1.0 / max(1.0, DETECTOR_SPAN * clock.lag), 1.0 / (JUDGED_SPANS * n * clock.lag)
    for k in range(len(theta)):
        omega[k] = np.nan
        if np.isnan(theta[k, 0]):
            continue
        flags[k] |= decode(theta[k], clock, roots, omega[k])
        weight, span, elapsed = counts[k, 0], interval * counts[k, 1], interval * counts[k, 2]
        if weight == 0.0:
            continue
        started = flags[k] & STARTING == 0
        # The residual of what was known before this row.
        square = residual_of(rows[k], before) ** 2
        before[:] = theta[k]
        if np.isfinite(square):
            levels[NEWEST] += smoothing * (square - levels[NEWEST])
            levels[LEFT] += square - forgotten * levels[LEFT]
        # One unlike the others is doubted at once; otherwise a verdict is given now and then.
        contradicted = started and levels[NEWEST] > levels[USUAL]
        if counters[SINCE_VERDICT] == 0 or contradicted:
            gram, check = grams[k, 0].copy(), grams[k, 1].copy()
            verdict = flag_uncertain(gram, levels[LEFT], theta[k], roots, omega[k], clock, span, elapsed)
            if contradicted or verdict:
                verdict |= UNCERTAIN
                levels[NEWEST] = 0.0
                if started:
                    counters[SINCE_DOUBT] = 0
                if contradicted:
                    counters[SINCE_CHANGE] = 0
            # Rows from before a change must first have left the window.
            elif counters[SINCE_CHANGE] < judged.flush or not lasts_a_period(
                omega[k], counters[SINCE_DOUBT] * interval
            ):
                verdict = UNCERTAIN
            verdict |= flag_inconsistent(check, omega[k], clock.second_delay, MIXED_NEGLIGIBLE)
            counters[VERDICT] = verdict
            misfit = max(squared_residual(gram, theta[k]), rounding_of(gram, theta[k]))
            levels[USUAL] = ALARM_RATIO * misfit / weight
        counters[SINCE_VERDICT] = (counters[SINCE_VERDICT] + 1) % clock.every if started else 0
        counters[SINCE_DOUBT:] += 1
        flags[k] |= counters[VERDICT]


# --- least squares that restart when the signal changes ------------------------------------------------------------


#: The estimate is computed anew with every row at first, then after this number of rows.
REFRESH = 10
EAGER_ROWS = 40
#: Rows for each tone before the first estimate.
FIRST_ROWS_PER_TONE = 2
#: Older data are dropped if the whole fit leaves more than this multiple of the mean squared residual of newer ones.
MIXED_RATIO = 6.0
#: A fit that leaves no larger fraction of the regressand's second moment is exact, however short its data are.
EXACT = 1e-13
#: Fraction of the regressand's second moment that the frequencies may leave at the second delay.
NEGLIGIBLE = 1e-8
OLDER, NEWER, CHECK = range(3)
RESIDUAL, ALARM = 2, 3
ROWS, NEXT, FLUSH, LAST_VERDICT = range(4)


class Restarting(NamedTuple):
    """Settings of the tracker, counted in samples."""

    #: Rows before the detector may raise an alarm, before the first comparison of halves, and before an estimate can be
    #: valid.
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

    #: Second moments of the rows before the last comparison of halves, of those since, and at the second delay.
    moments: Array
    theta: Array
    omega: Array
    #: Rows older and newer than that comparison, less what was forgotten; newest mean squared residual, alarm level.
    levels: Array
    #: Rows since the restart, rows at the next comparison of halves, samples still to flush, verdict (flags).
    counters: IntArray


@njit(cache=True, nogil=True)
def judge(gram: Array, theta: Array, omega: Array, clock: Clock, rows: float, age: float) -> tuple[int, bool]:
    """Frequencies of a fit to a number of rows since a restart; flags, and whether the fit may judge new samples.

    It may if it is certain, or has been there for so long that its misfit is not that of a beginning.
    """
    roots, filled = np.empty(theta.size), 2 * theta.size * clock.lag
    span, elapsed = (filled + rows) * clock.interval, (filled + age) * clock.interval
    flags = decode(theta, clock, roots, omega)
    uncertain = flag_uncertain(gram, np.inf, theta, roots, omega, clock, span, elapsed)
    return flags | uncertain, uncertain == 0 or lasts_a_period(omega, elapsed / FIRST_PERIODS)


@njit(cache=True, nogil=True)
def drop_mixed_rows(clock: Clock, compared: int, fit: Fit) -> bool:
    """Drop the older half of the rows if the newer one fits so much better that the older is of another signal."""
    moments, theta, omega, levels, counters = fit.moments, fit.theta.copy(), fit.omega.copy(), fit.levels, fit.counters
    newer, gram = moments[NEWER], moments[OLDER] + moments[NEWER]
    mixed = False
    if levels[OLDER] > 0.0 and least_squares(newer, 0.0, theta):
        # A fit to so few rows that it says nothing must not condemn the others, unless it is exact.
        alone = squared_residual(newer, theta)
        judges = judge(newer, theta, omega, clock, levels[NEWER], levels[NEWER])[1]
        if (judges or alone <= EXACT * newer[-1, -1]) and least_squares(gram, 0.0, theta):
            together = squared_residual(gram, theta) - 1e-14 * gram[-1, -1]
            mixed = together / (levels[OLDER] + levels[NEWER]) > MIXED_RATIO * alone / levels[NEWER]
    if mixed:
        counters[ROWS] = int(levels[NEWER])
        levels[OLDER] = levels[RESIDUAL] = 0.0
        moments[OLDER] = 0.0
        moments[CHECK] = 0.0
    moments[OLDER] += moments[NEWER]
    levels[OLDER] += levels[NEWER]
    moments[NEWER] = 0.0
    levels[NEWER] = 0.0
    # At doubling intervals: whatever is mixed is found at the latest when as much again has arrived.
    counters[NEXT] = max(compared, 2 * counters[ROWS])
    return mixed


@njit(cache=True, nogil=True)
def refresh(clock: Clock, whitener: Array, fit: Fit) -> None:
    """Estimate by least squares or total least squares, alarm level and verdict from all rows."""
    n, theta, levels, counters = fit.theta.size, fit.theta, fit.levels, fit.counters
    gram, weight = fit.moments[OLDER] + fit.moments[NEWER], levels[OLDER] + levels[NEWER]
    # Tones that the rows do not tell apart leave a singular matrix; the last estimate is then kept, marked.
    counters[LAST_VERDICT] = UNDETERMINED
    if not least_squares(gram, 0.0, theta):
        return
    if whitener.size > 0:
        # In M G M' the noise is the same in all directions, M the inverse of its lower factor. v = M' u for the
        # eigenvector u of the least eigenvalue, theta = -v_phi/v_psi.
        v = whitener.T @ np.ascontiguousarray(np.linalg.eigh(whitener @ gram @ whitener.T)[1][:, 0])
        theta[:] = -v[:n] / v[n:]
    # Residuals of an exact fit are rounding; the lower limit keeps them from raising an alarm.
    levels[ALARM] = (ALARM_RATIO * squared_residual(gram, theta) + ROUNDING_FLOOR * gram[n, n]) / weight
    verdict, judges = judge(gram, theta, fit.omega, clock, weight, counters[ROWS])
    if not judges:
        levels[ALARM] = np.inf
    inconsistent = flag_inconsistent(fit.moments[CHECK], fit.omega, clock.second_delay, NEGLIGIBLE)
    counters[LAST_VERDICT] = verdict | inconsistent


@njit(cache=True, nogil=True)
def restarting_fits(rows: Array, clock: Clock, settings: Restarting, fit: Fit, omega: Array, flags: Flags) -> None:
    """Least squares with alarm, flush, restart and comparison with the newer data alone."""
    moments, theta, own_omega, levels, counters = fit
    smoothing = 1.0 / max(1, round(DETECTOR_SPAN * clock.lag))
    for k in range(len(omega)):
        row, found = rows[0, k], np.isfinite(rows[0, k, 0])
        flag = 0 if found or counters[ROWS] + counters[FLUSH] == 0 else GAP
        if counters[FLUSH] > 0:
            # Samples from before the change are still in the delays: hold the estimate.
            counters[FLUSH] -= 1
            flag |= CHANGED
        elif found:
            if counters[ROWS] == 0:
                # The first comparison needs an older half.
                counters[NEXT] = settings.compared // 2
                counters[LAST_VERDICT] = 0
                moments[:] = 0.0
                levels[: RESIDUAL + 1] = 0.0
            elif counters[ROWS] >= settings.armed:
                # The detector sees the row before the fit does.
                levels[RESIDUAL] += smoothing * (residual_of(row, theta) ** 2 - levels[RESIDUAL])
            counters[ROWS] += 1
            if levels[OLDER] + levels[NEWER] > settings.memory - 0.5:
                # What exceeds the memory is forgotten exponentially.
                keep = 1.0 - 1.0 / settings.memory
                levels[: NEWER + 1] *= keep
                moments *= keep
            levels[NEWER] += 1.0
            add_row(row, moments[NEWER])
            add_row(rows[1, k], moments[CHECK])
            # A second change while the delays were flushed leaves rows of two signals.
            dropped = counters[ROWS] >= counters[NEXT] and drop_mixed_rows(clock, settings.compared, fit)
            due = dropped or counters[ROWS] % REFRESH == 0 or counters[ROWS] <= EAGER_ROWS
            if due and counters[ROWS] >= FIRST_ROWS_PER_TONE * theta.size:
                refresh(clock, settings.whitener, fit)
            # The alarm comes last: an estimate that has just been refreshed is judged by its own level.
            if levels[RESIDUAL] > levels[ALARM]:
                counters[FLUSH], counters[ROWS] = settings.flush, 0
                flag = CHANGED
        if counters[ROWS] < settings.enough and flag == 0:
            flag = STARTING
        omega[k] = own_omega
        flags[k] = flag | counters[LAST_VERDICT]
