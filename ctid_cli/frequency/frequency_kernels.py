r"""All compiled loops of the online estimators, and of the fits of tones to windows.

A kernel calls only kernels of this file and reads no constant and no type of another: Numba's cache on disk looks only
at the file of a function, and is then never stale. What the options mean is found beside them, in NumPy.

The recursions ``advance_...(samples, output, *settings, *states)`` take a signal sample by sample and change the arrays
of their states in place: however a record is cut into pieces, the numbers are the same, bit for bit.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ctid_cli.arrays import Array, IntArray

# The first bits of ctid_cli.frequency.flags.Flag; a test compares them.
STARTING, GAP, CHANGED, UNDETERMINED = 1, 2, 4, 8
UNCERTAIN, COMPLEX_ROOTS, OUT_OF_BOUNDS, INCONSISTENT = 16, 32, 64, 128


class Output(NamedTuple):
    """Where a kernel puts its rows, one for each sample."""

    #: Frequencies [rad/s], shape (N, n).
    omega: Array
    #: What may be wrong with them [rad/s], shape (N, n).
    uncertainty: Array
    #: Shape (N,).
    flags: NDArray[np.uint16]


# --- least squares from second moments -----------------------------------------------------------------------------


#: Second moments summed over many samples carry relative errors of about this size.
ROUNDING = 4e-15


@njit(cache=True, nogil=True)
def accumulate_row(row: Array, gram: Array, keep: float) -> None:
    """Add a row to the lower triangle of second moments that forget."""
    for i in range(row.size):
        for j in range(i + 1):
            gram[i, j] = keep * gram[i, j] + row[i] * row[j]


@njit(cache=True, nogil=True)
def squared_residual(gram: Array, theta: Array) -> float:
    """Sum of the squared residuals ``psi - phi' theta``."""
    # psi'psi - 2 theta' Phi'psi + theta' Phi'Phi theta, from the lower triangle; a negative sum is rounding.
    n = theta.size
    total = gram[n, n]
    for i in range(n):
        total -= 2.0 * theta[i] * gram[n, i]
        for j in range(i):
            total += 2.0 * theta[i] * theta[j] * gram[i, j]
        total += theta[i] * theta[i] * gram[i, i]
    return float(max(total, 0.0))


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
            if i == j:
                # What is left of a column that the others explain is rounding: not positive definite.
                if not total > 4e-16 * n:
                    return False
                factor[i, i] = np.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    return True


