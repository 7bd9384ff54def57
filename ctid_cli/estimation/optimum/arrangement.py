"""Fractions of which a model is the sum: the input, denominator and states of each.

A transfer function is one fraction. A sum of submodels has several fractions of one input; several inputs have one
fraction each, with separate denominators or a common one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IntArray
from ctid_cli.models.additive import Term


class Channel(NamedTuple):
    """Blocks of one input, which are denominators with their integrators, and the places of its states."""

    input: int
    #: Degrees of the fraction of each block; several if the input drives a sum of submodels.
    terms: tuple[Term, ...]
    #: Places of the blocks, their states and their searched poles in the whole model.
    blocks: slice
    states: slice
    poles: slice
    #: Whether no earlier channel has the same blocks.
    first: bool
    #: Places of the states that span the strictly proper part of all ``B/A u``: the last m + 1 of each fraction.
    spanning: IntArray
    #: Index of the fraction with direct feedthrough, of relative degree 0; -1 if there is none.
    direct: int
    #: Mask of the states of searched poles, not of integrators.
    searched: BoolArray

    @property
    def order(self) -> int:
        """Number of states."""
        return self.searched.size

    @property
    def size(self) -> int:
        """Number of identifiable coefficients of the numerators."""
        return self.spanning.size + (self.direct >= 0)

    def directs(self, weight: float) -> Array:
        """Return the feedthrough of each fraction."""
        found = np.zeros(len(self.terms))
        if self.direct >= 0:
            found[self.direct] = weight
        return found


@dataclass(frozen=True, eq=False)
class Arrangement:
    """Channels of a model."""

    channels: tuple[Channel, ...]

    @cached_property
    def owners(self) -> tuple[int, ...]:
        """First channel of each denominator, or of each sum."""
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
    """Return the channel of an input, placed after that of the previous input unless they share blocks."""
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
    """Return the arrangement of inputs with a common denominator; ``fewer`` zeros than ``zeros`` for each input."""
    channels: list[Channel] = []
    for k, less in enumerate(fewer):
        term = Term(poles, max(zeros - less, 0), integrators)
        channels.append(_channel(k, [term], channels[-1] if channels else None, shared=True))
    return Arrangement(tuple(channels))


@lru_cache(maxsize=1024)
def with_own_denominators(terms: tuple[Term, ...], inputs: tuple[int, ...]) -> Arrangement:
    """Return the arrangement of fractions with separate denominators, grouped by input."""
    channels: list[Channel] = []
    for number in dict.fromkeys(inputs):
        own = [term for term, driver in zip(terms, inputs, strict=True) if driver == number]
        channels.append(_channel(number, own, channels[-1] if channels else None, shared=False))
    return Arrangement(tuple(channels))
