r"""A model's output and its sensitivities to the parameters as one discrete-time system driven by the held input.

For every submodel ``B/(p^l A)`` of an additive model, and for an unfactored transfer function as the only one with
``l = 0``, two chains of states are driven one by the other: ``1/(p^l A)`` by the input, ``1/A`` by the output of the
first. They hold all sensitivities, so the input is filtered once. The first chain is the submodel itself; a
controller closed around it feeds back the same states that the sensitivities read, and no integrator appears twice.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.errors import DataError
from ctid_cli.filtering.bank import standard_rows
from ctid_cli.filtering.filter_data import filter_data, plain_array, split_delay
from ctid_cli.filtering.realisation import chain, held_step, scaled_roots
from ctid_cli.filtering.simulate import feedthrough
from ctid_cli.filtering.submodels import SubmodelFilter
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record


@dataclass(frozen=True)
class Structure:
    """Degrees of a transfer function and whether its delay is a parameter."""

    poles: int
    zeros: int
    delay: bool = False

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.poles + self.zeros + 1 + int(self.delay)

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names in the order of theta: ``a1 … an, b0 … bm`` and ``delay``."""
        names = [f"a{i}" for i in range(1, self.poles + 1)] + [f"b{j}" for j in range(self.zeros + 1)]
        return tuple(names + ["delay"] * self.delay)

    @cached_property
    def sensitivity_rows(self) -> IndexArray:
        """Standard rows of dx/dtheta, up to the sign."""
        n, m = self.poles, self.zeros
        rows = [n + 1 + n - i for i in range(1, n + 1)] + [m - j for j in range(m + 1)]
        return np.array(rows + [3 * n + 2] * self.delay, dtype=np.intp)

    @cached_property
    def regressor_rows(self) -> IndexArray:
        """Standard rows of the regressor: as the sensitivities, the measured output in the model output's place."""
        rows = self.sensitivity_rows.copy()
        rows[: self.poles] += self.poles
        return rows

    @cached_property
    def signs(self) -> Array:
        """Signs of the rows above."""
        signs = np.ones(self.size)
        signs[: self.poles] = -1.0
        if self.delay:
            signs[-1] = -1.0
        return signs

    @property
    def error_row(self) -> int:
        """Standard row of the output error."""
        return 3 * self.poles + 1

    def hessian(self, moments: Array) -> Array:
        """``sum psi psi'`` from the second moments of the standard rows."""
        rows = self.sensitivity_rows
        return np.asarray(moments[np.ix_(rows, rows)] * np.outer(self.signs, self.signs))


def sensitivities(
    model: AdditiveModel | TransferFunction,
    signal: HeldSignal,
    times: ArrayLike,
    zeros: int | None = None,
    *,
    estimate_delay: bool = False,
) -> Array:
    """Derivatives of a model's output at given times by its parameters, of a fraction also by its delay."""
    instants = np.asarray(times, dtype=float)
    data = filter_data(Record(instants, np.zeros(instants.size), signal), start=-np.inf)
    if isinstance(model, AdditiveModel):
        found = SubmodelFilter(data, model.terms, model.delay).rows(model.theta)
        if found is None:
            raise DataError("the response of the system is not finite")
        return found[0]
    structure = Structure(model.order, model.numerator.size - 1 if zeros is None else zeros, estimate_delay)
    if model.order == 0:
        return np.column_stack([signal.at(instants - model.delay), *[np.zeros(instants.size)] * estimate_delay])
    n, (direct, rest) = model.order, feedthrough(model)
    rows = standard_rows(data, model.denominator, rest if direct else model.numerator, model.delay)
    if structure.zeros == n:
        # p^n/A u = u - sum of a_i p^(n-i)/A u, and x is what passes at once besides. Between the breaks of a held input
        # the derivative by the delay has nothing of that.
        rows[:, n + 1 : 2 * n + 1] += direct * rows[:, :n]
        rows[:, n] -= rows[:, n - 1 :: -1] @ model.denominator[1:]
    return np.asarray(rows[:, structure.sensitivity_rows] * structure.signs)


@dataclass(frozen=True, eq=False)
class DiscreteSystem:
    """``s(k+1) = A s(k) + B w(k)``, ``o(k) = C s(k) + D w(k)``."""

    #: Transition of the state over one sampling interval [-], shape (n, n).
    A: Array
    #: Effect of the inputs held over it, shape (n, i).
    B: Array
    #: Outputs from the state, shape (o, n).
    C: Array
    #: Outputs from the inputs at the same instant, shape (o, i).
    D: Array

    @property
    def radius(self) -> float:
        """Spectral radius of A [-]; below 1 the outputs are stationary under a stationary input."""
        return float(np.abs(np.linalg.eigvals(self.A)).max(initial=0.0))

    def after(self, first: DiscreteSystem) -> DiscreteSystem:
        """The series of another system and this one."""
        n, m = first.A.shape[0], self.A.shape[0]
        A = np.block([[first.A, np.zeros((n, m))], [self.B @ first.C, self.A]])
        B = np.vstack([first.B, self.B @ first.D])
        return DiscreteSystem(A, B, np.hstack([self.D @ first.C, self.C]), self.D @ first.D)


