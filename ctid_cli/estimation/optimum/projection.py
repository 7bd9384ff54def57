r"""Variable projection: the squared output error over the denominator and the delay alone.

.. math:: y(t_k) = \frac{B}{A} u(t_k - \tau) + \frac{C}{A}\delta(t_k - t_s) + c + d (t_k - t_0) + r_k

or a sum of such responses, of several inputs. For given poles and delays B, C, c and d follow by linear least squares.
With Phi their columns and P the projection on them, Kaufman's Jacobian of the residual is ``-(I - P) dPhi/dalpha c``;
since ``r`` is orthogonal to Phi its gradient is exact. Known coefficients of B leave Phi, and their part of the
response leaves y. The derivatives of ``B/A u`` at a fixed B are the same, so that nothing else changes.

References
----------
L. Kaufman, "A variable projection method for solving separable nonlinear least squares problems", *BIT* 15 (1975)
49-57. doi:10.1007/BF01932995
"""

from collections.abc import Iterator, Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.optimum.chain import Chain, Form, Modal, form_of, numerators, order_of, polynomial
from ctid_cli.estimation.optimum.triangle import (
    SINGLE,
    Channel,
    Columns,
    Delays,
    each_delay,
    rows_of,
    triangle_of,
    triangles_of,
)
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.filtering.frequency_lines import FrequencyLines
from ctid_cli.inference.innovations import SampledNoise

#: Singular values of the scaled columns below this fraction of the largest count as zero.
RANK_TOLERANCE = 1e-11
#: Models times samples whose squared errors are found together: what fits into the second cache of a processor.
TOGETHER = 12_000

#: Speeds and dampings of the sections of a denominator.
Sections = tuple[Array, Array]


def split_sections(speed: Array, damping: Array, orders: tuple[int, ...]) -> list[Sections]:
    """Return the sections of each denominator, of given numbers of poles; of the only one where none are given."""
    if len(orders) < 2:
        return [(speed, damping)]
    last = np.cumsum(np.where(damping < 0.0, 1, 2))
    ends = [0, *np.searchsorted(last, np.cumsum(orders), side="right").tolist()]
    return [(speed[i:j], damping[i:j]) for i, j in pairwise(ends)]


class Problem(NamedTuple):
    """Records, or a frequency response in their place, and what is eliminated with them.

    The model is a sum of fractions, the *channels*. Each has an input, and as a denominator one of the *blocks*.
    """

    records: tuple[FilterData | FrequencyLines, ...]
    #: Greatest degree of a numerator.
    zeros: int
    free_response: bool
    #: Powers of time that are eliminated for each record.
    trend: tuple[int, ...]
    #: Period [s] of each record that repeats for ever, else 0.
    periods: tuple[float, ...]
    #: Known coefficients ``b_0 ... b_m`` of the numerators of all channels, NaN for those that are free; empty where
    #: all are.
    numerator: Array = np.zeros(0)
    #: Poles at 0 that the model has besides. The lowest powers of time are then part of a free response.
    integrators: int = 0
    #: The noise by whose innovations errors count, of each record; empty where that is white.
    noises: tuple[SampledNoise, ...] = ()
    channels: tuple[Channel, ...] = SINGLE
    #: Numbers of poles of several blocks, and the integrators among the poles of each; empty of one block.
    orders: tuple[int, ...] = ()
    block_integrators: tuple[int, ...] = ()

    @property
    def laid_out(self) -> Iterator[tuple[FilterData | FrequencyLines, float, SampledNoise | None]]:
        """Each record, its period and its noise."""
        return zip(self.records, self.periods, self.noises or (None,) * len(self.records), strict=True)

    @property
    def length(self) -> float:
        """Length of the longest record [s]."""
        return max(data.length for data in self.records)

    @property
    def sampled(self) -> tuple[FilterData, ...]:
        """The records in time."""
        return tuple(data for data in self.records if isinstance(data, FilterData))

    @property
    def lines(self) -> FrequencyLines | None:
        """The frequency response, if there is one in their place."""
        return next((data for data in self.records if isinstance(data, FrequencyLines)), None)

    @property
    def sizes(self) -> list[int]:
        """Number of coefficients of the numerator of each channel."""
        return [max(self.zeros - channel.fewer_zeros, 0) + 1 for channel in self.channels]

    @property
    def each_integrators(self) -> tuple[int, ...]:
        """Poles at 0 of each block."""
        return self.block_integrators or (self.integrators,)

    def blocks(self, speed: Array, damping: Array) -> list[Sections]:
        """Return the sections of each block with its integrators behind them."""
        found = []
        for sections, count in zip(split_sections(speed, damping, self.orders), self.each_integrators, strict=True):
            if count:
                sections = np.append(sections[0], np.zeros(count)), np.append(sections[1], -np.ones(count))
            found.append(sections)
        return found

    def forms(self, speed: Array, damping: Array) -> list[Form]:
        """Return the form of each block: partial fractions only where all of them can be."""
        blocks = self.blocks(speed, damping)
        forms = [form_of(*sections, self.length) for sections in blocks]
        if len(forms) > 1 and not all(isinstance(form, Modal) for form in forms):
            return [Chain.of(*sections) for sections in blocks]
        return forms


