"""Which estimates a plan asks for, and which there are, told without a list of them."""

from collections.abc import Container, Iterator

import numpy as np

from ctid_cli.arrays import BoolArray
from ctid_cli.storage.manifest import Key, Manifest, shard_of


class KeySet(Container[Key]):
    """Estimates that there are: a byte for each."""

    def __init__(self) -> None:
        self._there: dict[tuple[str, str, str], bytearray] = {}

    def add(self, key: Key) -> None:
        """Put one in."""
        data, replicate, estimator, start = key
        flags = self._there.get((data, estimator, start))
        if flags is None:
            flags = self._there[data, estimator, start] = bytearray()
        if replicate >= len(flags):
            flags.extend(bytes(replicate + 1 - len(flags)))
        flags[replicate] = 1

    def discard(self, key: Key) -> None:
        """Take one out."""
        if key in self:
            self._there[key.data_hash, key.estimator_hash, key.start][key.replicate] = 0

    def __contains__(self, key: object) -> bool:
        if not isinstance(key, Key):
            return False
        flags = self._there.get((key.data_hash, key.estimator_hash, key.start), b"")
        return key.replicate < len(flags) and bool(flags[key.replicate])

    def groups(self) -> Iterator[tuple[str, str, str, bytearray]]:
        """Data cells, estimators and starts, each with a byte for every replicate."""
        for (data, estimator, start), flags in self._there.items():
            yield data, estimator, start, flags

    def flags(self, data_hash: str, estimator_hash: str, start: str, count: int) -> BoolArray:
        """Which of the first replicates there are."""
        found = self._there.get((data_hash, estimator_hash, start), bytearray())[:count]
        return np.frombuffer(found.ljust(count, b"\0"), dtype=np.bool_)

    def __len__(self) -> int:
        return sum(map(sum, self._there.values()))

    def __iter__(self) -> Iterator[Key]:
        for (data, estimator, start), flags in self._there.items():
            for replicate in range(len(flags)):
                if flags[replicate]:
                    yield Key(data, replicate, estimator, start)


class PlannedKeys(Container[Key]):
    """The estimates of a plan, those that two names share once."""

    def __init__(self, manifest: Manifest) -> None:
        self._shard, self._cells = shard_of(manifest), len(manifest["data_cells"])
        #: Places of a data cell and its number of replicates; starts of an estimator.
        self._places: dict[str, list[tuple[int, int]]] = {}
        self._starts: dict[str, set[str]] = {}
        for number, cell in enumerate(manifest["data_cells"]):
            self._places.setdefault(cell["hash"], []).append((number, cell["replicates"]))
        for estimator in manifest["estimators"]:
            self._starts.setdefault(estimator["hash"], set()).update(estimator["starts"])

    def __contains__(self, key: object) -> bool:
        if not isinstance(key, Key) or key.start not in self._starts.get(key.estimator_hash, ()):
            return False
        return self._has(key.data_hash, key.replicate)

    def _has(self, data_hash: str, replicate: int) -> bool:
        return any(
            replicate < count and (self._shard is None or self._shard.has(number, replicate, self._cells))
            for number, count in self._places.get(data_hash, ())
        )

    def count_in(self, keys: KeySet) -> int:
        """How many of some estimates are asked for."""
        found = 0
        for data, estimator, start, flags in keys.groups():
            if start not in self._starts.get(estimator, ()):
                continue
            there = flags[: max((count for _, count in self._places.get(data, ())), default=0)]
            if self._shard is None:
                found += sum(there)
            else:
                found += sum(self._has(data, replicate) for replicate, flag in enumerate(there) if flag)
        return found

    def __len__(self) -> int:
        most = {name: max(count for _, count in places) for name, places in self._places.items()}
        sets = sum(most.values())
        if self._shard is not None:
            sets = sum(self._has(name, replicate) for name, count in most.items() for replicate in range(count))
        return sets * sum(map(len, self._starts.values()))
