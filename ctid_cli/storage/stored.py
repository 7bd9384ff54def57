"""The stored estimates of one plan, by column and by row, wherever they are read from.

However many they are: columns are arrays, read when they are asked for, and rows are made some at a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, overload

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IndexArray
from ctid_cli.errors import StorageError
from ctid_cli.storage import columns
from ctid_cli.storage.identity import Origin, are_mixed
from ctid_cli.storage.manifest import Key, Manifest, found_values, row_columns, true_values
from ctid_cli.storage.packing import decoded, keys, results, unpacked
from ctid_cli.storage.pieces import ROWS, AnyArray, Table, ranges
from ctid_cli.storage.summary import judged

_FAILED = [name.encode() for name in columns.FAILURES]
#: What parameters of an estimate are found in, and what says which of these places are filled.
_OF_PARAMETERS = {
    "numerator": "length",
    "denominator": "length",
    "delay": "",
    "parameters": "present",
    "standard_errors": "present",
    "quantiles": "present",
}


@dataclass(frozen=True)
class Stored:
    """The stored estimates of one plan."""

    manifest: Manifest
    origins: tuple[Origin, ...]
    #: The estimates in arrays, in the order of the sealed file, which are only read as far as is needed.
    table: Table

    @property
    def mixed(self) -> bool:
        """Whether several versions of the code, or platforms, computed what is compared here."""
        return are_mixed(self.origins)

    @cached_property
    def results(self) -> dict[Key, dict[str, Any]]:
        """All results by key: for those who want all of them, which are not many then."""
        found: dict[Key, dict[str, Any]] = {}
        for start, stop in ranges(self.table.count):
            found |= zip(keys(self.table, start, stop), results(self.table, start, stop), strict=True)
        return found

    @cached_property
    def _read(self) -> dict[str, AnyArray]:
        return {}

    def column(self, name: str) -> AnyArray:
        """A column of the table."""
        if name not in self._read:
            self._read[name] = self.table.read(name)
        return self._read[name]

    def rows(self) -> list[dict[str, Any]]:
        """All estimate rows, in the order of the sealed file."""
        return list(self.every())

    def every(self) -> Rows:
        """The same, made when they are asked for."""
        return Rows(self, np.arange(self.table.count))

    @cached_property
    def _windows(self) -> dict[str, tuple[int, int, AnyArray]]:
        """The rows of each column that were asked for last."""
        return {}

    def at(self, name: str, places: IndexArray) -> AnyArray:
        """A column at some places; of blocks of many rows, only the last one is kept."""
        if name in self._read or not places.size:
            return np.asarray(self.column(name)[places])
        starts, _ = self._starts
        first, last = (int(np.searchsorted(starts, place, side="right")) for place in (places.min(), places.max()))
        start, stop = int(starts[first - 1]), int(starts[last])
        if stop - start < ROWS:
            return np.asarray(self.column(name)[places])
        if self._windows.get(name, ())[:2] != (start, stop):
            self._windows[name] = (start, stop, self.table.read(name, start, stop))
        return np.asarray(self._windows[name][2][places - start])

    @cached_property
    def _starts(self) -> tuple[IndexArray, list[tuple[str, ...]]]:
        """First row of every block, and the number of rows; estimator, its name and the data cell of each block."""
        parts = [self.table.read(name) for name in ("estimator_hash", "estimator", "cell")]
        count = self.table.count
        differs: BoolArray = np.zeros(max(count - 1, 0), dtype=bool)
        for part in parts:
            differs |= part[1:] != part[:-1]
        places = np.array([*([0] if count else []), *(np.flatnonzero(differs) + 1), count], dtype=np.intp)
        return places, list(zip(*(decoded(part[places[:-1]]) for part in parts), strict=True))

    @cached_property
    def blocks(self) -> list[Block]:
        """The rows of every estimator on every data cell, which follow each other."""
        known = {(part["hash"], part["name"]): part for part in self.manifest["estimators"]}
        cells = {cell["hash"]: cell for cell in self.manifest["data_cells"]}
        found = []
        places, parts = self._starts
        for (first, last), (estimator, name, cell) in zip(pairwise(places.tolist()), parts, strict=True):
            if cell not in cells or (estimator, name) not in known:
                raise StorageError(
                    f"estimates of {name} on the data cell {cell} are stored that the plan does not have"
                )
            found.append(Block(first, last, cells[cell], known[estimator, name]))
        return found

    @cached_property
    def _truths(self) -> dict[str, dict[str, float]]:
        """True values by name of every data cell."""
        try:
            return {cell["hash"]: true_values(cell) for cell in self.manifest["data_cells"]}
        # Somebody else may have written the plan.
        except (TypeError, ValueError, KeyError, AttributeError) as error:
            raise StorageError(f"the plan of {self.manifest['experiment']} holds a system that is none") from error

    def failures(self, where: AnyArray | None = None) -> BoolArray:
        """Which estimates are failures."""
        return np.isin(self.column("status") if where is None else self.at("status", where), _FAILED)

    def converged(self, block: Block, where: AnyArray) -> BoolArray | None:
        """Which estimates of a block satisfy the rule; None where there is none."""
        success, truth = self.manifest["success"], self._truths[block.cell["hash"]]
        if not success:
            return None
        measures = None
        if success.get("band") is not None:
            first, last = (int(where[0]), int(where[-1]) + 1) if where.size else (0, 0)
            column = next(column for column in columns.COLUMNS if column.name == "measures")
            whole = unpacked(self.table, column, first, last)
            measures = [whole[k - first] for k in where.tolist()]
        values = self.found(where, tuple(truth))[0]
        fit = self.at("fit_percent", where)
        return judged(success, truth, self.failures(where), dict(zip(truth, values.T, strict=True)), fit, measures)

    def found(self, where: AnyArray, names: Sequence[str]) -> tuple[Array, Array, Array]:
        """Values, standard errors and quantiles under the names of the true ones, NaN where none is, shape (n, p).

        Rows that have the same form take their numbers from the same places: what `found_values` says of places.
        """
        names_of_forms = [f"{name}_{form}" for name, form in _OF_PARAMETERS.items() if form and self.table.has(name)]
        held = {name: self.at(name, where) for name in _OF_PARAMETERS if self.table.has(name)}
        held |= {name: self.at(name, where) for name in names_of_forms}
        forms = [held[name].reshape(len(where), -1) for name in names_of_forms]
        form: AnyArray = np.hstack(forms) if forms else np.zeros((len(where), 1), dtype=int)
        values, errors, quantiles = np.full((3, len(where), len(names)), np.nan)
        left = np.ones(len(where), dtype=bool)
        while left.any():
            some = int(left.argmax())
            alike = left & (form == form[some]).all(axis=1)
            row = self._places(some, held)
            for target, places in zip((values, errors, quantiles), found_values(row, names), strict=True):
                for k, name in enumerate(names):
                    place = places[name]
                    if isinstance(place, tuple):
                        target[alike, k] = held[place[0]].reshape(len(where), -1)[alike, place[1]]
                    elif place is not None:
                        target[alike, k] = place
            left &= ~alike
        return values, errors, quantiles

    def _places(self, number: int, held: Mapping[str, AnyArray]) -> dict[str, Any]:
        """One of some rows with the places of its numbers in their place."""
        row: dict[str, Any] = {"delay": ("delay", 0) if "delay" in held else None}
        for name, form in _OF_PARAMETERS.items():
            if form and name in held:
                there = held[f"{name}_{form}"][number]
                if form == "length":
                    row[name] = None if there < 0 else [(name, k) for k in range(there)]
                else:
                    row[name] = {part: (name, k) for k, part in enumerate(self.table.parts(name)) if there[k]} or None
        return row


@dataclass(frozen=True, eq=False)
class Block:
    """The rows of one estimator on one data cell."""

    first: int
    last: int
    cell: Mapping[str, Any]
    estimator: Mapping[str, Any]


class Rows(Sequence[dict[str, Any]]):
    """Some estimates, in the order of the sealed file: as rows, or as columns."""

    def __init__(self, stored: Stored, places: IndexArray, names: Sequence[str] = ()) -> None:
        self.stored, self.places = stored, places
        #: Columns that rows are made of; all of them if nothing is said.
        self._names = names

    def only(self, *names: str) -> Rows:
        """The same, with rows of some columns only."""
        return Rows(self.stored, self.places, names)

    def __len__(self) -> int:
        return len(self.places)

    @overload
    def __getitem__(self, item: int) -> dict[str, Any]: ...
    @overload
    def __getitem__(self, item: slice) -> Rows: ...
    def __getitem__(self, item: int | slice) -> dict[str, Any] | Rows:
        if isinstance(item, slice):
            return Rows(self.stored, self.places[item], self._names)
        (row,) = Rows(self.stored, self.places[[item]], self._names)
        return row

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for start, stop in ranges(len(self.places)):
            places = self.places[start:stop]
            yield from self._chosen(places) if self._names else self._made(places)

    def chosen(self, which: BoolArray | IndexArray) -> Rows:
        """Some of them."""
        return Rows(self.stored, self.places[which], self._names)

    def column(self, name: str) -> AnyArray:
        """A column as an array."""
        return self.stored.at(name, self.places)

    def has(self, name: str) -> bool:
        """Whether they have such a column at all."""
        return self.stored.table.has(name)

    @property
    def failures(self) -> BoolArray:
        """Which of them failed."""
        return self.stored.failures(self.places)

    @cached_property
    def converged(self) -> BoolArray | None:
        """Which of them satisfy the rule of success; None where there is none for all of them."""
        found = [self.stored.converged(block, places) for block, places in self._by_block(self.places)]
        known = [part for part in found if part is not None]
        return np.concatenate(known) if known and len(known) == len(found) else None

    def found(self, names: Sequence[str]) -> tuple[Array, Array, Array]:
        """Estimated values, standard errors and quantiles of intervals under the names of the true ones."""
        return self.stored.found(self.places, names)

    def _by_block(self, places: IndexArray) -> Iterator[tuple[Block, IndexArray]]:
        starts = [block.first for block in self.stored.blocks]
        number = int(np.searchsorted(starts, places[0], side="right")) - 1 if places.size else 0
        while places.size:
            block = self.stored.blocks[number]
            inside = int(np.searchsorted(places, block.last))
            if inside:
                yield block, places[:inside]
            places, number = places[inside:], number + 1

    def values(self, name: str) -> list[Any]:
        """A column as it is in rows."""
        return [row[name] for row in self.only(name)]

    def _chosen(self, places: IndexArray) -> Iterator[dict[str, Any]]:
        """Rows of some of the columns that are stored."""
        own = [column for column in columns.COLUMNS if column.name in self._names]
        first, last = int(places[0]), int(places[-1]) + 1
        values = [unpacked(self.stored.table, column, first, last) for column in own]
        for place in (places - first).tolist():
            yield {column.name: part[place] for column, part in zip(own, values, strict=True)}

    def _made(self, places: IndexArray) -> Iterator[dict[str, Any]]:
        """The rows at some places, which are read together where they are near each other."""
        stored = self.stored
        own = [column for column in row_columns(stored.manifest) if column.name not in ("experiment", "initial_delay")]
        first, last = int(places[0]), int(places[-1]) + 1
        if last - first > 4 * max(len(places), ROWS):
            for half in np.array_split(places, 2):
                yield from self._made(half)
            return
        values = {column.name: unpacked(stored.table, column, first, last) for column in own}
        for block, inside in self._by_block(places):
            converged = stored.converged(block, inside)
            truth = stored._truths[block.cell["hash"]].get("delay")
            swept = {**block.cell["swept"], **block.estimator["swept"]}
            for k, place in enumerate(inside.tolist()):
                row = {name: column[place - first] for name, column in values.items()}
                row |= {"experiment": stored.manifest["experiment"]}
                row["initial_delay"] = stored.manifest["starts"].get(row["start"])
                if row["denominator"] is not None:
                    # An estimate with a model has a table of errors, if an empty one.
                    row["standard_errors"] = row["standard_errors"] or {}
                ordered = {column.name: row[column.name] for column in row_columns(stored.manifest)}
                judgement = None if converged is None else bool(converged[k])
                yield ordered | swept | {"converged": judgement, "true_delay": truth}


def first_with(table: Table, prefix: str) -> list[int]:
    """Rows whose id begins with some letters."""
    rows: list[int] = np.flatnonzero(np.char.startswith(table.read("id"), prefix.encode())).tolist()
    return rows
