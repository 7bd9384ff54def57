"""Shards: the data sets of one experiment, dealt to runs that know nothing of each other.

Whose a data set is follows from its place in the plan and the number of shards alone. Every shard gets as many as any
other, within one, and as many of each data cell as can be; what is dealt stays where it is when ``runs`` is raised.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from math import lcm
from typing import Self

from ctid_cli.errors import UsageError


@dataclass(frozen=True, order=True)
class Shard:
    """One of several shards, counted from 1."""

    number: int
    of: int

    def __str__(self) -> str:
        return f"shard {self.number} of {self.of}"

    @classmethod
    def read(cls, text: str) -> Self:
        """The shard that a text such as ``2/3`` names."""
        found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
        if found is None or not 1 <= int(found[1]) <= int(found[2]):
            raise UsageError(f"--shard {text}: write k/n, for example 2/3 for the second of three, with k from 1 to n")
        return cls(int(found[1]), int(found[2]))

    def folder(self, experiment: str) -> str:
        """Name of the folder of its results."""
        return f"{experiment}.shard-{self.number}-of-{self.of}"

    def has(self, cell: int, replicate: int, cells: int) -> bool:
        """Whether a data set is among those of this shard."""
        return owner(cell, replicate, cells, self.of) == self.number


def owner(cell: int, replicate: int, cells: int, of: int) -> int:
    """Number of the shard that a data set is dealt to."""
    index = replicate * cells + cell
    # Dealt in turn, a number of cells that has a factor in common with that of the shards would give some shards the
    # same cells over and over; so each turn through both begins one shard later.
    return (index + index // lcm(cells, of)) % of + 1


def ranges(numbers: Iterable[int]) -> str:
    """Numbers as job arrays take them: ``1-3,7``."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and runs[-1][-1] == number - 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ",".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs)
