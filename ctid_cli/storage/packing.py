"""Estimates as arrays, a row for each, and back: what the sealed file holds, and what tables are counted from."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from ctid_cli.canonical import canonical_json
from ctid_cli.storage import columns
from ctid_cli.storage.manifest import Key, Manifest, Slot, plan_values, row_columns, swept_names
from ctid_cli.storage.pieces import ROWS, AnyArray, Pieces, Table

#: Stands for a missing whole number.
MISSING = -1
#: Columns of the times, which are no results.
CLOCKS = ("seconds", "cpu_seconds")


class Packed(NamedTuple):
    """One estimate on its way into arrays."""

    slot: Slot
    result: Mapping[str, Any]
    seconds: float | None = None
    cpu_seconds: float | None = None
    session: int = 0


class PackedTable:
    """Estimates packed piece by piece; read, all pieces are laid out alike.

    Arrays have the names of their columns, as in the sealed file. Coefficients are padded behind their last one and
    have a ``_length``; columns by name have ``_present``; those of swept fields begin with ``swept/``.
    """

    def __init__(self, manifest: Manifest, rows: Iterable[Packed], pieces: Pieces | None = None) -> None:
        self._manifest, self._pieces = manifest, pieces or Pieces()
        self._columns = {column.name: column for column in row_columns(manifest)}
        #: Names of the parts of a column, and distinct values of swept fields, in the order in which they came.
        self._names: dict[str, dict[str, None]] = {n: {} for n, c in self._columns.items() if c.type == "by name"}
        self._swept: dict[str, dict[str, tuple[int, Any]]] = {name: {} for name in swept_names(manifest)}
        self._codes: dict[tuple[int, int], dict[str, int]] = {}
        #: What the estimates have values of: a column that is younger than all of them is missing.
        self._known = {"estimator_hash", *CLOCKS}
        self.count = 0
        #: Packed frequencies over time, by id, of those estimates that have them.
        self.tracks: dict[str, Any] = {}
        waiting = iter(rows)
        while piece := list(islice(waiting, ROWS)):
            self._pack(piece)
        self._parts = {name: self._columns[name].names([found]) for name, found in self._names.items()}

    # --- writing ----------------------------------------------------------------------------------------------------

    def _pack(self, rows: Sequence[Packed]) -> None:
        self.count += len(rows)
        results, plans = [row.result for row in rows], [plan_values(row.slot, self._manifest) for row in rows]
        self._known.update(plans[0], *results)
        append = self._pieces.append
        append("estimator_hash", texts([row.slot.key.estimator_hash for row in rows]))
        append("session", np.array([row.session for row in rows], dtype=np.int64))
        for name, column in self._columns.items():
            if column.source == "clock":
                append(name, floats([getattr(row, name) for row in rows]))
            elif name != "experiment":
                values = [value.get(name) for value in (plans if column.source == "plan" else results)]
                for part, array in self._arrays(column, values):
                    append(part, array)
        codes = [self._codes_of(row.slot) for row in rows] if self._swept else []
        for name in self._swept:
            append(f"swept/{name}", np.array([code[name] for code in codes], dtype=np.int64))
        for plan, result in zip(plans, results, strict=True):
            if result.get("track") is not None:
                self.tracks.setdefault(plan["id"], result["track"])

    def _codes_of(self, slot: Slot) -> dict[str, int]:
        """Numbers of the values of swept fields among the distinct ones of each."""
        place = (id(slot.cell), id(slot.estimator))
        if place not in self._codes:
            swept, numbers = slot.swept, {}
            for name, known in self._swept.items():
                value = swept.get(name)
                numbers[name] = known.setdefault(canonical_json(value), (len(known), value))[0]
            self._codes[place] = numbers
        return self._codes[place]

    def _arrays(self, column: columns.Column, rows: Sequence[Any]) -> Iterator[tuple[str, AnyArray]]:
        name = column.name
        match column.type:
            case "str":
                yield name, texts([str(row or "") for row in rows])
            case "int64" | "Int64":
                yield name, np.array([MISSING if row is None else row for row in rows], dtype=np.int64)
            case "coefficients":
                lengths = np.array([MISSING if row is None else len(row) for row in rows], dtype=np.int64)
                padded = np.full((len(rows), lengths.max(initial=1)), np.nan)
                there = np.arange(padded.shape[1]) < lengths[:, np.newaxis]
                padded[there] = floats([value for row in rows if row for value in row])
                yield name, padded
                yield f"{name}_length", lengths
            case "by name":
                known = self._names[name]
                found = [row or {} for row in rows]
                for row in found:
                    if not row.keys() <= known.keys():
                        known.update(dict.fromkeys(row))
                shape = (len(rows), len(known))
                yield name, floats([row.get(part) for row in found for part in known]).reshape(shape)
                present = [part in row for row in found for part in known]
                yield f"{name}_present", np.array(present, dtype=np.uint8).reshape(shape)
            case _:
                # "random" is no number: where the search started is in start_delay, and the label in start.
                yield name, floats([None if isinstance(row, str) else row for row in rows])

    # --- reading ----------------------------------------------------------------------------------------------------

    def has(self, name: str) -> bool:
        """Whether there is such an array."""
        return name in self._known

    def parts(self, name: str) -> list[str]:
        """Names of the columns of an array that has several."""
        return self._parts[name]

    def read(self, name: str, start: int = 0, stop: int | None = None) -> AnyArray:
        """Some rows of an array, laid out as in all its other pieces."""
        stop = self.count if stop is None else min(stop, self.count)
        laid_out = self._layout(name)
        found = [
            laid_out(piece[max(start - first, 0) : stop - first])
            for first, piece in self._pieces.pieces(name, start, stop)
        ]
        return np.concatenate(found or [laid_out(np.empty((0, 0)))])

    def _layout(self, name: str) -> Callable[[AnyArray], AnyArray]:
        """What brings any piece of an array to the form that all have."""
        base = name.removesuffix("_present")
        if name.startswith("swept/"):
            values = swept_values([value for _, value in self._swept[name.removeprefix("swept/")].values()])
            return lambda piece: values[piece.reshape(-1).astype(np.intp)]
        if base in self._parts:
            places = [list(self._names[base]).index(part) for part in self._parts[base]]
            return lambda piece: _reordered(piece, places, 0 if name != base else np.nan)
        if name in self._columns and self._columns[name].type == "coefficients":
            width = max([1, *(shape[1] for _, shape in self._pieces.kinds(name))])
            return lambda piece: _reordered(piece, range(width), np.nan)
        if name == "estimator_hash" or (name in self._columns and self._columns[name].type == "str"):
            size = max([1, *(dtype.itemsize for dtype, _ in self._pieces.kinds(name))])
            return lambda piece: piece.reshape(-1).astype(f"S{size}")
        whole = name.endswith("_length") or name == "session" or self._columns[name].type in ("int64", "Int64")
        return lambda piece: piece.reshape(-1).astype(np.int64 if whole else np.float64)


def _reordered(piece: AnyArray, places: Sequence[int], missing: float) -> AnyArray:
    """Columns of a piece in another order, those that it does not have yet filled."""
    laid = np.full((len(piece), len(places)), missing, dtype=np.float64 if missing else np.uint8)
    for k, place in enumerate(places):
        if place < piece.shape[1]:
            laid[:, k] = piece[:, place]
    return laid


def swept_values(values: Sequence[Any]) -> AnyArray:
    """Values of a swept field: numbers, or JSON."""
    if all(value is None or type(value) in (int, float) for value in values):
        return floats(values)
    return texts([canonical_json(value) for value in values])


def texts(values: Sequence[str]) -> AnyArray:
    """Texts as bytes."""
    return np.array([value.encode("utf-8") for value in values], dtype=np.bytes_ if values else "S1")


def floats(values: Sequence[Any]) -> AnyArray:
    """Numbers, NaN where there is none."""
    return np.array(values, dtype=np.float64)


def decoded(values: AnyArray) -> list[str]:
    """Texts out of bytes."""
    if values.dtype.kind != "S" or values.ndim != 1:
        raise ValueError("there are no texts where some belong")
    return [value.decode("utf-8") for value in values.tolist()]


def unpacked(table: Table, column: columns.Column, start: int, stop: int) -> list[Any]:
    """Values of a column, None where there is none."""
    name = column.name
    if not table.has(name):
        return [None] * (stop - start)
    values = table.read(name, start, stop)
    match column.type:
        case "str":
            return decoded(values)
        case "int64" | "Int64":
            return [None if value == MISSING else value for value in values.tolist()]
        case "coefficients":
            lengths = table.read(f"{name}_length", start, stop).tolist()
            return [None if n == MISSING else row[:n] for row, n in zip(_plain(values), lengths, strict=True)]
        case "by name":
            names, masks = table.parts(name), table.read(f"{name}_present", start, stop).tolist()
            return [
                {part: value for part, value, there in zip(names, row, mask, strict=True) if there} or None
                for row, mask in zip(_plain(values), masks, strict=True)
            ]
    return _plain(values)


def _plain(values: AnyArray) -> list[Any]:
    found = values.astype(object)
    found[values != values] = None
    numbers: list[Any] = found.tolist()
    return numbers


def results(table: Table, start: int, stop: int) -> list[dict[str, Any]]:
    """Results of some estimates, as they were computed."""
    wanted = [column for column in columns.COLUMNS if column.source == "result"]
    # A column that is younger than a file is missing there.
    values = [unpacked(table, column, start, stop) for column in wanted]
    found = [dict(zip((c.name for c in wanted), row, strict=True)) for row in zip(*values, strict=True)]
    for result in found:
        # An estimate with a model has a table of errors, if an empty one.
        if result["denominator"] is not None:
            result["standard_errors"] = result["standard_errors"] or {}
    return found


def keys(table: Table, start: int, stop: int) -> list[Key]:
    """Identities of some estimates."""
    replicates = table.read("replicate", start, stop).tolist()
    others = (decoded(table.read(name, start, stop)) for name in ("cell", "estimator_hash"))
    starts = decoded(table.read("start", start, stop)) if table.has("start") else ["none"] * len(replicates)
    cells, estimators = others
    return list(map(Key, cells, replicates, estimators, starts))
