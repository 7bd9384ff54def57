"""The stored estimates of one plan, by column and by row, and as a table of pandas.

However many they are: columns are arrays, read when they are asked for, and rows are made some at a time.

An estimate has *converged* if it satisfies every condition of the specification's ``success``:

- ``delay_relative_error``: the estimated delay differs from the true one by at most this fraction of it;
- ``fit_percent``: the fit on the record it was estimated from is at least this [%];
- ``parameter_relative_error``: every parameter but the delay differs from the true one by at most this fraction;
- ``band`` [rad/s] and ``by`` [s]: every frequency of a signal came into the band around the true one to stay there,
  counted from the start, and after its last step from that.

Its status does not matter: an estimate that stopped at the iteration limit with the right delay has converged, one that
settled elsewhere has not. An estimate without a result (``FAILED``, ``CRASHED``, ``TIMEOUT``, ``MEMORY``) has not
converged and counts in every percentage. Without ``success``, or without true values to compare with, nothing is said.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IndexArray
from ctid_cli.errors import CtidError, StorageError, UsageError
from ctid_cli.storage import columns
from ctid_cli.storage import folder as place
from ctid_cli.storage.export import (
    EXPORT,
    MISSING,
    ROWS,
    AnyArray,
    Export,
    export_in_memory,
    open_export,
    sha256_of,
)
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.manifest import (
    Key,
    Manifest,
    Slot,
    found_values,
    is_of_signal,
    row_columns,
    swept_names,
    true_values,
)

if TYPE_CHECKING:
    import pandas as pd

#: Columns of the times, which are in the journal only.
CLOCKS = ("seconds", "cpu_seconds")
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
#: Times of the estimates of an estimator on a data cell, from the hashes of both, by replicate and start.
Times = Callable[[str, str], Mapping[tuple[int, str], tuple[float | None, float | None]]]


def read_estimates(folder: Path, names: Sequence[str] | None = None) -> pd.DataFrame:
    """Estimates of the latest plan of an experiment, or some columns of them, as a table."""
    return read_stored(folder).frame(names)


def read_stored(folder: Path) -> Stored:
    """The estimates of the latest plan of an experiment."""
    with place.reading_journal(folder) as log:
        if log is None:
            # There is a journal without a plan where the run was killed before it had planned anything.
            if not (folder / EXPORT).exists():
                raise UsageError(f"there are no results in {folder}; 'ctid run' writes them")
            return Stored(open_export(folder / EXPORT))
        exported = log.exported()
        if exported is not None and sha256_of(folder / EXPORT) == exported:
            return Stored(open_export(folder / EXPORT), _times_of(folder, exported))
        log.check()
        stored = Stored(export_in_memory(log))
        times = {(block.cell["hash"], block.hash): log.times(block.cell["hash"], block.hash) for block in stored.blocks}
        return Stored(stored.export, lambda *part: times[part])


def _times_of(folder: Path, exported: str) -> Times:
    """Times out of a journal, as long as that is the one of ``runs.h5``."""

    def read(data_hash: str, estimator_hash: str) -> Mapping[tuple[int, str], tuple[float | None, float | None]]:
        with suppress(CtidError), place.reading_journal(folder) as log:
            if log is not None and log.exported() == exported:
                return log.times(data_hash, estimator_hash)
        return {}

    return read


@dataclass(frozen=True, eq=False)
class Block:
    """The rows of one estimator on one data cell."""

    first: int
    last: int
    cell: Mapping[str, Any]
    estimator: Mapping[str, Any]
    #: Hash of the estimator.
    hash: str


class Stored:
    """The stored estimates of one plan, or some that follow each other."""

    def __init__(self, export: Export, times: Times | None = None, part: tuple[int, int] | None = None) -> None:
        self.export = export
        self._times = times
        self._first, self._last = (0, export.count) if part is None else part
        self._read: dict[str, AnyArray] = {}

    def part(self, start: int, stop: int) -> Stored:
        """Some of them."""
        return Stored(self.export, self._times, (self._first + start, min(self._first + stop, self._last)))

    @property
    def manifest(self) -> Manifest:
        """The plan."""
        return self.export.manifest

    @property
    def origins(self) -> tuple[Origin, ...]:
        """Where they come from."""
        return self.export.origins

    @property
    def mixed(self) -> bool:
        """Whether several versions of the code, or platforms, computed what is compared here."""
        return len(self.origins) > 1

    @property
    def count(self) -> int:
        """Number of estimates."""
        return self._last - self._first

    # --- columns ----------------------------------------------------------------------------------------------------

    def has(self, name: str) -> bool:
        """Whether there is such a column."""
        return name in CLOCKS or self.export.has(name)

    def column(self, name: str) -> AnyArray:
        """A column as an array."""
        if name not in self._read:
            if name in CLOCKS:
                self._read |= zip(CLOCKS, self._clocks(), strict=True)
            else:
                self._read[name] = self.export.read(name, self._first, self._last)
        return self._read[name]

    def values(self, name: str) -> list[Any]:
        """A column as it is in rows: None where there is no value."""
        (column,) = (column for column in columns.COLUMNS if column.name == name)
        if name in CLOCKS:
            return [None if value != value else value for value in self.column(name).tolist()]
        if name == "experiment":
            return [self.manifest["experiment"]] * self.count
        if name == "initial_delay":
            return [self.manifest["starts"].get(start) for start in self.values("start")]
        if column.source == "truth":
            return self._compared(name)
        values = self.export.values(column, self._first, self._last)
        if name == "standard_errors" and self.has("denominator"):
            # An estimate with a model has a table of errors, if an empty one.
            models = (self.column("denominator_length") != MISSING).tolist()
            values = [value or ({} if there else None) for value, there in zip(values, models, strict=True)]
        return values

    def _clocks(self) -> tuple[Array, Array]:
        """Times of the estimates [s]; NaN where they are not known."""
        found = np.full((2, self.count), np.nan)
        if self._times is not None and self.count:
            replicates, starts = self.column("replicate").tolist(), self.values("start")
            for block in self.blocks:
                times = self._times(block.cell["hash"], block.hash)
                inside = range(block.first, block.last)
                pairs = [times.get((replicates[k], starts[k]), (None, None)) for k in inside]
                found[:, inside] = np.array(pairs, dtype=float).T
        return found[0], found[1]

    def _compared(self, name: str) -> list[Any]:
        """What follows from a comparison with the truth: ``converged`` or ``true_delay``."""
        values: list[Any] = []
        for block in self.blocks:
            if name == "true_delay":
                values += [self._truths[block.cell["hash"]].get("delay")] * (block.last - block.first)
                continue
            converged = self.converged(block, np.arange(block.first, block.last))
            values += [None] * (block.last - block.first) if converged is None else converged.tolist()
        return values

    @cached_property
    def blocks(self) -> list[Block]:
        """The rows of every estimator on every data cell, which follow each other."""
        known = {(part["hash"], part["name"]): part for part in self.manifest["estimators"]}
        cells = {cell["hash"]: cell for cell in self.manifest["data_cells"]}
        parts = [self.column(name) for name in ("estimator_hash", "estimator", "cell")]
        differs: BoolArray = np.zeros(max(self.count - 1, 0), dtype=bool)
        for part in parts:
            differs |= part[1:] != part[:-1]
        places = [*([0] if self.count else []), *(np.flatnonzero(differs) + 1).tolist(), self.count]
        found = []
        for first, last in pairwise(places):
            estimator, name, cell = (part[first].decode() for part in parts)
            if cell not in cells or (estimator, name) not in known:
                what = f"estimates of {name} on the data cell {cell} are stored that the plan does not have"
                raise StorageError(f"{self.export.path}: {what}")
            found.append(Block(first, last, cells[cell], known[estimator, name], estimator))
        return found

    @cached_property
    def ends_of_blocks(self) -> IndexArray:
        """The row after the last one of every block."""
        return np.array([block.last for block in self.blocks], dtype=np.intp)

    @cached_property
    def _truths(self) -> dict[str, dict[str, float]]:
        """True values by name of every data cell."""
        try:
            return {cell["hash"]: true_values(cell) for cell in self.manifest["data_cells"]}
        # Somebody else may have written the plan.
        except (TypeError, ValueError, KeyError, AttributeError) as error:
            raise StorageError(f"the plan of {self.manifest['experiment']} holds a system that is none") from error

    @property
    def failures(self) -> BoolArray:
        """Which estimates are failures."""
        return np.isin(self.column("status"), _FAILED)

    def converged(self, block: Block, where: IndexArray) -> BoolArray | None:
        """Which estimates of a block satisfy the rule; None where there is none."""
        success, truth = self.manifest["success"], self._truths[block.cell["hash"]]
        if not success:
            return None
        measures = None
        if success.get("band") is not None:
            measures = self.part(int(where[0]), int(where[-1]) + 1).values("measures") if where.size else []
            measures = [measures[k - where[0]] for k in where.tolist()]
        values = dict(zip(truth, self.found(where, tuple(truth))[0].T, strict=True))
        fit, failures = self.column("fit_percent")[where], np.isin(self.column("status")[where], _FAILED)
        return judged(success, truth, failures, values, fit, measures)

    def found(self, where: IndexArray, names: Sequence[str]) -> tuple[Array, Array, Array]:
        """Values, standard errors and quantiles under the names of the true ones, NaN where none is, shape (n, p).

        Rows that have the same form take their numbers from the same places: what `found_values` says of places.
        """
        there = [name for name in _OF_PARAMETERS if self.has(name)]
        names_of_forms = [f"{name}_{_OF_PARAMETERS[name]}" for name in there if _OF_PARAMETERS[name]]
        held = {name: self.column(name)[where] for name in (*there, *names_of_forms)}
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
                    at = places[name]
                    if isinstance(at, tuple):
                        target[alike, k] = held[at[0]].reshape(len(where), -1)[alike, at[1]]
                    elif at is not None:
                        target[alike, k] = at
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
                    row[name] = {part: (name, k) for k, part in enumerate(self.export.parts(name)) if there[k]} or None
        return row

    # --- rows -------------------------------------------------------------------------------------------------------

    def every(self) -> Rows:
        """All of them, as rows."""
        return Rows(self, np.arange(self.count))

    @property
    def row_names(self) -> list[str]:
        """Names of what a row has."""
        names = [column.name for column in row_columns(self.manifest)]
        compared = [column.name for column in columns.COLUMNS if column.source == "truth"]
        return [*names, *swept_names(self.manifest), *compared]

    def fields(self, names: Sequence[str] | None = None) -> dict[str, list[Any]]:
        """All of what rows have, or some of it, by name."""
        swept = swept_names(self.manifest)
        return {n: self._swept(n) if n in swept else self.values(n) for n in names or self.row_names}

    def _swept(self, name: str) -> list[Any]:
        """Values of a swept field."""
        values: list[Any] = []
        for block in self.blocks:
            values += [{**block.cell["swept"], **block.estimator["swept"]}.get(name)] * (block.last - block.first)
        return values

    def slot(self, number: int) -> Slot:
        """What an estimate is of."""
        (block,) = (block for block in self.blocks if block.first <= number < block.last)
        start, replicate = self.column("start")[number].decode(), int(self.column("replicate")[number])
        return Slot(Key(block.cell["hash"], replicate, block.hash, start), block.cell, block.estimator)

    @cached_property
    def results(self) -> dict[Key, dict[str, Any]]:
        """All results by key."""
        part = (self._first, self._last)
        return dict(zip(self.export.keys(*part), self.export.results(*part), strict=True))

    def frame(self, names: Sequence[str] | None = None, types: Mapping[str, Any] | None = None) -> pd.DataFrame:
        """All of them as a table, with the units of its columns; the types of swept fields may be given."""
        import pandas as pd

        # Where there is no system, the columns of one would be empty.
        left_out = "systems" if is_of_signal(self.manifest) else ""
        known = {c.name: c for c in columns.COLUMNS}
        shown = [n for n in names or self.row_names if n not in known or known[n].of != left_out]
        series = {
            name: pd.Series(values, dtype=known[name].dtype if name in known else (types or {}).get(name))
            for name, values in self.fields(shown).items()
        }
        frame = pd.DataFrame(series)
        frame.attrs["mixed"] = self.mixed
        frame.attrs["units"] = {name: known[name].unit for name in shown if name in known and known[name].unit}
        return frame


class Rows:
    """Some estimates, in the order of ``runs.h5``: as columns, or one after the other."""

    def __init__(self, stored: Stored, places: IndexArray, names: Sequence[str] | None = None) -> None:
        self.stored, self.places = stored, places
        self._names = names

    def only(self, *names: str) -> Rows:
        """The same, with rows of some columns only."""
        return Rows(self.stored, self.places, names)

    def chosen(self, which: BoolArray | IndexArray | slice) -> Rows:
        """Some of them."""
        return Rows(self.stored, self.places[which], self._names)

    def __len__(self) -> int:
        return len(self.places)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for start in range(0, self.stored.count, ROWS):
            inside = self.places[slice(*np.searchsorted(self.places, (start, start + ROWS)))]
            if inside.size:
                first = int(inside[0])
                fields = self.stored.part(first, int(inside[-1]) + 1).fields(self._names)
                for number in (inside - first).tolist():
                    yield {name: values[number] for name, values in fields.items()}

    def has(self, name: str) -> bool:
        """Whether they have such a column at all."""
        return self.stored.has(name)

    def column(self, name: str) -> AnyArray:
        """A column as an array."""
        return np.asarray(self.stored.column(name)[self.places])

    def values(self, name: str) -> list[Any]:
        """A column as it is in rows."""
        return [row[name] for row in self.only(name)]

    @property
    def failures(self) -> BoolArray:
        """Which of them failed."""
        return np.isin(self.column("status"), _FAILED)

    @cached_property
    def converged(self) -> BoolArray | None:
        """Which of them satisfy the rule of success; None where there is none for all of them."""
        if not len(self):
            return None
        found = []
        first, last = np.searchsorted(self.stored.ends_of_blocks, self.places[[0, -1]], side="right")
        for block in self.stored.blocks[first : last + 1]:
            inside = self.places[slice(*np.searchsorted(self.places, (block.first, block.last)))]
            found.append(self.stored.converged(block, inside))
        known = [part for part in found if part is not None]
        return np.concatenate(known) if known and len(known) == len(found) else None

    def found(self, names: Sequence[str]) -> tuple[Array, Array, Array]:
        """Estimated values, standard errors and quantiles of intervals under the names of the true ones."""
        return self.stored.found(self.places, names)


# --- success and flat tables ----------------------------------------------------------------------------------------


def is_converged(row: Mapping[str, Any], success: Mapping[str, Any] | None, truth: Mapping[str, float]) -> bool | None:
    """Whether an estimate satisfies the success rule, from the true values by name."""
    found = {name: _array(value) for name, value in found_values(row, truth)[0].items()}
    failures = np.array([row["status"] in columns.FAILURES])
    hits = judged(success, truth, failures, found, _array(row.get("fit_percent")), [row.get("measures")])
    return None if hits is None else bool(hits[0])


def _array(value: float | None) -> Array:
    return np.array([value], dtype=np.float64)


def judged(
    success: Mapping[str, Any] | None,
    truth: Mapping[str, float],
    failures: BoolArray,
    found: Mapping[str, Array],
    fit_percent: Array,
    measures: Sequence[Mapping[str, float | None] | None] | None,
) -> BoolArray | None:
    """Which estimates satisfy the success rule: from what they found by name, NaN where there is nothing."""
    rule = success or {}
    conditions: list[BoolArray] = []
    if rule.get("delay_relative_error") is not None and "delay" in truth:
        conditions.append(_near(found["delay"], truth["delay"], rule["delay_relative_error"]))
    others = truth.keys() - {"delay"}
    if rule.get("parameter_relative_error") is not None and others:
        conditions += [_near(found[name], truth[name], rule["parameter_relative_error"]) for name in others]
    if rule.get("band") is not None and measures is not None:
        from ctid_cli.simulation.frequency_measures import is_settled

        conditions.append(np.array([is_settled(one, rule["band"], rule.get("by")) for one in measures], dtype=bool))
    if rule.get("fit_percent") is not None:
        conditions.append(fit_percent >= rule["fit_percent"])
    return np.logical_and.reduce([~failures, *conditions]) if conditions else None


def _near(values: Array, true: float, tolerance: float) -> BoolArray:
    return np.abs(values - true) <= tolerance * abs(true)


def export_rows(estimates: pd.DataFrame) -> pd.DataFrame:
    """Estimates as a flat table for other programs, with one number per cell."""
    import pandas as pd

    parts = {column.name: column for column in columns.COLUMNS if column.type in ("coefficients", "by name")}
    flat: dict[str, Any] = {}
    for name in estimates.columns:
        if name not in parts:
            flat[name] = estimates[name]
            continue
        for part, values in _parts(parts[name], estimates[name]):
            key, column = f"{parts[name].prefix}{part}", pd.Series(values, dtype="float64", index=estimates.index)
            # Parameters that make a model are its coefficients too; other names that are taken get a longer one.
            if key in estimates.columns and key != "delay":
                key = f"parameters.{key}"
            flat[key] = flat[key].combine_first(column) if key in flat else column
    return pd.DataFrame(flat)


def _parts(column: columns.Column, cells: Iterable[Any]) -> Iterator[tuple[Any, list[float | None]]]:
    """The parts of a column with several numbers in a cell, each with its values."""
    # As mappings, coefficients are numbered from 0; the first one of a denominator is 1 and left out.
    rows: list[Any] = [dict(enumerate(row)) if isinstance(row, list) else row or {} for row in cells]
    found: list[Any] = column.names(rows) if column.type == "by name" else []
    for part in found or sorted({k for row in rows for k in row if k or column.name != "denominator"}):
        yield part, [row.get(part) for row in rows]
