"""Partial fractions of a sum of submodels: psi and phi as maps of the rows of the compiled pass."""

from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray, IntArray
from ctid_cli.filtering.filter_data import plain_array
from ctid_cli.filtering.partial_fractions import MODAL_CONDITION_LIMIT, add_mode, modal_condition, pole_slopes
from ctid_cli.filtering.realisation import horner, scaled_roots


@njit(cache=True, nogil=True)
def _taylor_of_reciprocal(a: Array, count: int) -> Array:
    """Leading Taylor coefficients of 1/A, ``A = 1 + a[0] p + a[1] p^2 + …``."""
    series = np.zeros(max(count, 1))
    series[0] = 1.0
    for q in range(1, count):
        total = 0.0
        for k in range(1, min(q, a.size) + 1):
            total -= a[k - 1] * series[q - k]
        series[q] = total
    return series


@njit(cache=True, nogil=True)
def _product(left: Array, right: Array, count: int) -> Array:
    """Leading coefficients of a product of power series."""
    series = np.zeros(max(count, 1))
    for q in range(count):
        total = 0.0
        for k in range(min(q + 1, left.size)):
            if q - k < right.size:
                total += left[k] * right[q - k]
        series[q] = total
    return series


class RowLayout(NamedTuple):
    """Places of the rows of the compiled pass.

    They are ``z, w, integrals of v, v, y - x, e``, and in closed loop ``z_u, integrals of u, u``; the first of each.
    psi is made of those before y - x, so that only the products of the rows up to it with all are summed.
    """

    #: Rows of z, as many as of w, e and z_u: one for a real pole, two for a pair.
    modes: int
    #: Integrals of the input, 1/p … 1/p^l.
    integrals: int
    value: int
    error: int
    #: In open loop v is u, and these are its rows.
    u_modes: int
    u_integrals: int
    u_value: int
    width: int


class PooledModes(NamedTuple):
    """Partial fractions of all submodels, and the rows of psi and phi as maps of the rows of the pass."""

    #: Amplification of rounding [-].
    condition: float
    #: Poles of all submodels, one of each pair [rad/s].
    poles: ComplexArray
    #: Submodel of each mode.
    owner: IntArray
    #: Residues of the model output.
    residues: ComplexArray
    #: Weights of the integrals of the input in the model output.
    origin: Array
    #: Submodel that integrates.
    origin_owner: int
    #: Direct feed-through, and the submodel that has it.
    direct: float
    direct_owner: int
    layout: RowLayout
    #: psi, phi and the model output driven by z, stacked, from the rows of the pass, shape (2 p + 1, q).
    maps: Array


class _Part(NamedTuple):
    """One submodel ``B/(p^l A)``: coefficients in rising powers, A without its 1, and their places in theta."""

    a: Array
    b: Array
    #: Coefficient of the highest power of A.
    highest: float
    integrators: int
    #: First rows of psi, and by how much those of phi lie below them.
    first_a: int
    first_b: int
    phi: int


@njit(cache=True, nogil=True)
def _row_layout(degrees: IntArray, closed: bool) -> RowLayout:
    n, integrals = degrees[:, 0].sum(), degrees[:, 2].sum()
    error = 2 * n + integrals + 1
    # In open loop the rows of z and w are those of the measured input too, and what follows them is shared.
    u_modes = error + 1 + n if closed else 0
    u_integrals = u_modes + (n if closed else 2 * n)
    u_value = u_integrals + integrals
    width = max(error + n, u_value) + 1
    return RowLayout(n, integrals, error - 1, error, u_modes, u_integrals, u_value, width)