class Weights(NamedTuple):
    """What the weights of the states, and of u itself, can be: a given part, and the span of a basis."""

    basis: Array
    given: Array


class Triangles(NamedTuple):
    """The rows of all records."""

    #: The form of each channel.
    forms: list[Form]
    columns: Columns
    delays: Delays
    #: Shape (K, q, q).
    rows: Array


class Slopes(NamedTuple):
    """Derivatives of half the squared error to the logarithmic coordinates and, last, the free delays [1/s]."""

    squared_error: float
    gradient: Array
    #: J'J of Kaufman's Jacobian.
    curvature: Array


def weights_of(problem: Problem, speed: Array, damping: Array) -> Weights | None:
    """Weights of the states with which the numerators have their known coefficients; None where all are free.

    With ``b = T'w``, T the numerators of the states (and, last, A for u itself), the known ones ask ``T_k'w = b_k``.
    """
    if not np.isfinite(problem.numerator).any():
        return None
    blocks, ends = problem.blocks(speed, damping), np.cumsum([0, *problem.sizes])
    found = [
        _weights(problem.numerator[i:j], blocks[channel.block])
        for channel, (i, j) in zip(problem.channels, pairwise(ends.tolist()), strict=True)
    ]
    basis, column = np.zeros((int(ends[-1]), sum(one.basis.shape[1] for one in found))), 0
    for first, one in zip(ends.tolist(), found, strict=False):
        rows, columns = one.basis.shape
        basis[first : first + rows, column : column + columns] = one.basis
        column += columns
    return Weights(basis, np.concatenate([one.given for one in found]))


def _weights(numerator: Array, sections: Sections) -> Weights:
    """Weights of the states of one channel."""
    known = np.isfinite(numerator)
    if not known.any():
        return Weights(np.eye(numerator.size), np.zeros(numerator.size))
    table = numerators(*sections)
    if numerator.size > len(table):
        table = np.vstack((np.pad(table, ((0, 0), (1, 0))), polynomial(*sections)))
    else:
        table = table[-numerator.size :, -numerator.size :]
    asked = table[:, known]
    lengths = np.linalg.norm(asked, axis=0)
    whole, triangle = np.linalg.qr(asked / lengths, mode="complete")
    count = lengths.size
    given = whole[:, :count] @ np.linalg.solve(triangle[:count].T, numerator[known] / lengths)
    return Weights(whole[:, count:], given)


def _columns(problem: Problem, columns: Columns, rows: Array, states: Sequence[Array]) -> tuple[Array, Array]:
    """Return the columns Phi, and y, from the triangles of all records; further axes in front are further models.

    There are maps from z to states for each channel.
    """
    *many, records, q, _ = rows.shape
    shared, own = sum(problem.sizes), sum(columns.free) + len(columns.trend)
    # The numerators are common to all records; a free response and a trend are zero outside their own.
    phi, place = np.zeros((*many, records, q, shared + records * own)), 0
    to_states = [np.swapaxes(each, -1, -2) for each in states]
    for k, size in enumerate(problem.sizes):
        # The last m + 1 states of the chain span B/A u; of degree n there is u itself besides.
        n = columns.orders[k]
        proper = min(size, n)
        phi[..., place : place + proper] = rows[..., columns.z(k)] @ to_states[k][..., n - proper :]
        if size > n:
            phi[..., place + n] = rows[..., columns.u(k)]
        place += size
    of_blocks = [channel.block for channel in problem.channels]
    for record in (slice(k, k + 1) for k in range(records if own else 0)):
        for block, n in enumerate(columns.free):
            free = rows[..., record, :, columns.free_z(block)]
            phi[..., record, :, place : place + n] = free @ to_states[of_blocks.index(block)]
            place += n
        phi[..., record, :, place : place + len(columns.trend)] = rows[..., record, :, columns.powers]
        place += len(columns.trend)
    return phi.reshape(*many, records * q, -1), rows[..., columns.y].reshape(*many, -1)


