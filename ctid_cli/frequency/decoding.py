r"""From the parameters of the delay regression to frequencies, and how far an error of the one moves the other.

``prod(c - c_i) = c^n + theta_1 c^(n-1) + ... + theta_n`` has the roots ``c_i = cos(w_i h)``, real and within [-1, 1] if
theta belongs to sinusoids at all. Noise can move a pair of roots off the real axis, or a root out of the interval.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array
from ctid_cli.filtering.realisation import polynomial_roots, time_scale
from ctid_cli.frequency.flags import CERTAIN_FRACTION, COMPLEX_ROOTS, OUT_OF_BOUNDS, UNCERTAIN

#: A root must settle within this many Newton steps; simple roots need fewer than ten.
NEWTON_STEPS = 60
#: An estimation younger than so many periods, or beats of neighbours, is less certain than its misfit shows.
FIRST_PERIODS = 2.0
#: Keeps a division from overflowing.
TINY = 1e-30


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
    """Real parts of the roots of any monic polynomial, largest first."""
    n = roots.size
    if real_roots(coefficients, work, roots):
        return True
    if n == 2:
        roots[0] = roots[1] = -0.5 * coefficients[1]
        return False
    # In units of the size of the roots, so that no power of them overflows.
    scale = time_scale(coefficients)
    factor = 1.0
    for k in range(n + 1):
        work[k] = coefficients[k] * factor
        factor /= scale
    raw = polynomial_roots(work)
    roots[:] = np.sort(raw.real * scale)[::-1]
    return bool(np.all(raw.imag == 0.0))


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
