"""Stored estimates of one plan: by column, by row, as pandas table, CSV and JSON.

Any number of estimates is supported: columns are arrays that are read when first used; rows are made in batches.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IndexArray
from ctid_cli.errors import StorageError, UsageError
from ctid_cli.progress import reported
from ctid_cli.storage import columns
from ctid_cli.storage import folder as folders
from ctid_cli.storage import manifest as plans
from ctid_cli.storage.column_arrays import ROWS, AnyArray, names_of
from ctid_cli.storage.export import Export, export_in_memory, open_export, sha256_of
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.journal import JournalReader
from ctid_cli.storage.manifest import Key, Manifest, Slot
from ctid_cli.storage.sqlite_file import EXPORT
from ctid_cli.storage.truth import ERRORS, VALUES, Found, failures, found_under, satisfied

if TYPE_CHECKING:
    import pandas as pd

#: Columns of times, which are stored in the journal only.
CLOCKS = ("seconds", "cpu_seconds")
#: Columns of several named numbers.
_BY_NAME = [column.name for column in columns.COLUMNS if column.type == "by name"]
#: Function that returns the times of the estimates of an estimator on a data cell, by replicate and start, from the
#: hashes of both and the first and last replicate.
Times = Callable[[str, str, int, int], Mapping[tuple[int, str], tuple[float | None, float | None]]]


def read_estimates(folder: Path, names: Sequence[str] | None = None) -> pd.DataFrame:
    """Return all or some columns of the estimates of the latest plan of an experiment as a table."""
    return read_stored(folder).frame(names)


@reported("reading stored estimates")
def read_stored(folder: Path) -> Estimates:
    """Return the estimates of the latest plan of an experiment."""
    with folders.reading_journal(folder) as log:
        return stored_in(folder, log)


def stored_in(folder: Path, log: JournalReader | None) -> Estimates:
    """Return the estimates of the latest plan, from ``runs.h5`` if it is up to date with the journal."""
    if log is None:
        # A journal has no plan if the run was killed before planning.
        if not (folder / EXPORT).exists():
            raise UsageError(f"there are no results in {folder}; 'ctid run' writes them")
        return Estimates(open_export(folder / EXPORT))
    exported, times = log.exported(), partial(_times_in, folder)
    if exported is not None and sha256_of(folder / EXPORT) == exported:
        return Estimates(open_export(folder / EXPORT), times)
    log.check()
    return Estimates(export_in_memory(log), times)


def _times_in(folder: Path, *part: Any) -> Any:
    """Return the times stored in a journal."""
    with folders.reading_journal(folder) as log:
        return {} if log is None else log.times(*part)


@dataclass(frozen=True, eq=False)
class Block:
    """The rows of one estimator on one data cell."""

    first: int
    last: int
    cell: Mapping[str, Any]
    estimator: Mapping[str, Any]
    #: Hash of the estimator.
    hash: str


class Estimates:
    """All or a subset of the stored estimates of one plan, in the order of ``runs.h5``."""

    def __init__(self, export: Export, times: Times | None = None, places: range | IndexArray | None = None) -> None:
        self.export = export
        self._times = times
        self._places = places
        #: All estimates, if these are a subset selected one by one.
        self._all: Estimates | None = None
        self._read: dict[str, AnyArray] = {}

    @property
    def places(self) -> range | IndexArray:
        """Row numbers in the export."""
        return range(self.export.count) if self._places is None else self._places

    def part(self, start: int, stop: int) -> Estimates:
        """Return a contiguous part; its columns are read separately."""
        return self._some(self.places[start:stop])

    def chosen(self, which: BoolArray | IndexArray) -> Estimates:
        """Return a subset; its columns are selected from those of all estimates."""
        places, numbers = self.places, np.flatnonzero(which) if which.dtype == bool else which
        # Converting a range to an array would need memory for the whole export, for each of perhaps a thousand groups.
        some = self._some(places.start + numbers if isinstance(places, range) else places[numbers])
        some._all = self if self._places is None else self._all
        return some

    def _some(self, places: range | IndexArray) -> Estimates:
        return Estimates(self.export, self._times, places)

    @property
    def manifest(self) -> Manifest:
        """The plan."""
        return self.export.manifest

    @property
    def origins(self) -> tuple[Origin, ...]:
        """Origins (code version, platform) of the estimates."""
        return self.export.origins

    @property
    def mixed(self) -> bool:
        """Whether the estimates come from several code versions or platforms."""
        return len(self.origins) > 1

    def __len__(self) -> int:
        return len(self.places)

    # --- columns ----------------------------------------------------------------------------------------------------

    def has(self, name: str) -> bool:
        """Return whether a column exists."""
        return name in CLOCKS or self.export.has(name)

    def column(self, name: str) -> AnyArray:
        """Return a column as an array."""
        if self._all is not None:
            return np.asarray(self._all.column(name)[self.places])
        if name not in self._read:
            if name in CLOCKS:
                self._read |= zip(CLOCKS, self._clocks(), strict=True)
            else:
                self._read[name] = self._span(lambda first, last: self.export.read(name, first, last))
        return self._read[name]

    def _span(self, read: Callable[[int, int], Any]) -> Any:
        """Read the rows from the first to the last place, and drop those in between that are not selected."""
        places = self.places
        if not len(places):
            return read(0, 0)
        first, last = int(places[0]), int(places[-1]) + 1
        found = read(first, last)
        if last - first == len(places):
            return found
        inside = np.asarray(places) - first
        return found[inside] if isinstance(found, np.ndarray) else [found[k] for k in inside.tolist()]

    def values(self, name: str) -> list[Any]:
        """Return a column as values of rows: None for missing values."""
        known = {column.name: column for column in columns.COLUMNS}
        if name not in known:
            return self._by_block(lambda block: {**block.cell["swept"], **block.estimator["swept"]}.get(name))
        if name in CLOCKS:
            return [None if value != value else value for value in self.column(name).tolist()]
        if name == "experiment":
            return [self.manifest["experiment"]] * len(self)
        if name == "initial_delay":
            return [self.manifest["starts"].get(start) for start in self.values("start")]
        if name == "true_delay":
            return self._by_block(lambda block: self._truths[block.cell["hash"]].get("delay"))
        if name == "converged":
            return [None if value != value else bool(value) for value in self.satisfied.tolist()]
        values: list[Any] = self._span(lambda first, last: self.export.values(known[name], first, last))
        return values

    def _by_block(self, value: Callable[[Block], Any]) -> list[Any]:
        return [one for block in self.blocks for one in [value(block)] * (block.last - block.first)]

    def _clocks(self) -> Array:
        """Return the computing times of the estimates [s], shape (2, n); NaN if unknown."""
        found, unknown = np.full((2, len(self)), np.nan), (np.nan, np.nan)
        for block in self.blocks if self._times is not None else ():
            assert self._times is not None
            own = slice(block.first, block.last)
            replicates, starts = self.column("replicate")[own].tolist(), self.column("start")[own].tolist()
            # Not of the whole block: these can be a small part of a large one.
            times = self._times(block.cell["hash"], block.hash, min(replicates), max(replicates))
            keys = zip(replicates, (start.decode() for start in starts), strict=True)
            found[:, own] = np.array([times.get(key, unknown) for key in keys], dtype=float).T
        return found

    @cached_property
    def blocks(self) -> list[Block]:
        """Contiguous rows, one block for each estimator on each data cell."""
        known = {(part["hash"], part["name"]): part for part in self.manifest["estimators"]}
        cells = {cell["hash"]: cell for cell in self.manifest["data_cells"]}
        parts = [self.column(name) for name in ("estimator_hash", "estimator", "cell")]
        differs: BoolArray = np.zeros(max(len(self) - 1, 0), dtype=bool)
        for part in parts:
            differs |= part[1:] != part[:-1]
        places = [*([0] if len(self) else []), *(np.flatnonzero(differs) + 1).tolist(), len(self)]
        found = []
        for first, last in pairwise(places):
            estimator, name, cell = (part[first].decode() for part in parts)
            if cell not in cells or (estimator, name) not in known:
                what = f"estimates of {name} on the data cell {cell} are stored that the plan does not have"
                raise StorageError(f"{self.export.path}: {what}")
            found.append(Block(first, last, cells[cell], known[estimator, name], estimator))
        return found

    @property
    def failures(self) -> BoolArray:
        """Mask of the failed estimates."""
        return failures({"status": self.column("status")})

    # --- comparison with the truth ----------------------------------------------------------------------------------

    @cached_property
    def _truths(self) -> dict[str, dict[str, float]]:
        """True values by name, for each data cell."""
        if self._all is not None:
            return self._all._truths
        try:
            return {cell["hash"]: plans.true_values(cell) for cell in self.manifest["data_cells"]}
        # The plan is untrusted input.
        except (TypeError, ValueError, KeyError, AttributeError) as error:
            raise StorageError(f"the plan of {self.manifest['experiment']} holds a system that is none") from error

    @property
    def converged(self) -> BoolArray | None:
        """Mask of the estimates that satisfy the success rule; None unless the rule applies to all of them."""
        found = self.satisfied
        return None if not len(found) or np.isnan(found).any() else found.astype(bool)

    @cached_property
    def satisfied(self) -> Array:
        """1 for estimates that satisfy the success rule, 0 for others, NaN if no rule applies."""
        found, success = np.full(len(self), np.nan), self.manifest["success"]
        if not success:
            return found
        arrays = self._arrays("status", "fit_percent", *VALUES)
        measures = self.values("measures") if success.get("band") is not None else None
        for block in self.blocks:
            own, truth = slice(block.first, block.last), self._truths[block.cell["hash"]]
            some = {name: array if name.endswith("_names") else array[own] for name, array in arrays.items()}
            values = found_under(tuple(truth), some, block.last - block.first).values
            hits = satisfied(success, truth, some, values, measures and measures[own])
            if hits is not None:
                found[own] = hits
        return found

    def found(self, names: Sequence[str]) -> Found:
        """Return values, standard errors and quantiles under the true names, NaN if missing, shape (n, p)."""
        return found_under(names, self._arrays(*VALUES, *ERRORS), len(self))

    def _arrays(self, *names: str) -> dict[str, AnyArray]:
        """Return the named arrays that exist, and the names of their parts."""
        arrays = {name: self.column(name) for name in names if self.has(name)}
        parts = {names_of(name): np.array(self.export.parts(name), dtype=object) for name in arrays if name in _BY_NAME}
        return arrays | parts

    # --- rows -------------------------------------------------------------------------------------------------------

    @property
    def names(self) -> list[str]:
        """Column names of a row."""
        own = [column.name for column in plans.row_columns(self.manifest)]
        compared = [column.name for column in columns.COLUMNS if column.source == "truth"]
        return [*own, *plans.swept_names(self.manifest), *compared]

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return self.rows()

    def rows(self, *names: str) -> Iterator[dict[str, Any]]:
        """Yield all rows, or some columns of them, reading some thousand at a time."""
        for start in range(0, self.export.count, ROWS):
            inside = slice(*np.searchsorted(np.asarray(self.places), (start, start + ROWS)))
            some = self.part(inside.start, inside.stop)
            if len(some):
                fields = {name: some.values(name) for name in names or self.names}
                yield from (dict(zip(fields, row, strict=True)) for row in zip(*fields.values(), strict=True))

    def slot(self, number: int) -> Slot:
        """Return the place of an estimate in the plan."""
        (block,) = (block for block in self.blocks if block.first <= number < block.last)
        start, replicate = self.column("start")[number].decode(), int(self.column("replicate")[number])
        return Slot(Key(block.cell["hash"], replicate, block.hash, start), block.cell, block.estimator)

    @cached_property
    def results(self) -> dict[Key, dict[str, Any]]:
        """All results by key."""
        return dict(self.by_key())

    def by_key(self) -> Iterator[tuple[Key, dict[str, Any]]]:
        """Yield the results as computed, each with its key."""
        names = [column.name for column in columns.COLUMNS if column.source == "result"]
        for block in self.blocks:
            for row in self.part(block.first, block.last).rows("replicate", "start", *names):
                key = Key(block.cell["hash"], row.pop("replicate"), block.hash, row.pop("start"))
                yield key, row

    @reported("reading stored estimates")
    def frame(self, names: Sequence[str] | None = None, types: Mapping[str, Any] | None = None) -> pd.DataFrame:
        """Return the estimates as a table, with the units of its columns; types of swept fields may be given."""
        import pandas as pd

        # Columns of systems would be empty for signals.
        left_out = "systems" if plans.is_of_signal(self.manifest) else ""
        known = {c.name: c for c in columns.COLUMNS}
        shown = [n for n in names or self.names if n not in known or known[n].of != left_out]
        dtypes = {name: known[name].dtype if name in known else (types or {}).get(name) for name in shown}
        # Numbers are already arrays; columns that are not stored have no value.
        arrays = {n for n in shown if n in known and known[n].type == "float64" and n != "true_delay" and self.has(n)}
        frame = pd.DataFrame(
            {n: pd.Series(self.column(n) if n in arrays else self.values(n), dtype=dtypes[n]) for n in shown}
        )
        frame.attrs["mixed"] = self.mixed
        frame.attrs["units"] = {name: known[name].unit for name in shown if name in known and known[name].unit}
        return frame


# --- text for other programs ------------------------------------------------------------------------------


def csv_lines(stored: Estimates) -> Iterator[str]:
    """Yield the estimates as parts of a CSV file with one number in a cell, the header first."""
    names, types, parts = list(map(str, stored.part(0, 0).frame())), _types(stored), _parts(stored)
    for start in range(0, max(len(stored), 1), ROWS):
        flat = flat_frame(stored.part(start, start + ROWS), names, types, parts)
        yield str(flat.to_csv(index=False, lineterminator="\n", header=start == 0))


def flat_frame(
    stored: Estimates, names: Sequence[str], types: Mapping[str, Any], parts: Mapping[str, Mapping[str, int]]
) -> pd.DataFrame:
    """Return columns of estimates with one number in a cell; columns with several numbers are split into parts."""
    import pandas as pd

    frame = stored.frame([name for name in names if name not in parts], types)
    flat: dict[str, pd.Series] = {}
    for name in names:
        if name not in parts:
            flat[name] = frame[name]
        elif parts[name]:
            values = pd.DataFrame(stored.column(name))
            for part, place in parts[name].items():
                # Parameters of a model are also its coefficients; other names already in use get a longer name.
                key = f"{name}.{part}" if part in names and part != "delay" else part
                flat[key] = flat[key].combine_first(values[place]) if key in flat else values[place]
    return pd.DataFrame(flat)


def _parts(stored: Estimates) -> dict[str, dict[str, int]]:
    """Return the names of the numbers in columns with several, those that any estimate has, with their places."""
    found: dict[str, dict[str, int]] = {}
    for column in columns.COLUMNS:
        name, places = column.name, dict[str, int]()
        if column.type == "by name" and stored.has(name):
            there: Any = stored.column(f"{name}_present").any(axis=0)
            places = {part: k for k, part in enumerate(stored.export.parts(name)) if there[k]}
        elif column.type == "coefficients" and stored.has(name):
            # The leading 1 of a denominator is left out.
            first, longest = int(name == "denominator"), int(stored.column(f"{name}_length").max(initial=0))
            places = {str(k): k for k in range(first, longest)}
        if column.type in ("by name", "coefficients"):
            found[name] = {f"{column.prefix}{part}": k for part, k in places.items()}
    return found


def _types(stored: Estimates) -> dict[str, Any]:
    """Return the types of the columns of swept fields over all estimates."""
    import pandas as pd

    swept = [{**block.cell["swept"], **block.estimator["swept"]} for block in stored.blocks]
    return {name: pd.Series([part.get(name) for part in swept]).dtype for name in plans.swept_names(stored.manifest)}


#: Keys of every estimate in machine-readable output, in this order.
ESTIMATE_KEYS = (
    *("id", "experiment", "estimator", "cell", "replicate", "start", "status"),
    *("delay", "numerator", "denominator", "standard_errors", "cost", "fit_percent", "iterations", "seconds"),
)


def as_object(estimate: Mapping[str, Any]) -> dict[str, Any]:
    """Return an estimate for JSON: the documented keys first, then all other stored values."""
    keys = list(ESTIMATE_KEYS)
    if "parameters" in estimate:
        keys.insert(keys.index("standard_errors"), "parameters")
    return {key: estimate.get(key) for key in keys} | {key: item for key, item in estimate.items() if key not in keys}


def json_lines(rows: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the estimates as lines of one JSON list of objects."""
    before = "[\n"
    for row in rows:
        yield before + indent(json.dumps(as_object(row), indent=1, allow_nan=False), " ")
        before = ",\n"
    yield "[]\n" if before == "[\n" else "\n]\n"
