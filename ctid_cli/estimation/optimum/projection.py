r"""Variable projection: the squared output error over the denominator and the delay alone.

.. math:: y(t_k) = \frac{B}{A} u(t_k - \tau) + \frac{C}{A}\delta(t_k - t_s) + c + r_k

For given poles and delay B, C and c follow by linear least squares. With Phi their columns and P the projection on
them, Kaufman's Jacobian of the residual is ``-(I - P) dPhi/dalpha c``; since ``r`` is orthogonal to Phi its gradient is
exact.

References
----------
L. Kaufman, "A variable projection method for solving separable nonlinear least squares problems", *BIT* 15 (1975)
49-57. doi:10.1007/BF01932995
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array
from ctid_cli.estimation.optimum.chain import chain_dynamics, driven_chain, logarithmic_slopes
from ctid_cli.estimation.optimum.triangle import ChainState, Delay, place_of, triangle_of
from ctid_cli.filtering.exponential import held_step
from ctid_cli.filtering.filter_data import FilterData

#: Singular values of the scaled columns below this fraction of the largest count as zero.
RANK_TOLERANCE = 1e-11


class Problem(NamedTuple):
    """A record, and what is eliminated with it."""

    data: FilterData
    #: Degree of the numerator.
    zeros: int
    free_response: bool
    offset: bool
    #: Period [s] of a record that repeats for ever, else 0.
    period: float


class Projected(NamedTuple):
    """The least squares for given poles and delay."""

    squared_error: float
    #: Weights of the states, of u itself, of the states of the free response, and the offset.
    output: Array
    direct: float
    free: Array
    offset: float


class Slopes(NamedTuple):
    """Derivatives of half the squared error to the logarithmic coordinates and, last, the delay [1/s]."""

    squared_error: float
    gradient: Array
    #: J'J of Kaufman's Jacobian.
    curvature: Array


@njit(cache=True, nogil=True)
def _readout(dynamics: Array, gain: Array, delay: Delay, data: FilterData) -> Array:
    """Map from ``[z, u, change of u]`` of a triangle to ``[z, u]`` at the instants read, shape (n + 1, n + 2)."""
    n = gain.size
    readout = np.zeros((n + 1, n + 2))
    fraction = place_of(delay, data.interval)[1] if data.interval > 0.0 else 0.0
    part = held_step(dynamics, gain, fraction * data.interval)
    for i in range(n):
        for j in range(n):
            readout[i, j] = part.transition[i, j]
        # v and its change over the *part* of the interval.
        readout[i, n], readout[i, n + 1] = part.from_value[i], part.from_change[i] * fraction
    readout[n, n], readout[n, n + 1] = 1.0, fraction
    return readout


@njit(cache=True, nogil=True)
def _columns(triangle: Array, readout: Array, n: int, problem: Problem) -> Array:
    """The columns Phi in the coordinates of a triangle whose chains begin with the n states."""
    m = problem.zeros
    proper = min(m, n - 1) + 1
    forced = readout.shape[0] - 1
    width = proper + (1 if m == n else 0) + (n if problem.free_response else 0) + (1 if problem.offset else 0)
    columns = np.zeros((triangle.shape[0], width))
    internal = np.ascontiguousarray(triangle[:, : forced + 2])
    for i in range(proper):
        columns[:, i] = internal @ readout[n - proper + i]
    place = proper
    if m == n:
        columns[:, place] = internal @ readout[forced]
        place += 1
    if problem.free_response:
        columns[:, place : place + n] = triangle[:, forced + 2 : forced + 2 + n]
        place += n
    if problem.offset:
        columns[:, place] = triangle[:, -2]
    return columns


@njit(cache=True, nogil=True)
def _factored(columns: Array) -> tuple[Array, Array, Array, Array]:
    """Lengths of the columns and singular values and vectors of what is left when these are taken out."""
    lengths = np.sqrt((columns * columns).sum(axis=0))
    for i in range(lengths.size):
        if not lengths[i] > 0.0:
            lengths[i] = 1.0
    left, values, right = np.linalg.svd(columns / lengths, False)
    rank = 0
    while rank < values.size and values[rank] > RANK_TOLERANCE * values[0]:
        rank += 1
    return lengths, np.ascontiguousarray(left[:, :rank]), values[:rank], np.ascontiguousarray(right[:rank])


@njit(cache=True, nogil=True)
def project(problem: Problem, speed: Array, damping: Array, delay: Delay) -> Projected:
    """Eliminate numerator, free response and offset for given sections, fastest first."""
    F, g = chain_dynamics(speed, damping)
    n = g.size
    nothing = np.zeros(0)
    chain = ChainState(F, g, F, g if problem.free_response else nothing)
    triangle = triangle_of(chain, delay, problem.data, problem.period)
    columns = _columns(triangle, _readout(F, g, delay, problem.data), n, problem)
    lengths, left, values, right = _factored(columns)
    y = np.ascontiguousarray(triangle[:, -1])
    along = left.T @ y
    residual = y - left @ along
    solution = (right.T @ (along / values)) / lengths
    output, free, direct, offset = np.zeros(n), np.zeros(n), 0.0, 0.0
    proper = min(problem.zeros, n - 1) + 1
    output[n - proper :] = solution[:proper]
    place = proper
    if problem.zeros == n:
        direct = solution[place]
        place += 1
    if problem.free_response:
        free[:] = solution[place : place + n]
        place += n
    if problem.offset:
        offset = solution[place]
    return Projected(np.dot(residual, residual), output, direct, free, offset)


@njit(cache=True, nogil=True)
def slopes(
    problem: Problem, speed: Array, damping: Array, delay: Delay, projected: Projected, delay_free: bool
) -> Slopes:
    """Exact gradient, and Kaufman's J'J, at what :func:`project` gave for the same sections and delay."""
    F, g = chain_dynamics(speed, damping)
    n = g.size
    # A second chain driven by x = B/A u: dx/dalpha_j = -(d ln A/d alpha_j) x, up to what Phi spans itself. The free
    # response C/A delta drives one too.
    dynamics, gain = driven_chain(F, g, projected.output, projected.direct)
    free_dynamics, free_start = dynamics, np.zeros(0)
    if problem.free_response:
        free_dynamics, free_start = driven_chain(F, g, projected.free, 0.0)
    chain = ChainState(dynamics, gain, free_dynamics, free_start)
    triangle = triangle_of(chain, delay, problem.data, problem.period)
    readout = _readout(dynamics, gain, delay, problem.data)
    _, left, _, _ = _factored(_columns(triangle, readout, n, problem))
    y = np.ascontiguousarray(triangle[:, -1])
    residual = y - left @ (left.T @ y)
    size = n + 1 if delay_free else n
    psi = np.zeros((triangle.shape[0], size))
    internal = np.ascontiguousarray(triangle[:, : 2 * n + 2])
    driven = internal @ np.ascontiguousarray(readout[n : 2 * n].T)
    if problem.free_response:
        driven += triangle[:, 3 * n + 2 : 4 * n + 2]
    psi[:, :n] = -driven @ np.ascontiguousarray(logarithmic_slopes(speed, damping, F).T)
    if delay_free:
        # dx/dtau = -x'(t - tau), x' = output (F z + g u).
        rate = np.zeros(2 * n + 1)
        rate[:n] = projected.output @ F
        rate[2 * n] = np.dot(projected.output, g)
        psi[:, n] = -(internal @ (rate @ readout))
    psi -= left @ (left.T @ psi)
    return Slopes(np.dot(residual, residual), -(psi.T @ residual), psi.T @ psi)
