"""State-space realisations that stay accurate for stiff and for repeated poles.

A polynomial A of degree n is realised as a *chain* of first-order (real pole) and second-order (complex pair)
sections of unit static gain, fastest first. No partial fractions are formed, so repeated poles are no special case,
and because a slow section only ever integrates what a faster one has settled, no cancellation grows with the spread
of the poles. Everything runs in the polynomial's own time unit ``1/w0``, ``w0 = |a_n|^(1/n)``.
"""

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, BoolArray, ComplexArray

#: Roots whose distance is a smaller fraction of their magnitudes together count as close to each other.
APART = 0.2


@njit(cache=True, nogil=True)
def time_scale(denominator: Array) -> float:
    """Characteristic frequency of a monic polynomial."""
    order = denominator.size - 1
    for k in range(order, 0, -1):
        if denominator[k] != 0.0:
            return float(abs(denominator[k]) ** (1.0 / k))
    return 1.0


@njit(cache=True, nogil=True)
def scaled_roots(denominator: Array) -> tuple[float, ComplexArray]:
    """Characteristic frequency w0 of a monic polynomial, and its roots in the time unit 1/w0, see the next function."""
    w0 = time_scale(denominator)
    scaled = np.empty(denominator.size)
    for k in range(denominator.size):
        scaled[k] = denominator[k] / w0**k
    return w0, polynomial_roots(scaled)


@njit(cache=True, nogil=True, forceinline=True)
def horner(coefficients: Array, point: complex) -> tuple[complex, complex]:
    """Value and derivative of a polynomial."""
    value, slope = 0.0j, 0.0j
    for k in range(coefficients.size):
        slope = slope * point + value
        value = value * point + coefficients[k]
    return value, slope


@njit(cache=True, nogil=True)
def polynomial_roots(coefficients: Array) -> ComplexArray:
    """Roots of a monic real polynomial, fastest first and conjugates side by side."""
    n = coefficients.size - 1
    roots = np.zeros(n, np.complex128)
    if n == 1:
        roots[0] = -coefficients[1]
        return roots
    if n == 2:
        half = -0.5 * coefficients[1]
        discriminant = half * half - coefficients[2]
        if discriminant < 0.0:
            roots[0] = complex(half, np.sqrt(-discriminant))
            roots[1] = complex(half, -np.sqrt(-discriminant))
        else:
            large = half - np.sqrt(discriminant) if half < 0.0 else half + np.sqrt(discriminant)
            roots[0] = large
            roots[1] = coefficients[2] / large if large != 0.0 else 0.0
        return roots
    raw = np.empty(n, np.complex128)
    if not _simultaneous_roots(coefficients, raw):
        companion = np.zeros((n, n), np.complex128)
        for k in range(n):
            companion[0, k] = -coefficients[k + 1]
        for k in range(1, n):
            companion[k, k - 1] = 1.0
        raw = np.linalg.eigvals(companion)  # type: ignore[assignment]  # numba declares it wider than it is
    # Newton steps against the rounding of the eigenvalue solver, which is relative to the *largest* root. Only where
    # the step is small against the distance to the next root: the members of a cluster are wrong each by itself and
    # right together, and must not be moved one by one.
    for i in range(n):
        gap = np.inf
        for j in range(n):
            if j != i:
                gap = min(gap, abs(raw[j] - raw[i]))
        for _ in range(3):
            value, slope = complex(1.0, 0.0), complex(0.0, 0.0)
            for k in range(1, n + 1):
                slope = slope * raw[i] + value
                value = value * raw[i] + coefficients[k]
            if not abs(value) < 1e-3 * gap * abs(slope):
                break
            raw[i] -= value / slope
    return _pair_conjugates(raw)


@njit(cache=True, nogil=True)
def _simultaneous_roots(coefficients: Array, roots: ComplexArray) -> bool:
    """Roots by the Aberth-Ehrlich iteration, several times faster than eigenvalues; whether all are found and simple.

    From a circle of points it converges cubically to simple roots and slowly to clusters. Roots close to each other are
    left to the eigenvalues, whose errors compensate one another.
    """
    n = roots.size
    radius = 1.0
    for k in range(1, n + 1):
        radius = max(radius, abs(coefficients[k]) ** (1.0 / k))
    for i in range(n):
        # Points without symmetry about the real axis, which conjugate roots could not break.
        roots[i] = radius * np.exp(1j * (2.0 * np.pi * i / n + 0.4))
    for _ in range(40):
        settled = True
        for i in range(n):
            # A and A' by Horner; the step -A/(A' - A sum 1/(root - other)) takes the other roots out of A.
            value, slope = complex(1.0, 0.0), complex(0.0, 0.0)
            for k in range(1, n + 1):
                slope = slope * roots[i] + value
                value = value * roots[i] + coefficients[k]
            if value == 0.0:
                continue
            repulsion = 0.0j
            for j in range(n):
                if j != i:
                    if roots[j] == roots[i]:
                        return False
                    repulsion += 1.0 / (roots[i] - roots[j])
            denominator = slope - value * repulsion
            if denominator == 0.0 or not np.isfinite(denominator.real):
                return False
            change = value / denominator
            roots[i] -= change
            if abs(change) > 1e-14 * abs(roots[i]):
                settled = False
        if settled:
            for i in range(n):
                for j in range(i):
                    if abs(roots[i] - roots[j]) < APART * (abs(roots[i]) + abs(roots[j])):
                        return False
            return True
    return False


