r"""Compiled loops of the estimators on the delay regression.

Kernels use only kernels, constants and types of this file: Numba's disk cache depends only on the file of a function,
so that it is never stale. The state between samples is in arrays that are modified in place, so that a record can be
split anywhere.
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

#: Largest number of steps for roots to converge; simple ones need fewer than ten, nearly double ones thirty.
ROOT_STEPS = 60
#: Approximate relative error of second moments summed over many samples.
ROUNDING = 4e-15
#: Smallest multiple of that error at which the moments determine a squared residual.
DETERMINED = 10.0
#: Added to the unit diagonal of scaled second moments if the best fit must exist even if it is not unique.
REGULARISATION = 1e-10
#: Number of first periods, or beats of neighbours, in which an estimate is less certain than its misfit shows.
FIRST_PERIODS = 2.0
#: Frequencies are certain if the possible error due to the misfit of the equations is below this fraction of the
#: frequency and of the distance to its neighbours.
CERTAIN_FRACTION = 0.1
#: The frequencies are inconsistent if their squared residual exceeds this multiple of the smallest possible one.
WORSE_THAN_BEST = 10.0
#: Fraction of h over which residuals of new rows are averaged, to be compared with those of the rows of the estimate.
DETECTOR_SPAN = 1.0 / 14.0
#: Ratio of these mean squares that indicates a change of the signal, and lower limit due to rounding.
ALARM_RATIO = 30.0
ROUNDING_FLOOR = 1e-18


class Clock(NamedTuple):
    """Delay regression at a sampling interval."""

    #: Sampling interval [s].
    interval: float
    #: Delay h in sampling intervals, and in seconds.
    lag: int
    delay: float
    #: Second delay, at which the frequencies are checked, in sampling intervals, and in seconds.
    second_lag: int
    second_delay: float
    #: Samples between two checks.
    every: int


# --- least squares from second moments -----------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def add_row(row: Array, gram: Array) -> None:
    """Add a row to second moments, unless a sample of it is missing."""
    for i in range(row.size if np.isfinite(row[0]) else 0):
        for j in range(row.size):
            gram[i, j] += row[i] * row[j]


@njit(cache=True, nogil=True)
def symmetric(upper: Array, size: int) -> Array:
    """Return the symmetric matrix whose upper triangle is given row by row."""
    matrix, place = np.empty((size, size)), 0
    for i in range(size):
        for j in range(i, size):
            matrix[i, j] = matrix[j, i] = upper[place]
            place += 1
    return matrix


@njit(cache=True, nogil=True)
def residual_of(row: Array, theta: Array) -> float:
    """Return the residual ``psi - phi' theta`` of a row ``[phi psi]``."""
    residual = row[theta.size]
    for i in range(theta.size):
        residual -= theta[i] * row[i]
    return float(residual)


@njit(cache=True, nogil=True)
def squared_residual(gram: Array, theta: Array) -> float:
    """Return the sum of the squared residuals ``psi - phi' theta``; a negative one is rounding."""
    return max(residual_of(gram[-1] - theta @ gram[:-1], theta), 0.0)


@njit(cache=True, nogil=True)
def rounding_of(gram: Array, theta: Array) -> float:
    """Return the rounding error of the sum of squared residuals, with terms ``|psi| + sum |theta_k phi_k|``."""
    sizes = np.sqrt(np.diag(gram))
    return float(ROUNDING * (sizes[-1] + np.sum(np.abs(theta) * sizes[:-1])) ** 2)


@njit(cache=True, nogil=True, error_model="numpy")
def solve(gram: Array, ridge: float, columns: Array) -> bool:
    """Solve ``G X = B`` in place for the second moments G of the regressors; return False if they are singular."""
    n, count = columns.shape
    matrix, scales = np.empty((n, n)), np.empty(n)
    for i in range(n):
        scales[i] = np.sqrt(gram[i, i])
        if not 0.0 < scales[i] < np.inf:
            return False
        # A unit diagonal makes the pivots comparable with rounding, for any units of the regressors.
        for j in range(i + 1):
            matrix[j, i] = gram[i, j] / (scales[i] * scales[j])
        matrix[i, i] += ridge
        for c in range(count):
            columns[i, c] /= scales[i]
    for k in range(n):
        # The remainder of a linearly dependent column is rounding error.
        if not matrix[k, k] > 1e-15 * n:
            return False
        for i in range(k + 1, n):
            factor = matrix[k, i] / matrix[k, k]
            for j in range(i, n):
                matrix[i, j] -= factor * matrix[k, j]
            for c in range(count):
                columns[i, c] -= factor * columns[k, c]
    for k in range(n - 1, -1, -1):
        for c in range(count):
            for j in range(k + 1, n):
                columns[k, c] -= matrix[k, j] * columns[j, c]
            columns[k, c] /= matrix[k, k]
    for k in range(n):
        for c in range(count):
            columns[k, c] /= scales[k]
    return True