@njit(cache=True, nogil=True)
def substitute(factor: Array, values: Array) -> None:
    """Solve ``L L' x = b`` in place."""
    n = values.size
    # L first, from above; then L', from below.
    for i in range(n):
        total = values[i]
        for k in range(i):
            total -= factor[i, k] * values[k]
        values[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        total = values[i]
        for k in range(i + 1, n):
            total -= factor[k, i] * values[k]
        values[i] = total / factor[i, i]


@njit(cache=True, nogil=True)
def least_squares(gram: Array, factor: Array, scales: Array, theta: Array) -> None:
    """Least-squares parameters from second moments and their factor."""
    n = theta.size
    for i in range(n):
        theta[i] = gram[n, i] / scales[i]
    substitute(factor, theta)
    for i in range(n):
        theta[i] /= scales[i]


@njit(cache=True, nogil=True)
def moment_uncertainty(
    gram: Array, factor: Array, scales: Array, misfit: float, theta: Array, slopes: Array, error: Array, rounding: Array
) -> None:
    r"""Error that the misfit of the equations would make if all of it lay in the worst direction.

    Residuals e at the true parameters move the estimate by ``G^-1 Phi' e`` and a frequency by at most
    ``sqrt(g' G^-1 g e'e)`` (Cauchy-Schwarz), whatever the e: noise, a bias, another tone. The residual left by
    the fit stands for ``e'e``; as a difference of moments it is known up to rounding only, and taken for no less.
    Rounding of G moves a frequency by up to ``|G^-1 g|`` times the rounding errors.
    """
    n = theta.size
    # Size of the terms that cancel in a residual: |psi| + sum |theta_k| |phi_k|.
    size = np.sqrt(gram[n, n])
    for k in range(n):
        size += abs(theta[k]) * scales[k]
    direction = np.empty(n)
    for i in range(n):
        for k in range(n):
            direction[k] = slopes[i, k] / scales[k]
        # G^-1 g with g the sensitivities of this frequency, both in the scaled columns of the factor.
        substitute(factor, direction)
        square, length = 0.0, 0.0
        for k in range(n):
            square += direction[k] * slopes[i, k] / scales[k]
            length += abs(direction[k])
        error[i] = np.sqrt(max(square, 0.0) * max(misfit, ROUNDING * size * size))
        rounding[i] = ROUNDING * size * length


# --- the delay regression and its mixing, see `regression` ---------------------------------------------------------


class DelayClock(NamedTuple):
    """The delay regression at a sampling interval, as the kernels take it."""

    #: Coefficients of the regression, shape (n + 1, 2 n + 1).
    table: Array
    #: Sampling interval [s].
    interval: float
    #: The delay h in sampling intervals, and in seconds.
    lag: int
    delay: float
    #: A second delay, at which the frequencies are checked.
    second_lag: int
    second_delay: float
    #: Cosines of the highest and of the lowest frequency times h [-].
    bottom: float
    top: float
    #: Samples from one verdict to the next.
    every: int


@njit(cache=True, nogil=True)
def following(place: int, size: int) -> int:
    """The next place of a ring."""
    return place + 1 if place + 1 < size else 0


@njit(cache=True, nogil=True)
def form_row(history: Array, newest: int, lag: int, table: Array, row: Array) -> bool:
    """Regression row ``[phi psi]`` at the newest sample of a ring; whether no sample of it is missing."""
    count, width = table.shape
    row[:count] = 0.0
    place = newest
    complete = True
    # One delayed sample after the other, from y(t) to y(t - 2 n h).
    for j in range(width):
        value = history[place]
        complete = complete and np.isfinite(value)
        for k in range(count):
            row[k] += table[k, j] * value
        # The ring holds 2 n lags and one sample: one step beyond its start at most.
        place -= lag
        if place < 0:
            place += history.size
    return complete


@njit(cache=True, nogil=True)
def mix_rows(
    rows: Array, newest: int, first: int, spacing: int, plan: IntArray, matrix: Array, minors: Array, mixed: Array
) -> float:
    """``[adj(Phi) Psi_f, det Phi]`` of the rows ``first`` to ``first + n - 1`` spacings ago; returns their scale."""
    n = matrix.shape[0]
    size = rows.shape[0]
    place = newest - first * spacing
    # Hadamard: no minor exceeds the product of the lengths of the rows, nor does its rounding by much.
    scale = 1.0
    for i in range(n):
        if place < 0:
            place += size
        square = 0.0
        for k in range(n + 1):
            value = rows[place, k]
            matrix[i, k] = value
            square += value * value
        scale *= np.sqrt(square)
        place -= spacing
    # Laplace expansion along the last row: every minor of the first rows is computed once, and finite though singular.
    minors[:] = 0.0
    minors[0] = 1.0
    for step in range(plan.shape[0]):
        minors[plan[step, 0]] += plan[step, 4] * matrix[plan[step, 1], plan[step, 2]] * minors[plan[step, 3]]
    everything = minors.size - 1
    for k in range(n):
        # Column psi moves from the last place to place k: n - 1 - k exchanges.
        sign = -1.0 if (n - 1 - k) % 2 else 1.0
        mixed[k] = sign * minors[everything - (1 << k)]
    mixed[n] = minors[everything - (1 << n)]
    return scale


# --- from parameters to frequencies --------------------------------------------------------------------------------


# ``prod(c - c_i) = c^n + theta_1 c^(n-1) + ... + theta_n`` has the roots ``c_i = cos(w_i h)``, real and within [-1, 1]
# if theta belongs to sinusoids at all. Noise can move a pair of roots off the real axis, or a root out of the interval.

#: Real parts that are closer than this share of the size of the roots are those of a conjugate pair.
CONJUGATE = 1e-10
#: A root must settle within this many Newton steps; simple roots need fewer than ten.
NEWTON_STEPS = 60
#: An estimation younger than so many periods, or beats of neighbours, is less certain than its misfit shows.
FIRST_PERIODS = 2.0
#: Keeps a division from overflowing.
TINY = 1e-30
#: Frequencies are called certain while the error that the misfit of the equations can make stays below this fraction of
#: the frequency itself and of the distance to its neighbours.
CERTAIN_FRACTION = 0.1


class Decoding(NamedTuple):
    """Memory for one decoding."""

    #: Real parts of the roots, within bounds, shape (n,).
    roots: Array
    #: Derivatives of the frequencies with respect to their roots, shape (n,).
    slopes: Array
    #: What rounding may move the frequencies [rad/s], shape (n,).
    rounding: Array
    #: Derivatives of the frequencies with respect to the coefficients, shape (n, n).
    sensitivities: Array
    #: Coefficients of the polynomial, and what is left of it while roots are divided out, shape (n + 1,).
    polynomial: Array
    quotient: Array


@njit(cache=True, nogil=True)
def decoding_memory(tones: int) -> Decoding:
    """Memory for a number of tones."""
    roots, slopes, rounding = np.empty(tones), np.empty(tones), np.empty(tones)
    return Decoding(roots, slopes, rounding, np.empty((tones, tones)), np.empty(tones + 1), np.empty(tones + 1))


@njit(cache=True, nogil=True)
def horner(coefficients: Array, degree: int, x: float) -> tuple[float, float]:
    """Value and slope of a monic polynomial."""
    value, slope = 1.0, 0.0
    for k in range(1, degree + 1):
        slope = slope * x + value
        value = value * x + coefficients[k]
    return value, slope


@njit(cache=True, nogil=True, forceinline=True)
def real_roots(coefficients: Array, work: Array, roots: Array) -> bool:
    """Roots of a monic polynomial whose roots are all real, largest first.

    Right of its largest root a polynomial with only real roots is convex and increasing, so Newton's iteration from the
    Samuelson bound falls monotonically on the largest root. It is divided out, the last two roots come from the
    quadratic formula, and each root is polished on the undivided polynomial. A step that rises shows complex roots.
    """
    n = roots.size
    for k in range(n + 1):
        work[k] = coefficients[k]
    for found in range(n - 2):
        degree = n - found
        # Samuelson: no root lies farther from the mean of all than sqrt(degree - 1) of their standard deviations.
        spread = (degree - 1.0) ** 2 * work[1] * work[1] - 2.0 * degree * (degree - 1.0) * work[2]
        if not spread >= 0.0:
            return False
        x = (-work[1] + np.sqrt(spread)) / degree
        settled = False
        # Falls from the right: a slope that is not positive there shows complex roots.
        for _ in range(NEWTON_STEPS):
            value, slope = horner(work, degree, x)
            if value == 0.0:
                settled = True
                break
            if not slope > 0.0:
                return False
            change = value / slope
            small = abs(change) <= 1e-13 * (abs(x) + 1e-3)
            if small or change < 0.0:
                # Rounding may carry the iteration just beyond a root, but no further.
                settled = small or abs(change) <= 1e-6 * (abs(x) + 1e-3)
                x -= change
                break
            x -= change
        if not settled:
            return False
        roots[found] = x
        # Horner's numbers are the coefficients of the quotient.
        for k in range(1, degree):
            work[k] += x * work[k - 1]
    if n == 1:
        roots[0] = -work[1]
        return True
    half = -0.5 * work[1]
    discriminant = half * half - work[2]
    if not discriminant >= 0.0:
        return False
    # The root of larger size first, without cancellation; the other one by Vieta.
    large = half - np.sqrt(discriminant) if half < 0.0 else half + np.sqrt(discriminant)
    other = work[2] / large if large != 0.0 else 0.0
    roots[n - 2] = max(large, other)
    roots[n - 1] = min(large, other)
    if n > 2:
        # Dividing out has spoilt the later roots a little: two more steps on the undivided polynomial.
        for i in range(n):
            gap = np.inf
            if i > 0:
                gap = abs(roots[i - 1] - roots[i])
            if i < n - 1:
                gap = min(gap, abs(roots[i] - roots[i + 1]))
            for _ in range(2):
                value, slope = horner(coefficients, n, roots[i])
                if not abs(value) < 1e-3 * gap * abs(slope):
                    break
                roots[i] -= value / slope
    return True


@njit(cache=True, nogil=True, forceinline=True)
def root_real_parts(coefficients: Array, work: Array, roots: Array) -> bool:
    """Real parts of the roots of any monic polynomial, largest first, and whether all roots are real."""
    n = roots.size
    if real_roots(coefficients, work, roots):
        return True
    if n == 2:
        roots[0] = roots[1] = -0.5 * coefficients[1]
        return False
    # Eigenvalues of the companion matrix in units of the size of the roots, so that no power of them overflows.
    scale = 1.0
    for k in range(1, n + 1):
        if coefficients[k] != 0.0:
            scale = abs(coefficients[k]) ** (1.0 / k)
    companion = np.zeros((n, n), np.complex128)
    factor = 1.0
    for k in range(n):
        factor /= scale
        companion[0, k] = -coefficients[k + 1] * factor
    for k in range(1, n):
        companion[k, k - 1] = 1.0
    parts = np.linalg.eigvals(companion).real
    # Sorted by insertion: NumPy's sort would take long to compile.
    for i in range(n):
        part, place = parts[i] * scale, i
        while place > 0 and roots[place - 1] < part:
            roots[place] = roots[place - 1]
            place -= 1
        roots[place] = part
    # Conjugate roots have one real part, but for rounding.
    for i in range(1, n):
        if roots[i - 1] - roots[i] <= CONJUGATE * scale:
            roots[i] = roots[i - 1]
    return False


@njit(cache=True, nogil=True, forceinline=True)
def bounded_roots(
    coefficients: Array, lowest: float, highest: float, polynomial: Array, quotient: Array, roots: Array
) -> int:
    """Real parts of the roots of ``x^n + a_1 x^(n-1) + ... + a_n``, largest first, within bounds; returns flags."""
    n = coefficients.size
    polynomial[0] = 1.0
    for k in range(n):
        if not np.isfinite(coefficients[k]):
            roots[:] = np.nan
            return COMPLEX_ROOTS
        polynomial[k + 1] = coefficients[k]
    flags = 0 if root_real_parts(polynomial, quotient, roots) else COMPLEX_ROOTS
    # Order survives the clipping, so the frequencies stay sorted.
    for i in range(n):
        if roots[i] < lowest or roots[i] > highest:
            roots[i] = min(max(roots[i], lowest), highest)
            flags |= OUT_OF_BOUNDS
    return flags


@njit(cache=True, nogil=True)
def decode(
    theta: Array, delay: float, bottom: float, top: float, work: Array, quotient: Array, roots: Array, omega: Array
) -> int:
    """Frequencies that belong to the parameters of the delay regression, ascending; flags what was wrong."""
    flags = bounded_roots(theta, bottom, top, work, quotient, roots)
    # The largest cosine is that of the lowest frequency.
    for i in range(theta.size):
        omega[i] = np.arccos(roots[i]) / delay
    return flags


@njit(cache=True, nogil=True)
def root_sensitivities(roots: Array, slopes: Array, out: Array) -> None:
    """Derivatives of the frequencies with respect to the coefficients of their polynomial."""
    n = roots.size
    # d x_i/d a_k = -x_i^(n-k)/prod_j(x_i - x_j): implicit derivative of the polynomial at its root.
    for i in range(n):
        slope = 1.0
        for j in range(n):
            if j != i:
                slope *= roots[i] - roots[j]
        factor = -slopes[i] / slope if slope != 0.0 else np.inf
        for k in range(n - 1, -1, -1):
            out[i, k] = factor
            factor *= roots[i]


@njit(cache=True, nogil=True)
def cosine_sensitivities(roots: Array, delay: float, slopes: Array, out: Array) -> None:
    """Derivatives of the frequencies with respect to the parameters of the delay regression."""
    for i in range(roots.size):
        # d arccos(c)/h: infinite at the ends, where a cosine says nothing of its angle.
        square = 1.0 - roots[i] * roots[i]
        slopes[i] = -1.0 / (delay * np.sqrt(square)) if square > 0.0 else -np.inf
    root_sensitivities(roots, slopes, out)


@njit(cache=True, nogil=True)
def room_of(omega: Array, place: int) -> float:
    """How far a frequency can be wrong before it is another one."""
    room = omega[place]
    if place > 0:
        room = min(room, omega[place] - omega[place - 1])
    if place + 1 < omega.size:
        room = min(room, omega[place + 1] - omega[place])
    return float(room)


@njit(cache=True, nogil=True)
def propagate(sensitivities: Array, errors: Array, out: Array) -> None:
    """Largest errors of the frequencies that given errors of the parameters can make."""
    for i in range(out.size):
        total = 0.0
        for k in range(errors.size):
            total += abs(sensitivities[i, k]) * errors[k]
        out[i] = total


@njit(cache=True, nogil=True)
def still_doubtful(omega: Array, quiet: float) -> bool:
    """Whether an estimate was uncertain less than a period, or a beat, ago."""
    least = np.inf
    for i in range(omega.size):
        least = min(least, room_of(omega, i))
    return bool(not quiet * least >= 2.0 * np.pi)


@njit(cache=True, nogil=True)
def flag_uncertain(omega: Array, uncertainty: Array, rounding: Array, span: float, elapsed: float) -> int:
    """Compare what may be wrong with a frequency with the frequency itself and with the distance to its neighbours.

    Within a part of a period, or of the beat of two neighbours, a bias, a drift or another tone hardly differs from a
    change of the frequencies, and hardly shows as a misfit. Measured errors grow like the fifth power of the missing
    part: the possible error is multiplied by ``(period/span)^5``. The same holds for the first two periods: later a
    misfit has shown itself, even if the estimate itself rests on fewer samples.
    """
    flag = 0
    enough = min(span, elapsed / FIRST_PERIODS)
    for i in range(omega.size):
        room = room_of(omega, i)
        if room * enough < 2.0 * np.pi:
            short = 2.0 * np.pi / max(room * enough, TINY)
            uncertainty[i] *= short * short * short * short * short
        # Rounding does not shrink with time, and is not enlarged by the lack of it.
        uncertainty[i] += rounding[i]
        if not uncertainty[i] <= CERTAIN_FRACTION * room:
            flag = UNCERTAIN
    return flag


# --- whether frequencies explain the newest samples, and the signal at another delay -------------------------------


# With the delay h alone, a frequency w and all its aliases ``2 pi k/h - w``, ``2 pi k/h + w`` are one and the same. At
# a second delay, a whole number of sampling intervals that shares no divisor with the first, they are not.

#: The frequencies are inconsistent if they leave so many times the smallest possible squared residual.
WORSE_THAN_BEST = 10.0
#: Time constant of the detector of changes as a fraction of h.
DETECTOR_SPAN = 1.0 / 14.0
#: The signal changed if residuals are so much larger than before (mean squares), and than rounding.
ALARM_RATIO = 30.0
ROUNDING_FLOOR = 1e-18
#: The usual level of a residual is that of so many times n h.
USUAL_SPANS = 20
#: It sinks so many times as fast as it rises, so that it follows an estimate that converges; in noise it is too low
#: therefore, and so much more is needed to contradict an estimate.
SINKING = 50.0
CONTRADICTION_RATIO = 300.0
#: Added to the unit diagonal of the scaled second moments, so that the best fit exists even if it is not unique.
REGULARISATION = 1e-10


@njit(cache=True, nogil=True)
def contradicts(row: Array, theta: Array, levels: Array, fast: float, slow: float) -> bool:
    """Whether the newest row leaves a residual unlike those of the rows before."""
    # levels: rows so far, mean squares of the newest residuals, of the usual ones, and of psi.
    n = theta.size
    residual = row[n]
    for i in range(n):
        residual -= theta[i] * row[i]
    square = residual * residual
    if not np.isfinite(square):
        return False
    # Plain means at first, exponential ones once they span their time.
    levels[0] += 1.0
    levels[1] += max(fast, 1.0 / levels[0]) * (square - levels[1])
    usual = max(slow, 1.0 / levels[0])
    levels[3] += usual * (row[n] * row[n] - levels[3])
    if levels[1] < levels[2]:
        usual = max(min(SINKING * slow, fast), 1.0 / levels[0])
    levels[2] += usual * (levels[1] - levels[2])
    return bool(levels[1] > CONTRADICTION_RATIO * levels[2] + ROUNDING_FLOOR * levels[3])


@njit(cache=True, nogil=True)
def check_consistency(gram: Array, omega: Array, delay: float, negligible: float) -> int:
    """Compare the residual that the frequencies leave at the second delay with the smallest possible one.

    Where noise in the regressors leads least squares far astray, the true frequencies are called inconsistent, too;
    they are uncertain there anyway.
    """
    n = omega.size
    if delay == 0.0 or not gram[n, n] > 0.0:
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
    least_squares(gram, factor, scales, theta)
    return INCONSISTENT if residual > WORSE_THAN_BEST * squared_residual(gram, theta) else 0


# --- dynamic regressor extension and mixing (DREM) -----------------------------------------------------------------


#: A mixed regression may be wrong by this fraction of the product of its rows' lengths.
MIXING_ROUNDING = 1e-15
#: The check at the second delay forgets over so many times n h.
CHECK_SPANS = 4
#: Fraction of the regressand's second moment that the frequencies may leave at the second delay.
MIXED_NEGLIGIBLE = 1e-4
#: A scatter of the scalar regressions below this fraction of their square is rounding.
SCATTER_ROUNDING = 1e-14
#: Places in the counters of a front end, and in its doubts.
FRONT_PLACE, FRONT_ROW, FRONT_USED = range(3)
SINCE_VERDICT, LAST_VERDICT, SINCE_DOUBT = range(3)


class Mixing(NamedTuple):
    """How rows become scalar regressions."""

    #: Order in which the minors are built up, shape (m, 5).
    plan: IntArray
    first_row: int
    #: Distance of the stacked rows [samples].
    spacing: int
    #: Factor ``eps^p`` of Delta and Psi.
    normalisation: float
    #: Rows that an estimate needs before it can be valid.
    enough: int
    #: Whether theta is that of a sliding window; otherwise gradient steps lead to it.
    windowed: bool


class Front(NamedTuple):
    """State of the front end."""

    #: Ring of samples, shape (2 n lag + 1,).
    samples: Array
    #: Ring of regression rows ``[phi psi]``, shape (r, n + 1).
    rows: Array
    #: What the back end estimates, shape (n,).
    theta: Array
    #: Second moments of the rows at the second delay.
    check: Array
    #: Places of the newest sample and of the newest row; mixed regressions that could be used so far.
    counters: IntArray
    #: Samples since the last verdict, the verdict (flags), samples since the last doubt.
    doubts: IntArray
    #: Averages of :func:`contradicts`.
    levels: Array
    #: Of the last verdict [rad/s], shape (n,).
    possible_errors: Array


@njit(cache=True, nogil=True, forceinline=True)
def judge_mixed(
    front: Front,
    omega: Array,
    relative: float,
    span: float,
    elapsed: float,
    clock: DelayClock,
    errors: Array,
    memory: Decoding,
) -> int:
    """What may be wrong with the frequencies, and the flags that follow."""
    # theta is wrong by at most its errors, and by rounding in Delta and Psi; the decoding multiplies both.
    cosine_sensitivities(memory.roots, clock.delay, memory.slopes, memory.sensitivities)
    propagate(memory.sensitivities, errors, front.possible_errors)
    for i in range(omega.size):
        errors[i] = (1.0 + abs(front.theta[i])) * relative
    propagate(memory.sensitivities, errors, memory.rounding)
    flag = flag_uncertain(omega, front.possible_errors, memory.rounding, span, elapsed)
    return flag | check_consistency(front.check, omega, clock.second_delay, MIXED_NEGLIGIBLE)


class Gains(NamedTuple):
    """Settings of the gradient."""

    #: ``gamma_k`` times the sampling interval, shape (n,).
    gains: Array
    #: ``theta(0)``, shape (n,).
    initial: Array
    #: Whether the part of the initial value is taken out.
    finite_time: bool
    #: Number of the largest gain.
    fastest: int
    #: What the recent sums keep from one sample to the next.
    keep: float


class Gradient(NamedTuple):
    """State of the gradient."""

    #: z and q, ``theta = z + (1 - q) theta(0)``, shape (2, n).
    sums: Array
    #: Recent sums of the squares of ``Psi_k - Delta theta_k``, of Delta and of its rounding, and of the squared weights
    #: with which the rows enter q, shape (n + 3,).
    recent: Array


@njit(cache=True, nogil=True, forceinline=True)
def absorb_gradient(
    scale: float, count: int, tuning: Gains, back: Gradient, theta: Array, mixed: Array
) -> tuple[float, float]:
    """Exact solution of ``theta_k' = gamma_k Delta (Psi_k - Delta theta_k)`` over one interval, Delta and Psi held."""
    n = theta.size
    sums, recent = back
    gains, initial = tuning.gains, tuning.initial
    if np.isnan(scale):
        return recent[n], float(count)
    delta = mixed[n]
    recent[n] = tuning.keep * recent[n] + delta * delta
    recent[n + 1] = tuning.keep * recent[n + 1] + (MIXING_ROUNDING * scale) ** 2
    x, m, gain = 0.0, 0.0, 0.0
    for i in range(n):
        if count > 1:
            # The residual of what was known before this sample: theta moves only below.
            recent[i] = tuning.keep * recent[i] + (mixed[i] - delta * theta[i]) ** 2
        if i == 0 or gains[i] != gains[i - 1]:
            # m = 1 - exp(-x), the share of the new row; gain = gamma m/x without 0/0 where Delta vanishes.
            x = gains[i] * delta * delta
            m = -np.expm1(-x)
            gain = gains[i] * (m / x if x > 1e-8 else 1.0 - 0.5 * x)
        if i == tuning.fastest:
            recent[n + 2] = (1.0 - m) ** 2 * recent[n + 2] + m * m
        # The part of the rows and that of the initial value are kept apart, so that no difference cancels.
        sums[0, i] += gain * delta * mixed[i] - m * sums[0, i]
        sums[1, i] += m * (1.0 - sums[1, i])
        z, q = sums[0, i], sums[1, i]
        theta[i] = z / q if tuning.finite_time and q > 0.0 else z + (1.0 - q) * initial[i]
    return recent[n], float(count)


@njit(cache=True, nogil=True)
def weigh_gradient(tuning: Gains, back: Gradient, theta: Array, errors: Array) -> tuple[float, float]:
    """Errors of theta that the recent residuals show, rounding of Delta relative to Delta, rows that carry weight."""
    n = theta.size
    recent, q = back.recent, back.sums[1, tuning.fastest]
    for i in range(n):
        errors[i] = np.sqrt(recent[i] / recent[n])
    # (sum w)^2/sum w^2 for the weights w with which the rows enter the fastest parameter.
    remembered = q * q / recent[n + 2] if recent[n + 2] > 0.0 else 0.0
    return np.sqrt(recent[n + 1] / recent[n]), remembered


class SlidingWindow(NamedTuple):
    """State of the sliding sums; an entry is ``[Delta Psi, Psi^2, Delta^2, rounding^2, 1]``, of the size 2 n + 3."""

    #: Entries after the place of the next one, each summed with all that follow it; before the place, plain ones.
    entries: Array
    #: Sum of the plain entries.
    newer: Array
    #: Sum of the window.
    sums: Array
    place: IntArray


@njit(cache=True, nogil=True, forceinline=True)
def slide(window: Array, newer: Array, place: int, sums: Array) -> int:
    """Sum a sliding window after a new entry at ``place``; the place of the next entry.

    Nothing is ever subtracted, so no rounding error of an entry outlives it.
    """
    length, width = window.shape
    for i in range(width):
        newer[i] += window[place, i]
        sums[i] = newer[i]
    if place + 1 < length:
        # The next place holds the sum of all older entries that are still in the window.
        for i in range(width):
            sums[i] += window[place + 1, i]
        return place + 1
    # The window is full of plain entries: sum them backwards, and begin anew.
    for j in range(length - 2, -1, -1):
        for i in range(width):
            window[j, i] += window[j + 1, i]
    newer[:] = 0.0
    return 0


@njit(cache=True, nogil=True, forceinline=True)
def absorb_window(scale: float, back: SlidingWindow, theta: Array, mixed: Array) -> tuple[float, float]:
    """Least squares on each scalar regression, ``theta_k = sum Delta Psi_k/sum Delta^2`` over the window."""
    n = theta.size
    entries, newer, sums, place = back
    here = place[0]
    if np.isnan(scale):
        for i in range(sums.size):
            entries[here, i] = 0.0
    else:
        # [Delta Psi, Psi^2, Delta^2, rounding^2, 1]; a missing sample leaves a zero entry, which weighs nothing.
        for i in range(n):
            entries[here, i] = mixed[n] * mixed[i]
            entries[here, n + i] = mixed[i] * mixed[i]
        entries[here, 2 * n] = mixed[n] * mixed[n]
        entries[here, 2 * n + 1] = (MIXING_ROUNDING * scale) ** 2
        entries[here, 2 * n + 2] = 1.0
    place[0] = slide(entries, newer, here, sums)
    # While Delta vanishes there is no estimate, not an old one: the window has forgotten it.
    for i in range(n):
        theta[i] = sums[i] / sums[2 * n] if sums[2 * n] > 0.0 else np.nan
    return sums[2 * n], sums[2 * n + 2]


@njit(cache=True, nogil=True)
def weigh_window(back: SlidingWindow, theta: Array, errors: Array) -> tuple[float, float]:
    """Scatter of the scalar regressions of the window, rounding of Delta relative to Delta, rows in the window."""
    n, sums = theta.size, back.sums
    for i in range(n):
        # Mean of (Psi - Delta theta)^2 over that of Delta^2; as a difference it is known up to rounding only.
        square = sums[n + i] / sums[2 * n]
        scatter = square - theta[i] * theta[i]
        errors[i] = np.sqrt(scatter) if scatter > SCATTER_ROUNDING * square else 0.0
    return np.sqrt(sums[2 * n + 1] / sums[2 * n]), sums[2 * n + 2]


@njit(cache=True, nogil=True)
def advance_mixed(
    samples: Array,
    output: Output,
    clock: DelayClock,
    mixing: Mixing,
    gains: Gains,
    front: Front,
    gradient: Gradient,
    window: SlidingWindow,
) -> None:
    """Delays, mixing, gradient steps or least squares over a window, decoding and verdict, sample by sample."""
    # Arrays are taken out of their tuples once: in the loop, each would cost two counts of its references.
    omegas, uncertainty, flags = output
    history, rows, theta, check, counters, doubts, levels, possible_errors = front
    table, plan, n = clock.table, mixing.plan, omegas.shape[1]
    row, matrix, minors, mixed = np.empty(n + 1), np.empty((n, n + 1)), np.empty(2 ** (n + 1)), np.empty(n + 1)
    errors, memory = np.empty(n), decoding_memory(n)
    roots, polynomial, quotient = memory.roots, memory.polynomial, memory.quotient
    # The check at the second delay, the newest residuals and the usual ones forget over different times.
    keep = 1.0 - clock.every / (CHECK_SPANS * n * clock.lag)
    fast, slow = 1.0 / max(1.0, DETECTOR_SPAN * clock.lag), 1.0 / (USUAL_SPANS * n * clock.lag)
    # How far the rows of one mixed regression reach back [samples].
    reach = rows.shape[0] + 2 * n * clock.lag
    for k in range(samples.size):
        counters[FRONT_PLACE] = following(counters[FRONT_PLACE], history.size)
        counters[FRONT_ROW] = following(counters[FRONT_ROW], rows.shape[0])
        history[counters[FRONT_PLACE]] = samples[k]
        # The second delay comes first: it leaves its own row behind.
        checked = counters[FRONT_PLACE] % clock.every == 0 and clock.second_lag > 0
        if checked and form_row(history, counters[FRONT_PLACE], clock.second_lag, table, row):
            accumulate_row(row, check, keep)
        form_row(history, counters[FRONT_PLACE], clock.lag, table, row)
        for i in range(n + 1):
            rows[counters[FRONT_ROW], i] = row[i]
        scale = mix_rows(rows, counters[FRONT_ROW], mixing.first_row, mixing.spacing, plan, matrix, minors, mixed)
        scale *= mixing.normalisation
        for i in range(n + 1):
            mixed[i] *= mixing.normalisation
        # A missing sample makes a row and all its minors NaN; squares beyond the largest number are of no use either.
        flag = 0
        if np.isfinite(scale * scale) and np.isfinite(mixed[n] * mixed[n]):
            counters[FRONT_USED] += 1
        else:
            scale = np.nan
            flag = GAP if counters[FRONT_USED] > 0 else STARTING
        if mixing.windowed:
            weight, used = absorb_window(scale, window, theta, mixed)
        else:
            weight, used = absorb_gradient(scale, counters[FRONT_USED], gains, gradient, theta, mixed)
        started = used >= mixing.enough
        if not started:
            flag |= STARTING
        # Initial frequencies are shown as well, though nothing bears them out.
        omega = omegas[k]
        if weight > 0.0 or np.isfinite(theta[0]):
            flag |= decode(theta, clock.delay, clock.bottom, clock.top, polynomial, quotient, roots, omega)
        else:
            omega[:] = np.nan
        if weight > 0.0:
            # A residual unlike the ones before is doubted at once; otherwise a verdict is given now and then.
            contradicted = started and contradicts(row, theta, levels, fast, slow)
            if doubts[SINCE_VERDICT] == 0 or contradicted:
                if mixing.windowed:
                    relative, remembered = weigh_window(window, theta, errors)
                else:
                    relative, remembered = weigh_gradient(gains, gradient, theta, errors)
                span, elapsed = (reach + remembered) * clock.interval, (reach + counters[FRONT_USED]) * clock.interval
                verdict = judge_mixed(front, omega, relative, span, elapsed, clock, errors, memory)
                if verdict & UNCERTAIN or contradicted:
                    verdict |= UNCERTAIN
                    if started:
                        doubts[SINCE_DOUBT] = 0
                elif still_doubtful(omega, doubts[SINCE_DOUBT] * clock.interval):
                    verdict |= UNCERTAIN
                doubts[LAST_VERDICT] = verdict
            doubts[SINCE_VERDICT] = (doubts[SINCE_VERDICT] + 1) % clock.every if started else 0
            doubts[SINCE_DOUBT] += 1
            for i in range(n):
                uncertainty[k, i] = possible_errors[i]
        else:
            uncertainty[k, :] = np.nan
            if counters[FRONT_USED] > 0:
                flag |= UNDETERMINED
        flags[k] = flag | doubts[LAST_VERDICT]


# --- least squares that restart when the signal changes ------------------------------------------------------------


#: The estimate is computed anew with every row at first, later every so many.
REFRESH = 10
EAGER_ROWS = 40
#: Rows for each tone before the first estimate.
FIRST_ROWS_PER_TONE = 2
#: Older data are dropped if the whole fit leaves so many times the mean squared residual of the newer data alone; first
#: checked after so many lengths of the prefilter.
MIXED_RATIO = 6.0
#: A fit that leaves no larger fraction of the regressand's second moment is exact, however short its data are.
EXACT = 1e-13
#: Fraction of the regressand's second moment that the frequencies may leave at the second delay.
NEGLIGIBLE = 1e-8
OLDER, NEWER, RESIDUAL, ALARM = range(4)
PLACE, ROWS, NEXT, FLUSH, VERDICT, JUDGES = range(6)


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
def add_halves(older: Array, newer: Array, gram: Array) -> None:
    """Add the moments of both halves; an expression of whole arrays would take long to compile."""
    for i in range(gram.shape[0]):
        for j in range(gram.shape[1]):
            gram[i, j] = older[i, j] + newer[i, j]


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
    add_halves(fit.older, fit.newer, gram)
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
    add_halves(fit.older, fit.newer, fit.older)
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
    add_halves(fit.older, fit.newer, gram)
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
