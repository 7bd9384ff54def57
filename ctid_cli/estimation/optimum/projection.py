r"""Variable projection: the squared output error over the denominator and the delay alone.

.. math:: y(t_k) = \frac{B}{A} u(t_k - \tau) + \frac{C}{A}\delta(t_k - t_s) + c + r_k

For given poles and delay B, C and c follow by linear least squares. With Phi their columns and P the projection on
them, Kaufman's Jacobian of the residual is ``-(I - P) dPhi/dalpha c``; since ``r`` is orthogonal to Phi its gradient is
exact. Known coefficients of B leave Phi, and their part of the response leaves y. The derivatives of ``B/A u`` at a
fixed B are the same, so that nothing else changes.

References
----------
L. Kaufman, "A variable projection method for solving separable nonlinear least squares problems", *BIT* 15 (1975)
49-57. doi:10.1007/BF01932995
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array
from ctid_cli.estimation.optimum.chain import chain_dynamics, driven_chain, logarithmic_slopes, numerators, polynomial
from ctid_cli.estimation.optimum.triangle import MOMENTS, ChainState, Delay, rows_of
from ctid_cli.filtering.filter_data import FilterData

#: Singular values of the scaled columns below this fraction of the largest count as zero.
RANK_TOLERANCE = 1e-11


class Problem(NamedTuple):
    """Records, and what is eliminated with them."""

    records: tuple[FilterData, ...]
    #: Degree of the numerator.
    zeros: int
    free_response: bool
    offset: bool
    #: Period [s] of each record that repeats for ever, else 0.
    periods: tuple[float, ...]
    #: Known coefficients ``b_0 ... b_m`` of the numerator, NaN for those that are free; empty where all are.
    numerator: Array = np.zeros(0)


class Weights(NamedTuple):
    """What the weights of the states, and of u itself, can be: a given part, and the span of a basis.

    The basis has no columns where all are known, and no rows where all are free.
    """

    basis: Array
    given: Array


#: All weights are free.
FREE_WEIGHTS = Weights(np.zeros((0, 0)), np.zeros(0))


class Projected(NamedTuple):
    """The least squares for given poles and delay."""

    squared_error: float
    #: Weights of the states, and of u itself.
    output: Array
    direct: float
    #: Weights of the states of the free response, and offset, of each record: shapes (K, n) and (K,).
    free: Array
    offset: Array


class Slopes(NamedTuple):
    """Derivatives of half the squared error to the logarithmic coordinates and, last, the delay [1/s]."""

    squared_error: float
    gradient: Array
    #: J'J of Kaufman's Jacobian.
    curvature: Array


def weights_of(problem: Problem, speed: Array, damping: Array) -> Weights:
    """Weights of the states with which the numerator has its known coefficients.

    With ``b = T'w``, T the numerators of the states (and, last, A for u itself), the known ones ask ``T_k'w = b_k``.
    """
    known = np.isfinite(problem.numerator)
    if not known.any():
        return FREE_WEIGHTS
    table = numerators(speed, damping)
    if problem.zeros == len(table):
        table = np.vstack((np.pad(table, ((0, 0), (1, 0))), polynomial(speed, damping)))
    else:
        table = table[-problem.zeros - 1 :, -problem.zeros - 1 :]
    asked = table[:, known]
    lengths = np.linalg.norm(asked, axis=0)
    whole, triangle = np.linalg.qr(asked / lengths, mode="complete")
    count = lengths.size
    given = whole[:, :count] @ np.linalg.solve(triangle[:count].T, problem.numerator[known] / lengths)
    return Weights(np.ascontiguousarray(whole[:, count:]), given)


@njit(cache=True, nogil=True)
def _columns(
    rows: Array, n: int, forced: int, zeros: int, free: bool, offset: bool, weights: Weights
) -> tuple[Array, Array]:
    """The columns Phi, and y less what is known of it.

    From rows of all records whose chains, of ``forced`` states, begin with the n states.
    """
    records, q = rows.shape[0], rows.shape[1]
    proper = min(zeros, n - 1) + 1
    shared = zeros + 1
    own = (n if free else 0) + (1 if offset else 0)
    # The numerator is common to all records; a free response and an offset are zero outside their own.
    columns = np.zeros((records * q, shared + records * own))
    for k in range(records):
        part = columns[k * q : (k + 1) * q]
        # The last m + 1 states of the chain span B/A u; of degree n there is u itself besides.
        part[:, :proper] = rows[k, :, n - proper : n]
        if zeros == n:
            part[:, proper] = rows[k, :, forced]
        place = shared + k * own
        if free:
            part[:, place : place + n] = rows[k, :, forced + 1 : forced + 1 + n]
        if offset:
            part[:, place + own - 1] = rows[k, :, -2]
    y = np.ascontiguousarray(rows[:, :, -1]).ravel()
    if weights.basis.shape[0] == 0:
        return columns, y
    both = np.ascontiguousarray(columns[:, :shared])
    return np.hstack((both @ weights.basis, columns[:, shared:])), y - both @ weights.given


@njit(cache=True, nogil=True)
def _factored(columns: Array) -> tuple[Array, Array, Array, Array]:
    """Lengths of the columns and singular values and vectors of what is left when these are taken out."""
    # Columns of length one: the rank then does not depend on the units of input, output and time.
    lengths = np.sqrt((columns * columns).sum(axis=0))
    if lengths.size == 0:
        return lengths, columns, lengths, columns[:0]
    for i in range(lengths.size):
        if not lengths[i] > 0.0:
            lengths[i] = 1.0
    left, values, right = np.linalg.svd(columns / lengths, False)
    rank = 0
    while rank < values.size and values[rank] > RANK_TOLERANCE * values[0]:
        rank += 1
    return lengths, np.ascontiguousarray(left[:, :rank]), values[:rank], np.ascontiguousarray(right[:rank])


@njit(cache=True, nogil=True)
def _eliminated(rows: Array, n: int, zeros: int, free_response: bool, offset: bool, weights: Weights) -> Projected:
    """Least squares of the last column of the rows on all that is eliminated."""
    columns, y = _columns(rows, n, n, zeros, free_response, offset, weights)
    lengths, left, values, right = _factored(columns)
    along = left.T @ y
    residual = y - left @ along
    # c = V S^-1 U'y; directions of no length are left out, which is the solution of least norm.
    solution = (right.T @ (along / values)) / lengths
    records = rows.shape[0]
    output, direct, free, offsets = np.zeros(n), 0.0, np.zeros((records, n)), np.zeros(records)
    # Read in the order in which the columns were written.
    proper, place, shared = min(zeros, n - 1) + 1, zeros + 1, solution
    if weights.basis.shape[0] > 0:
        place = weights.basis.shape[1]
        shared = weights.given + weights.basis @ solution[:place]
    output[n - proper :] = shared[:proper]
    if zeros == n:
        direct = shared[proper]
    for k in range(records):
        if free_response:
            free[k] = solution[place : place + n]
            place += n
        if offset:
            offsets[k] = solution[place]
            place += 1
    return Projected(np.dot(residual, residual), output, direct, free, offsets)


def project(problem: Problem, speed: Array, damping: Array, delay: Delay) -> Projected:
    """Eliminate numerator, free responses and offsets for given sections, fastest first."""
    F, g = chain_dynamics(speed, damping)
    chain = ChainState(F, g, F, g if problem.free_response else np.zeros(0))
    each = zip(problem.records, problem.periods, strict=True)
    rows = np.stack([rows_of(chain, delay, data, period, MOMENTS) for data, period in each])
    weights = weights_of(problem, speed, damping)
    found: Projected = _eliminated(rows, g.size, problem.zeros, problem.free_response, problem.offset, weights)
    return found


def twice(F: Array, g: Array, output: Array, direct: float, free: Array | None) -> ChainState:
    """The chain with a second one driven by x = B/A u: dx/dalpha_j = -(d ln A/d alpha_j) x up to what Phi spans.

    The free response ``C/A delta`` drives one too.
    """
    dynamics, gain = driven_chain(F, g, output, direct)
    if free is None:
        return ChainState(dynamics, gain, dynamics, np.zeros(0))
    return ChainState(dynamics, gain, *driven_chain(F, g, free, 0.0))


@njit(cache=True, nogil=True)
def _kaufman(
    rows: Array,
    F: Array,
    g: Array,
    projected: Projected,
    readings: Array,
    problem: tuple[int, bool, bool, bool],
    weights: Weights,
) -> Slopes:
    """Gradient and J'J from the rows of a chain that drives a second one; readings of ``d ln A/d alpha`` from it."""
    n = g.size
    zeros, free_response, offset, delay_free = problem
    columns, y = _columns(rows, n, 2 * n, zeros, free_response, offset, weights)
    _, left, _, _ = _factored(columns)
    residual = y - left @ (left.T @ y)
    psi = np.zeros((y.size, n + 1 if delay_free else n))
    # dx/dtau = -x'(t - tau), x' = output (F z + g u).
    rate = np.zeros(2 * n + 1)
    rate[:n] = projected.output @ F
    rate[2 * n] = np.dot(projected.output, g)
    q = rows.shape[1]
    for k in range(rows.shape[0]):
        driven = np.ascontiguousarray(rows[k, :, n : 2 * n])
        if free_response:
            driven = driven + rows[k, :, 3 * n + 1 : 4 * n + 1]
        psi[k * q : (k + 1) * q, :n] = -driven @ np.ascontiguousarray(readings.T)
        if delay_free:
            psi[k * q : (k + 1) * q, n] = -(np.ascontiguousarray(rows[k, :, : 2 * n + 1]) @ rate)
    # (I - P): what the eliminated coefficients would follow is no effect of the poles.
    psi -= left @ (left.T @ psi)
    return Slopes(np.dot(residual, residual), -(psi.T @ residual), psi.T @ psi)


def slopes(
    problem: Problem, speed: Array, damping: Array, delay: Delay, projected: Projected, delay_free: bool
) -> Slopes:
    """Exact gradient, and Kaufman's J'J, at what :func:`project` gave for the same sections and delay."""
    F, g = chain_dynamics(speed, damping)
    frees = projected.free if problem.free_response else [None] * len(problem.records)
    chains = [twice(F, g, projected.output, projected.direct, free) for free in frees]
    each = zip(chains, problem.records, problem.periods, strict=True)
    rows = np.stack([rows_of(chain, delay, data, period, MOMENTS) for chain, data, period in each])
    free = problem.zeros, problem.free_response, problem.offset, delay_free
    weights = weights_of(problem, speed, damping)
    found: Slopes = _kaufman(rows, F, g, projected, logarithmic_slopes(speed, damping, F), free, weights)
    return found