class Span:
    """What is eliminated, and what it leaves of the output, in the triangles of all records."""

    def __init__(self, problem: Problem, triangles: Triangles, weights: Weights | None) -> None:
        self.triangles, self.weights = triangles, weights
        self.shared = sum(problem.sizes)
        phi, y = _columns(problem, triangles.columns, triangles.rows, [form.states for form in triangles.forms])
        if weights is not None:
            both = phi[:, : self.shared]
            phi, y = np.hstack((both @ weights.basis, phi[:, self.shared :])), y - both @ weights.given
        # Columns of length one: the rank then does not depend on the units of input, output and time.
        lengths = np.sqrt(np.einsum("ij,ij->j", phi, phi))
        self.lengths = np.where(lengths > 0.0, lengths, 1.0)
        left, values, right = np.linalg.svd(phi / self.lengths, full_matrices=False)
        rank = int(np.count_nonzero(values > RANK_TOLERANCE * values[:1]))
        self.left, self.values, self.right = left[:, :rank], values[:rank], right[:rank]
        self.along = self.left.T @ y
        self.residual = y - self.left @ self.along

    def solution(self) -> tuple[Array, Array]:
        """Return the weights of the states and of u, and the coefficients of each record's own columns, row by row.

        Directions of no length are left out, which is the solution of least norm.
        """
        found = (self.right.T @ (self.along / self.values)) / self.lengths
        if self.weights is None:
            return found[: self.shared], found[self.shared :]
        free = self.weights.basis.shape[1]
        return self.weights.given + self.weights.basis @ found[:free], found[free:]


class Projected(NamedTuple):
    """The least squares for given poles and delays."""

    squared_error: float
    #: Weights of the states, and of u itself, of each channel.
    outputs: list[Array]
    directs: list[float]
    #: Weights of the states of the free responses, of all blocks side by side, and of the powers of time, of each
    #: record: shapes (K, n) and (K, q).
    free: Array
    trend: Array
    span: "Span"


def project(problem: Problem, speed: Array, damping: Array, delays: Delays, *, slopes_too: bool = False) -> Projected:
    """Eliminate numerators, free responses and trends for given sections, fastest first in each block.

    Where :func:`slopes` will follow, one pass over the records can serve both.
    """
    blocks = problem.forms(speed, damping)
    forms = [blocks[channel.block] for channel in problem.channels]
    second = slopes_too and isinstance(forms[0], Modal)
    triangles = _triangles(problem, [forms] * len(problem.records), delays, second)
    span = Span(problem, triangles, weights_of(problem, speed, damping))
    shared, own = span.solution()
    records, columns = len(problem.records), triangles.columns
    outputs, directs, place = [], [], 0
    for n, size in zip(columns.orders, problem.sizes, strict=True):
        proper, output = min(size, n), np.zeros(n)
        output[n - proper :] = shared[place : place + proper]
        outputs.append(output)
        directs.append(float(shared[place + n]) if size > n else 0.0)
        place += size
    own = own.reshape(records, -1)
    split = sum(columns.free)
    free = own[:, :split] if columns.free else np.zeros((records, sum(form.states.shape[0] for form in blocks)))
    squared_error = float(span.residual @ span.residual)
    return Projected(squared_error, outputs, directs, free, own[:, split:], span)


def responses(problem: Problem, speed: Array, damping: Array, delays: Delays, projected: Projected) -> list[Array]:
    """Return the response to all inputs, without free responses and trends, at the used samples of each record."""
    blocks = problem.forms(speed, damping)
    forms = [blocks[channel.block] for channel in problem.channels]
    columns, found = projected.span.triangles.columns._replace(free=(), second=False, trend=()), []
    for data, period, _ in problem.laid_out:
        parts = []
        for rows in rows_of(forms, columns, delays, data, period, channels=problem.channels):
            each = enumerate(zip(projected.outputs, projected.directs, strict=True))
            parts.append(
                np.sum([out @ rows[columns.z(k)] + own * rows[columns.u(k)] for k, (out, own) in each], axis=0)
            )
        found.append(np.concatenate(parts))
    return found