@njit(cache=True, nogil=True)
def _pair_conjugates(raw: ComplexArray) -> ComplexArray:
    """Exact conjugate pairs, by falling magnitude, from eigenvalues that are conjugate only up to rounding."""
    n = raw.size
    used = np.zeros(n, np.bool_)
    roots = np.zeros(n, np.complex128)
    count = 0
    while count < n:
        # The largest that is left.
        i = -1
        for k in range(n):
            if not used[k] and (i < 0 or abs(raw[k]) > abs(raw[i])):
                i = k
        used[i] = True
        # A root is real if it is its own nearest conjugate.
        partner, distance = i, 2.0 * abs(raw[i].imag)
        for j in range(n):
            if not used[j]:
                gap = abs(raw[j] - raw[i].conjugate())
                if gap < distance:
                    partner, distance = j, gap
        if partner == i:
            roots[count] = raw[i].real
            count += 1
        else:
            used[partner] = True
            mean = 0.5 * (raw[i] + raw[partner].conjugate())
            roots[count] = complex(mean.real, abs(mean.imag))
            roots[count + 1] = complex(mean.real, -abs(mean.imag))
            count += 2
    return roots


@njit(cache=True, nogil=True)
def chain(roots: ComplexArray) -> tuple[Array, Array, Array]:
    """Chain of unit-gain sections and the map from its states to ``s^k/A``."""
    n = roots.size
    dynamics = np.zeros((n, n))
    gain = np.zeros(n)
    # Static gain of the chain up to and including the section in which a state lies.
    cumulative = np.ones(n)
    paired = np.zeros(n, np.bool_)
    product = 1.0
    previous = -1
    i = 0
    while i < n:
        # A pair w^2/(s^2 + 2 d s + w^2): z1' = w z2, z2' = w v - w z1 - 2 d z2. A real pole r/(s + r): z' = r v - r z.
        # An integrator has no static gain to bring to 1: its rate is 1.
        if roots[i].imag != 0.0:
            natural = abs(roots[i])
            dynamics[i, i + 1] = natural
            dynamics[i + 1, i] = -natural
            dynamics[i + 1, i + 1] = 2.0 * roots[i].real
            entry, size, product = i + 1, 2, product * natural * natural
            rate = natural
            paired[i] = paired[i + 1] = True
        else:
            rate = abs(roots[i]) if roots[i] != 0.0 else 1.0
            dynamics[i, i] = roots[i].real
            entry, size, product = i, 1, product * rate
        if previous < 0:
            gain[entry] = rate
        else:
            dynamics[entry, previous] = rate
        for k in range(i, i + size):
            cumulative[k] = product
        previous = i
        i += size
    powers = np.zeros((n, n))
    for k in range(n):
        polynomial = np.zeros(n)
        polynomial[n - 1 - k] = 1.0
        _expand(polynomial, roots, paired, cumulative, powers[k])
    return dynamics, gain, powers


@njit(cache=True, nogil=True)
def _expand(polynomial: Array, roots: ComplexArray, paired: BoolArray, cumulative: Array, out: Array) -> None:
    """Write ``polynomial/A`` on the states: divide by the slowest section, keep the remainder, go on."""
    n = roots.size
    quotient = polynomial.copy()
    length = n
    i = n - 1
    while i >= 0:
        # Q = q (s^2 + s1 s + s0) + remainder: q goes on to the faster sections, and the remainder is read off this one,
        # whose states are 1/(s^2 + s1 s + s0) and s/(s^2 + s1 s + s0) of what it receives, up to their gains.
        if paired[i]:
            s1 = -2.0 * roots[i].real
            s0 = roots[i].real ** 2 + roots[i].imag ** 2
            for k in range(length - 2):
                quotient[k + 1] -= s1 * quotient[k]
                quotient[k + 2] -= s0 * quotient[k]
            out[i - 1] = quotient[length - 1] / cumulative[i]
            if length >= 2:
                out[i] = quotient[length - 2] * np.sqrt(s0) / cumulative[i]
            length -= 2
            i -= 2
        else:
            pole = roots[i].real
            for k in range(length - 1):
                quotient[k + 1] += pole * quotient[k]
            out[i] = quotient[length - 1] / cumulative[i]
            length -= 1
            i -= 1
