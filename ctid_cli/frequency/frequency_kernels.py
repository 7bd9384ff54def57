r"""All compiled loops of the online estimators, and of the fits of tones to windows.

A kernel calls only kernels of this file and reads no constant and no type of another: Numba's cache on disk looks only
at the file of a function, and is then never stale. What the options mean is found beside them, in NumPy.

The recursions ``advance_...(samples, output, *settings, *states)`` take a signal sample by sample and change the arrays
of their states in place: however a record is cut into pieces, the numbers are the same, bit for bit.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ctid_cli.arrays import Array, BoolArray, IndexArray, IntArray

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


@njit(cache=True, nogil=True)
def following(place: int, size: int) -> int:
    """The next place of a ring."""
    return place + 1 if place + 1 < size else 0


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


# --- regression on filtered derivatives ----------------------------------------------------------------------------


#: The estimate is decoded anew every so many samples.
FILTER_REFRESH = 5
SEEN, REFILL, NEW, FILTER_VERDICT = range(4)


class Filter(NamedTuple):
    """Settings of the filters and of the regression."""

    #: The chain over one interval: its transition, and what the last sample and the change since then add to it.
    step: tuple[Array, Array, Array]
    #: Rows of the regression from the chain, shape (n + 1, 2 n + 1).
    derivatives: Array
    #: What the second moments keep from one sample to the next.
    keep: float
    #: Gains of the gradient times the interval, shape (n,); none for least squares.
    gains: Array
    #: [s]
    interval: float
    #: How far an estimate reaches back, when the first one is shown, and how long a gap empties the chain [samples].
    memory: float
    hold: int
    refill: int
    #: Bounds of the squared frequencies.
    lowest: float
    highest: float


class Chain(NamedTuple):
    """State of the filters and of the regression."""

    #: The newest sample, and it after 1, 2, ... 2 n filters.
    chain: Array
    moments: Array
    #: Coefficients, frequencies and their possible errors, shape (3, n).
    estimate: Array
    #: Samples so far, samples until the chain is full again after a gap, rows since the last verdict, verdict (flags).
    counters: IntArray


@njit(cache=True, nogil=True, forceinline=True)
def filter_sample(
    y: float, transition: Array, from_value: Array, from_change: Array, chain: Array, moved: Array
) -> None:
    """Chain of filters over one interval, exactly for a signal that is linear between its samples."""
    for i in range(moved.size):
        moved[i] = from_value[i] * chain[0] + from_change[i] * (y - chain[0])
        # Lower triangular: a filter sees only those before it.
        for j in range(i + 1):
            moved[i] += transition[i, j] * chain[1 + j]
    chain[0] = y
    for i in range(moved.size):
        chain[1 + i] = moved[i]


@njit(cache=True, nogil=True)
def take_gradient_step(row: Array, gains: Array, coefficients: Array) -> None:
    """Implicit step ``a += K phi e/(1 + phi' K phi)``: no gain is too large."""
    n = coefficients.size
    residual, size = row[n], 1.0
    for i in range(n):
        residual -= row[i] * coefficients[i]
        size += gains[i] * row[i] * row[i]
    for i in range(n):
        coefficients[i] += gains[i] * row[i] * residual / size


@njit(cache=True, nogil=True, forceinline=True)
def estimate_frequencies(settings: Filter, state: Chain, factor: Array, scales: Array, work: Decoding) -> int:
    """Frequencies and their possible errors from the moments, and the flags that follow."""
    # Singular moments determine nothing, whatever the gradient has made of them.
    n, moments = scales.size, state.moments
    coefficients, frequencies, possible_errors = state.estimate[0], state.estimate[1], state.estimate[2]
    if not factorise(moments, 0.0, factor, scales):
        return UNDETERMINED
    if settings.gains.size == 0:
        least_squares(moments, factor, scales, coefficients)
    roots, slopes, sensitivities, rounding = work.roots, work.slopes, work.sensitivities, work.rounding
    verdict = bounded_roots(coefficients, settings.lowest, settings.highest, work.polynomial, work.quotient, roots)
    # The roots are squared frequencies: ascending, as frequencies are shown.
    for i in range(n // 2):
        roots[i], roots[n - 1 - i] = roots[n - 1 - i], roots[i]
    for i in range(n):
        frequencies[i] = np.sqrt(roots[i])
        slopes[i] = 0.5 / frequencies[i] if frequencies[i] > 0.0 else np.inf
    # d w/d w^2 = 1/(2 w), times the derivatives of the roots.
    root_sensitivities(roots, slopes, sensitivities)
    misfit = squared_residual(moments, coefficients)
    moment_uncertainty(moments, factor, scales, misfit, coefficients, sensitivities, possible_errors, rounding)
    elapsed = state.counters[SEEN] * settings.interval
    span = min(elapsed, settings.memory * settings.interval)
    return verdict | flag_uncertain(frequencies, possible_errors, rounding, span, elapsed)


@njit(cache=True, nogil=True)
def advance_filter(samples: Array, output: Output, settings: Filter, state: Chain) -> None:
    """Chain of filters, regression with forgetting, and least squares or gradient steps."""
    n = output.omega.shape[1]
    row, moved = np.empty(n + 1), np.empty(2 * n)
    factor, scales, memory = np.empty((n, n)), np.empty(n), decoding_memory(n)
    # Arrays are taken out of their tuples once: in the loop, each would cost two counts of its references.
    chain, moments, estimate, counters = state
    omegas, uncertainty, flags = output
    (transition, from_value, from_change), derivatives, gains = settings.step, settings.derivatives, settings.gains
    coefficients = estimate[0]
    for k in range(samples.size):
        y = samples[k]
        flag = STARTING if counters[SEEN] < settings.hold else 0
        # A gap breaks the chain: what is in it belongs to another time.
        if not np.isfinite(y):
            counters[REFILL] = settings.refill + 1
            flag |= GAP
        elif counters[REFILL] == settings.refill + 1 or counters[SEEN] == 0:
            # Nothing to interpolate from: the chain begins at rest.
            chain[:] = 0.0
            chain[0] = y
            flag |= GAP if counters[REFILL] > 0 else STARTING
            counters[REFILL] = max(counters[REFILL] - 1, 0)
        else:
            filter_sample(y, transition, from_value, from_change, chain, moved)
            if counters[REFILL] > 0:
                counters[REFILL] -= 1
                flag |= GAP
            else:
                # Derivatives of the filtered signal are combinations of the chain.
                for i in range(n + 1):
                    row[i] = 0.0
                    for j in range(2 * n + 1):
                        row[i] += derivatives[i, j] * chain[j]
                accumulate_row(row, moments, settings.keep)
                if gains.size:
                    take_gradient_step(row, gains, coefficients)
                counters[NEW] += 1
        # Verdicts come after the hold, and only where new rows have come.
        counters[SEEN] += 1
        if counters[NEW] >= FILTER_REFRESH and counters[SEEN] > settings.hold:
            counters[NEW] = 0
            counters[FILTER_VERDICT] = estimate_frequencies(settings, state, factor, scales, memory)
        for i in range(n):
            omegas[k, i] = estimate[1, i]
            uncertainty[k, i] = estimate[2, i]
        flags[k] = flag | counters[FILTER_VERDICT]


# --- adaptive observer ---------------------------------------------------------------------------------------------


#: Ridge of the Gauss-Newton matrix, as a fraction of its trace.
TRACE_RIDGE = 1e-4


class Adaptation(NamedTuple):
    """Settings of the observer."""

    #: [s]
    interval: float
    #: Poles with the sign changed [rad/s], shape (2 n,).
    poles: Array
    #: Of forgetting [1/s].
    rate: float
    #: Samples without adaptation.
    hold: int
    #: Smallest distance of two frequencies, and bounds [rad/s].
    smallest_gap: float
    lowest: float
    highest: float


class Observer(NamedTuple):
    """State of the observer."""

    #: Squared frequencies [rad^2/s^2], shape (n,).
    squares: Array
    #: Each tone and its derivative; below, their sensitivities to each squared frequency, shape (n + 1, 2 n).
    states: Array
    #: Averaged products of the sensitivities of the prediction, and the squared error, shape (n + 1, n + 1).
    moments: Array
    #: The last sample, and how many so far.
    last: Array
    #: Frequencies, averaged [rad/s], shape (n,).
    average: Array
    seen: IntArray


@njit(cache=True, nogil=True)
def place_poles(squares: Array, poles: Array, gains: Array) -> None:
    """Observer gains for given frequencies."""
    # prod(s^2 + w_i^2) + sum (l_i1 s + l_i2) prod_(j != i)(s^2 + w_j^2) = prod(s + p_k), compared at s = j w_i.
    for i in range(squares.size):
        omega = np.sqrt(squares[i])
        value = complex(1.0, 0.0)
        for k in range(poles.size):
            value *= complex(poles[k], omega)
        others = 1.0
        for j in range(squares.size):
            if j != i:
                others *= squares[j] - squares[i]
        gains[2 * i] = value.imag / (omega * others)
        gains[2 * i + 1] = value.real / others


@njit(cache=True, nogil=True)
def observer_slope(states: Array, y: float, squares: Array, gains: Array, slope: Array) -> None:
    """Time derivative of the observer and of its sensitivities."""
    n = squares.size
    for p in range(n + 1):
        # The sensitivities obey the same equations, without the signal.
        error = y if p == 0 else 0.0
        for i in range(n):
            error -= states[p, 2 * i]
        for i in range(n):
            slope[p, 2 * i] = states[p, 2 * i + 1] + gains[2 * i] * error
            slope[p, 2 * i + 1] = -squares[i] * states[p, 2 * i] + gains[2 * i + 1] * error
        if p > 0:
            # Derivative of -w_p^2 s_p with respect to w_p^2 itself.
            slope[p, 2 * p - 1] -= states[0, 2 * p - 2]


@njit(cache=True, nogil=True, forceinline=True)
def predict(
    before: float, change: float, interval: float, squares: Array, gains: Array, observer: Array, memory: Array
) -> None:
    """Classical Runge-Kutta step for a signal that changes linearly; ``memory`` has the shape (3, n + 1, 2 n)."""
    stage, total, slope = memory[0], memory[1], memory[2]
    states, now, sums, steps = observer.ravel(), stage.ravel(), total.ravel(), slope.ravel()
    now[:] = states
    sums[:] = 0.0
    # Where in the interval a slope is taken, its weight, and how far it leads to the next one.
    for share, weight, ahead in ((0.0, 1.0, 0.5), (0.5, 2.0, 0.5), (0.5, 2.0, 1.0), (1.0, 1.0, 1.0)):
        observer_slope(stage, before + share * change, squares, gains, slope)
        for i in range(states.size):
            sums[i] += weight * steps[i]
            now[i] = states[i] + ahead * interval * steps[i]
    for i in range(states.size):
        states[i] += interval / 6.0 * sums[i]


@njit(cache=True, nogil=True, forceinline=True)
def adapt(
    y: float, settings: Adaptation, state: Observer, xi: Array, step: Array, matrix: Array, factor: Array, scales: Array
) -> int:
    """Recursive Gauss-Newton step of the squared frequencies; flags a bound that it meets."""
    n = state.squares.size
    smoothing = settings.rate * settings.interval
    states, moments, squares = state.states, state.moments, state.squares
    # The prediction is the sum of the tones; so are its sensitivities those of theirs.
    for p in range(n + 1):
        xi[p] = 0.0
        for i in range(n):
            xi[p] += states[p, 2 * i]
    error = y - xi[0]
    trace = 0.0
    for p in range(n):
        for j in range(p + 1):
            moments[p, j] += smoothing * (xi[p + 1] * xi[j + 1] - moments[p, j])
        trace += moments[p, p]
    moments[n, n] += smoothing * (error * error - moments[n, n])
    if state.seen[0] < settings.hold:
        return 0
    for p in range(n):
        for j in range(p + 1):
            matrix[p, j] = moments[p, j]
        # The ridge bounds the step while the moments are nearly singular, the newest row while they are nearly zero.
        matrix[p, p] += TRACE_RIDGE * trace + smoothing * xi[p + 1] * xi[p + 1]
        step[p] = smoothing * xi[p + 1] * error
    if not factorise(matrix, 0.0, factor, scales):
        return 0
    for p in range(n):
        step[p] /= scales[p]
    substitute(factor, step)
    flag = 0
    bound = settings.lowest
    for p in range(n):
        # From the lowest frequency upwards, each leaves room for those above it: equal ones have no finite gains.
        wanted = max(squares[p] + step[p] / scales[p], 0.0)
        ceiling = settings.highest - (n - 1 - p) * settings.smallest_gap
        frequency = min(max(np.sqrt(wanted), bound), ceiling)
        allowed = wanted if frequency == np.sqrt(wanted) else frequency * frequency
        if allowed != wanted:
            flag = OUT_OF_BOUNDS
        # The states move with the frequencies, to first order: what they would be, had these been there before.
        for i in range(2 * n):
            states[0, i] += states[p + 1, i] * (allowed - squares[p])
        squares[p] = allowed
        bound = frequency + settings.smallest_gap
    return flag


@njit(cache=True, nogil=True)
def advance_observer(samples: Array, output: Output, settings: Adaptation, state: Observer) -> None:
    """Observer, sensitivities and recursive Gauss-Newton steps."""
    n = output.omega.shape[1]
    gains, no_gains, xi = np.empty(2 * n), np.zeros(2 * n), np.empty(n + 1)
    memory, matrix, factor = np.empty((3, n + 1, 2 * n)), np.empty((n + 1, n + 1)), np.empty((n, n))
    scales, step, unit, no_rounding = np.empty(n), np.empty(n), np.empty(n), np.zeros(n)
    # Arrays are taken out of their tuples once: in the loop, each would cost two counts of its references.
    squares, observer, moments, last, average, seen = state
    omegas, uncertainty, flags = output
    poles = settings.poles
    smoothing = settings.rate * settings.interval
    for k in range(samples.size):
        y = samples[k]
        flag = STARTING if seen[0] < settings.hold else 0
        present = np.isfinite(y) and np.isfinite(last[0])
        if seen[0] > 0 and present:
            place_poles(squares, poles, gains)
            predict(last[0], y - last[0], settings.interval, squares, gains, observer, memory)
        elif seen[0] > 0:
            # Without samples the observer runs on by itself.
            predict(0.0, 0.0, settings.interval, squares, no_gains, observer, memory)
        if present:
            flag |= adapt(y, settings, state, xi, step, matrix, factor, scales)
        else:
            flag |= GAP if seen[0] > 0 or not np.isfinite(y) else STARTING
        last[0] = y
        seen[0] += 1
        determined = factorise(moments, 0.0, factor, scales)
        for p in range(n):
            omega = np.sqrt(squares[p])
            average[p] += smoothing * (omega - average[p])
            omegas[k, p] = omega
            uncertainty[k, p] = np.nan
            if determined:
                # Error of w_p that the mean squared residual makes in the worst direction: w_p^2 over 2 w_p.
                unit[:] = 0.0
                unit[p] = 1.0 / scales[p]
                substitute(factor, unit)
                misfit = np.sqrt(max(unit[p], 0.0) / scales[p] * moments[n, n]) / (2.0 * omega)
                # An estimate that still moves is not where it will be.
                uncertainty[k, p] = misfit + abs(omega - average[p])
        if determined:
            # The effective length of an exponential window, and the delay of the observer.
            elapsed = seen[0] * settings.interval
            span = min(elapsed, 2.0 / settings.rate + 1.0 / poles[0])
            flag |= flag_uncertain(omegas[k], uncertainty[k], no_rounding, span, elapsed)
        elif seen[0] > settings.hold:
            flag |= UNDETERMINED
        flags[k] = flag


# --- sums of decaying chirps fitted to windows ---------------------------------------------------------------------


#: Numbers of a tone: cosine and sine amplitude, and over half a window logarithmic growth, phase, curvature of phase.
NUMBERS = 5
#: Tones that are so many bins apart do not disturb each other's steps.
FAR = 8.0
#: Samples that are taken together. Each has phasors of its own that turn from one such chunk to the next, so that the
#: loops within a chunk have nothing to wait for; few enough for all of a chunk to stay in the nearest cache.
CHUNK = 128
#: Numbers of a tone that do not curve: what curves is fitted when what turns is nearly right.
STRAIGHT = 4
#: Largest logarithmic growth over half a window, and phase bent over half a window [rad].
MOST_GROWTH = 4.0
MOST_BEND = 1e4
#: How many numbers of each tone are free, and how many steps are taken at most, one stage after the other.
STAGES = ((2, 1), (STRAIGHT, 4), (NUMBERS, 30))
#: A stage ends when the step would lower the sum of squares by less than this share of one sample's, or change no phase
#: by more than this [rad] and no amplitude by more than this share.
SMALL = 1e-3
SMALLEST = 1e-9
#: Longest step of a phase over half a window [rad].
MOST_TURNED = 2.0
#: Marquardt's damping, in units of the diagonal: at first, its factors, and where it gives up.
DAMPING = 1e-4
RAISED = 10.0
LOWERED = 0.1
MOST_DAMPING = 1e6
#: Added to the diagonal before a covariance is found, as a share of it.
RIDGE = 1e-13


class ToneWork(NamedTuple):
    """Memory of one window after the other; of what comes twice, one is of the numbers so far and one of a trial."""

    #: Sums of the products of the sensitivities psi, lower triangles; sums of psi times residual; residuals; their
    #: sums of squares; shapes (2, 5 n + 1, 5 n + 1), (2, 5 n + 1), (2, L) and (2,).
    gram: Array
    right: Array
    left: Array
    cost: Array
    #: Which of the two is that of the numbers so far, shape (1,).
    now: IndexArray
    #: Equations of the numbers that are free, their factor, and in three rows their right side, a step, and scales.
    packed: Array
    factor: Array
    vectors: Array
    #: Of a chunk: sensitivities, phasors and their factors; whether there is a sample, two rows for products, and u.
    sensitivities: Array
    phasors: Array
    rows: Array
    #: Pairs of tones, and in the last row the tones that the constant disturbs.
    pairs: IndexArray


@njit(cache=True, nogil=True)
def work_for(tones: int, length: int) -> ToneWork:
    """Memory for windows of a length with no more than so many tones."""
    size, chunk = NUMBERS * tones + 1, min(CHUNK, length)
    return ToneWork(
        np.zeros((2, size, size)),
        np.zeros((2, size)),
        np.empty((2, length)),
        np.zeros(2),
        np.zeros(1, np.int64),
        np.zeros((size, size)),
        np.zeros((size, size)),
        np.zeros((3, size)),
        np.empty((size, chunk)),
        np.empty((4 * max(tones, 1), chunk)),
        np.empty((4, chunk)),
        np.empty((3, tones * (tones + 1) // 2 + 1), np.int64),
    )


@njit(cache=True, nogil=True)
def _first_phasors(tones: Array, length: int, phasors: Array, further: NDArray[np.complex128]) -> None:
    """Phasor of each tone at each sample of the first chunk, its factor to the next chunk, and that factor's factor."""
    du = 2.0 / (length - 1)
    chunk = phasors.shape[1]
    ahead = chunk * du
    for k in range(tones.shape[0]):
        growth, turn, bend = tones[k, 2], tones[k, 3], tones[k, 4]
        z = np.exp(complex(-growth, -turn + bend))
        # phi(u + d) - phi(u) = turn d + bend (2 u d + d^2), at u = -1 to the next sample, and to the next chunk
        q = np.exp(complex(growth * du, turn * du + bend * (du * du - 2.0 * du)))
        p = np.exp(complex(0.0, 2.0 * bend * du * du))
        leap = np.exp(complex(growth * ahead, turn * ahead + bend * (ahead * ahead - 2.0 * ahead)))
        longer = np.exp(complex(0.0, 2.0 * bend * ahead * du))
        further[k] = np.exp(complex(0.0, 2.0 * bend * ahead * ahead))
        for j in range(chunk):
            phasors[4 * k, j], phasors[4 * k + 1, j] = z.real, z.imag
            phasors[4 * k + 2, j], phasors[4 * k + 3, j] = leap.real, leap.imag
            z *= q
            q *= p
            leap *= longer


@njit(cache=True, nogil=True)
def _neighbours(tones: Array, pairs: IndexArray) -> tuple[int, int]:
    """Pairs of tones that disturb each other, each with itself too, and the number of tones that the constant disturbs.

    Those tones are listed in the last row of ``pairs``.
    """
    n = tones.shape[0]
    count, low = 0, 0
    for a in range(n):
        wide = FAR * math.pi + 2.0 * abs(tones[a, 4])
        if abs(tones[a, 3]) < wide:
            pairs[2, low] = a
            low += 1
        for b in range(a + 1):
            if abs(tones[a, 3] - tones[b, 3]) < wide + 2.0 * abs(tones[b, 4]):
                pairs[0, count], pairs[1, count] = a, b
                count += 1
    return count, low


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _product(one: Array, other: Array, count: int) -> float:
    total = 0.0
    for j in range(count):
        total += one[j] * other[j]
    return total


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _sum(one: Array, count: int) -> float:
    total = 0.0
    for j in range(count):
        total += one[j]
    return total


@njit(cache=True, nogil=True, fastmath={"contract"})
def _begin_chunk(y: Array, constant: float, left: Array, there: Array) -> None:
    """The samples of a chunk without the constant, zero where one is missing."""
    for j in range(y.size):
        known = not math.isnan(y[j])
        there[j] = 1.0 if known else 0.0
        left[j] = y[j] - constant if known else 0.0


@njit(cache=True, nogil=True, fastmath={"contract"})
def _take_tone(tone: Array, phasors: Array, there: Array, signal: Array, turned: Array, left: Array) -> None:
    """Take a tone from what is left of a chunk; its signal, and that a quarter of a period on."""
    real, imag = phasors[0], phasors[1]
    cosine, sine = tone[0], tone[1]
    for j in range(left.size):
        signal[j] = there[j] * (cosine * real[j] + sine * imag[j])
    for j in range(left.size):
        turned[j] = there[j] * (sine * real[j] - cosine * imag[j])
    for j in range(left.size):
        left[j] -= signal[j]


@njit(cache=True, nogil=True, fastmath={"contract"})
def _sensitivities(phasors: Array, there: Array, signal: Array, turned: Array, u: Array, rows: Array) -> None:
    """Derivatives of a tone with respect to its numbers."""
    of_cosine, of_sine, of_growth, of_turn, of_bend = rows[0], rows[1], rows[2], rows[3], rows[4]
    count = signal.size
    for j in range(count):
        of_cosine[j] = there[j] * phasors[0, j]
    for j in range(count):
        of_sine[j] = there[j] * phasors[1, j]
    for j in range(count):
        of_growth[j] = u[j] * signal[j]
    for j in range(count):
        of_turn[j] = u[j] * turned[j]
    for j in range(count):
        of_bend[j] = u[j] * of_turn[j]


@njit(cache=True, nogil=True, fastmath={"contract"})
def _turn(phasors: Array, further: complex, scratch: Array) -> None:
    """Phasors of the next chunk."""
    real, imag, leap_real, leap_imag = phasors[0], phasors[1], phasors[2], phasors[3]
    for j in range(scratch.size):
        scratch[j] = real[j] * leap_real[j] - imag[j] * leap_imag[j]
    for j in range(scratch.size):
        imag[j] = real[j] * leap_imag[j] + imag[j] * leap_real[j]
    for j in range(scratch.size):
        real[j] = scratch[j]
    for j in range(scratch.size):
        scratch[j] = leap_real[j] * further.real - leap_imag[j] * further.imag
    for j in range(scratch.size):
        leap_imag[j] = leap_real[j] * further.imag + leap_imag[j] * further.real
    for j in range(scratch.size):
        leap_real[j] = scratch[j]


@njit(cache=True, nogil=True)
def _advance(values: Array, by: float) -> None:
    for j in range(values.size):
        values[j] += by


@njit(cache=True, nogil=True)
def make_equations(y: Array, tones: Array, constant: float, work: ToneWork, place: int) -> float:
    """``sum psi psi'`` and ``sum psi r`` of all numbers, what is left, and its sum of squares.

    Products of tones that are far from each other are left out: they vary so fast that their sums are nearly nothing.
    """
    gram, right, rows, pairs = work.gram[place], work.right[place], work.sensitivities, work.pairs
    length, n = y.size, tones.shape[0]
    last = NUMBERS * n
    further = np.empty(n, np.complex128)
    _first_phasors(tones, length, work.phasors, further)
    count, low = _neighbours(tones, pairs)
    gram[: last + 1, : last + 1] = 0.0
    right[: last + 1] = 0.0
    total = 0.0
    chunk = work.rows.shape[1]
    u = work.rows[3]
    for j in range(chunk):
        u[j] = 2.0 * j / (length - 1) - 1.0
    for first in range(0, length, chunk):
        here = min(chunk, length - first)
        there, signal, turned = work.rows[0, :here], work.rows[1, :here], work.rows[2, :here]
        left = work.left[place, first : first + here]
        _begin_chunk(y[first : first + here], constant, left, there)
        for k in range(n):
            phasors = work.phasors[4 * k : 4 * k + 4]
            _take_tone(tones[k], phasors, there, signal, turned, left)
            _sensitivities(phasors, there, signal, turned, u, rows[NUMBERS * k : NUMBERS * k + NUMBERS])
            if first + chunk < length:
                _turn(phasors, further[k], work.rows[1])
        total += _product(left, left, here)
        _advance(u, 2.0 * chunk / (length - 1))
        gram[last, last] += _sum(there, here)
        right[last] += _sum(left, here)
        for a in range(last):
            right[a] += _product(rows[a], left, here)
        for j in range(low):
            for a in range(NUMBERS * pairs[2, j], NUMBERS * pairs[2, j] + NUMBERS):
                gram[last, a] += _sum(rows[a], here)
        for j in range(count):
            one, two = NUMBERS * pairs[0, j], NUMBERS * pairs[1, j]
            for a in range(one, one + NUMBERS):
                for b in range(two, a + 1 if one == two else two + NUMBERS):
                    gram[a, b] += _product(rows[a], rows[b], here)
    work.cost[place] = total
    return total


class ToneWindows(NamedTuple):
    """ToneWindows of one length, and the tones that are fitted in each."""

    #: First sample of each window, shape (R,).
    first: IndexArray
    #: Number of tones in each window, shape (R,).
    used: IndexArray
    #: Numbers of the tones, shape (R, n, 5).
    numbers: Array
    #: Variances of the numbers in units of the noise: the diagonal of the inverse normal matrix, shape (R, n, 5).
    variances: Array
    #: Whether the iteration ended at a minimum, shape (R,).
    converged: BoolArray


@njit(cache=True, nogil=True)
def _solve_scaled(factor: Array, scales: Array, right: Array, step: Array) -> None:
    """Solve the scaled normal equations whose factor is known."""
    for a in range(scales.size):
        step[a] = right[a] / scales[a]
    substitute(factor, step[: scales.size])
    for a in range(scales.size):
        step[a] /= scales[a]


@njit(cache=True, nogil=True)
def _pack(work: ToneWork, tones: int, free: int) -> None:
    """Choose the equations of the first numbers of each tone, and of the constant."""
    size, place = free * tones + 1, work.now[0]
    right = work.vectors[0]
    for a in range(size):
        from_a = NUMBERS * (a // free) + a % free if a < size - 1 else NUMBERS * tones
        right[a] = work.right[place, from_a]
        for b in range(a + 1):
            from_b = NUMBERS * (b // free) + b % free if b < size - 1 else NUMBERS * tones
            work.packed[a, b] = work.gram[place, from_a, from_b]


@njit(cache=True, nogil=True)
def _iterate(y: Array, tones: Array, constant: float, free: int, most: int, work: ToneWork) -> tuple[float, bool]:
    """Levenberg-Marquardt steps; the constant and whether they ended at a minimum. ``tones`` is changed in place.

    The equations of the first numbers are known, and those of the last ones are when it is done.
    """
    n = tones.shape[0]
    size = free * n + 1
    right, step, scales = work.vectors[0], work.vectors[1], work.vectors[2, :size]
    trial = np.empty_like(tones)
    damping = DAMPING
    for _ in range(most):
        _pack(work, n, free)
        cost = work.cost[work.now[0]]
        while True:
            if damping > MOST_DAMPING:
                return constant, True
            if factorise(work.packed, damping, work.factor, scales):
                _solve_scaled(work.factor, scales, right, step)
                largest, turned = 0.0, 0.0
                for k in range(n):
                    for j in range(NUMBERS):
                        trial[k, j] = tones[k, j] + (step[free * k + j] if j < free else 0.0)
                    trial[k, 2] = min(max(trial[k, 2], -MOST_GROWTH), MOST_GROWTH)
                    trial[k, 4] = min(max(trial[k, 4], -MOST_BEND), MOST_BEND)
                    height = math.hypot(tones[k, 0], tones[k, 1]) + 1e-300
                    for j in range(free):
                        moved = abs(trial[k, j] - tones[k, j])
                        largest = max(largest, moved / height if j < 2 else moved)
                        turned = max(turned, 0.0 if j < 2 else moved)
                level = constant + step[size - 1]
                gain = 0.0
                for a in range(size):
                    gain += step[a] * right[a]
                # So small a share of the standard errors matters to nobody, nor does rounding.
                if gain <= SMALL * cost / work.packed[size - 1, size - 1] or largest <= SMALLEST:
                    return constant, True
                # A longer step may land on any of the minima. Nearly every step is taken: its equations are the next.
                if turned < MOST_TURNED and make_equations(y, trial, level, work, 1 - work.now[0]) <= cost:
                    for k in range(n):
                        for j in range(NUMBERS):
                            tones[k, j] = trial[k, j]
                    constant = level
                    work.now[0] = 1 - work.now[0]
                    damping = max(damping * LOWERED, 1e-12)
                    break
            damping *= RAISED
    return constant, False


@njit(cache=True, nogil=True)
def fit_windows(samples: Array, length: int, windows: ToneWindows, chosen: IndexArray, residuals: Array) -> None:
    """Fit the tones of some windows, beginning with the numbers that they have; what is left goes to ``residuals``."""
    work = work_for(windows.numbers.shape[1], length)
    for row in chosen:
        y = samples[windows.first[row] : windows.first[row] + length]
        n = windows.used[row]
        tones = windows.numbers[row, :n]
        constant = 0.0
        there = 0
        for value in y:
            if not math.isnan(value):
                constant += value
                there += 1
        constant = constant / there if there else 0.0
        if there <= NUMBERS * n + 1:
            windows.converged[row] = False
            residuals[row] = np.nan
            continue
        make_equations(y, tones, constant, work, work.now[0])
        for free, most in STAGES:
            constant, windows.converged[row] = _iterate(y, tones, constant, free, most, work)
        for i in range(length):
            residuals[row, i] = np.nan if math.isnan(y[i]) else work.left[work.now[0], i]
        _pack(work, n, NUMBERS)
        _variances(work, NUMBERS * n + 1, windows.variances[row])


@njit(cache=True, nogil=True)
def _variances(work: ToneWork, size: int, variances: Array) -> None:
    """Diagonal of the inverse of the equations: squares of the columns of the inverse of their factor."""
    scales, column = work.vectors[2, :size], work.vectors[1]
    known = factorise(work.packed, RIDGE, work.factor, scales)
    for a in range(size - 1):
        total = 0.0
        for i in range(a, size if known else a):
            value = 1.0 if i == a else 0.0
            for k in range(a, i):
                value -= work.factor[i, k] * column[k]
            column[i] = value / work.factor[i, i]
            total += column[i] * column[i]
        variances[a // NUMBERS, a % NUMBERS] = total / (scales[a] * scales[a]) if known else np.nan
