r"""Models as functions of their parameters: the simulated output, and its exact derivatives.

With ``G = B/A exp(-tau p)``, ``theta = (a_1 … a_n, b_0 … b_m, tau)`` and monic A

.. math:: \frac{\partial G}{\partial a_i} = -\frac{p^{n-i}}{A} G, \quad
          \frac{\partial G}{\partial b_j} = \frac{p^{m-j}}{A} e^{-\tau p}, \quad
          \frac{\partial G}{\partial\tau} = -p\,G,

and for a submodel ``B/(p^l A)`` of a sum, whose coefficients are numbered by their power of p, ``-p^k/A G`` and
``p^k/(p^l A) exp(-tau p)``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctid_cli.arrays import Array, ComplexArray, IndexArray
from ctid_cli.errors import DataError
from ctid_cli.filtering.bank import standard_rows
from ctid_cli.filtering.filter_data import FilterData, filter_data
from ctid_cli.filtering.simulate import feedthrough, simulate
from ctid_cli.models.additive import AdditiveModel, Term, names_of
from ctid_cli.models.factoring import pole_jacobian, unfactored
from ctid_cli.models.transfer_function import TransferFunction, sorted_roots
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
        """Standard rows of the regressor: the sensitivities with the measured instead of the model output."""
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


@dataclass(frozen=True)
class SumStructure:
    """Degrees of a sum of submodels and whether its delay is a parameter."""

    terms: tuple[Term, ...]
    delay: bool = False

    @property
    def poles(self) -> int:
        """Number of poles, integrators included."""
        return sum(term.order for term in self.terms)

    @property
    def zeros(self) -> int:
        """Number of coefficients of all numerators, less one."""
        return sum(term.zeros + 1 for term in self.terms) - 1

    @property
    def size(self) -> int:
        """Number of parameters."""
        return sum(term.size for term in self.terms) + int(self.delay)

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names: those of the submodels and ``delay``."""
        return names_of(self.terms) + ("delay",) * self.delay

    @property
    def denominators(self) -> IndexArray:
        """Indices of the coefficients of the denominators."""
        return np.array([k for k, name in enumerate(self.names) if "_a" in name], dtype=np.intp)

    @property
    def numerators(self) -> IndexArray:
        """Indices of the coefficients of each numerator, in descending powers."""
        last = np.cumsum([term.size for term in self.terms]).tolist()
        places = [np.arange(end - 1, end - term.zeros - 2, -1) for end, term in zip(last, self.terms, strict=True)]
        return np.concatenate(places).astype(np.intp)

    def theta_of(self, model: Model) -> Array:
        """Return the parameters of a model of this structure."""
        assert isinstance(model, AdditiveModel)
        return np.concatenate((model.theta, [model.delay] * self.delay))

    def fractions_of(self, theta: Array) -> tuple[list[tuple[Array, Array]], Array]:
        """Return B and the monic A of each fraction, and the derivatives of their coefficients by the parameters.

        The lowest coefficients of A are zero if there are integrators.
        """
        found, slopes, first, row = [], np.zeros((self.poles + self.zeros + 1, self.size - int(self.delay))), 0, 0
        for term in self.terms:
            n, width = term.poles, term.zeros + 1
            monic, own = _monic(theta[first : first + term.size], n)
            found.append((monic[n:], np.concatenate(([1.0], monic[:n], np.zeros(term.integrators)))))
            columns = slice(first, first + term.size)
            slopes[row : row + n, columns] = own[:n]
            slopes[row + term.order : row + term.order + width, columns] = own[n:]
            first, row = first + term.size, row + term.order + width
        return found, slopes


def _monic(theta: Array, n: int) -> tuple[Array, Array]:
    """Return ``a_1 ... a_n, b_0 ... b_m`` of the monic fraction of a submodel, and derivatives by its parameters."""
    highest, size = (theta[n - 1] if n else 1.0), theta.size
    # The constant term of A is 1; the others are in the order of descending powers.
    order = [*range(n - 2, -1, -1), *[size] * (n > 0), *range(size - 1, n - 1, -1)]
    values, slopes = np.append(theta, 1.0)[order] / highest, np.eye(size + 1)[order, :size] / highest
    if n:
        slopes[:, n - 1] -= values / highest
    return values, slopes


