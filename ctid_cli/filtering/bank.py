r"""Filtered signals of a record and their second moments, exactly, for any clock, hold and delay.

For a monic A of degree n, a numerator B, and a delay tau, the *standard rows* at each used sample are

====================  =====================================================
rows                  signal
====================  =====================================================
``0 … n-1``           ``p^k/A u(t - tau)``, k = 0 … n-1
``n``                 ``u(t - tau)``
``n+1 … 2n``          ``p^k/A x(t)``, ``x = B/A u(t - tau)``
``2n+1 … 3n``         ``p^k/A y``
``3n+1``              ``y - x``, the output error
``3n+2``              ``p x``, the derivative of the output error with respect to tau
====================  =====================================================

Every refined instrumental variable step, cost, gradient and Hessian is a function of their second moments.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.filtering.exponential import held_step, place
from ctid_cli.filtering.filter_data import FilterData, plain_array, split_delay
from ctid_cli.filtering.kernels import irregular_chain_pass, modal_pass, regular_chain_pass
from ctid_cli.filtering.realisation import chain, polynomial_roots, scaled_denominator, time_scale

Form = Literal["auto", "modal", "chain"]

#: Partial fractions are used while they amplify rounding by less than this; beyond, poles count as repeated.
MODAL_CONDITION_LIMIT = 1e4


@njit(cache=True, nogil=True)
def double_chain(a: Array, b: Array) -> tuple[float, Array, Array, Array, Array]:
    """Realise 1/A driven by the input and a second 1/A driven by the output of B/A."""
    n = a.size - 1
    m = b.size - 1
    w0 = time_scale(a)
    single, entry, powers = chain(polynomial_roots(scaled_denominator(a, w0)))
    for k in range(n):
        for i in range(n):
            powers[k, i] *= w0 ** (k - n)
    output = np.zeros(n)
    for i in range(m + 1):
        for j in range(n):
            output[j] += b[i] * powers[m - i, j]
    dynamics = np.zeros((2 * n, 2 * n))
    gain = np.zeros(2 * n)
    place(dynamics, 0, 0, single)
    place(dynamics, n, n, single)
    for i in range(n):
        gain[i] = entry[i]
        for j in range(n):
            dynamics[n + i, j] = entry[i] * output[j]
    return w0, dynamics, gain, powers, output


@njit(cache=True, nogil=True)
def _fill_derivative(a: Array, b: Array, mapping: Array) -> None:
    """Write the row ``p x`` of a map to standard rows from the rows above it."""
    n = a.size - 1
    m = b.size - 1
    last = 3 * n + 2
    for column in range(mapping.shape[1]):
        total = 0.0
        for i in range(m + 1):
            power = m - i + 1
            if power < n:
                total += b[i] * mapping[power, column]
            else:
                total += b[i] * mapping[n, column]
                for k in range(1, n + 1):
                    total -= b[i] * a[k] * mapping[n - k, column]
        mapping[last, column] = total


@njit(cache=True, nogil=True)
def _to_standard(mapping: Array, rows: Array, gram: Array, want_rows: bool) -> Array:
    """Apply the map to internal rows or to their moments."""
    if want_rows:
        return rows @ np.ascontiguousarray(mapping.T)
    return mapping @ gram @ np.ascontiguousarray(mapping.T)


@njit(cache=True, nogil=True)
def _regular_chain(a: Array, b: Array, delay: float, data: FilterData, want_rows: bool) -> Array:
    n = a.size - 1
    interval = data.interval
    w0, dynamics, gain, powers, output = double_chain(a, b)
    transition, from_value, from_change = held_step(dynamics, gain, interval * w0)
    y_transition = transition[:n, :n].copy()
    y_value, y_change = from_value[:n].copy(), from_change[:n].copy()
    shift, fraction = split_delay(delay, interval)
    readout = np.zeros((2 * n, 2 * n + 2))
    if fraction > 0.0:
        part, part_value, part_change = held_step(dynamics, gain, fraction * interval * w0)
        place(readout, 0, 0, part)
        for i in range(2 * n):
            readout[i, 2 * n] = part_value[i]
            readout[i, 2 * n + 1] = part_change[i] * fraction
    else:
        for i in range(2 * n):
            readout[i, i] = 1.0
    q = 3 * n + 3
    mapping = np.zeros((q, q))
    place(mapping, 0, 0, powers @ readout[:n])
    mapping[n, 2 * n] = 1.0
    mapping[n, 2 * n + 1] = fraction
    place(mapping, n + 1, 0, powers @ readout[n:])
    place(mapping, 2 * n + 1, 2 * n + 2, powers)
    mapping[3 * n + 1, 3 * n + 2] = 1.0
    _fill_derivative(a, b, mapping)
    count = np.count_nonzero(data.use)
    rows = np.zeros((count if want_rows else 0, q))
    gram = np.zeros((0 if want_rows else q, 0 if want_rows else q))
    regular_chain_pass(
        transition,
        from_value,
        from_change,
        output @ readout[:n],
        data.u,
        data.input_foh,
        shift,
        y_transition,
        y_value,
        y_change,
        data.y,
        data.y_foh,
        data.use,
        np.zeros(0),
        rows,
        gram,
    )
    return _to_standard(mapping, rows, gram, want_rows)


@njit(cache=True, nogil=True)
def _evaluate(coefficients: Array, point: complex) -> tuple[complex, complex, complex]:
    """Value and first two derivatives of a polynomial."""
    value, first, second = 0.0j, 0.0j, 0.0j
    for k in range(coefficients.size):
        second = second * point + 2.0 * first
        first = first * point + value
        value = value * point + coefficients[k]
    return value, first, second


@njit(cache=True, nogil=True)
def modal_condition(roots: ComplexArray, slopes: ComplexArray, curvatures: ComplexArray) -> float:
    """How much the partial fractions of ``p^k/A^2`` amplify rounding, against the peak gain of each."""
    n = roots.size
    worst = 0.0
    for k in range(n):
        peak, spread = 0.0, 0.0
        for at in range(n + 1):
            s = 1j * (abs(roots[at - 1]) if at > 0 else 0.0)
            exact, total = 1.0, 0.0
            for i in range(n):
                distance = s - roots[i]
                exact /= abs(distance) ** 2
                power = roots[i] ** k
                lower = k * roots[i] ** (k - 1) if k > 0 else 0.0j
                square = slopes[i] * slopes[i]
                total += abs(power / (square * distance * distance))
                total += abs((lower - power * curvatures[i]) / (square * distance))
            peak = max(peak, exact * abs(s) ** k if k > 0 else exact)
            spread = max(spread, total)
        if not peak > 0.0:
            return np.inf
        worst = max(worst, spread / peak)
    return worst


@njit(cache=True, nogil=True)
def modal_map(a: Array, b: Array) -> tuple[float, ComplexArray, ComplexArray, Array]:
    """Partial fractions of the standard rows."""
    n = a.size - 1
    w0 = time_scale(a)
    roots = polynomial_roots(scaled_denominator(a, w0)) * w0
    modes = 0
    for i in range(n):
        if roots[i].imag >= 0.0:
            modes += 1
    poles = np.zeros(modes, np.complex128)
    residues = np.zeros(modes, np.complex128)
    mapping = np.zeros((3 * n + 3, 3 * n + 2))
    place, mode = 0, 0
    slopes, curvatures = np.zeros(n, np.complex128), np.zeros(n, np.complex128)
    for i in range(n):
        pole = roots[i]
        if pole.imag < 0.0:
            continue
        paired = pole.imag > 0.0
        weight = 2.0 if paired else 1.0
        slope = 1.0 + 0.0j  # A'(pole), as a product: exact where the polynomial form would cancel
        curvature = 0.0j  # A''/A' = 2 sum 1/(pole - other)
        for j in range(n):
            if j != i:
                slope *= pole - roots[j]
                if roots[j] != pole:
                    curvature += 2.0 / (pole - roots[j])
        if slope * slope == 0.0 or pole == 0.0:
            return np.inf, poles, residues, mapping
        slopes[i], curvatures[i] = slope, curvature
        if paired:
            slopes[i + 1], curvatures[i + 1] = np.conj(slope), np.conj(curvature)
        poles[mode] = pole
        value, first, _ = _evaluate(b, pole)
        residues[mode] = weight * value / slope
        power, power_slope = 1.0 + 0.0j, 0.0j
        for k in range(n):
            single = weight * power / slope
            numerator = power * value
            numerator_slope = power_slope * value + power * first
            double = weight * numerator / (slope * slope)
            mixed = weight * (numerator_slope - numerator * curvature) / (slope * slope)
            mapping[k, place] = single.real
            mapping[2 * n + 1 + k, 2 * n + 1 + place] = single.real
            mapping[n + 1 + k, place] = mixed.real
            mapping[n + 1 + k, n + place] = double.real
            if paired:
                mapping[k, place + 1] = -single.imag
                mapping[2 * n + 1 + k, 2 * n + 2 + place] = -single.imag
                mapping[n + 1 + k, place + 1] = -mixed.imag
                mapping[n + 1 + k, n + place + 1] = -double.imag
            power_slope = power_slope * pole + power
            power *= pole
        place += 2 if paired else 1
        mode += 1
    mapping[n, 2 * n] = 1.0
    mapping[3 * n + 1, 3 * n + 1] = 1.0
    _fill_derivative(a, b, mapping)
    return modal_condition(roots, slopes, curvatures), poles, residues, mapping


@njit(cache=True, nogil=True)
def _modal(
    poles: ComplexArray,
    residues: ComplexArray,
    mapping: Array,
    delay: float,
    data: FilterData,
    want_rows: bool,
) -> Array:
    q = mapping.shape[1]
    rows = np.zeros((np.count_nonzero(data.use) if want_rows else 0, q))
    gram = np.zeros((0 if want_rows else q, 0 if want_rows else q))
    shift, fraction = 0, 0.0
    if data.interval > 0.0:
        shift, fraction = split_delay(delay, data.interval)
    modal_pass(
        poles,
        residues,
        data.interval,
        shift,
        fraction,
        data.tu,
        data.u,
        data.input_foh,
        delay,
        data.t,
        data.y,
        data.y_foh,
        data.common_clock,
        data.use,
        np.zeros(0),
        rows,
        gram,
    )
    return _to_standard(mapping, rows, gram, want_rows)


@njit(cache=True, nogil=True)
def _irregular_chain(a: Array, b: Array, delay: float, data: FilterData, want_rows: bool) -> Array:
    n = a.size - 1
    w0, dynamics, gain, powers, output = double_chain(a, b)
    q = 3 * n + 2
    mapping = np.zeros((3 * n + 3, q))
    place(mapping, 0, 0, powers)
    mapping[n, 2 * n] = 1.0
    place(mapping, n + 1, n, powers)
    place(mapping, 2 * n + 1, 2 * n + 1, powers)
    mapping[3 * n + 1, 3 * n + 1] = 1.0
    _fill_derivative(a, b, mapping)
    rows = np.zeros((np.count_nonzero(data.use) if want_rows else 0, q))
    gram = np.zeros((0 if want_rows else q, 0 if want_rows else q))
    output_map = np.zeros(2 * n)
    for i in range(n):
        output_map[i] = output[i]
    irregular_chain_pass(
        dynamics,
        gain,
        output_map,
        data.tu * w0,
        data.u,
        data.input_foh,
        delay * w0,
        dynamics[:n, :n].copy(),
        gain[:n].copy(),
        data.t * w0,
        data.y,
        data.y_foh,
        data.use,
        np.zeros(0),
        rows,
        gram,
    )
    return _to_standard(mapping, rows, gram, want_rows)


@njit(cache=True, nogil=True)
def standard_moments(
    a: Array,
    b: Array,
    delay: float,
    data: FilterData,
    want_rows: bool,
    limit: float,
) -> Array:
    """Second moments of the standard rows, or the rows: one compiled entry, so that a call costs one crossing."""
    condition, poles, residues, mapping = modal_map(a, b)
    if condition < limit:
        return _modal(poles, residues, mapping, delay, data, want_rows)
    if data.interval > 0.0:
        return _regular_chain(a, b, delay, data, want_rows)
    return _irregular_chain(a, b, delay, data, want_rows)


def _run(data: FilterData, a: Array, b: Array, delay: float, want_rows: bool, form: Form) -> Array:
    limit = {"chain": 0.0, "modal": np.inf, "auto": MODAL_CONDITION_LIMIT}[form]
    moments: Array = standard_moments(plain_array(a), plain_array(b), float(delay), data, want_rows, limit)
    return moments


def second_moments(data: FilterData, a: Array, b: Array, delay: float = 0.0, form: Form = "auto") -> Array:
    """Sums of products of the standard rows over the used samples."""
    return _run(data, a, b, delay, False, form)


def standard_rows(data: FilterData, a: Array, b: Array, delay: float = 0.0, form: Form = "auto") -> Array:
    """The standard rows themselves."""
    return _run(data, a, b, delay, True, form)
