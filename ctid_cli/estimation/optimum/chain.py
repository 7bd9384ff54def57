r"""Cascade of sections, fastest first, and two forms of their signals: partial fractions and a state space.

Section i has unit static gain, ``p/(s + p)`` or ``w^2/(s^2 + 2 zeta w s + w^2)``, and its input is the output of the
previous section; an integrator, of speed 0, is ``1/s``. The state ``s/w`` times the output precedes the output, so that
state i of n has, over the common denominator, a numerator of degree ``n-1-i``: the last m + 1 states span all ``B/A u``
of degree m. Two real poles may merge into a pair.

Submodels of a sum are parallel cascades: maps are then block diagonal, and there are no divisions by differences
between poles of two submodels.

The *rows* of a form are ``z``, which are mapped to the states of the sections, and ``w``, which are mapped together
with z to the derivatives of ``x = B/A u`` with respect to the poles. Partial fractions are fast, and their rows do not
depend on B; the state space is used if poles are so close that partial fractions would amplify rounding.
"""

import cmath
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import inf
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ctid_cli.arrays import Array, ComplexArray, IntArray
from ctid_cli.filtering.bank import MODAL_CONDITION_LIMIT, Modes, Place, chain_states, modal_pass, to_steady_state
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.filtering.frequency_lines import FrequencyLines
from ctid_cli.filtering.realisation import exponential_minus_identity, transitions

Number = TypeVar("Number", np.float64, np.complex128)
#: Samples that are filtered at once, which limits the memory for a long record.
PIECE = 4096


class Record(NamedTuple):
    """Input of a form: a record with its delay and period."""

    data: FilterData
    delay: Place
    #: Period [s] of a periodic input, else 0; and the transition through one period up to the start of the data.
    period: float = 0.0
    once: FilterData | None = None

    @property
    def undelayed(self) -> Place:
        """Place without a delay."""
        return (0, 0.0) if self.data.interval > 0.0 else 0.0


def order_of(damping: Array) -> int:
    """Return the number of poles: one for a real pole, marked by a negative damping, two for a pair."""
    return damping.size + int(np.count_nonzero(damping >= 0.0))


def poles_of(speed: Array, damping: Array) -> list[complex]:
    """Return the poles section by section, the upper or the faster one first."""
    poles: list[complex] = []
    for w, zeta in zip(speed.tolist(), damping.tolist(), strict=True):
        if zeta < 0.0:
            poles.append(complex(-w))
        elif zeta < 1.0:
            poles += [
                w * complex(-zeta, swing) for swing in ((1.0 - zeta * zeta) ** 0.5, -((1.0 - zeta * zeta) ** 0.5))
            ]
        else:
            # The product of both poles is w^2, which gives the slow one without cancellation.
            fast = w * (zeta + (zeta * zeta - 1.0) ** 0.5)
            poles += [complex(-fast), complex(-w * w / fast)]
    return poles


def chain_dynamics(speed: Array, damping: Array) -> tuple[Array, Array]:
    """Return dynamics F and gain g of ``z' = F z + g v``."""
    n = order_of(damping)
    F, g, row = np.zeros((n, n)), np.zeros(n), 0
    for w, zeta in zip(speed.tolist(), damping.tolist(), strict=True):
        if row == 0:
            g[0] = w or 1.0
        else:
            F[row, row - 1] = w or 1.0
        # A pair has the states (s/w) x and x: x' = w (s/w) x, and ((s/w) x)' = -2 zeta w (s/w) x - w x + w v.
        if zeta < 0.0:
            F[row, row] = -w
            row += 1
        else:
            F[row, row], F[row, row + 1], F[row + 1, row] = -2.0 * zeta * w, -w, w
            row += 2
    return F, g


def polynomial(speed: Array, damping: Array) -> Array:
    """Return the monic product of the sections, descending powers."""
    product = np.ones(1)
    for w, zeta in zip(speed.tolist(), damping.tolist(), strict=True):
        product = np.convolve(product, [1.0, w] if zeta < 0 else [1.0, 2.0 * zeta * w, w * w])
    return product


