"""Which fractions a model is a sum of: what drives each, which denominator it has, and where its states are.

A transfer function is one fraction. A sum of submodels has several that one input drives; several inputs have one
fraction each, with denominators of their own or all with one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IntArray
from ctid_cli.models.additive import Term


class Channel(NamedTuple):
    """What one input drives: the blocks, which are denominators with their integrators, and where its states are."""

    input: int
    #: Degrees of the fraction of each block; several where the input drives a sum of submodels.
    terms: tuple[Term, ...]
    #: The blocks, their states, and their searched poles, among those of the whole model.
    blocks: slice
    states: slice
    poles: slice
    #: Whether no channel before has the same blocks.
    first: bool
    #: Places of the states that span the strictly proper part of all ``B/A u``: of each fraction its last m + 1.
    spanning: IntArray
    #: Which fraction has u itself besides, as one of degree n has; none where -1.
    direct: int
    #: Which states belong to poles that are searched, not to integrators.
    searched: BoolArray

    @property
    def order(self) -> int:
        """Number of states."""
        return self.searched.size

    @property
    def size(self) -> int:
        """Number of coefficients of the numerators that can be told apart."""
        return self.spanning.size + (self.direct >= 0)

    def directs(self, weight: float) -> Array:
        """Return the weight of u in each fraction."""
        found = np.zeros(len(self.terms))
        if self.direct >= 0:
            found[self.direct] = weight
        return found


@dataclass(frozen=True, eq=False)
class Arrangement:
    """The channels of a model."""

    channels: tuple[Channel, ...]

    @cached_property
    def owners(self) -> tuple[int, ...]:
        """The first channel of each denominator, or of each sum."""
        return tuple(k for k, channel in enumerate(self.channels) if channel.first)

    @cached_property
    def order(self) -> int:
        """Number of states."""
        return int(self.channels[-1].states.stop)

    @cached_property
    def poles(self) -> int:
        """Number of searched poles."""
        return int(self.channels[-1].poles.stop)


def _channel(number: int, terms: Sequence[Term], before: Channel | None, shared: bool) -> Channel:
    """Return the channel of an input, behind that of the input before unless it shares its blocks."""
    order, poles = sum(term.order for term in terms), sum(term.poles for term in terms)
    place = (0, 0, 0) if shared or before is None else (before.blocks.stop, before.states.stop, before.poles.stop)
    sizes = len(terms), order, poles
    blocks, states, own = (slice(first, first + size) for first, size in zip(place, sizes, strict=True))
    first, spanning, direct, searched = 0, list[int](), -1, list[bool]()
    for k, term in enumerate(terms):
        spanning += range(first + term.order - min(term.zeros + 1, term.order), first + term.order)
        direct = k if term.zeros == term.order else direct
        searched += [True] * term.poles + [False] * term.integrators
        first += term.order
    places = np.array(spanning, dtype=np.int64), direct, np.array(searched, dtype=bool)
    return Channel(number, tuple(terms), blocks, states, own, before is None or not shared, *places)


@lru_cache(maxsize=1024)
def with_one_denominator(poles: int, integrators: int, zeros: int, fewer: tuple[int, ...]) -> Arrangement:
    """Return the arrangement of inputs that share a denominator; numerators may have fewer zeros than the most."""
    channels: list[Channel] = []
    for k, less in enumerate(fewer):
        term = Term(poles, max(zeros - less, 0), integrators)
        channels.append(_channel(k, [term], channels[-1] if channels else None, shared=True))
    return Arrangement(tuple(channels))


@lru_cache(maxsize=1024)
def with_own_denominators(terms: tuple[Term, ...], inputs: tuple[int, ...]) -> Arrangement:
    """Return the arrangement of fractions with denominators of their own, those of one input side by side."""
    channels: list[Channel] = []
    for number in dict.fromkeys(inputs):
        own = [term for term, driver in zip(terms, inputs, strict=True) if driver == number]
        channels.append(_channel(number, own, channels[-1] if channels else None, shared=False))
    return Arrangement(tuple(channels))
