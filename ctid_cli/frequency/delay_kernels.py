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

# The first bits of ctid_cli.frequency.flags.Flag; a test compares them.
STARTING, GAP, CHANGED, UNDETERMINED = 1, 2, 4, 8
UNCERTAIN, COMPLEX_ROOTS, OUT_OF_BOUNDS, INCONSISTENT = 16, 32, 64, 128

#: A root must settle within this many Newton steps; simple roots need fewer than ten.
NEWTON_STEPS = 60
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
    #: Cosines of the highest and of the lowest frequency times h [-].
    bottom: float
    top: float
    #: Samples from one verdict to the next.
    every: int


# --- least squares from second moments -----------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def add_row(row: Array, gram: Array) -> None:
    """Add a row to second moments."""
    for i in range(row.size):
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
    n = theta.size
    total = residual_of(gram[n], theta)
    for i in range(n):
        total -= theta[i] * residual_of(gram[i], theta)
    return max(total, 0.0)


@njit(cache=True, nogil=True)
def size_of(gram: Array, theta: Array) -> float:
    """Size of the terms that cancel in the residuals, ``|psi| + sum |theta_k| |phi_k|``."""
    size = np.sqrt(gram[theta.size, theta.size])
    for k in range(theta.size):
        size += abs(theta[k]) * np.sqrt(gram[k, k])
    return float(size)


@njit(cache=True, nogil=True)
def factorise(gram: Array, ridge: float, factor: Array, scales: Array) -> bool:
    """Cholesky factor of the regressors' second moments, scaled to a unit diagonal."""
    n = scales.size
    # A unit diagonal makes the pivots below comparable with rounding, whatever the units of the columns.
    for i in range(n):
        scales[i] = np.sqrt(gram[i, i])
        if not (np.isfinite(scales[i]) and scales[i] > 0.0):
            return False
    for i in range(n):
        for j in range(i + 1):
            total = gram[i, j] / (scales[i] * scales[j])
            if i == j:
                total += ridge
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = total / factor[j, j]
            elif total > 4e-16 * n:
                factor[i, i] = np.sqrt(total)
            else:
                # What is left of a column that the others explain is rounding: not positive definite.
                return False
    return True