@njit(cache=True, nogil=True)
def least_squares(gram: Array, ridge: float, theta: Array) -> bool:
    """Compute the least-squares parameters; return False if the second moments do not determine them."""
    solution = gram[:-1, -1:].copy()
    determined = solve(gram, ridge, solution)
    if determined:
        theta[:] = solution[:, 0]
    return determined


# --- from parameters to frequencies --------------------------------------------------------------------------------


# ``prod(c - c_i) = c^n + theta_1 c^(n-1) + ... + theta_n`` has the roots ``c_i = cos(w_i h)``, real and within [-1, 1]
# for sinusoids. Noise can move a pair of roots off the real axis, or a root out of the interval.


@njit(cache=True, nogil=True, error_model="numpy")
def real_roots(coefficients: Array, roots: Array) -> bool:
    """Compute all roots of a monic polynomial, given without leading coefficient; return False if some are complex.

    The Durand-Kerner iteration updates every root from the others. It starts at Chebyshev points with the mean and the
    variance of the roots, which are the exact roots for degrees one and two.
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
            # A value below its rounding error does not locate the root.
            if not abs(value) <= 2e-16 * n * size:
                settled = False
                roots[i] -= value / others
        if settled:
            return True
    return False


@njit(cache=True, nogil=True)
def decode(theta: Array, clock: Clock, roots: Array, omega: Array) -> int:
    """Compute ascending frequencies from the parameters of the delay regression; return flags."""
    flags, n = 0, theta.size
    if not np.isfinite(np.sum(theta)):
        omega[:] = np.nan
        return COMPLEX_ROOTS
    if not real_roots(theta, roots):
        flags = COMPLEX_ROOTS
        companion = np.zeros((n, n), np.complex128)
        for i in range(n):
            companion[0, i] = -theta[i]
            if i > 0:
                companion[i, i - 1] = 1.0
        roots[:] = np.linalg.eigvals(companion).real
    # The largest cosine belongs to the lowest frequency, and clipping preserves the order.
    if n > 2 or flags:
        roots[:] = np.sort(roots)[::-1]
    for i in range(n):
        if abs(roots[i]) > 1.0:
            roots[i] = 1.0 if roots[i] > 0.0 else -1.0
            flags |= OUT_OF_BOUNDS
        omega[i] = np.arccos(roots[i]) / clock.delay
    return flags


# --- reliability of frequencies ------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def spacings_of(omega: Array) -> Array:
    """Return the distances of ascending frequencies to their nearest neighbours, or to zero."""
    spacings = omega.copy()
    spacings[1:] -= omega[:-1]
    spacings[:-1] = np.minimum(spacings[:-1], spacings[1:])
    return spacings


@njit(cache=True, nogil=True)
def lasts_a_period(omega: Array, elapsed: float) -> bool:
    """Return whether a time [s] contains a period of every frequency, and a beat of all neighbours."""
    return bool(spacings_of(omega).min() * elapsed >= 2.0 * np.pi)


@njit(cache=True, nogil=True)
def flag_uncertain(
    gram: Array, left: float, theta: Array, roots: Array, omega: Array, clock: Clock, span: float, elapsed: float
) -> int:
    r"""Compare the possible error due to the misfit of the equations with the frequencies and their distances.

    Residuals e at the true parameters shift a frequency with the sensitivities g by at most ``sqrt(g' G^-1 g e'e)``
    (Cauchy-Schwarz), for any e: noise, a bias, another tone. The residual of the estimate replaces ``e'e``. As a
    difference of moments it is limited by rounding: below that it is replaced by ``left``, the sum of single squared
    residuals, or by the rounding error, whichever is less. Rounding of G shifts a frequency by up to ``|G^-1 g|`` times
    the rounding errors.

    Within a part of a period, or of the beat of two neighbours, a bias, a drift or another tone is similar to a change
    of the frequencies, with a small misfit. Measured errors grow like the fifth power of the missing part: the possible
    error is multiplied by ``(period/span)^5``. This also applies to the first two periods; later a misfit is reliable,
    even if the estimate is from fewer samples.
    """
    n = theta.size
    # d c_i/d theta_k = -c_i^(n-k)/prod_j(c_i - c_j), and w = arccos(c)/h.
    slopes = np.empty((n, n))
    for i in range(n):
        others = roots[i] - roots
        others[i] = clock.delay * np.sqrt(max(1.0 - roots[i] * roots[i], 0.0))
        slopes[:, i] = roots[i] ** np.arange(n - 1, -1, -1) / np.prod(others)
    directions = slopes.copy()
    if not solve(gram, 0.0, directions):
        return UNDETERMINED
    misfit, rounded = squared_residual(gram, theta), rounding_of(gram, theta)
    if misfit < DETERMINED * rounded:
        misfit = min(left, max(misfit, rounded))
    errors = np.sqrt(np.maximum(np.sum(slopes * directions, axis=0), 0.0) * misfit)
    spacings, sizes = spacings_of(omega), np.sqrt(np.diag(gram)[:n])
    for i in range(n):
        periods = spacings[i] * min(span, elapsed / FIRST_PERIODS) / (2.0 * np.pi)
        if periods < 1.0:
            errors[i] /= max(periods, 1e-30) ** 5
        # Rounding does not depend on the time span. Equal roots give NaN.
        rounding = np.sqrt(ROUNDING * rounded) * np.sum(np.abs(directions[:, i]) * sizes)
        if not errors[i] + rounding <= CERTAIN_FRACTION * spacings[i]:
            return UNCERTAIN
    return 0


@njit(cache=True, nogil=True)
def flag_inconsistent(gram: Array, omega: Array, delay: float, negligible: float) -> int:
    """Compare the residual of the frequencies at the second delay with the smallest possible one.

    The delay h cannot distinguish a frequency w from its aliases ``2 pi k/h - w``, ``2 pi k/h + w``. A second delay, a
    whole number of sampling intervals without a common divisor with the first, can.
    """
    n = omega.size
    theta = np.zeros(n)
    # Coefficients of prod(x - cos(w_i delay)) after the leading one.
    for i in range(n):
        c = np.cos(omega[i] * delay)
        theta[1:] -= c * theta[:-1]
        theta[0] -= c
    # A residual far below the regressand is consistent, so that the best fit is not needed.
    residual = squared_residual(gram, theta)
    if residual <= negligible * gram[n, n] or not least_squares(gram, REGULARISATION, theta):
        return 0
    return INCONSISTENT if residual > WORSE_THAN_BEST * squared_residual(gram, theta) else 0


# --- checks of estimates by recent rows ----------------------------------------------------------------------------


#: Negligible residual of the frequencies at the second delay, as a fraction of the regressand's second moment.
MIXED_NEGLIGIBLE = 1e-4
#: Time span of the residuals that check an estimate, as a multiple of n h.
CHECKED_SPANS = 4
NEWEST, USUAL, LEFT = range(3)
SINCE_CHECK, RESULT, SINCE_UNCERTAIN, SINCE_CHANGE = range(4)


class Checks(NamedTuple):
    """State of the checks of estimates."""

    #: Number of samples after which the effect of a change has ended.
    flush: int
    theta: Array
    #: Newest mean squared residual, its largest expected value, and the sum of the last squared residuals.
    levels: Array
    #: Samples since the last check, its result (flags), samples since the last doubt and the last change.
    counters: IntArray


@njit(cache=True, nogil=True)
def check_estimates(
    theta: Array, rows: Array, grams: Array, counts: Array, clock: Clock, checks: Checks, omega: Array, flags: Flags
) -> None:
    """Decode estimates and flag unreliable ones by the moments of recent rows at both delays, as upper triangles.

    ``counts`` contains, for each estimate, its number of recent rows (without any it is not checked), its number of
    samples, and the number of all samples so far; ``flags`` are the known flags, which are extended.
    """
    n, before, levels, counters = theta.shape[1], checks.theta, checks.levels, checks.counters
    roots, interval = np.empty(n), clock.interval
    smoothing, forgotten = 1.0 / max(1.0, DETECTOR_SPAN * clock.lag), 1.0 / (CHECKED_SPANS * n * clock.lag)
    for k in range(len(theta)):
        omega[k] = np.nan
        if np.isnan(theta[k, 0]):
            continue
        flags[k] |= decode(theta[k], clock, roots, omega[k])
        weight, span, elapsed = counts[k, 0], interval * counts[k, 1], interval * counts[k, 2]
        if weight == 0.0:
            continue
        started = flags[k] & STARTING == 0
        # Residual of the previous estimate at this row.
        square = residual_of(rows[k], before) ** 2
        before[:] = theta[k]
        if np.isfinite(square):
            levels[NEWEST] += smoothing * (square - levels[NEWEST])
            levels[LEFT] += square - forgotten * levels[LEFT]
        # A contradicted estimate is checked at once, others at regular intervals.
        contradicted = started and levels[NEWEST] > levels[USUAL]
        if counters[SINCE_CHECK] == 0 or contradicted:
            gram, check = symmetric(grams[k, 0], n + 1), symmetric(grams[k, 1], n + 1)
            result = flag_uncertain(gram, levels[LEFT], theta[k], roots, omega[k], clock, span, elapsed)
            if contradicted or result:
                result |= UNCERTAIN
                levels[NEWEST] = 0.0
                if started:
                    counters[SINCE_UNCERTAIN] = 0
                if contradicted:
                    counters[SINCE_CHANGE] = 0
            # The window must not contain rows from before a change.
            elif counters[SINCE_CHANGE] < checks.flush or not lasts_a_period(
                omega[k], counters[SINCE_UNCERTAIN] * interval
            ):
                result = UNCERTAIN
            result |= flag_inconsistent(check, omega[k], clock.second_delay, MIXED_NEGLIGIBLE)
            counters[RESULT] = result
            misfit = max(squared_residual(gram, theta[k]), rounding_of(gram, theta[k]))
            levels[USUAL] = ALARM_RATIO * misfit / weight
        counters[SINCE_CHECK] = (counters[SINCE_CHECK] + 1) % clock.every if started else 0
        counters[SINCE_UNCERTAIN:] += 1
        flags[k] |= counters[RESULT]


# --- least squares that restart when the signal changes ------------------------------------------------------------


#: Rows between two updates of the estimate, and number of first rows with an update at each.
REFRESH = 10
EAGER_ROWS = 40
#: Rows per tone before the first estimate.
FIRST_ROWS_PER_TONE = 2
#: Older data are dropped if the mean squared residual of the whole fit exceeds this multiple of that of newer data.
MIXED_RATIO = 6.0
#: Squared residual of an exact fit, as a fraction of the regressand's second moment, for any length of the data.
EXACT = 1e-13
#: Negligible residual of the frequencies at the second delay, as a fraction of the regressand's second moment.
NEGLIGIBLE = 1e-8
OLDER, NEWER, CHECK = range(3)
RESIDUAL, ALARM = 2, 3
ROWS, NEXT, FLUSH, LAST_CHECK = range(4)


class Restarting(NamedTuple):
    """Settings of the tracker in samples."""

    #: Rows before the first possible alarm, before the first comparison of halves, and before the first valid estimate.
    armed: int
    compared: int
    enough: int
    #: Memory of the delays and the prefilter [samples].
    flush: int
    memory: float
    #: Inverse of the lower factor of the noise covariance of a row; empty for plain least squares.
    whitener: Array


class Fit(NamedTuple):
    """State of the tracker."""

    #: Second moments of the rows before the last comparison of halves, of the rows since, and at the second delay.
    moments: Array
    theta: Array
    omega: Array
    #: Rows before and after that comparison, minus forgotten ones; newest mean squared residual, alarm level.
    levels: Array
    #: Rows since the restart, rows at the next comparison of halves, remaining samples to flush, flags of the check.
    counters: IntArray


@njit(cache=True, nogil=True)
def check_fit(gram: Array, theta: Array, omega: Array, clock: Clock, rows: float, age: float) -> tuple[int, bool]:
    """Compute the frequencies of a fit to the rows since a restart; return flags, and whether it can test new samples.

    It can if it is certain, or if it is too old for a starting misfit.
    """
    roots, filled = np.empty(theta.size), 2 * theta.size * clock.lag
    span, elapsed = (filled + rows) * clock.interval, (filled + age) * clock.interval
    flags = decode(theta, clock, roots, omega)
    uncertain = flag_uncertain(gram, np.inf, theta, roots, omega, clock, span, elapsed)
    return flags | uncertain, uncertain == 0 or lasts_a_period(omega, elapsed / FIRST_PERIODS)


@njit(cache=True, nogil=True)
def drop_mixed_rows(clock: Clock, compared: int, fit: Fit) -> bool:
    """Drop the older half of the rows if a much better fit of the newer half shows a change of the signal."""
    moments, theta, omega, levels, counters = fit.moments, fit.theta.copy(), fit.omega.copy(), fit.levels, fit.counters
    newer, gram = moments[NEWER], moments[OLDER] + moments[NEWER]
    mixed = False
    if levels[OLDER] > 0.0 and least_squares(newer, 0.0, theta):
        # A fit to too few rows must not reject the others, unless it is exact.
        alone = squared_residual(newer, theta)
        reliable = check_fit(newer, theta, omega, clock, levels[NEWER], levels[NEWER])[1]
        if (reliable or alone <= EXACT * newer[-1, -1]) and least_squares(gram, 0.0, theta):
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
    # Doubling intervals: mixed data are detected at the latest when their length has doubled.
    counters[NEXT] = max(compared, 2 * counters[ROWS])
    return mixed


@njit(cache=True, nogil=True)
def refresh(clock: Clock, whitener: Array, fit: Fit) -> None:
    """Update the (total) least-squares estimate, the alarm level and the flags from all rows."""
    n, theta, levels, counters = fit.theta.size, fit.theta, fit.levels, fit.counters
    gram, weight = fit.moments[OLDER] + fit.moments[NEWER], levels[OLDER] + levels[NEWER]
    # Tones that the rows do not resolve give a singular matrix; the last estimate is then kept with a flag.
    counters[LAST_CHECK] = UNDETERMINED
    if not least_squares(gram, 0.0, theta):
        return
    if whitener.size > 0:
        # In M G M' the noise is isotropic, with M the inverse of its lower factor. v = M' u for the eigenvector u of
        # the least eigenvalue, theta = -v_phi/v_psi.
        v = whitener.T @ np.ascontiguousarray(np.linalg.eigh(whitener @ gram @ whitener.T)[1][:, 0])
        theta[:] = -v[:n] / v[n:]
    # The lower limit prevents alarms by residuals of an exact fit, which are rounding.
    levels[ALARM] = (ALARM_RATIO * squared_residual(gram, theta) + ROUNDING_FLOOR * gram[n, n]) / weight
    result, reliable = check_fit(gram, theta, fit.omega, clock, weight, float(counters[ROWS]))
    if not reliable:
        levels[ALARM] = np.inf
    inconsistent = flag_inconsistent(fit.moments[CHECK], fit.omega, clock.second_delay, NEGLIGIBLE)
    counters[LAST_CHECK] = result | inconsistent


@njit(cache=True, nogil=True)
def restarting_fits(rows: Array, clock: Clock, settings: Restarting, fit: Fit, omega: Array, flags: Flags) -> None:
    """Run least squares with alarm, flush, restart and comparison with a fit to newer data only."""
    moments, theta, own_omega, levels, counters = fit
    smoothing = 1.0 / max(1, round(DETECTOR_SPAN * clock.lag))
    for k in range(len(omega)):
        row, found = rows[0, k], np.isfinite(rows[0, k, 0])
        flag = 0 if found or counters[ROWS] + counters[FLUSH] == 0 else GAP
        if counters[FLUSH] > 0:
            # The delays still contain samples from before the change: hold the estimate.
            counters[FLUSH] -= 1
            flag |= CHANGED
        elif found:
            if counters[ROWS] == 0:
                # The first comparison needs an older half.
                counters[NEXT] = settings.compared // 2
                counters[LAST_CHECK] = 0
                moments[:] = 0.0
                levels[: RESIDUAL + 1] = 0.0
            elif counters[ROWS] >= settings.armed:
                # The detector uses the row before the fit does.
                levels[RESIDUAL] += smoothing * (residual_of(row, theta) ** 2 - levels[RESIDUAL])
            counters[ROWS] += 1
            if levels[OLDER] + levels[NEWER] > settings.memory - 0.5:
                # Data beyond the memory are forgotten exponentially.
                keep = 1.0 - 1.0 / settings.memory
                levels[: NEWER + 1] *= keep
                moments *= keep
            levels[NEWER] += 1.0
            add_row(row, moments[NEWER])
            add_row(rows[1, k], moments[CHECK])
            # After a second change during the flush there are rows of two signals.
            dropped = counters[ROWS] >= counters[NEXT] and drop_mixed_rows(clock, settings.compared, fit)
            due = dropped or counters[ROWS] % REFRESH == 0 or counters[ROWS] <= EAGER_ROWS
            if due and counters[ROWS] >= FIRST_ROWS_PER_TONE * theta.size:
                refresh(clock, settings.whitener, fit)
            # The alarm is last, so that an updated estimate is compared with its own level.
            if levels[RESIDUAL] > levels[ALARM]:
                counters[FLUSH], counters[ROWS] = settings.flush, 0
                flag = CHANGED
        if counters[ROWS] < settings.enough and flag == 0:
            flag = STARTING
        omega[k] = own_omega
        flags[k] = flag | counters[LAST_CHECK]