@dataclass(frozen=True, eq=False)
class Part:
    """A fraction ``B/(p^l A)``: a whole transfer function, or a submodel of a sum."""

    #: B and A in descending powers; A is monic in a transfer function and has the constant term 1 in a submodel.
    numerator: Array
    denominator: Array
    integrators: int
    #: Powers of p that the parameters multiply, in the order of theta.
    a_powers: tuple[int, ...]
    b_powers: tuple[int, ...]

    @property
    def size(self) -> int:
        """Number of coefficients that are parameters."""
        return len(self.a_powers) + len(self.b_powers)

    @property
    def derivative(self) -> Part:
        """The part in series with a differentiator."""
        return replace(self, numerator=np.append(self.numerator, 0.0), b_powers=tuple(k + 1 for k in self.b_powers))

    def fraction(self, delay: float) -> TransferFunction:
        """Return the part as a transfer function."""
        return TransferFunction(self.numerator, np.append(self.denominator, np.zeros(self.integrators)), delay)

    def frequency_slopes(self, s: ComplexArray, delay: float) -> list[ComplexArray]:
        """Return the derivatives of the response at ``s = j w`` by the coefficients."""
        own = np.polyval(self.denominator, s)
        over = s**self.integrators * own * np.exp(s * delay)
        response = np.polyval(self.numerator, s) / over
        by_a = [np.asarray(-(s**k) / own * response) for k in self.a_powers]
        return by_a + [np.asarray(s**k / over) for k in self.b_powers]

    def output_slopes(self, data: FilterData, signal: HeldSignal, delay: float) -> Array:
        """Return the derivatives of the output by the coefficients and, in the last column, by the delay."""
        highest, model = self.denominator[0], self.fraction(delay)
        a = self.denominator / highest
        n, order, (direct, rest) = a.size - 1, model.order, feedthrough(model)
        if order == 0:
            return np.column_stack((signal.at(data.t - delay), np.zeros(data.t.size)))
        rows = standard_rows(data, a, rest, delay, integrators=self.integrators)
        driven, u, filtered = rows[:, :order], rows[:, order], rows[:, order + 1 : order + 1 + n]
        # The rows are those of the strictly proper part of the model.
        x = direct * u - rows[:, order + 2 * n + 1]
        if direct:
            filtered = filtered + direct * driven[:, self.integrators :]
        by_a, by_b = _of_powers(filtered, x, a, self.a_powers), _of_powers(driven, u, a, self.b_powers)
        # Between the breaks of a held input the direct feedthrough does not affect the derivative by the delay.
        scales = np.repeat((-1.0 / highest, 1.0 / highest, -1.0), (len(self.a_powers), len(self.b_powers), 1))
        return np.asarray(np.hstack((by_a, by_b, rows[:, order + 2 * n + 2, None])) * scales)

    def pole_slopes(self) -> tuple[ComplexArray, ComplexArray]:
        """Return the poles without integrators, and their derivatives ``-p^k/A'(p)`` by the coefficients of A."""
        poles = sorted_roots(self.denominator)
        with np.errstate(invalid="ignore"):
            by_constant = pole_jacobian(self.denominator / self.denominator[0], poles)[:, -1:] / self.denominator[0]
            return poles, by_constant * poles[:, None] ** np.asarray(self.a_powers, dtype=int)


def _of_powers(lower: Array, signal: Array, a: Array, powers: tuple[int, ...]) -> Array:
    """Return the columns ``p^k/(p^l A) s`` for given k, from those with k below the degree of A and from s."""
    degree = lower.shape[1]
    if degree in powers:
        lower = np.column_stack((lower, signal - lower[:, degree - a.size + 1 :] @ a[:0:-1]))
    return lower[:, list(powers)]


def parts_of(model: Model, zeros: int | None = None) -> list[Part]:
    """Return the submodels of a sum, with coefficients in rising powers, or the single fraction of another model.

    The number of zeros of a fraction is given if leading coefficients of its numerator are zero.
    """
    if isinstance(model, AdditiveModel):
        return [
            Part(
                one.numerator,
                one.denominator,
                one.integrators,
                tuple(range(1, one.denominator.size)),
                tuple(range(one.numerator.size)),
            )
            for one in model.submodels
        ]
    m = model.numerator.size - 1 if zeros is None else zeros
    a_powers, b_powers = tuple(range(model.order - 1, -1, -1)), tuple(range(m, -1, -1))
    return [Part(model.numerator, model.denominator, 0, a_powers, b_powers)]


def sensitivities(
    model: Model, signal: HeldSignal, times: ArrayLike, zeros: int | None = None, *, estimate_delay: bool = False
) -> Array:
    """Return derivatives of a model's output at given times by its coefficients, and by an estimated delay."""
    found = _output_slopes(parts_of(model, zeros), model.delay, signal, times)
    return found if estimate_delay else found[:, :-1]


def _output_slopes(parts: Sequence[Part], delay: float, signal: HeldSignal, times: ArrayLike) -> Array:
    """Return derivatives of the output from rest by the coefficients of all parts and, last, by the delay."""
    instants = np.asarray(times, dtype=float)
    data = filter_data(Record(instants, np.zeros(instants.size), signal), start=-np.inf)
    found = [part.output_slopes(data, signal, delay) for part in parts]
    return np.column_stack((*(slopes[:, :-1] for slopes in found), np.sum([s[:, -1] for s in found], axis=0)))