@njit(cache=True, nogil=True)
def substitute(factor: Array, scales: Array, values: Array) -> None:
    """Solve ``S L L' S x = b`` in place, with S the scales."""
    n = values.size
    for i in range(n):
        total = values[i] / scales[i]
        for k in range(i):
            total -= factor[i, k] * values[k]
        values[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        total = values[i]
        for k in range(i + 1, n):
            total -= factor[k, i] * values[k]
        values[i] = total / factor[i, i]
    for i in range(n):
        values[i] /= scales[i]


# --- from parameters to frequencies --------------------------------------------------------------------------------


# ``prod(c - c_i) = c^n + theta_1 c^(n-1) + ... + theta_n`` has the roots ``c_i = cos(w_i h)``, real and within [-1, 1]
# if theta belongs to sinusoids at all. Noise can move a pair of roots off the real axis, or a root out of the interval.


@njit(cache=True, nogil=True)
def horner(coefficients: Array, degree: int, x: float) -> tuple[float, float]:
    """Value and slope of a monic polynomial."""
    value, slope = 1.0, 0.0
    for k in range(1, degree + 1):
        slope = slope * x + value
        value = value * x + coefficients[k]
    return value, slope


@njit(cache=True, nogil=True)
def largest_root(coefficients: Array, degree: int) -> float:
    """Largest root of a monic polynomial whose roots are all real; NaN where complex roots show.

    Right of its largest root such a polynomial is convex and increasing, so Newton's iteration from the Samuelson bound
    (no root lies farther from the mean of all than ``sqrt(degree - 1)`` of their standard deviations) falls
    monotonically on it.
    """
    a, b = coefficients[1], coefficients[2]
    spread = (degree - 1.0) ** 2 * a * a - 2.0 * degree * (degree - 1.0) * b
    if not spread >= 0.0:
        return np.nan
    x = (-a + np.sqrt(spread)) / degree
    for _ in range(NEWTON_STEPS):
        value, slope = horner(coefficients, degree, x)
        if value == 0.0:
            return float(x)
        if not slope > 0.0:
            return np.nan
        change = value / slope
        x -= change
        # Rounding may carry the iteration just beyond the root, but no further.
        if abs(change) <= 1e-13 * (abs(x) + 1e-3) or -1e-6 * (abs(x) + 1e-3) <= change < 0.0:
            return float(x)
        if change < 0.0:
            return np.nan
    return np.nan


@njit(cache=True, nogil=True)
def real_roots(coefficients: Array, work: Array, roots: Array) -> bool:
    """Roots of a monic polynomial, largest first, unless some are complex.

    Each largest root is divided out, the last two come from the quadratic formula.
    """
    n = roots.size
    work[:] = coefficients
    for found in range(n - 2):
        roots[found] = largest_root(work, n - found)
        if np.isnan(roots[found]):
            return False
        # Horner's numbers are the coefficients of the quotient.
        for k in range(1, n - found):
            work[k] += roots[found] * work[k - 1]
    if n == 1:
        roots[0] = -work[1]
        return True
    half = -0.5 * work[1]
    discriminant = half * half - work[2]
    if not discriminant >= 0.0:
        return False
    # The root of larger size first, without cancellation; the other one by Vieta.
    large = half + np.copysign(np.sqrt(discriminant), half)
    other = work[2] / large if large != 0.0 else 0.0
    roots[n - 2], roots[n - 1] = max(large, other), min(large, other)
    # Dividing out has spoilt the later roots a little: two more steps on the undivided polynomial, if small ones.
    for i in range(n if n > 2 else 0):
        gap = min(roots[i - 1] - roots[i] if i > 0 else np.inf, roots[i] - roots[i + 1] if i < n - 1 else np.inf)
        for _ in range(2):
            value, slope = horner(coefficients, n, roots[i])
            if abs(value) < 1e-3 * gap * abs(slope):
                roots[i] -= value / slope
    return True


@njit(cache=True, nogil=True)
def decode(theta: Array, clock: Clock, roots: Array, omega: Array) -> int:
    """Frequencies that belong to the parameters of the delay regression, ascending; flags what was wrong."""
    n = theta.size
    polynomial, work = np.ones(n + 1), np.empty(n + 1)
    for k in range(n):
        polynomial[k + 1] = theta[k]
        if not np.isfinite(theta[k]):
            omega[:] = np.nan
            return COMPLEX_ROOTS
    flags = 0
    if not real_roots(polynomial, work, roots):
        # Real parts of the eigenvalues of the companion matrix.
        flags = COMPLEX_ROOTS
        companion = np.zeros((n, n), np.complex128)
        for k in range(n):
            companion[0, k] = -theta[k]
            if k > 0:
                companion[k, k - 1] = 1.0
        roots[:] = np.sort(np.linalg.eigvals(companion).real)[::-1]
    # The largest cosine is that of the lowest frequency, and order survives the bounds.
    for i in range(n):
        if roots[i] < clock.bottom or roots[i] > clock.top:
            roots[i] = min(max(roots[i], clock.bottom), clock.top)
            flags |= OUT_OF_BOUNDS
        omega[i] = np.arccos(roots[i]) / clock.delay
    return flags


# --- how far frequencies can be trusted ----------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def smallest_gap(omega: Array, place: int) -> float:
    """Return the distance of a frequency to its nearest neighbour, or to zero."""
    gap = omega[place]
    if place > 0:
        gap = min(gap, omega[place] - omega[place - 1])
    if place + 1 < omega.size:
        gap = min(gap, omega[place + 1] - omega[place])
    return float(gap)


@njit(cache=True, nogil=True)
def lasts_a_period(omega: Array, elapsed: float) -> bool:
    """Whether a time [s] holds a period of every frequency, and a beat of all neighbours."""
    least = np.inf
    for i in range(omega.size):
        least = min(least, smallest_gap(omega, i))
    return bool(least * elapsed >= 2.0 * np.pi)


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
    n = theta.size
    factor, scales, slopes, direction = np.empty((n, n)), np.empty(n), np.empty(n), np.empty(n)
    if not factorise(gram, 0.0, factor, scales):
        return UNDETERMINED
    size = size_of(gram, theta)
    misfit, rounded = squared_residual(gram, theta), ROUNDING * size * size
    if misfit < DETERMINED * rounded:
        misfit = min(left, max(misfit, rounded))
    enough = min(span, elapsed / FIRST_PERIODS)
    for i in range(n):
        # d c_i/d theta_k = -c_i^(n-k)/prod_j(c_i - c_j), and w = arccos(c)/h.
        slope = clock.delay * np.sqrt(max(1.0 - roots[i] * roots[i], 0.0))
        for j in range(n):
            if j != i:
                slope *= roots[i] - roots[j]
        if slope == 0.0:
            return UNCERTAIN
        for k in range(n - 1, -1, -1):
            slopes[k] = roots[i] ** (n - 1 - k) / slope
            direction[k] = slopes[k]
        substitute(factor, scales, direction)
        square, length = 0.0, 0.0
        for k in range(n):
            square += direction[k] * slopes[k]
            length += abs(direction[k]) * scales[k]
        gap = smallest_gap(omega, i)
        error = np.sqrt(max(square, 0.0) * misfit)
        if gap * enough < 2.0 * np.pi:
            error *= (2.0 * np.pi / max(gap * enough, 1e-30)) ** 5
        # Rounding does not shrink with time, and is not enlarged by the lack of it.
        if not error + ROUNDING * size * length <= CERTAIN_FRACTION * gap:
            return UNCERTAIN
    return 0


@njit(cache=True, nogil=True)
def flag_inconsistent(gram: Array, omega: Array, delay: float, negligible: float) -> int:
    """Compare the residual that the frequencies leave at the second delay with the smallest possible one.

    With the delay h alone, a frequency w and all its aliases ``2 pi k/h - w``, ``2 pi k/h + w`` are the same. At a
    second delay, a whole number of sampling intervals that shares no divisor with the first, they are not.
    """
    n = omega.size
    if not gram[n, n] > 0.0:
        return 0
    theta = np.zeros(n)
    # Coefficients of prod(x - cos(w_i delay)) after the leading one.
    for i in range(n):
        c = np.cos(omega[i] * delay)
        for k in range(i, 0, -1):
            theta[k] -= c * theta[k - 1]
        theta[0] -= c
    # Far below the regressand nothing is inconsistent, and the best fit need not be found.
    residual = squared_residual(gram, theta)
    factor, scales = np.empty((n, n)), np.empty(n)
    if residual <= negligible * gram[n, n] or not factorise(gram, REGULARISATION, factor, scales):
        return 0
    theta[:] = gram[n, :n]
    substitute(factor, scales, theta)
    return INCONSISTENT if residual > WORSE_THAN_BEST * squared_residual(gram, theta) else 0


# --- dynamic regressor extension and mixing (DREM) -----------------------------------------------------------------


#: Fraction of the regressand's second moment that the frequencies may leave at the second delay.
MIXED_NEGLIGIBLE = 1e-4
#: An estimate is judged by the residuals of this multiple of n h.
JUDGED_SPANS = 4
NEWEST, USUAL, LEFT = range(3)
SINCE_VERDICT, VERDICT, SINCE_DOUBT, SINCE_CHANGE = range(4)


@njit(cache=True, nogil=True)
def gradient_steps(mixed: Array, gains: Array, initial: Array, finite_time: bool, sums: Array, theta: Array) -> None:
    """Exact solution of ``theta_k' = gamma_k Delta (Psi_k - Delta theta_k)`` over each interval, Delta and Psi held.

    ``theta = z + (1 - q) theta(0)``, with z and q in ``sums``; the finite-time estimate is ``z/q``. Rows with NaN
    change nothing.
    """
    n = gains.size
    for k in range(len(mixed)):
        delta = mixed[k, n]
        for i in range(n):
            if np.isfinite(delta):
                # m = 1 - exp(-x), the share of the new row; gain = gamma m/x without 0/0 where Delta vanishes.
                x = gains[i] * delta * delta
                m = -np.expm1(-x)
                gain = gains[i] * (m / x if x > 1e-8 else 1.0 - 0.5 * x)
                sums[0, i] += gain * delta * mixed[k, i] - m * sums[0, i]
                sums[1, i] += m * (1.0 - sums[1, i])
            z, q = sums[0, i], sums[1, i]
            theta[k, i] = z / q if finite_time and q > 0.0 else z + (1.0 - q) * initial[i]


@njit(cache=True, nogil=True)
def slide(entries: Array, window: Array, newer: Array, place: IntArray, sums: Array) -> None:
    """Sum entries over a sliding window.

    A block of old entries is summed backwards once, and the newer ones forwards; nothing is ever subtracted, so no
    rounding error of an entry outlives it. ``window`` holds plain entries before ``place`` and, from there on, each
    summed with all that follow it.
    """
    length, width = window.shape
    for k in range(len(entries)):
        here = place[0]
        for i in range(width):
            window[here, i] = entries[k, i]
            newer[i] += entries[k, i]
            # The next place holds the sum of all older entries that are still in the window.
            sums[k, i] = newer[i] + (window[here + 1, i] if here + 1 < length else 0.0)
        place[0] = here + 1
        if place[0] == length:
            for j in range(length - 2, -1, -1):
                for i in range(width):
                    window[j, i] += window[j + 1, i]
            newer[:] = 0.0
            place[0] = 0


@njit(cache=True, nogil=True)
def judge_rows(
    theta: Array,
    rows: Array,
    grams: Array,
    counts: Array,
    spans: Array,
    elapsed: Array,
    clock: Clock,
    flush: int,
    before: Array,
    levels: Array,
    doubts: IntArray,
    omega: Array,
    flags: NDArray[np.uint16],
) -> None:
    """Decode estimates that come with the moments of recent rows at both delays, and say which cannot be trusted.

    Estimates without recent rows (``counts`` of 0) are not judged; ``flags`` holds what is known already.
    """
    n = theta.shape[1]
    roots = np.empty(n)
    smoothing = 1.0 / max(1.0, DETECTOR_SPAN * clock.lag)
    keep = 1.0 - 1.0 / (JUDGED_SPANS * n * clock.lag)
    for k in range(len(theta)):
        if np.isnan(theta[k, 0]):
            omega[k] = np.nan
            continue
        flags[k] |= decode(theta[k], clock, roots, omega[k])
        if counts[k] == 0.0:
            continue
        started = flags[k] & STARTING == 0
        # The residual of what was known before this row.
        square = residual_of(rows[k], before) ** 2
        before[:] = theta[k]
        if np.isfinite(square):
            levels[NEWEST] += smoothing * (square - levels[NEWEST])
            levels[LEFT] = keep * levels[LEFT] + square
        # One unlike the others is doubted at once; otherwise a verdict is given now and then.
        contradicted = started and levels[NEWEST] > levels[USUAL]
        if doubts[SINCE_VERDICT] == 0 or contradicted:
            gram = grams[k, 0]
            verdict = flag_uncertain(gram, levels[LEFT], theta[k], roots, omega[k], clock, spans[k], elapsed[k])
            if contradicted or verdict:
                verdict |= UNCERTAIN
                levels[NEWEST] = 0.0
                if started:
                    doubts[SINCE_DOUBT] = 0
                if contradicted:
                    doubts[SINCE_CHANGE] = 0
            # Rows from before a change must first have left the window.
            elif doubts[SINCE_CHANGE] < flush or not lasts_a_period(omega[k], doubts[SINCE_DOUBT] * clock.interval):
                verdict = UNCERTAIN
            verdict |= flag_inconsistent(grams[k, 1], omega[k], clock.second_delay, MIXED_NEGLIGIBLE)
            doubts[VERDICT] = verdict
            rounded = ROUNDING * size_of(gram, theta[k]) ** 2
            levels[USUAL] = ALARM_RATIO * max(squared_residual(gram, theta[k]), rounded) / counts[k]
        doubts[SINCE_VERDICT] = (doubts[SINCE_VERDICT] + 1) % clock.every if started else 0
        doubts[SINCE_DOUBT:] += 1
        flags[k] |= doubts[VERDICT]


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
OLDER, NEWER, RESIDUAL, ALARM = range(4)
ROWS, NEXT, FLUSH, LAST_VERDICT, JUDGES = range(5)


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
    older: Array
    newer: Array
    check: Array
    theta: Array
    omega: Array
    #: Rows in ``older`` and in ``newer``, less what was forgotten; newest mean squared residual, and alarm level.
    levels: Array
    #: Rows since the restart, rows at the next comparison of halves, samples still to flush, verdict (flags), whether
    #: the residual may be compared with the alarm level.
    counters: IntArray


@njit(cache=True, nogil=True)
def solve(gram: Array, whitener: Array, theta: Array) -> bool:
    """Least squares or total least squares from second moments; False if tones cannot be told apart."""
    n = theta.size
    factor, scales = np.empty((n, n)), np.empty(n)
    if not factorise(gram, 0.0, factor, scales):
        return False
    if whitener.size == 0:
        theta[:] = gram[n, :n]
        substitute(factor, scales, theta)
        return True
    # In M G M' the noise is the same in all directions, M the inverse of its lower factor. v = M' u for the
    # eigenvector u of the least eigenvalue, theta = -v_phi/v_psi.
    vectors = np.linalg.eigh(whitener @ gram @ whitener.T)[1]
    v = whitener.T @ np.ascontiguousarray(vectors[:, 0])
    for k in range(n):
        theta[k] = -v[k] / v[n] if v[n] != 0.0 else np.nan
    return True


@njit(cache=True, nogil=True)
def judge(gram: Array, theta: Array, omega: Array, clock: Clock, rows: float, age: float) -> tuple[int, bool]:
    """Frequencies of a fit to a number of rows since a restart; flags, and whether the fit may judge new samples.

    It may if it is certain, or has been there for so long that its misfit is not that of a beginning.
    """
    n = theta.size
    roots = np.empty(n)
    filled = 2 * n * clock.lag
    span, elapsed = (filled + rows) * clock.interval, (filled + age) * clock.interval
    flags = decode(theta, clock, roots, omega)
    uncertain = flag_uncertain(gram, np.inf, theta, roots, omega, clock, span, elapsed)
    return flags | uncertain, uncertain == 0 or lasts_a_period(omega, elapsed / FIRST_PERIODS)


@njit(cache=True, nogil=True)
def drop_mixed_rows(clock: Clock, compared: int, fit: Fit) -> bool:
    """Drop the older half of the rows if the newer one fits so much better that the older is of another signal."""
    n, levels, counters = fit.theta.size, fit.levels, fit.counters
    theta, omega, plain = np.empty(n), np.empty(n), np.empty((0, 0))
    mixed = False
    if levels[OLDER] > 0.0 and solve(fit.newer, plain, theta):
        # A fit to so few rows that it says nothing must not condemn the others, unless it is exact.
        alone = squared_residual(fit.newer, theta)
        judges = judge(fit.newer, theta, omega, clock, levels[NEWER], levels[NEWER])[1]
        gram = fit.older + fit.newer
        if (judges or alone <= EXACT * fit.newer[n, n]) and solve(gram, plain, theta):
            together = squared_residual(gram, theta) - 1e-14 * gram[n, n]
            mixed = together / (levels[OLDER] + levels[NEWER]) > MIXED_RATIO * alone / levels[NEWER]
    if mixed:
        counters[ROWS] = int(levels[NEWER])
        levels[OLDER] = levels[RESIDUAL] = 0.0
        fit.older[:] = 0.0
        fit.check[:] = 0.0
    fit.older[:] = fit.older + fit.newer
    fit.newer[:] = 0.0
    levels[OLDER] += levels[NEWER]
    levels[NEWER] = 0.0
    # At doubling intervals: whatever is mixed is found at the latest when as much again has arrived.
    counters[NEXT] = max(compared, 2 * counters[ROWS])
    return mixed


@njit(cache=True, nogil=True)
def refresh(clock: Clock, whitener: Array, fit: Fit) -> None:
    """Estimate, alarm level and verdict from all rows."""
    n, levels, counters = fit.theta.size, fit.levels, fit.counters
    gram = fit.older + fit.newer
    # Tones that the rows do not tell apart leave a singular matrix; the last estimate is then kept, marked.
    counters[LAST_VERDICT] = UNDETERMINED
    if not solve(gram, whitener, fit.theta):
        return
    weight = levels[OLDER] + levels[NEWER]
    # Residuals of an exact fit are rounding; the floor keeps them from raising an alarm.
    levels[ALARM] = (ALARM_RATIO * squared_residual(gram, fit.theta) + ROUNDING_FLOOR * gram[n, n]) / weight
    verdict, judges = judge(gram, fit.theta, fit.omega, clock, weight, counters[ROWS])
    counters[JUDGES] = 1 if judges else 0
    counters[LAST_VERDICT] = verdict | flag_inconsistent(fit.check, fit.omega, clock.second_delay, NEGLIGIBLE)


@njit(cache=True, nogil=True)
def restarting_fits(
    rows: Array,
    second_rows: Array,
    missing: NDArray[np.bool_],
    clock: Clock,
    settings: Restarting,
    fit: Fit,
    omega: Array,
    flags: NDArray[np.uint16],
) -> None:
    """Least squares with alarm, flush, restart and comparison with the newer data alone."""
    older, newer, check, theta, own_omega, levels, counters = fit
    smoothing = 1.0 / max(1, round(DETECTOR_SPAN * clock.lag))
    for k in range(len(rows)):
        row = rows[k]
        flag = 0
        if counters[FLUSH] > 0:
            # Samples from before the change are still in the delays: hold the estimate.
            counters[FLUSH] -= 1
            flag = CHANGED | GAP if missing[k] else CHANGED
        elif not np.isfinite(row).all():
            flag = GAP if counters[ROWS] > 0 else STARTING
        else:
            if counters[ROWS] == 0:
                # The first comparison needs an older half.
                counters[NEXT] = settings.compared // 2
                counters[LAST_VERDICT] = 0
                for moments in (older, newer, check):
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
                for moments in (older, newer, check):
                    moments *= keep
            levels[NEWER] += 1.0
            add_row(row, newer)
            if np.isfinite(second_rows[k]).all():
                add_row(second_rows[k], check)
            # A second change while the delays were flushed leaves rows of two signals.
            due = counters[ROWS] % REFRESH == 0 or counters[ROWS] <= EAGER_ROWS
            if counters[ROWS] >= counters[NEXT] and drop_mixed_rows(clock, settings.compared, fit):
                due = True
            if due and counters[ROWS] >= FIRST_ROWS_PER_TONE * theta.size:
                refresh(clock, settings.whitener, fit)
            # The alarm comes last: an estimate that has just been refreshed is judged by its own level.
            if counters[ROWS] < settings.enough:
                flag = STARTING
            elif counters[ROWS] >= settings.armed and counters[JUDGES] > 0 and levels[RESIDUAL] > levels[ALARM]:
                counters[FLUSH] = settings.flush
                counters[ROWS] = 0
                flag = CHANGED
        omega[k] = own_omega
        flags[k] = flag | counters[LAST_VERDICT]
