r"""Models as functions of their parameters: the simulated output, and its exact derivatives.

With ``G = B/A exp(-tau p)``, ``theta = (a_1 … a_n, b_0 … b_m, tau)`` and monic A

.. math:: \frac{\partial G}{\partial a_i} = -\frac{p^{n-i}}{A} G, \quad
          \frac{\partial G}{\partial b_j} = \frac{p^{m-j}}{A} e^{-\tau p}, \quad
          \frac{\partial G}{\partial\tau} = -p\,G,

and of a submodel ``B/(p^l A)`` of a sum, whose coefficients go by the powers of p that they multiply,
``-p^k/A G`` and ``p^k/(p^l A) exp(-tau p)``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctid_cli.arrays import Array, ComplexArray, IndexArray
from ctid_cli.errors import DataError
from ctid_cli.filtering.bank import standard_rows
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.simulate import feedthrough, simulate
from ctid_cli.filtering.submodels import SubmodelFilter
from ctid_cli.inference.derived import pole_slopes
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.factoring import unfactored
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

Number = TypeVar("Number", np.float64, np.complex128)
Model = TransferFunction | AdditiveModel
_COEFFICIENT = re.compile(r"(?:g\d+_)?[ab](\d+)|delay")


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


class _Part(NamedTuple):
    """A fraction ``B/(p^l A)`` of a model, and the powers of p that its parameters multiply."""

    numerator: Array
    denominator: Array
    integrators: int
    a_powers: range
    b_powers: range

    @classmethod
    def of_submodel(cls, part: Submodel) -> _Part:
        """Lay out a submodel of a sum, whose coefficients go by rising powers."""
        term = part.term()
        a_powers, b_powers = range(1, term.poles + 1), range(term.zeros + 1)
        return cls(part.numerator, part.denominator, part.integrators, a_powers, b_powers)


@dataclass(frozen=True, eq=False)
class Parametric:
    """A model, and which of its numbers are free."""

    model: Model
    #: Of all free parameters of a fit, initial states and offsets among them, which no response of the model has.
    names: tuple[str, ...]
    #: Whether responses over time are those behind a differentiator.
    differentiated: bool = False

    @cached_property
    def zeros(self) -> int:
        """Degree of the numerator of a fraction, a leading coefficient that is zero included."""
        own = [int(name[1:]) for name in self.names if re.fullmatch(r"b\d+", name)]
        return max([self.fraction.numerator.size - 1, *own])

    @property
    def zeros_of_fraction(self) -> int:
        """The same of the model as one transfer function."""
        return self.fraction.numerator.size - 1 if isinstance(self.model, AdditiveModel) else self.zeros

    @property
    def fraction(self) -> TransferFunction:
        """The model as one transfer function."""
        return unfactored(self.model) if isinstance(self.model, AdditiveModel) else self.model

    @cached_property
    def every(self) -> tuple[str, ...]:
        """Names of all numbers of the model, free or not."""
        if isinstance(self.model, AdditiveModel):
            return (*self.model.names, "delay")
        return Structure(self.model.order, self.zeros, delay=True).names

    @cached_property
    def free(self) -> tuple[IndexArray, IndexArray]:
        """Places of the free numbers of the model: among the names of the fit, and among all of the model."""
        mine = [k for k, name in enumerate(self.names) if _COEFFICIENT.fullmatch(name)]
        places = {name: k for k, name in enumerate(self.every)}
        unknown = [self.names[k] for k in mine if self.names[k] not in places]
        if unknown:
            raise DataError(f"the model has no parameter {unknown[0]!r}; it has {', '.join(self.every)}")
        return np.array(mine, dtype=np.intp), np.array([places[self.names[k]] for k in mine], dtype=np.intp)

    @cached_property
    def theta(self) -> Array:
        """All numbers of the model, in the order of ``every``."""
        model = self.model
        if isinstance(model, AdditiveModel):
            return np.append(model.theta, model.delay)
        b = np.concatenate((np.zeros(self.zeros + 1 - model.numerator.size), model.numerator))
        return np.concatenate((model.denominator[1:], b, [model.delay]))

    def at(self, change: Array) -> Parametric:
        """The model whose free numbers have changed so much; a delay does not fall below zero."""
        theta = self.theta.copy()
        theta[self.free[1]] += change
        delay = max(float(theta[-1]), 0.0)
        if isinstance(self.model, AdditiveModel):
            return replace(self, model=AdditiveModel.from_theta(theta[:-1], self.model.terms, delay))
        n = self.model.order
        return replace(self, model=TransferFunction(theta[n:-1], np.concatenate(([1.0], theta[:n])), delay))

    def _among_all(self, every: NDArray[Number]) -> NDArray[Number]:
        """Derivatives by all numbers of the model as derivatives by all parameters of the fit."""
        mine, places = self.free
        found = np.zeros((len(every), len(self.names)), dtype=every.dtype)
        found[:, mine] = every[:, places]
        return found

    @cached_property
    def _parts(self) -> list[_Part]:
        model = self.model
        if isinstance(model, AdditiveModel):
            return [_Part.of_submodel(part) for part in model.submodels]
        n, m = model.order, self.zeros
        return [_Part(model.numerator, model.denominator, 0, range(n - 1, -1, -1), range(m, -1, -1))]

    def frequency_slopes(self, frequencies: Array) -> ComplexArray:
        """Derivatives of ``G(j w)``, shape (N, p)."""
        s = np.asarray(1j * frequencies, dtype=complex)
        delayed = np.exp(-s * self.model.delay)
        columns: list[ComplexArray] = []
        for part in self._parts:
            own = np.polyval(part.denominator, s)
            over = s**part.integrators * own / delayed
            response = np.polyval(part.numerator, s) / over
            columns += [np.asarray(-(s**k) / own * response) for k in part.a_powers]
            columns += [np.asarray(s**k / over) for k in part.b_powers]
        columns.append(-s * self.model.frequency_response(frequencies))
        return self._among_all(np.column_stack(columns))

    def simulated(self, signal: HeldSignal, times: Array) -> Array:
        """Output from rest."""
        return np.asarray(np.sum([simulate(part, signal, times) for part in self._fractions], axis=0))

    def output_slopes(self, signal: HeldSignal, times: Array) -> Array:
        """Derivatives of the output from rest, shape (N, p)."""
        columns = []
        delay = np.zeros((times.size, 1))
        # What a differentiator is behind has no constant term: the numerator has one more coefficient without it.
        more = int(self.differentiated)
        if isinstance(self.model, AdditiveModel):
            for part in self._submodels:
                found = sensitivities(AdditiveModel([part], self.model.delay), signal, times)
                columns.append(np.delete(found, np.s_[part.term().poles : part.term().poles + more], axis=1))
            if "delay" in self.names:
                delay += sum(sensitivities(one, signal, times, estimate_delay=True)[:, -1:] for one in self._fractions)
        else:
            found = sensitivities(self._fractions[0], signal, times, self.zeros + more, estimate_delay=True)
            columns, delay = [found[:, : found.shape[1] - 1 - more]], found[:, -1:]
        return self._among_all(np.hstack([*columns, delay]))

    @property
    def derivative(self) -> Parametric:
        """The model behind a differentiator, whose step response is the impulse response of this one."""
        parts = self.model.submodels if isinstance(self.model, AdditiveModel) else (self.model,)
        if any(part.relative_degree < 1 for part in parts):
            raise DataError(
                "a model with as many zeros as poles passes on an impulse itself, which is no number at any instant; "
                "look at its step response"
            )
        return replace(self, differentiated=True)

    @property
    def _submodels(self) -> list[Submodel]:
        """The submodels of a sum, differentiated where that is asked for."""
        assert isinstance(self.model, AdditiveModel)
        return [Submodel(self._driven(s.numerator), s.denominator, s.integrators) for s in self.model.submodels]

    @property
    def _fractions(self) -> list[TransferFunction]:
        """The model, or each of its submodels, with the delay, differentiated where that is asked for."""
        model = self.model
        if isinstance(model, AdditiveModel):
            parts = [part.transfer_function() for part in self._submodels]
            return [TransferFunction(part.numerator, part.denominator, model.delay) for part in parts]
        return [TransferFunction(self._driven(model.numerator), model.denominator, model.delay)]

    def _driven(self, numerator: Array) -> Array:
        """A numerator times p where the model is differentiated."""
        return np.append(numerator, 0.0) if self.differentiated else numerator

    def poles(self) -> tuple[ComplexArray, ComplexArray]:
        """Poles, and their derivatives, shape (n, p); integrators of submodels stay where they are."""
        rows, found, first = [], [], 0
        for part in self._parts:
            poles, jacobian = pole_slopes(part.denominator, part.a_powers)
            slopes = np.zeros((poles.size + part.integrators, len(self.every)), dtype=complex)
            slopes[: poles.size, first : first + len(part.a_powers)] = jacobian
            found.append(np.concatenate((poles, np.zeros(part.integrators))))
            rows.append(slopes)
            first += len(part.a_powers) + len(part.b_powers)
        return np.concatenate(found), self._among_all(np.vstack(rows))