@njit(cache=True, nogil=True, error_model="numpy")
def _map_pole(part: _Part, pole: complex, slope: complex, curvature: complex, row: int, modes: PooledModes) -> complex:
    """Write the partial fractions of a submodel at one of its poles; returns the residue of the model output.

    ``slope`` is A' and ``curvature`` A''/A' there; ``row`` is the row of the mode among those of z.
    """
    layout, maps, phi = modes.layout, modes.maps, part.phi
    own, zeros = part.a.size, part.b.size - 1
    paired = pole.imag > 0.0
    squared = slope * slope
    numerator, numerator_slope = horner(part.b[::-1], pole)
    reciprocal = 1.0 / pole**part.integrators
    add_mode(maps, 2 * phi, row, paired, numerator * reciprocal / slope)
    power = reciprocal  # p^(k - l)
    for k in range(max(own, zeros) + 1):
        if 1 <= k <= own:
            # psi_a = -p^k B/(p^l A^2) v, a double pole: -f/A'^2 of w and -(f' - f A''/A')/A'^2 of z, f = p^(k-l) B.
            a_row = part.first_a + k - 1
            f = power * numerator
            f_slope = power * (numerator_slope + (k - part.integrators) * numerator / pole)
            add_mode(maps, a_row, layout.modes + row, paired, -f / squared)
            add_mode(maps, a_row, row, paired, -(f_slope - f * curvature) / squared)
            # phi_a = -p^k/A of what the others leave of the output.
            add_mode(maps, phi + a_row, layout.error + 1 + row, paired, -(power / reciprocal / slope))
        if k <= zeros:
            # psi_b and phi_b = p^k/(p^l A) of v and of u.
            add_mode(maps, part.first_b + k, row, paired, power / slope)
            add_mode(maps, phi + part.first_b + k, layout.u_modes + row, paired, power / slope)
        power *= pole
    return numerator * reciprocal / slope * (2.0 if paired else 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _map_origin(part: _Part, modes: PooledModes) -> None:
    """Write the partial fractions at the origin: Taylor coefficients of ``1/A``, ``B/A`` and ``B/A^2`` there."""
    layout, maps, phi, integrators = modes.layout, modes.maps, part.phi, part.integrators
    single = _taylor_of_reciprocal(part.a, integrators)
    model = _product(part.b, single, integrators)
    sensitivity = _product(model, single, integrators)
    for order in range(integrators):  # the weight of 1/p^(order + 1)
        column = 2 * layout.modes + order
        modes.origin[order] = model[integrators - 1 - order]
        maps[2 * phi, column] += modes.origin[order]
        for k in range(integrators - order):
            if 1 <= k <= part.a.size:
                maps[part.first_a + k - 1, column] -= sensitivity[integrators - 1 - order - k]
            if k < part.b.size:
                maps[part.first_b + k, column] += single[integrators - 1 - order - k]
                maps[phi + part.first_b + k, layout.u_integrals + order] += single[integrators - 1 - order - k]


@njit(cache=True, nogil=True, error_model="numpy")
def _map_direct(part: _Part, direct: float, first: int, last: int, modes: PooledModes) -> None:
    """Write what acts without a pole: the feed-through, and the direct part that p^n/A always has.

    The modes of the submodel have the rows ``first … last - 1`` among those of z.
    """
    layout, maps, phi = modes.layout, modes.maps, part.phi
    own, zeros = part.a.size, part.b.size - 1
    biproper = zeros == own + part.integrators
    if biproper:
        maps[2 * phi, layout.value] += direct
        maps[part.first_b + zeros, layout.value] += 1.0 / part.highest
        maps[phi + part.first_b + zeros, layout.u_value] += 1.0 / part.highest
    if own == 0:
        return
    # What the others leave of the output is the error and the submodel's own output, -1/a_n of it here.
    row = part.first_a + own - 1
    if biproper:
        maps[row, layout.value] -= direct / part.highest
        maps[phi + row, layout.u_value] -= direct / part.highest
    maps[phi + row, layout.error] -= 1.0 / part.highest
    for j in range(first, last):
        maps[phi + row, layout.u_modes + j] -= maps[2 * phi, j] / part.highest
    if part.integrators > 0:
        for order in range(layout.integrals):
            maps[phi + row, layout.u_integrals + order] -= modes.origin[order] / part.highest


@njit(cache=True, nogil=True, error_model="numpy")
def pooled_modes(theta: Array, degrees: IntArray, closed: bool) -> PooledModes:
    """Partial fractions of all submodels; ``degrees`` holds poles, zeros and integrators of each."""
    layout = _row_layout(degrees, closed)
    n = layout.modes
    poles, residues, owner = np.zeros(n, np.complex128), np.zeros(n, np.complex128), np.zeros(n, np.int64)
    origin, origin_owner, direct, direct_owner, condition = np.zeros(layout.integrals), 0, 0.0, 0, 1.0
    maps = np.zeros((2 * theta.size + 1, layout.width))
    # The arrays are filled in place; the numbers behind them follow at the end.
    modes = PooledModes(1.0, poles, owner, residues, origin, 0, 0.0, 0, layout, maps)
    mode, row, offset = 0, 0, 0
    for i in range(degrees.shape[0]):
        own, zeros, integrators = degrees[i, 0], degrees[i, 1], degrees[i, 2]
        first_b = offset + own
        a, b = theta[offset:first_b], theta[first_b : first_b + zeros + 1]
        highest = a[own - 1] if own > 0 else 1.0
        if highest == 0.0:
            condition = np.inf  # theta has lost a pole
            break
        part = _Part(a, b, highest, integrators, offset, first_b, theta.size)
        # The same denominator monic and in falling powers, p^n first.
        monic = np.ones(own + 1)
        for k in range(own):
            monic[k + 1] = (a[own - 2 - k] if k < own - 1 else 1.0) / highest
        w0, scaled = scaled_roots(monic)
        roots = scaled * w0
        simple, slopes, curvatures = pole_slopes(roots)
        if not simple:
            condition = np.inf
            break
        if own > 1:
            condition = max(condition, modal_condition(roots, slopes, curvatures))
        # One pole of each pair; psi, phi and x at it, then at the origin, then what acts without a pole.
        first_row = row
        for j in range(own):
            if roots[j].imag < 0.0:
                continue
            poles[mode], owner[mode] = roots[j], i
            residues[mode] = _map_pole(part, roots[j], slopes[j] * highest, curvatures[j], row, modes)
            row += 2 if roots[j].imag > 0.0 else 1
            mode += 1
        if integrators > 0:
            origin_owner = i
            _map_origin(part, modes)
        own_direct = 0.0
        if zeros == own + integrators:
            own_direct = b[zeros] / highest
            direct, direct_owner = own_direct, i
        _map_direct(part, own_direct, first_row, row, modes)
        offset = first_b + zeros + 1
    poles, owner, residues = poles[:mode].copy(), owner[:mode].copy(), residues[:mode].copy()
    return PooledModes(condition, poles, owner, residues, origin, origin_owner, direct, direct_owner, layout, maps)


def simple_modes(theta: Array, degrees: IntArray) -> PooledModes | None:
    """Partial fractions where they are well conditioned."""
    try:
        modes = pooled_modes(plain_array(theta), degrees, False)
    except (ZeroDivisionError, np.linalg.LinAlgError):
        return None
    return modes if modes.condition < MODAL_CONDITION_LIMIT else None
