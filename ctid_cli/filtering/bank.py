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

from typing import Literal

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.filtering.chain_pass import irregular_chain_pass, regular_chain_pass
from ctid_cli.filtering.exponential import held_readout, held_step, place
from ctid_cli.filtering.filter_data import FilterData, in_unit, plain_array, split_delay
from ctid_cli.filtering.modal_pass import irregular_modal_pass, regular_modal_pass
from ctid_cli.filtering.partial_fractions import MODAL_CONDITION_LIMIT, add_mode, modal_condition, pole_slopes
from ctid_cli.filtering.realisation import chain, horner, scaled_roots
from ctid_cli.filtering.row_sink import RowSink, row_sink

Form = Literal["auto", "modal", "chain"]


@njit(cache=True, nogil=True)
def _double_chain(a: Array, b: Array) -> tuple[float, Array, Array, Array, Array]:
    """Realise 1/A driven by the input and a second 1/A driven by the output of B/A."""
    n = a.size - 1
    m = b.size - 1
    w0, roots = scaled_roots(a)
    single, entry, powers = chain(roots)
    # p^k/A in seconds, from the chain in the time unit 1/w0.
    for k in range(n):
        for i in range(n):
            powers[k, i] *= w0 ** (k - n)
    # x = B/A u on the states of the first chain, which drives the second: z2' = F z2 + g (output z1).
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
            # p^n/A u = u - sum of a_k p^(n-k)/A u, in terms of the rows below it.
            if power < n:
                total += b[i] * mapping[power, column]
            else:
                total += b[i] * mapping[n, column]
                for k in range(1, n + 1):
                    total -= b[i] * a[k] * mapping[n - k, column]
        mapping[last, column] = total


@njit(cache=True, nogil=True)
def _to_standard(mapping: Array, sink: RowSink, want_rows: bool) -> Array:
    """Apply the map from internal to standard rows to what a pass has left: rows, or their moments."""
    if want_rows:
        return sink.rows @ np.ascontiguousarray(mapping.T)
    return mapping @ sink.gram @ np.ascontiguousarray(mapping.T)


@njit(cache=True, nogil=True)
def _chain_rows(a: Array, b: Array, delay: float, data: FilterData, want_rows: bool) -> Array:
    """Standard rows for any poles, from [z (both chains), u and on a regular clock its change, filtered y, y - x]."""
    n = a.size - 1
    w0, dynamics, gain, powers, output = _double_chain(a, b)
    regular = data.interval > 0.0
    shift, fraction = split_delay(delay, data.interval) if regular else (0, 0.0)
    # On a regular clock the states stand at the break before the instant that arrives now: this reads them out there.
    readout = held_readout(dynamics, gain, data.interval * w0, fraction)
    filtered = 2 * n + (2 if regular else 1)
    mapping = np.zeros((3 * n + 3, filtered + n + 1))
    place(mapping, 0, 0, powers @ readout[:n])
    place(mapping, n + 1, 0, powers @ readout[n:])
    mapping[n, 2 * n] = 1.0
    place(mapping, 2 * n + 1, filtered, powers)
    mapping[3 * n + 1, filtered + n] = 1.0
    sink = row_sink(mapping.shape[1], data.use, want_rows)
    # y - x needs x at the instant read.
    output_map = output @ readout[:n]
    if regular:
        mapping[n, 2 * n + 1] = fraction
        # The states step by whole intervals whatever the delay.
        step = held_step(dynamics, gain, data.interval * w0)
        regular_chain_pass(step, output_map, shift, data, sink)
    else:
        irregular_chain_pass(dynamics, gain, output_map, delay * w0, in_unit(data, w0), sink)
    _fill_derivative(a, b, mapping)
    return _to_standard(mapping, sink, want_rows)


@njit(cache=True, nogil=True)
def modal_map(a: Array, b: Array) -> tuple[float, ComplexArray, ComplexArray, Array]:
    """Partial fractions of the standard rows: their condition, poles, residues of x, and the map from internal rows."""
    n = a.size - 1
    w0, scaled = scaled_roots(a)
    roots = scaled * w0
    modes = 0
    for i in range(n):
        if roots[i].imag >= 0.0:
            modes += 1
    poles, residues = np.zeros(modes, np.complex128), np.zeros(modes, np.complex128)
    mapping = np.zeros((3 * n + 3, 3 * n + 2))
    simple, slopes, curvatures = pole_slopes(roots)
    if not simple:
        return np.inf, poles, residues, mapping
    row, mode = 0, 0  # of the internal rows
    for i in range(n):
        pole, slope = roots[i], slopes[i]
        if pole.imag < 0.0:
            continue
        paired = pole.imag > 0.0
        poles[mode] = pole
        value, first = horner(b, pole)
        residues[mode] = (2.0 if paired else 1.0) * value / slope
        # p^k/A at its pole, and p^k B/A^2, a double pole: with f = p^k B it is f/A'^2 of w and
        # (f' - f A''/A')/A'^2 of z.
        power, power_slope = 1.0 + 0.0j, 0.0j
        for k in range(n):
            numerator = power * value
            numerator_slope = power_slope * value + power * first
            squared = slope * slope
            add_mode(mapping, k, row, paired, power / slope)
            add_mode(mapping, 2 * n + 1 + k, 2 * n + 1 + row, paired, power / slope)
            add_mode(mapping, n + 1 + k, row, paired, (numerator_slope - numerator * curvatures[i]) / squared)
            add_mode(mapping, n + 1 + k, n + row, paired, numerator / squared)
            power_slope = power_slope * pole + power
            power *= pole
        row += 2 if paired else 1
        mode += 1
    mapping[n, 2 * n] = 1.0
    mapping[3 * n + 1, 3 * n + 1] = 1.0
    _fill_derivative(a, b, mapping)
    return modal_condition(roots, slopes, curvatures), poles, residues, mapping


@njit(cache=True, nogil=True)
def standard_moments(a: Array, b: Array, delay: float, data: FilterData, want_rows: bool, limit: float) -> Array:
    """Second moments of the standard rows, or the rows: one compiled entry, so that a call costs one crossing.

    Partial fractions where they amplify rounding by less than the limit, else chains.
    """
    condition, poles, residues, mapping = modal_map(a, b)
    if condition < limit:
        sink = row_sink(mapping.shape[1], data.use, want_rows)
        if data.interval > 0.0:
            regular_modal_pass(poles, residues, delay, data, sink)
        else:
            irregular_modal_pass(poles, residues, delay, data, sink)
        return _to_standard(mapping, sink, want_rows)
    return _chain_rows(a, b, delay, data, want_rows)


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