def squared_errors(problem: Problem, sections: Sequence[Sections], delays: Delays) -> Array:
    """Return the squared errors of many sections of one order at given delays, to compare starts."""
    together = len(problem.orders) < 2 and not np.isfinite(problem.numerator).any()
    forms = [problem.forms(*own)[0] if together else None for own in sections]
    errors = np.zeros(len(forms))
    modal = [k for k, form in enumerate(forms) if isinstance(form, Modal)]
    for k in set(range(len(forms))) - set(modal):
        errors[k] = project(problem, *sections[k], delays).squared_error
    at_once = max(TOGETHER // sum(data.count for data in problem.records), 1)
    for first in range(0, len(modal), at_once):
        own, channels = modal[first : first + at_once], problem.channels
        group = [form for k in own if isinstance(form := forms[k], Modal)]
        columns = Columns.of((group[0].poles.size,), False, problem.free_response, problem.trend, channels)
        each = [triangles_of(group, columns, delays, *record, channels) for record in problem.laid_out]
        states = np.stack([form.states for form in group])[:, None]
        phi, y = _columns(problem, columns, np.stack(each, axis=1), [states] * len(channels))
        whole = np.concatenate((phi, y[:, :, None]), axis=2)
        lengths = np.linalg.norm(whole, axis=1, keepdims=True)
        left = np.asarray(np.linalg.qr(whole / np.where(lengths > 0.0, lengths, 1.0), mode="r"))[:, -1, -1]
        errors[own] = (left * lengths[:, 0, -1]) ** 2
    return errors


def _triangles(problem: Problem, forms: Sequence[list[Form]], delays: Delays, second: bool) -> Triangles:
    """Return the triangles of all records, each with a form for each channel."""
    first = [channel.block for channel in problem.channels].index
    blocks = [forms[0][first(block)].states.shape[0] for block in range(len(problem.each_integrators))]
    columns = Columns.of(blocks, second, problem.free_response, problem.trend, problem.channels)
    each = zip(forms, problem.laid_out, strict=True)
    rows = np.stack([triangle_of(own, columns, delays, *record, problem.channels) for own, record in each])
    return Triangles(forms[0], columns, delays, rows)


def slopes(
    problem: Problem,
    speed: Array,
    damping: Array,
    delays: Delays,
    projected: Projected,
    free_delays: Sequence[int] | bool,
) -> Slopes:
    """Exact gradient, and Kaufman's J'J, at what :func:`project` gave for the same sections and delays.

    The free delays are those of the inputs that are listed; of one input, whether its own is free.
    """
    moving = (0,) * free_delays if isinstance(free_delays, bool) else free_delays
    span, outputs, directs, channels = projected.span, projected.outputs, projected.directs, problem.channels
    triangles, orders = span.triangles, problem.orders or (order_of(damping),)
    ends = list(accumulate((n + count for n, count in zip(orders, problem.each_integrators, strict=True)), initial=0))
    of_block = [slice(*pair) for pair in pairwise(ends)]
    if not triangles.columns.second or each_delay(triangles.delays) != each_delay(delays):
        driven = [
            [
                form.driving(output, direct, free[of_block[channel.block]])
                for form, output, direct, channel in zip(triangles.forms, outputs, directs, channels, strict=True)
            ]
            for free in projected.free
        ]
        span = Span(problem, _triangles(problem, driven, delays, True), weights_of(problem, speed, damping))
    forms, columns, _, rows = span.triangles
    first = list(accumulate(orders, initial=0))
    psi = np.zeros((*rows.shape[:2], first[-1] + len(moving)))
    for k, (form, output, direct, channel) in enumerate(zip(forms, outputs, directs, channels, strict=True)):
        begin, n = first[channel.block], orders[channel.block]
        psi[:, :, begin : begin + n] += rows[:, :, columns.states(k)] @ form.slopes(output, direct)[:, :n]
        if channel.input in moving:
            # dx/dtau = -x'(t - tau).
            of_z, of_u = form.rate(output)
            place = first[-1] + moving.index(channel.input)
            psi[:, :, place] -= rows[:, :, columns.z(k)] @ of_z + of_u * rows[:, :, columns.u(k)]
    for block in range(len(columns.free)):
        begin, n, form = first[block], orders[block], forms[[channel.block for channel in channels].index(block)]
        each = [form.slopes(free[of_block[block]], 0.0)[:, :n] for free in projected.free]
        psi[:, :, begin : begin + n] += rows[:, :, columns.free_states(block)] @ np.stack(each)
    psi = psi.reshape(span.residual.size, -1)
    # (I - P): what the eliminated coefficients would follow is no effect of the poles.
    psi -= span.left @ (span.left.T @ psi)
    residual = span.residual
    return Slopes(float(residual @ residual), -(psi.T @ residual), psi.T @ psi)