def polynomial_slopes(speed: Array, damping: Array) -> Array:
    """Return the derivatives of ``a_1 ... a_n`` by ln w and ln zeta, or ln p, of each section, shape (n, n)."""
    columns = []
    for i, (w, zeta) in enumerate(zip(speed.tolist(), damping.tolist(), strict=True)):
        others = polynomial(np.delete(speed, i), np.delete(damping, i))
        own = [[w]] if zeta < 0 else [[2 * zeta * w, 2 * w * w], [2 * zeta * w, 0.0]]
        columns += [np.convolve(others, slope) for slope in own]
    n = len(columns)
    return np.array([np.pad(column, (n - column.size, 0)) for column in columns]).reshape(n, n).T


def numerators(speed: Array, damping: Array) -> Array:
    """Return the numerators of the states over the monic polynomial, descending powers, shape (n, n)."""
    n = order_of(damping)
    result = np.zeros((n, n))
    gain, row = 1.0, 0
    for i, (w, zeta) in enumerate(zip(speed.tolist(), damping.tolist(), strict=True)):
        rest = polynomial(speed[i + 1 :], damping[i + 1 :])
        gain *= (w or 1.0) if zeta < 0 else w * w
        if zeta >= 0:
            result[row, n - 1 - rest.size : n - 1] = gain / w * rest
            row += 1
        result[row, n - rest.size :] = gain * rest
        row += 1
    return result


#: Speeds and dampings of the sections of each submodel; a transfer function has one.
Rows = Sequence[tuple[Array, Array]]


def split(speed: Array, damping: Array, parts: Sequence[int]) -> Rows:
    """Return the sections of each of several submodels of given orders."""
    ends = np.cumsum(np.where(damping < 0.0, 1, 2))
    last = np.searchsorted(ends, np.cumsum(parts), side="right").tolist()
    first = [0, *last[:-1]]
    return [(speed[begin:end], damping[begin:end]) for begin, end in zip(first, last, strict=True)]


def block_diagonal(blocks: Sequence[NDArray[Number]]) -> NDArray[Number]:
    """Return a matrix with blocks along its diagonal."""
    if len(blocks) == 1:
        return blocks[0]
    rows = np.cumsum([0, *(len(block) for block in blocks)])
    columns = np.cumsum([0, *(block.shape[1] for block in blocks)])
    whole = np.zeros((rows[-1], columns[-1]), blocks[0].dtype)
    for k, block in enumerate(blocks):
        whole[rows[k] : rows[k + 1], columns[k] : columns[k + 1]] = block
    return whole


def submodels_of(rows: Rows) -> IntArray:
    """Return the submodel index of each state, shape (n,)."""
    return np.repeat(np.arange(len(rows)), [order_of(damping) for _, damping in rows])


def chains_dynamics(rows: Rows) -> tuple[Array, Array]:
    """Return dynamics F and gain g of all parallel cascades."""
    each = [chain_dynamics(*own) for own in rows]
    return block_diagonal([F for F, _ in each]), np.concatenate([g for _, g in each])


def all_numerators(rows: Rows) -> Array:
    """Return the numerators of the states, each over the polynomial of its submodel, shape (n, n)."""
    return block_diagonal([numerators(*own) for own in rows])


def forms_of(rows: Rows, channels: Sequence[slice], length: float) -> list["Form"]:
    """Return the form of the sections of each channel; all of one kind, so that one pass of the records serves all."""
    modal = all(_apart(poles_of(*own), length) for own in rows)
    made = dict[int, Form]()
    for own in channels:
        if own.start not in made:
            made[own.start] = Modal.of(rows[own]) if modal else Chain.of(rows[own])
    return [made[own.start] for own in channels]


def _apart(poles: list[complex], length: float) -> bool:
    """Return whether poles are far enough apart for accurate partial fractions."""
    worst = 1.0
    for i, pole in enumerate(poles):
        # Residues of poles with overlapping resonances, or responses within the record, nearly cancel: each such pair
        # amplifies rounding by this factor, and by its square if the denominator is squared.
        product = 1.0
        for other in poles[:i] + poles[i + 1 :]:
            apart = abs(pole - other)
            product *= max(1.0, (2.0 / length - pole.real - other.real) / apart) if apart else inf
        worst = max(worst, product)
    return worst**2 < MODAL_CONDITION_LIMIT


