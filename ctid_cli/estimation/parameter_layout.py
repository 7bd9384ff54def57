"""Which numbers stand where in the parameter vector of measured records."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.optimum.triangle import SINGLE, Channel
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.models.several_inputs import AnyModel, MultiInputModel, fractions_of
from ctid_cli.models.transfer_function import TransferFunction

#: Parameters of the powers of time that the output has beside the response.
TREND_NAMES = ("offset", "drift", "drift2", "drift3")


@dataclass(frozen=True)
class Degrees:
    """Degrees of the transfer functions of all inputs, and which delays are parameters.

    The parameters are the coefficients of all denominators, those of all numerators, and the delays.
    """

    #: Poles, integrators included: of the common denominator, or of that of each input.
    orders: tuple[int, ...]
    zeros: tuple[int, ...]
    delays: tuple[bool, ...]
    #: Names of the inputs; one alone needs none.
    inputs: tuple[str, ...] = ("",)
    #: Poles at the origin of each denominator: that many of its last coefficients are zero.
    integrators: tuple[int, ...] = (0,)

    @classmethod
    def of(cls, structure: Structure, integrators: int = 0) -> "Degrees":
        """Return the degrees of one transfer function."""
        return cls((structure.poles,), (structure.zeros,), (structure.delay,), integrators=(integrators,))

    @property
    def structure(self) -> Structure:
        """The transfer function of the first input."""
        return Structure(self.orders[0], self.zeros[0], self.delays[0])

    @property
    def several(self) -> bool:
        """Whether there are several inputs."""
        return len(self.inputs) > 1

    @property
    def common(self) -> bool:
        """Whether there is one denominator."""
        return len(self.orders) == 1

    @property
    def poles(self) -> int:
        """Number of poles of all denominators."""
        return sum(self.orders)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The fractions as the search knows them."""
        if not self.several:
            return SINGLE
        most = max(self.zeros)
        return tuple(Channel(k, 0 if self.common else k, most - m) for k, m in enumerate(self.zeros))

    @cached_property
    def a(self) -> list[slice]:
        """Places of the coefficients of each denominator."""
        return _slices(0, self.orders)

    @cached_property
    def b(self) -> list[slice]:
        """Places of the coefficients of each numerator."""
        return _slices(self.poles, [m + 1 for m in self.zeros])

    @property
    def numerators(self) -> int:
        """Number of coefficients of all numerators."""
        return sum(m + 1 for m in self.zeros)

    def delay(self, k: int) -> int | None:
        """Place of the delay of an input; None where it is no parameter."""
        return self.b[-1].stop + sum(self.delays[:k]) if self.delays[k] else None

    @property
    def size(self) -> int:
        """Number of parameters."""
        return int(self.b[-1].stop) + sum(self.delays)

    @property
    def prefixes(self) -> list[str]:
        """What the names of the parameters of each input begin with."""
        return [f"{name}_" for name in self.inputs] if self.several else [""]

    @property
    def block_prefixes(self) -> list[str]:
        """What the names of the parameters of each denominator begin with."""
        return [""] if self.common else self.prefixes

    @property
    def names(self) -> list[str]:
        """Names of the parameters, such as ``a1`` or ``u1_b0``."""
        names = [f"{own}a{i}" for own, n in zip(self.block_prefixes, self.orders, strict=True) for i in range(1, n + 1)]
        names += [f"{own}b{j}" for own, m in zip(self.prefixes, self.zeros, strict=True) for j in range(m + 1)]
        return names + [f"{own}delay" for own, free in zip(self.prefixes, self.delays, strict=True) if free]

    def model(self, fractions: Sequence[TransferFunction]) -> AnyModel:
        """Return the model with given transfer functions."""
        return (
            MultiInputModel(dict(zip(self.inputs, fractions, strict=True)), self.common)
            if self.several
            else fractions[0]
        )

    def with_orders(self, model: AnyModel, delays: Sequence[bool]) -> "Degrees":
        """Return the degrees for the denominators of a model, some of whose poles may be missing."""
        fractions = fractions_of(model)
        return replace(self, orders=tuple(each.order for each in fractions[: len(self.orders)]), delays=tuple(delays))


def _slices(first: int, sizes: Sequence[int]) -> list[slice]:
    """Places of several parts in a row."""
    ends = first + np.cumsum([0, *sizes])
    return [slice(*pair) for pair in pairwise(ends.tolist())]


@dataclass(frozen=True)
class Layout:
    """Which numbers stand where in the parameter vector: coefficients, delays, then each experiment's own."""

    degrees: Degrees
    experiments: int = 1
    initial_state: bool = False
    #: Powers of time.
    trend: tuple[int, ...] = ()

    @property
    def own(self) -> int:
        """Number of parameters that belong to one experiment."""
        return self.degrees.poles * self.initial_state + len(self.trend)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.degrees.size + self.experiments * self.own

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names; those of an experiment end in its number where there are several."""
        names, degrees = self.degrees.names, self.degrees
        for k in range(self.experiments):
            tail = f"_{k + 1}" if self.experiments > 1 else ""
            for prefix, n in zip(degrees.block_prefixes, degrees.orders, strict=True):
                names += [f"{prefix}x{i}{tail}" for i in range(1, n + 1)] * self.initial_state
            names += [f"{TREND_NAMES[power]}{tail}" for power in self.trend]
        return tuple(names)

    def theta(self, model: AnyModel) -> Array:
        """The parameters of a model of these degrees, and zeros for what belongs to the experiments."""
        theta, degrees = np.zeros(self.size), self.degrees
        fractions = fractions_of(model)
        for own, part in zip(degrees.a, fractions, strict=False):
            theta[own] = part.denominator[1:]
        for k, part in enumerate(fractions):
            theta[degrees.b[k].stop - part.numerator.size : degrees.b[k].stop] = part.numerator
            if (place := degrees.delay(k)) is not None:
                theta[place] = part.delay
        return theta

    def own_of(self, theta: Array, experiment: int) -> tuple[Array, float]:
        """Initial state and offset of one experiment."""
        first = self.first(experiment)
        own = theta[first : first + self.own]
        states = self.degrees.poles * self.initial_state
        return own[:states], float(own[states]) if self.trend[:1] == (0,) else 0.0

    def first(self, experiment: int) -> int:
        """Where the parameters of an experiment begin."""
        return self.degrees.size + experiment * self.own