@dataclass(frozen=True, eq=False)
class Parametric:
    """A model with its free parameters."""

    model: Model
    #: Names of all free parameters of a fit, including initial states and offsets, which do not affect the model.
    names: tuple[str, ...]
    #: Whether responses over time are differentiated.
    differentiated: bool = False

    @cached_property
    def zeros(self) -> int:
        """Degree of the numerator as one transfer function, including leading coefficients that are zero."""
        own = [int(name[1:]) for name in self.names if re.fullmatch(r"b\d+", name)]
        return max([self.fraction.numerator.size - 1, *own])

    @property
    def fraction(self) -> TransferFunction:
        """The model as one transfer function."""
        return unfactored(self.model) if isinstance(self.model, AdditiveModel) else self.model

    @cached_property
    def every(self) -> tuple[str, ...]:
        """Names of all parameters of the model, free or not."""
        if isinstance(self.model, AdditiveModel):
            return (*self.model.names, "delay")
        return Structure(self.model.order, self.zeros, delay=True).names

    @cached_property
    def free(self) -> tuple[IndexArray, IndexArray]:
        """Indices of the free parameters of the model in the names of the fit, and in ``every``."""
        mine = [k for k, name in enumerate(self.names) if _COEFFICIENT.fullmatch(name)]
        places = {name: k for k, name in enumerate(self.every)}
        unknown = [self.names[k] for k in mine if self.names[k] not in places]
        if unknown:
            raise DataError(f"the model has no parameter {unknown[0]!r}; it has {', '.join(self.every)}")
        return np.array(mine, dtype=np.intp), np.array([places[self.names[k]] for k in mine], dtype=np.intp)

    @cached_property
    def theta(self) -> Array:
        """All parameters of the model, in the order of ``every``."""
        model = self.model
        if isinstance(model, AdditiveModel):
            return np.append(model.theta, model.delay)
        b = np.concatenate((np.zeros(self.zeros + 1 - model.numerator.size), model.numerator))
        return np.concatenate((model.denominator[1:], b, [model.delay]))

    def at(self, change: Array) -> Parametric:
        """Return the model with its free parameters changed; a negative delay becomes zero."""
        theta = self.theta.copy()
        theta[self.free[1]] += change
        delay = max(float(theta[-1]), 0.0)
        if isinstance(self.model, AdditiveModel):
            return replace(self, model=AdditiveModel.from_theta(theta[:-1], self.model.terms, delay))
        n = self.model.order
        return replace(self, model=TransferFunction(theta[n:-1], np.concatenate(([1.0], theta[:n])), delay))

    def _among_all(self, every: NDArray[Number]) -> NDArray[Number]:
        """Return derivatives by all parameters of the model as derivatives by all parameters of the fit."""
        mine, places = self.free
        found = np.zeros((len(every), len(self.names)), dtype=every.dtype)
        found[:, mine] = every[:, places]
        return found

    @cached_property
    def parts(self) -> list[Part]:
        """Fractions of the model, differentiated if requested."""
        parts = parts_of(self.model, None if isinstance(self.model, AdditiveModel) else self.zeros)
        return [part.derivative for part in parts] if self.differentiated else parts

    def frequency_slopes(self, frequencies: Array) -> ComplexArray:
        """Return the derivatives of ``G(j w)``, shape (N, p)."""
        s = np.asarray(1j * frequencies, dtype=complex)
        columns = [column for part in self.parts for column in part.frequency_slopes(s, self.model.delay)]
        return self._among_all(np.column_stack((*columns, -s * self.model.frequency_response(frequencies))))

    def simulated(self, signal: HeldSignal, times: Array) -> Array:
        """Return the output from rest."""
        fractions = [part.fraction(self.model.delay) for part in self.parts]
        return np.asarray(np.sum([simulate(fraction, signal, times) for fraction in fractions], axis=0))

    def output_slopes(self, signal: HeldSignal, times: Array) -> Array:
        """Return the derivatives of the output from rest, shape (N, p)."""
        return self._among_all(_output_slopes(self.parts, self.model.delay, signal, times))

    @property
    def derivative(self) -> Parametric:
        """The model in series with a differentiator, whose step response is the impulse response of this model."""
        parts = self.model.submodels if isinstance(self.model, AdditiveModel) else (self.model,)
        if any(part.relative_degree < 1 for part in parts):
            raise DataError(
                "the impulse response of a model with as many zeros as poles contains an impulse; use its step response"
            )
        return replace(self, differentiated=True)

    def poles(self) -> tuple[ComplexArray, ComplexArray]:
        """Return the poles and their derivatives, shape (n, p); integrators of submodels are fixed."""
        rows, found, first = [], [], 0
        for part in self.parts:
            poles, jacobian = part.pole_slopes()
            slopes = np.zeros((poles.size + part.integrators, len(self.every)), dtype=complex)
            slopes[: poles.size, first : first + len(part.a_powers)] = jacobian
            found.append(np.concatenate((poles, np.zeros(part.integrators))))
            rows.append(slopes)
            first += part.size
        return np.concatenate(found), self._among_all(np.vstack(rows))
