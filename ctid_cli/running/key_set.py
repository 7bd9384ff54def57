"""Sets of estimates told without a list of them: those that there are, and those that a plan asks for."""

from collections.abc import Container
from typing import Self

import numpy as np

from ctid_cli.arrays import BoolArray
from ctid_cli.storage.manifest import Key, Manifest, planned_parts


class KeySet(Container[Key]):
    """Some estimates: a byte for each."""

    def __init__(self) -> None:
        self._there: dict[tuple[str, str, str], bytearray] = {}

    @classmethod
    def planned(cls, manifest: Manifest) -> Self:
        """The estimates of a plan, those that two names share once."""
        found = cls()
        for estimator, cell, replicates in planned_parts(manifest):
            for start in estimator["starts"]:
                flags = found._room(cell["hash"], estimator["hash"], start, replicates[-1] + 1)
                # A shard has some of them, and all are written at once.
                if isinstance(replicates, range):
                    flags[: len(replicates)] = b"\1" * len(replicates)
                else:
                    for replicate in replicates:
                        flags[replicate] = 1
        return found

    def _room(self, data_hash: str, estimator_hash: str, start: str, count: int) -> bytearray:
        """The bytes of the replicates, so many at least."""
        flags = self._there.setdefault((data_hash, estimator_hash, start), bytearray())
        if count > len(flags):
            flags.extend(bytes(count - len(flags)))
        return flags

    def add(self, key: Key) -> None:
        """Put one in."""
        self._room(key.data_hash, key.estimator_hash, key.start, key.replicate + 1)[key.replicate] = 1

    def discard(self, key: Key) -> None:
        """Take one out."""
        if key in self:
            self._there[key.data_hash, key.estimator_hash, key.start][key.replicate] = 0

    def __contains__(self, key: object) -> bool:
        if not isinstance(key, Key):
            return False
        flags = self._there.get((key.data_hash, key.estimator_hash, key.start), b"")
        return key.replicate < len(flags) and bool(flags[key.replicate])

    def flags(self, data_hash: str, estimator_hash: str, start: str, count: int) -> BoolArray:
        """Which of the first replicates there are."""
        found = self._there.get((data_hash, estimator_hash, start), bytearray())[:count]
        return np.frombuffer(found.ljust(count, b"\0"), dtype=np.bool_)

    def count_in(self, keys: "KeySet") -> int:
        """How many of some estimates are in this set."""
        # As long numbers, whose bits are counted at once.
        pairs = ((flags, self._there.get(place, b"")) for place, flags in keys._there.items())
        both = (int.from_bytes(one, "little") & int.from_bytes(other, "little") for one, other in pairs)
        return sum(number.bit_count() for number in both)

    def __len__(self) -> int:
        return sum(flags.count(1) for flags in self._there.values())
