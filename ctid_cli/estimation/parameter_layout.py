"""Layout of the parameter vector of measured records."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.estimation.optimum.best_model import Optimum
from ctid_cli.estimation.optimum.known import NOTHING, KnownCoefficients
from ctid_cli.inference.sensitivities import Structure, SumStructure
from ctid_cli.models.additive import AdditiveModel, Term
from ctid_cli.models.several_inputs import AnyModel, MultiInputModel, SystemModel, fractions_of

#: Names of the parameters of the powers of time that are added to the response.
TREND_NAMES = ("offset", "drift", "drift2", "drift3")


@dataclass(frozen=True)
class Degrees:
    """Degrees of the transfer functions of all inputs, and flags for delays that are parameters.

    The parameters are the coefficients of all denominators, those of all numerators, and the delays.
    """

    #: Number of poles, including integrators, of the common denominator, or of the denominator of each input.
    orders: tuple[int, ...]
    zeros: tuple[int, ...]
    delays: tuple[bool, ...]
    #: Names of the inputs; not used for a single one.
    inputs: tuple[str, ...] = ("",)
    #: Number of poles at the origin of each denominator, which is the number of its last coefficients that are zero.
    integrators: tuple[int, ...] = (0,)

    @classmethod
    def of(cls, structure: Structure, integrators: int = 0) -> "Degrees":
        """Return the degrees of one transfer function."""
        return cls((structure.poles,), (structure.zeros,), (structure.delay,), integrators=(integrators,))

    @property
    def structure(self) -> Structure:
        """Structure of the transfer function of the first input."""
        return Structure(self.orders[0], self.zeros[0], self.delays[0])

    @property
    def several(self) -> bool:
        """Whether there are several inputs."""
        return len(self.inputs) > 1

    @property
    def common(self) -> bool:
        """Whether all inputs have one denominator."""
        return len(self.orders) == 1

    @property
    def poles(self) -> int:
        """Number of poles of all denominators."""
        return sum(self.orders)

    @property
    def search_arguments(self) -> dict[str, Any]:
        """Corresponding arguments of the search problem."""
        if self.common:
            most = max(self.zeros)
            fewer = tuple(most - m for m in self.zeros)
            return {"zeros": most, "integrators": self.integrators[0], "fewer_zeros": fewer}
        each = zip(self.orders, self.zeros, self.integrators, strict=True)
        terms = tuple(Term(n - count, m, count) for n, m, count in each)
        return {"zeros": max(self.zeros), "terms": terms, "inputs": tuple(range(len(terms)))}

    @cached_property
    def a(self) -> list[slice]:
        """Slices of the coefficients of each denominator."""
        return _slices(0, self.orders)

    @cached_property
    def b(self) -> list[slice]:
        """Slices of the coefficients of each numerator."""
        return _slices(self.poles, [m + 1 for m in self.zeros])

    @property
    def numerators(self) -> int:
        """Number of coefficients of all numerators."""
        return sum(m + 1 for m in self.zeros)

    def delay(self, k: int) -> int | None:
        """Return the index of the delay of an input; None if it is not a parameter."""
        return self.b[-1].stop + sum(self.delays[:k]) if self.delays[k] else None

    @property
    def size(self) -> int:
        """Number of parameters."""
        return int(self.b[-1].stop) + sum(self.delays)

    @property
    def prefixes(self) -> list[str]:
        """Prefix of the parameter names of each input."""
        return [f"{name}_" for name in self.inputs] if self.several else [""]

    @property
    def block_prefixes(self) -> list[str]:
        """Prefix of the parameter names of each denominator."""
        return [""] if self.common else self.prefixes

    @property
    def names(self) -> list[str]:
        """Names of the parameters, such as ``a1`` or ``u1_b0``."""
        names = [f"{own}a{i}" for own, n in zip(self.block_prefixes, self.orders, strict=True) for i in range(1, n + 1)]
        names += [f"{own}b{j}" for own, m in zip(self.prefixes, self.zeros, strict=True) for j in range(m + 1)]
        return names + [f"{own}delay" for own, free in zip(self.prefixes, self.delays, strict=True) if free]

    @property
    def state_names(self) -> list[str]:
        """Names of the parameters of an initial state."""
        each = zip(self.block_prefixes, self.orders, strict=True)
        return [f"{own}x{i}" for own, n in each for i in range(1, n + 1)]

    @property
    def denominators(self) -> list[int]:
        """Indices of the coefficients of all denominators, without those that are zero due to integrators."""
        each = zip(self.a, self.integrators, strict=True)
        return [place for own, count in each for place in range(own.start, own.stop - count)]

    def given(self, known: KnownCoefficients) -> BoolArray:
        """Return the mask of known coefficients, including those that are zero due to integrators."""
        found = np.ones(self.poles + self.numerators, dtype=bool)
        found[self.denominators], found[self.poles :] = False, False
        if known is not NOTHING:
            found[self.denominators] = np.isfinite(known.denominator)
            found[self.poles :] = np.isfinite(known.numerator)
        return found

    def model(self, found: Optimum) -> AnyModel:
        """Return the model of an optimum."""
        if not self.several:
            return found.model
        return MultiInputModel(dict(zip(self.inputs, found.fractions, strict=True)), self.common)

    def theta_of(self, model: AnyModel) -> Array:
        """Return the parameters of a model of these degrees."""
        theta, fractions = np.zeros(self.size), fractions_of(model)
        for own, part in zip(self.a, fractions, strict=False):
            theta[own] = part.denominator[1:]
        for k, part in enumerate(fractions):
            theta[self.b[k].stop - part.numerator.size : self.b[k].stop] = part.numerator
            if (place := self.delay(k)) is not None:
                theta[place] = part.delay
        return theta

    def fractions_of(self, theta: Array) -> tuple[list[tuple[Array, Array]], Array]:
        """Return B and the monic A of each fraction, and the derivatives of their coefficients by the parameters."""
        found, places = [], list[int]()
        for k, own in enumerate(self.b):
            a = self.a[0 if self.common else k]
            found.append((theta[own], np.concatenate(([1.0], theta[a]))))
            places += [*range(a.start, a.stop), *range(own.start, own.stop)]
        return found, np.eye(self.poles + self.numerators)[places]

    def with_orders(self, model: SystemModel, delays: Sequence[bool]) -> "Degrees":
        """Return the degrees for the denominators of a model that may have fewer poles."""
        assert not isinstance(model, AdditiveModel)
        fractions = fractions_of(model)
        return replace(self, orders=tuple(each.order for each in fractions[: len(self.orders)]), delays=tuple(delays))


@dataclass(frozen=True)
class SumDegrees:
    """Degrees of a sum of submodels of one input, with the interface of :class:`Degrees`."""

    structure: SumStructure
    inputs: ClassVar[tuple[str, ...]] = ("",)
    several: ClassVar[bool] = False

    @property
    def delays(self) -> tuple[bool, ...]:
        """Whether the delay is a parameter."""
        return (self.structure.delay,)

    @property
    def search_arguments(self) -> dict[str, Any]:
        """Corresponding arguments of the search problem."""
        return {"zeros": self.structure.zeros, "terms": self.structure.terms}

    @property
    def poles(self) -> int:
        """Number of poles, including integrators."""
        return self.structure.poles

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.structure.size

    @property
    def names(self) -> list[str]:
        """Names of the parameters."""
        return list(self.structure.names)

    @property
    def state_names(self) -> list[str]:
        """Names of the parameters of an initial state."""
        return [f"x{i}" for i in range(1, self.poles + 1)]

    @property
    def denominators(self) -> list[int]:
        """Indices of the coefficients of all denominators."""
        return [int(place) for place in self.structure.denominators]

    def delay(self, k: int) -> int | None:
        """Return the index of the delay; None if it is not a parameter."""
        return self.size - 1 if self.structure.delay else None

    def given(self, known: KnownCoefficients) -> BoolArray:
        """Return the mask of known coefficients."""
        found = np.zeros(self.size - int(self.structure.delay), dtype=bool)
        if known is not NOTHING:
            found[self.structure.denominators] = np.isfinite(known.denominator)
            found[self.structure.numerators] = np.isfinite(known.numerator)
        return found

    def model(self, found: Optimum) -> AnyModel:
        """Return the sum as one transfer function."""
        return found.model

    def theta_of(self, model: SystemModel) -> Array:
        """Return the parameters of a model of these degrees."""
        assert isinstance(model, AdditiveModel)
        return self.structure.theta_of(model)

    def fractions_of(self, theta: Array) -> tuple[list[tuple[Array, Array]], Array]:
        """Return B and the monic A of each fraction, and the derivatives of their coefficients by the parameters."""
        return self.structure.fractions_of(theta)

    def with_orders(self, model: SystemModel, delays: Sequence[bool]) -> "SumDegrees":
        """Return a copy with the flag of the delay replaced."""
        return SumDegrees(replace(self.structure, delay=delays[0]))


def _slices(first: int, sizes: Sequence[int]) -> list[slice]:
    """Return the slices of consecutive parts."""
    ends = first + np.cumsum([0, *sizes])
    return [slice(*pair) for pair in pairwise(ends.tolist())]


@dataclass(frozen=True)
class Layout:
    """Layout of the parameter vector: coefficients, delays, then the parameters of each experiment."""

    degrees: Degrees | SumDegrees
    experiments: int = 1
    initial_state: bool = False
    #: Powers of time.
    trend: tuple[int, ...] = ()

    @property
    def own(self) -> int:
        """Number of parameters of one experiment."""
        return self.degrees.poles * self.initial_state + len(self.trend)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.degrees.size + self.experiments * self.own

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names; with several experiments, theirs end in the number of the experiment."""
        names, degrees = self.degrees.names, self.degrees
        for k in range(self.experiments):
            tail = f"_{k + 1}" if self.experiments > 1 else ""
            names += [f"{name}{tail}" for name in degrees.state_names] * self.initial_state
            names += [f"{TREND_NAMES[power]}{tail}" for power in self.trend]
        return tuple(names)

    def theta(self, model: SystemModel) -> Array:
        """Return the parameters of a model of these degrees, and zeros for those of the experiments."""
        own = self.degrees.theta_of(model)  # type: ignore[arg-type]  # each has models of one kind
        return np.concatenate((own, np.zeros(self.experiments * self.own)))

    def own_of(self, theta: Array, experiment: int) -> tuple[Array, float]:
        """Return the initial state and offset of one experiment."""
        first = self.first(experiment)
        own = theta[first : first + self.own]
        states = self.degrees.poles * self.initial_state
        return own[:states], float(own[states]) if self.trend[:1] == (0,) else 0.0

    def first(self, experiment: int) -> int:
        """Return the first index of the parameters of an experiment."""
        return self.degrees.size + experiment * self.own