@lru_cache
def _both_of_pairs(pairs: tuple[bool, ...]) -> ComplexArray:
    """Return the map from real and imaginary parts of one pole of each pair, and from real poles, to all poles."""
    whole = np.eye(len(pairs), dtype=complex)
    upper = np.flatnonzero(pairs)
    whole[upper, upper + 1], whole[upper + 1, upper], whole[upper + 1, upper + 1] = 1j, 1.0, -1j
    return whole


@dataclass(frozen=True, eq=False)
class Fractions:
    """Partial fractions: z is ``1/(s - p) u`` of each pole and w is ``1/(s - p)^2 u``, real and imaginary parts."""

    #: Modes to be filtered, one of each pair.
    modes: Modes

    @staticmethod
    def modes_of(poles: ComplexArray) -> Modes:
        """Return modes without an output."""
        count = poles.size
        return Modes(poles, np.zeros(count, np.int64), np.zeros((count, 2), complex), np.zeros(1))

    def forced(self, record: Record, second: bool) -> Iterator[Array]:
        """Yield ``[z, w, u, y]`` of the used samples, piece by piece."""
        modes, states = self.modes, np.zeros((self.modes.poles.size, 5), complex)
        if record.once is not None:
            modal_pass(record.once, modes, record.undelayed, filter_output=False, states=states)
            to_steady_state(modes.poles, record.period, states)
        for data, delay in pieces(record.data, record.delay):
            yield modal_pass(data, modes, delay, rows=True, double=second, filter_output=False, states=states)

    def at_lines(self, lines: FrequencyLines, delay: Place, second: bool) -> ComplexArray:
        """Return ``[z, w, u]`` at the lines of a frequency response."""
        poles = self.modes.poles
        pairs = poles.imag > 0.0
        both = lines.of_modes(np.concatenate((poles, poles[pairs].conj())), delay)
        columns = []
        for values in both if second else both[:1]:
            upper, lower = values[:, : poles.size], values[:, : poles.size].copy()
            lower[:, pairs] = values[:, poles.size :]
            # Real and imaginary parts in time are half the sum and half the difference of a mode and its conjugate.
            of_z = np.stack((0.5 * (upper + lower), -0.5j * (upper - lower)), axis=2)
            columns.append(
                of_z.reshape(len(values), -1)[:, np.column_stack((np.full(poles.size, True), pairs)).ravel()]
            )
        return np.column_stack((*columns, lines.delayed(delay)))

    def free(self, elapsed: Array, second: bool) -> Array:
        """Return rows ``[z, w]`` after an impulse, transposed."""
        rows = np.empty((2 if second else 1, self.modes.width, elapsed.size))
        row = 0
        for pole in self.modes.poles.tolist():
            decay = np.exp(pole.real * elapsed)
            if pole.imag:
                rows[0, row] = decay * np.cos(pole.imag * elapsed)
                rows[0, row + 1] = decay * np.sin(pole.imag * elapsed)
                row += 2
            else:
                rows[0, row] = decay
                row += 1
        if second:
            np.multiply(rows[0], elapsed, out=rows[1])
        return rows.reshape(-1, elapsed.size)


def _residues(speed: Array, damping: Array, poles: list[complex]) -> ComplexArray:
    """Return the residues of the states of sections at their poles, shape (n, n)."""
    # A state is its gain over the product of s - pole up to the end of its section; the first of a pair is times s/w.
    n, gain, first = len(poles), 1.0, 0
    weights = np.zeros((n, n), dtype=complex)
    products = [1.0 + 0.0j] * n
    for w, zeta in zip(speed.tolist(), damping.tolist(), strict=True):
        last = first if zeta < 0.0 else first + 1
        for i in range(last + 1):
            for k in range(first if i < first else 0, last + 1):
                if i != k:
                    products[i] *= poles[i] - poles[k]
        gain *= (w or 1.0) if zeta < 0.0 else w * w
        weights[last, : last + 1] = [gain / product for product in products[: last + 1]]
        if zeta >= 0.0:
            weights[first, : last + 1] = [gain / w * p / q for p, q in zip(poles[: last + 1], products, strict=False)]
        first = last + 1
    return weights