def sensitivity_system(
    model: AdditiveModel | TransferFunction, interval: float, zeros: int | None = None
) -> DiscreteSystem:
    r"""System from the held input to the model's output and its sensitivities.

    Exact for an input held between samples, for any delay: a delay of a broken number of intervals is read off between
    the samples. For a submodel with the coefficient of ``p^k`` in A and B as the parameter of index k,

    .. math:: \partial x/\partial a_k = -\frac{p^k B}{p^l A^2} u, \qquad \partial x/\partial b_k = \frac{p^k}{p^l A} u,

    and for a monic transfer function with descending powers, k becomes n - i for ``a_i`` and m - j for ``b_j``.
    """
    shift, fraction = split_delay(model.delay, interval)
    blocks = [_held(*block, interval, fraction) for block in _blocks(model, zeros)]
    states = sum(block.A.shape[0] for block in blocks)
    size = sum(block.C.shape[0] - 1 for block in blocks)
    A, B = np.zeros((states, states)), np.zeros((states, 1))
    C, D = np.zeros((1 + size, states)), np.zeros((1 + size, 1))
    state, row = 0, 1
    for block in blocks:
        own = slice(state, state + block.A.shape[0])
        rows = slice(row, row + block.C.shape[0] - 1)
        A[own, own], B[own] = block.A, block.B
        C[0, own], C[rows, own] = block.C[0], block.C[1:]
        D[0] += block.D[0]
        D[rows] = block.D[1:]
        state, row = own.stop, rows.stop
    held = DiscreteSystem(A, B, C, D)
    if not shift:
        return held
    last = np.zeros((1, shift))
    last[0, -1] = 1.0
    line = DiscreteSystem(np.eye(shift, k=-1), np.eye(shift, 1), last, np.zeros((1, 1)))
    return held.after(line)


def _blocks(model: AdditiveModel | TransferFunction, zeros: int | None) -> list[tuple[Array, Array, Array, float]]:
    """Continuous-time cascade of every submodel, with the rows of its output and sensitivities."""
    if isinstance(model, TransferFunction):
        dynamics, gain, of_input, output, of_output, w0 = _cascade(model.numerator, model.denominator, 0)
        m = model.numerator.size - 1 if zeros is None else zeros
        return [(dynamics, gain, np.vstack([output, -of_output[-2::-1], of_input[m::-1]]), w0)]
    blocks = []
    for submodel in model.submodels:
        # The submodel's own coefficients are scaled to a constant term of 1; p^k/A then is p^k/(monic A) over the last.
        b, a = np.asarray(submodel.numerator, dtype=float), np.asarray(submodel.denominator, dtype=float)
        dynamics, gain, of_input, output, of_output, w0 = _cascade(b / a[0], a / a[0], submodel.integrators)
        rows = np.vstack([output, -of_output[1:] / a[0], of_input[: b.size] / a[0]])
        blocks.append((dynamics, gain, rows, w0))
    return blocks


def _cascade(b: Array, a: Array, integrators: int) -> tuple[Array, Array, Array, Array, Array, float]:
    """Chains ``1/(p^l A)`` and, driven by ``x = B/(p^l A) u``, ``1/A``, in the time unit 1/w0.

    Returns the dynamics, the gain, then as rows over (states, input) ``p^k/(p^l A) u`` for k = 0 … n+l, x, and
    ``p^k/A x`` for k = 0 … n, and w0.
    """
    n = a.size - 1
    order = n + integrators
    w0, poles = scaled_roots(plain_array(a))
    first, first_entry, first_powers = chain(np.concatenate([poles, np.zeros(integrators)]))
    second, second_entry, second_powers = chain(poles)
    size = order + n
    of_input = np.zeros((order + 1, size + 1))
    of_input[:order, :order] = first_powers * w0 ** (np.arange(order) - order)[:, None]
    of_input[order, size] = 1.0
    of_input[order] -= a[1:] @ of_input[integrators:order][::-1]
    output = b[::-1] @ of_input[: b.size]
    of_output = np.zeros((n + 1, size + 1))
    of_output[:n, order:size] = second_powers * w0 ** (np.arange(n) - n)[:, None]
    of_output[n] = output - a[1:] @ of_output[:n][::-1]
    dynamics = np.zeros((size, size))
    dynamics[:order, :order] = first
    dynamics[order:, order:] = second
    dynamics[order:, :order] = np.outer(second_entry, output[:order])
    gain = np.concatenate([first_entry, second_entry * output[size]])
    return dynamics, gain, of_input, output, of_output, w0


def _held(dynamics: Array, gain: Array, rows: Array, w0: float, interval: float, fraction: float) -> DiscreteSystem:
    """Exact sampled system, its rows read a fraction of an interval after the samples."""
    A, B, _ = held_step(dynamics, gain, interval * w0)
    C, D = rows[:, :-1], rows[:, -1]
    if fraction > 0.0:
        part, part_value, _ = held_step(dynamics, gain, fraction * interval * w0)
        C, D = C @ part, D + C @ part_value
    return DiscreteSystem(A, B[:, None], C, D[:, None])
