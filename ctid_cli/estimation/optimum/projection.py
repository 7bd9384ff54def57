r"""Variable projection: the squared output error over the denominator and the delay alone.

.. math:: y(t_k) = \frac{B}{A} u(t_k - \tau) + \frac{C}{A}\delta(t_k - t_s) + c + d (t_k - t_0) + r_k

For given poles and delay B, C, c and d follow by linear least squares. With Phi their columns and P the projection on
them, Kaufman's Jacobian of the residual is ``-(I - P) dPhi/dalpha c``; since ``r`` is orthogonal to Phi its gradient is
exact. Known coefficients of B leave Phi, and their part of the response leaves y. The derivatives of ``B/A u`` at a
fixed B are the same, so that nothing else changes.

A sum of submodels has columns of each of them in the place of those of ``B/A u``, and everything else in common.

References
----------
L. Kaufman, "A variable projection method for solving separable nonlinear least squares problems", *BIT* 15 (1975)
49-57. doi:10.1007/BF01932995
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IntArray
from ctid_cli.estimation.optimum.chain import (
    Form,
    Modal,
    Rows,
    block_diagonal,
    form_of,
    numerators,
    order_of,
    polynomial,
    split,
)
from ctid_cli.estimation.optimum.triangle import Columns, Delay, triangle_of, triangles_of
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.filtering.frequency_lines import FrequencyLines
from ctid_cli.inference.innovations import SampledNoise
from ctid_cli.models.additive import Term

#: Singular values of the scaled columns below this fraction of the largest count as zero.
RANK_TOLERANCE = 1e-11
#: Models times samples whose squared errors are found together: what fits into the second cache of a processor.
TOGETHER = 12_000


class Problem(NamedTuple):
    """Records, or a frequency response in their place, and what is eliminated with them."""

    records: tuple[FilterData | FrequencyLines, ...]
    #: Degree of the numerator.
    zeros: int
    free_response: bool
    #: Powers of time that are eliminated for each record.
    trend: tuple[int, ...]
    #: Period [s] of each record that repeats for ever, else 0.
    periods: tuple[float, ...]
    #: Known coefficients of the numerators in descending powers, NaN for those that are free; empty where all are. In a
    #: sum they belong to denominators with the constant term 1.
    numerator: Array = np.zeros(0)
    #: Poles at 0 that the model has besides. The lowest powers of time are then part of a free response.
    integrators: int = 0
    #: The noise by whose innovations errors count, of each record; empty where that is white.
    noises: tuple[SampledNoise, ...] = ()
    #: The submodels of a sum, which then say what ``zeros`` and ``integrators`` say of one fraction.
    terms: tuple[Term, ...] = ()

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
    def parts(self) -> tuple[int, ...]:
        """Number of poles of each submodel of a sum, integrators not among them; empty for one fraction."""
        return tuple(term.poles for term in self.terms)

    @property
    def coefficients(self) -> int:
        """Number of coefficients of all numerators."""
        return sum(term.zeros + 1 for term in self.terms) if self.terms else self.zeros + 1

    def submodels(self, order: int) -> "Submodels":
        """Return which states make up the response, of a model of a given order, integrators included."""
        return _submodels(self.terms, order, self.zeros, self.integrators)

    def rows(self, speed: Array, damping: Array) -> Rows:
        """Return the sections of each submodel with its integrators behind them."""
        if not self.terms:
            return [_integrating(speed, damping, self.integrators)]
        each = zip(split(speed, damping, self.parts), self.terms, strict=True)
        return [_integrating(*own, term.integrators) for own, term in each]


def _integrating(speed: Array, damping: Array, integrators: int) -> tuple[Array, Array]:
    """Return sections with integrators behind them."""
    if not integrators:
        return speed, damping
    return np.append(speed, np.zeros(integrators)), np.append(damping, -np.ones(integrators))


class Submodels(NamedTuple):
    """Which states of the sections make up a response."""

    terms: tuple[Term, ...]
    #: Places of the states that span the strictly proper part of all ``B/A u``: of each submodel its last m + 1.
    spanning: IntArray
    #: Which submodel has u itself besides, as one of degree n has; none where -1.
    direct: int
    #: Which states belong to poles that are searched, not to integrators.
    searched: BoolArray

    def directs(self, weight: float) -> Array:
        """Return the weight of u in each submodel."""
        found = np.zeros(len(self.terms))
        if self.direct >= 0:
            found[self.direct] = weight
        return found


@lru_cache
def _submodels(terms: tuple[Term, ...], order: int, zeros: int, integrators: int) -> Submodels:
    terms = terms or (Term(order - integrators, zeros, integrators),)
    first, spanning, direct, searched = 0, list[int](), -1, list[bool]()
    for k, term in enumerate(terms):
        spanning += range(first + term.order - min(term.zeros + 1, term.order), first + term.order)
        direct = k if term.zeros == term.order else direct
        searched += [True] * term.poles + [False] * term.integrators
        first += term.order
    return Submodels(terms, np.array(spanning, dtype=np.int64), direct, np.array(searched, dtype=bool))


class Weights(NamedTuple):
    """What the weights of the states, and of u itself, can be: a given part, and the span of a basis."""

    basis: Array
    given: Array


class Triangles(NamedTuple):
    """The rows of all records in one form."""

    form: Form
    columns: Columns
    delay: Delay
    #: Shape (K, q, q).
    rows: Array


class Slopes(NamedTuple):
    """Derivatives of half the squared error to the logarithmic coordinates and, last, the delay [1/s]."""

    squared_error: float
    gradient: Array
    #: J'J of Kaufman's Jacobian.
    curvature: Array


def weights_of(problem: Problem, speed: Array, damping: Array) -> Weights | None:
    """Weights of the states with which the numerator has its known coefficients; None where all are free.

    With ``b = T'w``, T the numerators of the states (and, last, A for u itself), the known ones ask ``T_k'w = b_k``.
    """
    known = np.isfinite(problem.numerator)
    if not known.any():
        return None
    rows = problem.rows(speed, damping)
    own = problem.submodels(sum(order_of(zeta) for _, zeta in rows))
    tables, directs = [], []
    for k, ((w, zeta), term) in enumerate(zip(rows, own.terms, strict=True)):
        # Known coefficients of a submodel belong to a denominator with the constant term 1.
        scale = polynomial(w, zeta)[term.poles] if problem.terms else 1.0
        table, width = numerators(w, zeta) / scale, term.zeros + 1
        if k == own.direct:
            tables.append(np.pad(table, ((0, 0), (1, 0))))
            directs.append(polynomial(w, zeta) / scale)
        else:
            tables.append(table[-width:, -width:])
            directs.append(np.zeros(width))
    table = block_diagonal(tables)
    if own.direct >= 0:
        table = np.vstack((table, np.concatenate(directs)))
    asked = table[:, known]
    lengths = np.linalg.norm(asked, axis=0)
    whole, triangle = np.linalg.qr(asked / lengths, mode="complete")
    count = lengths.size
    given = whole[:, :count] @ np.linalg.solve(triangle[:count].T, problem.numerator[known] / lengths)
    return Weights(whole[:, count:], given)


def _columns(problem: Problem, columns: Columns, rows: Array, states: Array) -> tuple[Array, Array]:
    """Return the columns Phi, and y, from the triangles of all records; further axes in front are further models."""
    *many, records, q, _ = rows.shape
    n, shared, submodels = columns.n, problem.coefficients, problem.submodels(columns.n)
    proper, own = submodels.spanning.size, n * problem.free_response + len(columns.trend)
    # The numerator is common to all records; a free response and a trend are zero outside their own.
    phi = np.zeros((*many, records, q, shared + records * own))
    to_states = np.swapaxes(states, -1, -2)
    phi[..., :proper] = rows[..., :n] @ to_states[..., submodels.spanning]
    if submodels.direct >= 0:
        phi[..., proper] = rows[..., columns.u]
    for k in range(records if own else 0):
        place, record = shared + k * own, slice(k, k + 1)
        if problem.free_response:
            phi[..., record, :, place : place + n] = rows[..., record, :, columns.free_z] @ to_states
        phi[..., record, :, place + own - len(columns.trend) : place + own] = rows[..., record, :, columns.powers]
    return phi.reshape(*many, records * q, -1), rows[..., columns.u + 1].reshape(*many, -1)


class Span:
    """What is eliminated, and what it leaves of the output, in the triangles of all records."""

    def __init__(self, problem: Problem, triangles: Triangles, weights: Weights | None) -> None:
        self.triangles, self.weights = triangles, weights
        self.n, self.shared = triangles.columns.n, problem.coefficients
        phi, y = _columns(problem, triangles.columns, triangles.rows, triangles.form.states)
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
    """The least squares for given poles and delay."""

    squared_error: float
    #: Weights of the states, and of u itself.
    output: Array
    direct: float
    #: Weights of the states of the free response, and of the powers of time, of each record: shapes (K, n) and (K, q).
    free: Array
    trend: Array
    span: "Span"


def project(problem: Problem, speed: Array, damping: Array, delay: Delay, *, slopes_too: bool = False) -> Projected:
    """Eliminate numerator, free responses and trends for given sections, fastest first.

    Where :func:`slopes` will follow, one pass over the records can serve both.
    """
    form = form_of(problem.rows(speed, damping), problem.length)
    second = slopes_too and isinstance(form, Modal)
    triangles = _triangles(problem, [form] * len(problem.records), delay, second)
    span = Span(problem, triangles, weights_of(problem, speed, damping))
    shared, own = span.solution()
    n, records = span.n, len(problem.records)
    output, free, trend = np.zeros(n), np.zeros((records, n)), np.zeros((records, len(problem.trend)))
    submodels = problem.submodels(n)
    proper = submodels.spanning.size
    output[submodels.spanning] = shared[:proper]
    if problem.free_response or problem.trend:
        own = own.reshape(records, -1)
        if problem.free_response:
            free = own[:, :n]
        trend = own[:, own.shape[1] - len(problem.trend) :]
    direct = float(shared[proper]) if submodels.direct >= 0 else 0.0
    squared_error = float(span.residual @ span.residual)
    return Projected(squared_error, output, direct, free, trend, span)


def squared_errors(problem: Problem, sections: Sequence[tuple[Array, Array]], delay: Delay) -> Array:
    """Return the squared errors of many sections of one order at one delay, to compare starts."""
    forms = [form_of(problem.rows(*own), problem.length) for own in sections]
    errors = np.zeros(len(forms))
    modal = [k for k, form in enumerate(forms) if isinstance(form, Modal)]
    if np.isfinite(problem.numerator).any():
        modal = []
    for k in set(range(len(forms))) - set(modal):
        errors[k] = project(problem, *sections[k], delay).squared_error
    at_once = max(TOGETHER // sum(data.count for data in problem.records), 1)
    for first in range(0, len(modal), at_once):
        own = modal[first : first + at_once]
        group = [form for k in own if isinstance(form := forms[k], Modal)]
        columns = Columns.of(group[0].poles.size, False, problem.free_response, problem.trend)
        rows = np.stack([triangles_of(group, columns, delay, *record) for record in problem.laid_out], axis=1)
        phi, y = _columns(problem, columns, rows, np.stack([form.states for form in group])[:, None])
        whole = np.concatenate((phi, y[:, :, None]), axis=2)
        lengths = np.linalg.norm(whole, axis=1, keepdims=True)
        left = np.asarray(np.linalg.qr(whole / np.where(lengths > 0.0, lengths, 1.0), mode="r"))[:, -1, -1]
        errors[own] = (left * lengths[:, 0, -1]) ** 2
    return errors


def _triangles(problem: Problem, forms: Sequence[Form], delay: Delay, second: bool) -> Triangles:
    """Return the triangles of all records, each in its form."""
    n = forms[0].states.shape[0]
    columns = Columns.of(n, second, problem.free_response, problem.trend)
    each = zip(forms, problem.laid_out, strict=True)
    rows = np.stack([triangle_of(form, columns, delay, *record) for form, record in each])
    return Triangles(forms[0], columns, delay, rows)


def slopes(
    problem: Problem, speed: Array, damping: Array, delay: Delay, projected: Projected, delay_free: bool
) -> Slopes:
    """Exact gradient, and Kaufman's J'J, at what :func:`project` gave for the same sections and delay."""
    span, output = projected.span, projected.output
    submodels = problem.submodels(span.n)
    direct = submodels.directs(projected.direct)
    triangles = span.triangles
    if not triangles.columns.second or triangles.delay != delay:
        forms = [triangles.form.driving(output, direct, free) for free in projected.free]
        span = Span(problem, _triangles(problem, forms, delay, True), weights_of(problem, speed, damping))
    form, columns, _, rows = span.triangles
    searched = submodels.searched
    n = int(np.count_nonzero(searched))
    psi = np.zeros((*rows.shape[:2], n + delay_free))
    states = 2 * columns.n
    psi[:, :, :n] = rows[:, :, :states] @ form.slopes(output, direct)[:, searched]
    if problem.terms and span.weights is not None:
        psi[:, :, :n] += _of_constants(problem, speed, damping, projected, span.triangles)
    if problem.free_response:
        maps = np.stack([form.slopes(free, 0.0 * direct)[:, searched] for free in projected.free])
        psi[:, :, :n] += rows[:, :, columns.free_states] @ maps
    if delay_free:
        # dx/dtau = -x'(t - tau).
        of_z, of_u = form.rate(output)
        psi[:, :, n] = -(rows[:, :, : columns.n] @ of_z + of_u * rows[:, :, columns.u])
    psi = psi.reshape(span.residual.size, n + delay_free)
    # (I - P): what the eliminated coefficients would follow is no effect of the poles.
    psi -= span.left @ (span.left.T @ psi)
    residual = span.residual
    return Slopes(float(residual @ residual), -(psi.T @ residual), psi.T @ psi)


def _of_constants(problem: Problem, speed: Array, damping: Array, projected: Projected, triangles: Triangles) -> Array:
    """Return what the constant terms of the denominators do to the output if known numerators keep their values."""
    found, first = [], 0
    form, columns, _, rows = triangles
    directs = problem.submodels(columns.n).directs(projected.direct)
    sections = split(speed, damping, problem.parts)
    for (_, zetas), term, direct in zip(sections, problem.terms, directs.tolist(), strict=True):
        own = np.zeros(columns.n)
        own[first : first + term.order] = projected.output[first : first + term.order]
        first += term.order
        response = rows[:, :, : columns.n] @ (own @ form.states) + direct * rows[:, :, columns.u]
        # The constant term is the product of all w^2 and p.
        found += [response * power for zeta in zetas.tolist() for power in ((1.0,) if zeta < 0 else (2.0, 0.0))]
    return np.stack(found, axis=-1)