@dataclass(frozen=True, eq=False)
class Modal(Fractions):
    """Sections as partial fractions."""

    #: Damping of all sections.
    damping: Array
    poles: ComplexArray
    #: Submodel index of each pole, shape (n,).
    submodel: IntArray
    #: Map from z to the modes of all poles, shape (n, n).
    whole: ComplexArray
    #: Maps from the modes of all poles, and from z, to the states of the sections, shape (n, n).
    weights: ComplexArray
    states: Array

    @classmethod
    def of(cls, rows: Rows) -> "Modal":
        """Return the partial fractions of distinct poles."""
        each = [poles_of(*own) for own in rows]
        poles = [pole for own in each for pole in own]
        weights = block_diagonal([_residues(*own, found) for own, found in zip(rows, each, strict=True)])
        modes = cls.modes_of(np.array([pole for pole in poles if pole.imag >= 0.0]))
        whole = _both_of_pairs(tuple(pole.imag > 0.0 for pole in poles))
        damping, states = np.concatenate([own for _, own in rows]), (weights @ whole).real
        return cls(modes, damping, np.array(poles), submodels_of(rows), whole, weights, states)

    def driving(self, output: Array, direct: Array, free: Array) -> "Modal":
        """Return the form with w for ``x = output z + direct u`` of each submodel and its free response."""
        return self

    def rate(self, output: Array) -> tuple[Array, float]:
        """Return the weights of z and of u in the derivative of ``x = output z`` to time."""
        residues = output @ self.weights
        return ((residues * self.poles) @ self.whole).real, float(residues.sum().real)

    def slopes(self, output: Array, direct: Array) -> Array:
        """Return the map from ``[z, w]`` to the derivatives of x to the coordinates, B being fixed, shape (2 n, n)."""
        residues = output @ self.weights
        moved = np.zeros((self.poles.size, self.poles.size), complex)
        k = 0
        for zeta in self.damping.tolist():
            moved[k, k] = self.poles[k]
            if zeta >= 0.0:
                # Both poles grow with w; with zeta the faster one grows and the slower one falls, -w (zeta +- root).
                root = cmath.sqrt(zeta * zeta - 1.0) * (1.0 if zeta >= 1.0 else -1.0)
                moved[k + 1, k] = self.poles[k + 1]
                moved[k, k + 1], moved[k + 1, k + 1] = zeta / root * self.poles[k], -zeta / root * self.poles[k + 1]
                k += 1
            k += 1
        # dx/dp_i = 1/(s - p_i) x, and 1/((s - p_i)(s - p_k)) is a difference of two fractions.
        inverse = self.poles[:, None] - self.poles
        inverse[inverse == 0.0] = 1.0
        inverse = np.where(self.submodel[:, None] == self.submodel, 1.0 / inverse, 0.0)
        np.fill_diagonal(inverse, 0.0)
        single = moved * (direct[self.submodel] + inverse @ residues)[:, None] + residues[:, None] * (inverse @ moved)
        return np.vstack((self.whole.T @ single, self.whole.T @ (moved * residues[:, None]))).real


