r"""Variable projection: the squared output error over the denominator and the delay alone.

.. math:: y(t_k) = \frac{B}{A} u(t_k - \tau) + \frac{C}{A}\delta(t_k - t_s) + c + d (t_k - t_0) + r_k

For given poles and delay B, C, c and d follow by linear least squares. With Phi their columns and P the projection on
them, Kaufman's Jacobian of the residual is ``-(I - P) dPhi/dalpha c``; since ``r`` is orthogonal to Phi its gradient is
exact. Columns of known coefficients of B are removed from Phi, and their response is subtracted from y. The derivatives
of ``B/A u`` at a fixed B do not change.

A sum of fractions, for submodels or for several inputs, has the columns of all fractions instead of those of ``B/A u``.

References
----------
L. Kaufman, "A variable projection method for solving separable nonlinear least squares problems", *BIT* 15 (1975)
49-57. doi:10.1007/BF01932995
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.optimum.arrangement import Arrangement, with_one_denominator, with_own_denominators
from ctid_cli.estimation.optimum.chain import (
    Form,
    Modal,
    Rows,
    block_diagonal,
    forms_of,
    numerators,
    order_of,
    polynomial,
    split,
)
from ctid_cli.estimation.optimum.triangle import Columns, Delay, Delays, each_delay, rows_of, triangle_of, triangles_of
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.filtering.frequency_lines import FrequencyLines
from ctid_cli.inference.innovations import SampledNoise
from ctid_cli.models.additive import Term

#: Singular values of the scaled columns below this fraction of the largest count as zero.
RANK_TOLERANCE = 1e-11
#: Models times samples whose squared errors are computed together, which fit into the L2 cache.
TOGETHER = 12_000


class Problem(NamedTuple):
    """Records, or a frequency response instead, and the terms that are eliminated."""

    records: tuple[FilterData | FrequencyLines, ...]
    #: Degree of the numerator; the highest one for inputs with a common denominator.
    zeros: int
    free_response: bool
    #: Powers of time that are eliminated for each record.
    trend: tuple[int, ...]
    #: Period [s] of each periodic record, else 0.
    periods: tuple[float, ...]
    #: Known coefficients of the numerators in descending powers, NaN for free ones; empty if all are free. In a sum of
    #: submodels they belong to denominators with the constant term 1.
    numerator: Array = np.zeros(0)
    #: Additional poles at 0. The lowest powers of time are then part of a free response.
    integrators: int = 0
    #: Noise model that whitens the errors of each record; empty for white noise.
    noises: tuple[SampledNoise, ...] = ()
    #: Difference of the numerator degree of each input from the highest, for inputs with a common denominator.
    fewer_zeros: tuple[int, ...] = (0,)
    #: Fractions with separate denominators, which replace ``zeros`` and ``integrators``; and the input of each, by
    #: default the only one.
    terms: tuple[Term, ...] = ()
    inputs: tuple[int, ...] = ()

    @property
    def laid_out(self) -> Iterator[tuple[FilterData | FrequencyLines, float, SampledNoise | None]]:
        """Yield each record, its period and its noise."""
        return zip(self.records, self.periods, self.noises or (None,) * len(self.records), strict=True)

    @property
    def length(self) -> float:
        """Length of the longest record [s]."""
        return max(data.length for data in self.records)

    @property
    def sampled(self) -> tuple[FilterData, ...]:
        """Records in the time domain."""
        return tuple(data for data in self.records if isinstance(data, FilterData))

    @property
    def lines(self) -> FrequencyLines | None:
        """Frequency response, if it replaces the records."""
        return next((data for data in self.records if isinstance(data, FrequencyLines)), None)

    @property
    def parts(self) -> tuple[int, ...]:
        """Number of poles of each of several denominators, without integrators; empty for one."""
        return tuple(term.poles for term in self.terms)

    @property
    def monic(self) -> bool:
        """Whether known coefficients refer to monic denominators, which is false for a sum of submodels."""
        return not self.terms or len(set(self.inputs)) > 1

    @property
    def coefficients(self) -> int:
        """Number of coefficients of all numerators."""
        if self.terms:
            return sum(term.zeros + 1 for term in self.terms)
        return sum(max(self.zeros - fewer, 0) + 1 for fewer in self.fewer_zeros)

    @property
    def each_integrators(self) -> tuple[int, ...]:
        """Poles at the origin of each denominator."""
        return tuple(term.integrators for term in self.terms) or (self.integrators,)

    def arranged(self, poles: int) -> Arrangement:
        """Return the channels of a model with a number of poles, without integrators."""
        if self.terms:
            return with_own_denominators(self.terms, self.inputs or (0,) * len(self.terms))
        return with_one_denominator(poles, self.integrators, self.zeros, self.fewer_zeros)

    def rows(self, speed: Array, damping: Array) -> Rows:
        """Return the sections of each denominator, followed by its integrators."""
        if not self.terms:
            return [_integrating(speed, damping, self.integrators)]
        each = zip(split(speed, damping, self.parts), self.terms, strict=True)
        return [_integrating(*own, term.integrators) for own, term in each]


def _integrating(speed: Array, damping: Array, integrators: int) -> tuple[Array, Array]:
    """Return sections followed by integrators."""
    if not integrators:
        return speed, damping
    return np.append(speed, np.zeros(integrators)), np.append(damping, -np.ones(integrators))


class Weights(NamedTuple):
    """Affine set of the weights of the states and of u: a given vector plus the span of a basis."""

    basis: Array
    given: Array


class Triangles(NamedTuple):
    """Rows of all records in one form of each channel."""

    arrangement: Arrangement
    forms: Sequence[Form]
    columns: Columns
    delays: tuple[Delay, ...]
    #: Shape (K, q, q).
    rows: Array


class Slopes(NamedTuple):
    """Derivatives of half the squared error by the logarithmic coordinates and, last, the free delays [1/s]."""

    squared_error: float
    gradient: Array
    #: J'J of Kaufman's Jacobian.
    curvature: Array


def weights_of(problem: Problem, speed: Array, damping: Array) -> Weights | None:
    """Return the weights of the states that give the known numerator coefficients; None if all are free.

    With ``b = T'w``, T the numerators of the states (and, last, A for u itself), the constraint is ``T_k'w = b_k``.
    """
    known = np.isfinite(problem.numerator)
    if not known.any():
        return None
    rows, tables = problem.rows(speed, damping), []
    for channel in problem.arranged(order_of(damping)).channels:
        own, directs = [], []
        for k, ((w, zeta), term) in enumerate(zip(rows[channel.blocks], channel.terms, strict=True)):
            scale = 1.0 if problem.monic else polynomial(w, zeta)[term.poles]
            table, width = numerators(w, zeta) / scale, term.zeros + 1
            if k == channel.direct:
                own.append(np.pad(table, ((0, 0), (1, 0))))
                directs.append(polynomial(w, zeta) / scale)
            else:
                own.append(table[-width:, -width:])
                directs.append(np.zeros(width))
        proper = block_diagonal(own)
        tables.append(np.vstack((proper, np.concatenate(directs))) if channel.direct >= 0 else proper)
    table = block_diagonal(tables)
    constrained = table[:, known]
    lengths = np.linalg.norm(constrained, axis=0)
    whole, triangle = np.linalg.qr(constrained / lengths, mode="complete")
    count = lengths.size
    given = whole[:, :count] @ np.linalg.solve(triangle[:count].T, problem.numerator[known] / lengths)
    return Weights(whole[:, count:], given)


def _columns(problem: Problem, triangles: Triangles, states: Sequence[Array]) -> tuple[Array, Array]:
    """Return the columns Phi, and y, from the triangles of all records; leading axes are several models.

    ``states``: the map from z to the states of the sections of each channel.
    """
    arrangement, columns, rows = triangles.arrangement, triangles.columns, triangles.rows
    *many, records, q, _ = rows.shape
    shared, trend = sum(channel.size for channel in arrangement.channels), len(columns.trend)
    own = arrangement.order * problem.free_response + trend
    # The numerators are common to all records; a free response and a trend are zero in other records.
    phi = np.zeros((*many, records, q, shared + records * own))
    to_states, place = [np.swapaxes(one, -1, -2) for one in states], 0
    for k, channel in enumerate(arrangement.channels):
        proper = channel.spanning.size
        phi[..., place : place + proper] = rows[..., columns.z(k)] @ to_states[k][..., channel.spanning]
        if channel.direct >= 0:
            phi[..., place + proper] = rows[..., columns.u(k)]
        place += channel.size
    for record in range(records if own else 0):
        place, one = shared + record * own, slice(record, record + 1)
        for number, k in enumerate(columns.free):
            order = columns.orders[k]
            phi[..., one, :, place : place + order] = rows[..., one, :, columns.free_z(number)] @ to_states[k]
            place += order
        phi[..., one, :, place : place + trend] = rows[..., one, :, columns.powers]
    return phi.reshape(*many, records * q, -1), rows[..., columns.y].reshape(*many, -1)


class Span:
    """Eliminated columns, and the residual of the output, in the triangles of all records."""

    def __init__(self, problem: Problem, triangles: Triangles, weights: Weights | None) -> None:
        self.triangles, self.weights = triangles, weights
        self.shared = sum(channel.size for channel in triangles.arrangement.channels)
        phi, y = _columns(problem, triangles, [form.states for form in triangles.forms])
        if weights is not None:
            both = phi[:, : self.shared]
            phi, y = np.hstack((both @ weights.basis, phi[:, self.shared :])), y - both @ weights.given
        # Columns are scaled to length one, so that the rank does not depend on the units of input, output and time.
        lengths = np.sqrt(np.einsum("ij,ij->j", phi, phi))
        if not np.isfinite(lengths).all():
            # A response that overflows explains nothing, so that the search turns away from such poles.
            phi[:, ~np.isfinite(lengths)] = lengths[~np.isfinite(lengths)] = 0.0
        self.lengths = np.where(lengths > 0.0, lengths, 1.0)
        left, values, right = np.linalg.svd(phi / self.lengths, full_matrices=False)
        rank = int(np.count_nonzero(values > RANK_TOLERANCE * values[:1]))
        self.left, self.values, self.right = left[:, :rank], values[:rank], right[:rank]
        self.along = self.left.T @ y
        self.residual = y - self.left @ self.along

    def solution(self) -> tuple[Array, Array]:
        """Return the weights of the states and of u, and the coefficients of the columns of each record, row by row.

        Null directions are omitted, which gives the solution of least norm.
        """
        found = (self.right.T @ (self.along / self.values)) / self.lengths
        if self.weights is None:
            return found[: self.shared], found[self.shared :]
        free = self.weights.basis.shape[1]
        return self.weights.given + self.weights.basis @ found[:free], found[free:]


class Projected(NamedTuple):
    """Linear least-squares solution for given poles and delays."""

    squared_error: float
    #: Weights of the states, and of the input, of each channel.
    outputs: list[Array]
    directs: list[float]
    #: Weights of the states of the free responses, and of the powers of time, of each record: shapes (K, n) and (K, q).
    free: Array
    trend: Array
    span: "Span"


def project(problem: Problem, speed: Array, damping: Array, delays: Delays, *, slopes_too: bool = False) -> Projected:
    """Eliminate numerators, free responses and trends for given sections, fastest first in each denominator.

    With ``slopes_too`` one pass over the records also serves :func:`slopes`.
    """
    arrangement = problem.arranged(order_of(damping))
    forms = forms_of(problem.rows(speed, damping), [one.blocks for one in arrangement.channels], problem.length)
    second = slopes_too and isinstance(forms[0], Modal)
    triangles = _triangles(problem, arrangement, [forms] * len(problem.records), delays, second)
    span = Span(problem, triangles, weights_of(problem, speed, damping))
    shared, own = span.solution()
    n, records, place = arrangement.order, len(problem.records), 0
    outputs, directs = list[Array](), list[float]()
    for channel in arrangement.channels:
        output, proper = np.zeros(channel.order), channel.spanning.size
        output[channel.spanning] = shared[place : place + proper]
        outputs.append(output)
        directs.append(float(shared[place + proper]) if channel.direct >= 0 else 0.0)
        place += channel.size
    free, trend = np.zeros((records, n)), np.zeros((records, len(problem.trend)))
    if problem.free_response or problem.trend:
        own = own.reshape(records, -1)
        if problem.free_response:
            free = own[:, :n]
        trend = own[:, own.shape[1] - len(problem.trend) :]
    return Projected(float(span.residual @ span.residual), outputs, directs, free, trend, span)


def responses(problem: Problem, projected: Projected) -> list[Array]:
    """Return the response to all inputs, without free responses and trends, at the used samples of each record."""
    triangles, found = projected.span.triangles, list[Array]()
    columns = replace(triangles.columns, free=(), second=False, trend=())
    for data, period, _ in problem.laid_out:
        parts = []
        for rows in rows_of(triangles.forms, columns, triangles.delays, data, period):
            each = zip(triangles.forms, projected.outputs, projected.directs, strict=True)
            of_channels = [
                (output @ form.states) @ rows[columns.z(k)] + direct * rows[columns.u(k)]
                for k, (form, output, direct) in enumerate(each)
            ]
            parts.append(np.sum(of_channels, axis=0))
        found.append(np.concatenate(parts))
    return found


def squared_errors(problem: Problem, sections: Sequence[tuple[Array, Array]], delays: Delays) -> Array:
    """Return the squared errors of many models of one order at given delays, to compare starts."""
    arrangement = problem.arranged(order_of(sections[0][1]))
    blocks = [channel.blocks for channel in arrangement.channels]
    candidates = [forms_of(problem.rows(*own), blocks, problem.length) for own in sections]
    errors = np.zeros(len(candidates))
    modal = [k for k, forms in enumerate(candidates) if isinstance(forms[0], Modal)]
    if np.isfinite(problem.numerator).any():
        modal = []
    for k in set(range(len(candidates))) - set(modal):
        errors[k] = project(problem, *sections[k], delays).squared_error
    at_once = max(TOGETHER // sum(data.count for data in problem.records), 1)
    columns = Columns.of(arrangement, False, problem.free_response, problem.trend)
    for first in range(0, len(modal), at_once):
        own = modal[first : first + at_once]
        group = [[form for form in candidates[k] if isinstance(form, Modal)] for k in own]
        rows = np.stack([triangles_of(group, columns, delays, *record) for record in problem.laid_out], axis=1)
        states = [np.stack([form.states for form in forms])[:, None] for forms in zip(*group, strict=True)]
        phi, y = _columns(problem, Triangles(arrangement, group[0], columns, each_delay(delays), rows), states)
        whole = np.concatenate((phi, y[:, :, None]), axis=2)
        lengths = np.linalg.norm(whole, axis=1, keepdims=True)
        left = np.asarray(np.linalg.qr(whole / np.where(lengths > 0.0, lengths, 1.0), mode="r"))[:, -1, -1]
        errors[own] = (left * lengths[:, 0, -1]) ** 2
    return errors


def _triangles(
    problem: Problem, arrangement: Arrangement, forms: Sequence[Sequence[Form]], delays: Delays, second: bool
) -> Triangles:
    """Return the triangles of all records, each with its forms of the channels."""
    columns = Columns.of(arrangement, second, problem.free_response, problem.trend)
    each = zip(forms, problem.laid_out, strict=True)
    rows = np.stack([triangle_of(own, columns, delays, *record) for own, record in each])
    return Triangles(arrangement, forms[0], columns, each_delay(delays), rows)


def slopes(
    problem: Problem,
    speed: Array,
    damping: Array,
    delays: Delays,
    projected: Projected,
    free_delays: Sequence[int] = (),
) -> Slopes:
    """Return the exact gradient, and Kaufman's J'J, at the result of :func:`project` for these sections and delays.

    ``free_delays``: inputs with derivatives by their delays, too.
    """
    span, directs = projected.span, projected.directs
    triangles, arrangement = span.triangles, span.triangles.arrangement
    channels = arrangement.channels
    of_direct = [channel.directs(direct) for channel, direct in zip(channels, directs, strict=True)]
    if not triangles.columns.second or triangles.delays != each_delay(delays):
        each = list(zip(triangles.forms, projected.outputs, of_direct, channels, strict=True))
        forms = [
            [form.driving(output, direct, free[channel.states]) for form, output, direct, channel in each]
            for free in projected.free
        ]
        weights = weights_of(problem, speed, damping)
        span = Span(problem, _triangles(problem, arrangement, forms, delays, True), weights)
    _, forms_used, columns, _, rows = span.triangles
    n = arrangement.poles
    psi = np.zeros((*rows.shape[:2], n + len(free_delays)))
    for k, channel in enumerate(channels):
        form, output, direct = forms_used[k], projected.outputs[k], of_direct[k]
        own = psi[:, :, channel.poles]
        own += rows[:, :, columns.states(k)] @ form.slopes(output, direct)[:, channel.searched]
        if not problem.monic and span.weights is not None:
            own += _of_constants(problem, speed, damping, projected, span.triangles, k)
        if channel.input in free_delays:
            # dx/dtau = -x'(t - tau).
            of_z, of_u = form.rate(output)
            place = n + free_delays.index(channel.input)
            psi[:, :, place] -= rows[:, :, columns.z(k)] @ of_z + of_u * rows[:, :, columns.u(k)]
    for number, k in enumerate(columns.free):
        channel, form = channels[k], forms_used[k]
        none = 0.0 * of_direct[k]
        maps = np.stack([form.slopes(free[channel.states], none)[:, channel.searched] for free in projected.free])
        psi[:, :, channel.poles] += rows[:, :, columns.free_states(number)] @ maps
    psi = psi.reshape(span.residual.size, -1)
    # I - P removes the part that the eliminated coefficients compensate.
    psi -= span.left @ (span.left.T @ psi)
    residual = span.residual
    return Slopes(float(residual @ residual), -(psi.T @ residual), psi.T @ psi)


def _of_constants(
    problem: Problem, speed: Array, damping: Array, projected: Projected, triangles: Triangles, k: int
) -> Array:
    """Return the effect of the constant terms of the denominators on the output at fixed known numerators."""
    found, first = [], 0
    channel, form = triangles.arrangement.channels[k], triangles.forms[k]
    columns, rows = triangles.columns, triangles.rows
    directs = channel.directs(projected.directs[k])
    sections = split(speed, damping, problem.parts)[channel.blocks]
    for (_, zetas), term, direct in zip(sections, channel.terms, directs.tolist(), strict=True):
        own = np.zeros(channel.order)
        own[first : first + term.order] = projected.outputs[k][first : first + term.order]
        first += term.order
        response = rows[:, :, columns.z(k)] @ (own @ form.states) + direct * rows[:, :, columns.u(k)]
        # The constant term is the product of all w^2 and p.
        found += [response * power for zeta in zetas.tolist() for power in ((1.0,) if zeta < 0 else (2.0, 0.0))]
    return np.stack(found, axis=-1)
