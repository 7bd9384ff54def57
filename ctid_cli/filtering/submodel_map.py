"""Partial fractions of a sum of submodels: psi and phi as maps of the rows of the compiled pass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray, IntArray
from ctid_cli.filtering.filter_data import plain_array
from ctid_cli.filtering.partial_fractions import MODAL_CONDITION_LIMIT, modal_condition
from ctid_cli.filtering.realisation import polynomial_roots, scaled_denominator, time_scale


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


@njit(cache=True, nogil=True)
def _add_mode(mapping: Array, row: int, column: int, paired: bool, weight: complex) -> None:
    """Add ``Re(weight z)`` of a mode, twice for a pair, to a row of a map."""
    if paired:
        mapping[row, column] += 2.0 * weight.real
        mapping[row, column + 1] -= 2.0 * weight.imag
    else:
        mapping[row, column] += weight.real


@njit(cache=True, nogil=True, error_model="numpy")
def pooled_modes(
    theta: Array, degrees: IntArray, closed: bool
) -> tuple[float, ComplexArray, IntArray, ComplexArray, Array, int, float, int, Array, Array, Array]:
    """Partial fractions of all submodels, and the rows of psi and phi as maps of the rows of the pass."""
    submodels = degrees.shape[0]
    n, order_at_origin, origin_owner, direct_owner = 0, 0, 0, 0
    for i in range(submodels):
        n += degrees[i, 0]
        if degrees[i, 2] > 0:
            order_at_origin = degrees[i, 2]
            origin_owner = i
    value = 2 * n + order_at_origin
    error = 3 * n + order_at_origin + 1
    extra = error + 1
    q = extra + (n + order_at_origin + 1 if closed else 0)
    u_modes = extra if closed else 0
    u_integrals = extra + n if closed else 2 * n
    u_value = extra + n + order_at_origin if closed else value
    poles, residues = np.zeros(n, np.complex128), np.zeros(n, np.complex128)
    owner = np.zeros(n, np.int64)
    origin = np.zeros(order_at_origin)
    direct, condition = 0.0, 1.0
    instruments, regressors, output = np.zeros((theta.size, q)), np.zeros((theta.size, q)), np.zeros((1, q))
    mode, place, offset = 0, 0, 0
    for i in range(submodels):
        own, zeros, poles_at_origin = degrees[i, 0], degrees[i, 1], degrees[i, 2]
        a = theta[offset : offset + own]
        b = theta[offset + own : offset + own + zeros + 1]
        first_b = offset + own
        highest = a[own - 1] if own > 0 else 1.0
        if highest == 0.0:
            condition = np.inf
            break
        monic = np.ones(own + 1)
        for k in range(own):
            monic[k + 1] = (a[own - 2 - k] if k < own - 1 else 1.0) / highest
        w0 = time_scale(monic)
        roots = polynomial_roots(scaled_denominator(monic, w0)) * w0
        slopes, curvatures = np.zeros(own, np.complex128), np.zeros(own, np.complex128)
        for j in range(own):
            slope, curvature = complex(1.0, 0.0), complex(0.0, 0.0)
            for m in range(own):
                if m != j:
                    slope *= roots[j] - roots[m]
                    if roots[m] != roots[j]:
                        curvature += 2.0 / (roots[j] - roots[m])
            slopes[j], curvatures[j] = slope, curvature
            if slope == 0.0 or roots[j] == 0.0:
                condition = np.inf
        if not condition < np.inf:
            break
        if own > 1:
            condition = max(condition, modal_condition(roots, slopes, curvatures))
        phi_from = place  # the first row of this submodel's modes
        # The partial fractions at the poles of A.
        for j in range(own):
            pole = roots[j]
            if pole.imag < 0.0:
                continue
            paired = pole.imag > 0.0
            slope = slopes[j] * highest
            squared = slope * slope
            numerator, numerator_slope = complex(0.0, 0.0), complex(0.0, 0.0)
            for k in range(zeros, -1, -1):
                numerator_slope = numerator_slope * pole + numerator
                numerator = numerator * pole + b[k]
            reciprocal = 1.0 / pole**poles_at_origin
            poles[mode], owner[mode] = pole, i
            residues[mode] = numerator * reciprocal / slope * (2.0 if paired else 1.0)
            _add_mode(output, 0, place, paired, numerator * reciprocal / slope)
            power = reciprocal  # p^(k - l)
            for k in range(max(own, zeros) + 1):
                if 1 <= k <= own:
                    f = power * numerator
                    f_slope = power * (numerator_slope + (k - poles_at_origin) * numerator / pole)
                    _add_mode(instruments, offset + k - 1, n + place, paired, -f / squared)
                    _add_mode(instruments, offset + k - 1, place, paired, -(f_slope - f * curvatures[j]) / squared)
                    weight = power / reciprocal / slope
                    _add_mode(regressors, offset + k - 1, value + 1 + place, paired, -weight)
                if k <= zeros:
                    _add_mode(instruments, first_b + k, place, paired, power / slope)
                    _add_mode(regressors, first_b + k, u_modes + place, paired, power / slope)
                power *= pole
            place += 2 if paired else 1
            mode += 1
        # The pole at the origin.
        if poles_at_origin > 0:
            single = _taylor_of_reciprocal(a, order_at_origin)
            model = _product(b, single, order_at_origin)
            sensitivity = _product(model, single, order_at_origin)
            for order in range(order_at_origin):  # the weight of 1/p^(order + 1)
                origin[order] = model[order_at_origin - 1 - order]
                output[0, 2 * n + order] += origin[order]
                for k in range(order_at_origin - order):
                    if 1 <= k <= own:
                        instruments[offset + k - 1, 2 * n + order] -= sensitivity[order_at_origin - 1 - order - k]
                    if k <= zeros:
                        instruments[first_b + k, 2 * n + order] += single[order_at_origin - 1 - order - k]
                        regressors[first_b + k, u_integrals + order] += single[order_at_origin - 1 - order - k]
        # Direct feed-through.
        if zeros == own + poles_at_origin:
            direct, direct_owner = b[zeros] / highest, i
            output[0, value] += direct
            instruments[first_b + zeros, value] += 1.0 / highest
            regressors[first_b + zeros, u_value] += 1.0 / highest
            if own > 0:
                instruments[offset + own - 1, value] -= direct / highest
        # p^n/A has a direct part always: what the other submodels leave of the output itself.
        if own > 0:
            row = offset + own - 1
            regressors[row, error] -= 1.0 / highest
            for j in range(place - phi_from):
                regressors[row, u_modes + phi_from + j] -= output[0, phi_from + j] / highest
            if poles_at_origin > 0:
                for order in range(order_at_origin):
                    regressors[row, u_integrals + order] -= origin[order] / highest
            if zeros == own + poles_at_origin:
                regressors[row, u_value] -= direct / highest
        offset = first_b + zeros + 1
    return (
        condition,
        poles[:mode].copy(),
        owner[:mode].copy(),
        residues[:mode].copy(),
        origin,
        origin_owner,
        direct,
        direct_owner,
        instruments,
        regressors,
        output[0].copy(),
    )


class PooledModes(NamedTuple):
    """Partial fractions of all submodels, see :func:`pooled_modes`."""

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
    #: Direct feed-through.
    direct: float
    #: Submodel with direct feed-through.
    direct_owner: int
    #: psi from the rows of the pass, shape (p, q).
    instruments: Array
    #: phi from the rows of the pass, shape (p, q).
    regressors: Array
    #: Model output driven by z from the rows of the pass, shape (q,).
    output: Array


def simple_modes(theta: Array, degrees: IntArray, closed: bool) -> PooledModes | None:
    """Partial fractions where they are well conditioned."""
    try:
        modes = PooledModes(*pooled_modes(plain_array(theta), degrees, closed))
    except (ZeroDivisionError, np.linalg.LinAlgError):
        return None
    return modes if modes.condition < MODAL_CONDITION_LIMIT else None