@dataclass(frozen=True, eq=False)
class Chain:
    """State space: z are the states of the sections, and w those of a second chain with input x."""

    rows: Rows
    dynamics: Array
    gain: Array
    #: Gains of the free response.
    free_dynamics: Array
    free_gain: Array

    @classmethod
    def of(cls, rows: Rows) -> "Chain":
        """Return the state space of sections without a second chain."""
        F, g = chains_dynamics(rows)
        return cls(rows, F, g, F, g)

    @property
    def states(self) -> Array:
        """Return the map from z to the states of the sections."""
        return np.eye(sum(order_of(damping) for _, damping in self.rows))

    def driving(self, output: Array, direct: Array, free: Array) -> "Chain":
        """Return the form whose w has the input ``x = output z + direct u`` of each submodel, and its free response.

        Each submodel has a separate second chain.
        """
        F, g, submodel = self.dynamics, self.gain, submodels_of(self.rows)
        own = np.where(submodel[:, None] == submodel, g[:, None], 0.0)
        double = np.zeros((2 * g.size, 2 * g.size))
        double[: g.size, : g.size] = double[g.size :, g.size :] = F
        double[g.size :, : g.size] = own * output
        double_free = double.copy()
        double_free[g.size :, : g.size] = own * free
        gain = np.concatenate((g, g * direct[submodel]))
        return replace(
            self, dynamics=double, gain=gain, free_dynamics=double_free, free_gain=np.concatenate((g, 0.0 * g))
        )

    def forced(self, record: Record, second: bool) -> Iterator[Array]:
        """Yield ``[z, w, u, y]`` of the used samples."""
        initial = np.zeros(self.gain.size)
        if record.once is not None:
            # x_N is the state after one period from rest: x0 = x_N + Phi^N x0. With X = Phi^N - I, computed by the
            # exponential without cancellation, X x0 = -x_N.
            end = chain_states(self.dynamics, self.gain, 1.0, record.once, record.undelayed)[-1, :-1]
            initial = np.asarray(np.linalg.solve(exponential_minus_identity(self.dynamics * record.period), -end))
        data = record.data
        states = chain_states(self.dynamics, self.gain, 1.0, data, record.delay, initial)
        yield np.column_stack((states, data.y))[data.use]

    def at_lines(self, lines: FrequencyLines, delay: Place, second: bool) -> ComplexArray:
        """Return ``[z, w, u]`` at the lines of a frequency response."""
        return np.column_stack((lines.of_states(self.dynamics, self.gain, delay), lines.delayed(delay)))

    def free(self, elapsed: Array, second: bool) -> Array:
        """Return rows ``[z, w]`` after an impulse, transposed."""
        from ctid_cli.filtering import kernels  # numba is slow to import

        table = transitions(self.free_dynamics, 0.0 * self.free_gain, float(elapsed[-1]))
        breaks = np.zeros(1), np.zeros(1), False
        return np.asarray(kernels.irregular_states(*table, *breaks, elapsed, 0.0, self.free_gain)[:, :-2].T)

    def rate(self, output: Array) -> tuple[Array, float]:
        """Return the weights of z and of u in the derivative of ``x = output z`` to time."""
        n = output.size
        return output @ self.dynamics[:n, :n], float(output @ self.gain[:n])

    def slopes(self, output: Array, direct: Array) -> Array:
        """Return the map from ``[z, w]`` to the derivatives of x to the coordinates, B being fixed, shape (2 n, n)."""
        table = all_numerators(self.rows)
        slopes = block_diagonal([polynomial_slopes(*own) for own in self.rows])
        return np.vstack((np.zeros_like(table), -np.linalg.solve(table.T, slopes)))


#: Either form of the sections.
Form = Modal | Chain


def pieces(data: FilterData, delay: Place) -> Iterator[tuple[FilterData, Place]]:
    """Yield the pieces of a record, each with the input from the break at which its states are given."""
    count, begin = data.t.size, 0
    if count <= PIECE:
        yield data, delay
        return
    for first in range(0, count, PIECE):
        last = min(first + PIECE, count)
        own = slice(first, last)
        part = data._replace(t=data.t[own], y=data.y[own], use=data.use[own])
        if isinstance(delay, tuple):
            shift, fraction = delay
            begin = max(first - shift, 0)
            end = max(last - shift, begin) + 1
            yield part._replace(u=data.u[begin:end]), (shift - first + begin, fraction)
        else:
            yield part._replace(tu=data.tu[begin:], u=data.u[begin:]), delay
            reached = np.searchsorted(data.tu, data.t[last - 1] - delay + data.slack, side="right")
            begin = max(int(reached) - 1, 0)
