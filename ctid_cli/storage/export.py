"""``runs.h5``: every estimate that a plan asks for, in columns, with all that is needed to redo them.

The bytes of the file depend on the results alone: rows are in the order of the specification, and times, hosts and runs
are not in it. It is written from the journal, some rows at a time, synchronised and renamed; the journal keeps its
SHA-256. Where there is no journal, HDF5's own checksums tell whether it is whole.
"""

import errno
import hashlib
import io
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from pydantic_core import from_json

from ctid_cli.canonical import canonical_json
from ctid_cli.errors import CtidError, DataError, StorageError
from ctid_cli.signals.files import require_file
from ctid_cli.signals.hdf5 import require_plain_tree
from ctid_cli.storage import columns
from ctid_cli.storage.columns import Column
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.journal import EXPORT, Journal, JournalReader, require_format
from ctid_cli.storage.manifest import (
    Key,
    Manifest,
    Slot,
    plan_values,
    planned_count,
    read_json,
    require_manifest,
    row_columns,
    swept_names,
)
from ctid_cli.written_files import replace_file

AnyArray = NDArray[Any]

KIND, FORMAT = "ctid runs", 2
#: Rows that are written at once, and make a chunk of the file.
ROWS = 8192
#: Stands for a missing whole number.
MISSING = -1
#: A file format whose metadata have checksums too.
_VERSION = ("v110", "v110")

_ESTIMATOR_HASH = Column("estimator_hash", "str", "hash of the settings of the estimator", source="plan")

#: Places in a plan with what was computed for them.
Results = Callable[[], Iterable[tuple[Slot, Mapping[str, Any]]]]


# --- writing --------------------------------------------------------------------------------------------------------


def seal(folder: Path, log: Journal) -> tuple[int, str]:
    """Write the estimates of the journal's plan to ``runs.h5``; returns their number and the SHA-256 of the file."""
    path, noted = folder / EXPORT, log.exported()
    if noted is not None and sha256_of(path) == noted:
        return open_export(path).count, noted
    manifest = log.manifest()
    try:
        count = replace_file(path, lambda temporary: _write_file(temporary, manifest, log))
        sha256 = sha256_of(path)
    except OSError as error:
        log.require_in_place()
        reason = f"{path} could not be written ({error.strerror or error})"
        safe = f"all {log.count()} estimates are safe in {log.path}"
        raise StorageError(f"{reason}; {safe}. Make room and run the same command again") from error
    assert sha256 is not None
    log.note_export(sha256)
    return count, sha256


def _write_file(path: Path, manifest: Manifest, log: JournalReader) -> int:
    with path.open("w+b", buffering=0) as file:
        written = _Recorder(file)
        count = write_export(written, manifest, *_of_journal(log, manifest))
        written.require_written()
        os.fsync(file.fileno())
    return count


def export_in_memory(log: JournalReader) -> "Export":
    """Return what would be exported of a journal's plan now."""
    manifest, image = log.manifest(), io.BytesIO()
    write_export(image, manifest, *_of_journal(log, manifest))
    return Export(h5py.File(image, "r"), log.path)


def _of_journal(log: JournalReader, manifest: Manifest) -> tuple[Callable[[], Sequence[Origin]], Results]:
    """Yield where the estimates of a plan come from, to ask when all of them were read, and these."""
    sessions: set[str] = set()

    def results() -> Iterator[tuple[Slot, Mapping[str, Any]]]:
        for slot, row in log.planned_rows(manifest):
            sessions.add(row.session)
            yield slot, from_json(row.result)

    return lambda: log.origins_of(sessions), results


class _Recorder:
    """A file for HDF5, to which all writing seems to succeed: HDF5 reports a full disk in many ways, or not at all."""

    def __init__(self, file: io.FileIO) -> None:
        self._file = file
        self._error: OSError | None = None
        self.seek, self.tell, self.read, self.readinto, self.flush = (
            file.seek,
            file.tell,
            file.read,
            file.readinto,
            file.flush,
        )

    def write(self, data: Any) -> int:
        """Write, unless writing has failed before."""
        left = memoryview(data).cast("B")
        with self._recording():
            while left and self._error is None:
                left = left[self._file.write(left) :]
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        """Cut the file, unless writing has failed before."""
        with self._recording():
            if self._error is None:
                self._file.truncate(size)
        return size or 0

    @contextmanager
    def _recording(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._error = error

    def require_written(self) -> None:
        """Raise the error that writing ended with."""
        if self._error is not None:
            raise self._error


def write_export(target: Any, manifest: Manifest, origins: Callable[[], Sequence[Origin]], results: Results) -> int:
    """Write the file of some estimates; returns their number."""
    extent = _Extent(manifest)
    for slot, result in results():
        extent.include(slot, result)
    try:
        with h5py.File(target, "w", libver=_VERSION) as file:
            _write_plan(file, manifest, origins())
            group = file.create_group("estimates")
            datasets = dict(extent.datasets(group))
            waiting = iter(results())
            for start in range(0, extent.count, ROWS):
                rows = [extent.values(*row) for row in islice(waiting, ROWS)]
                for name, dataset in datasets.items():
                    dataset[start : start + len(rows)] = extent.array(name, rows)
    except (OSError, RuntimeError) as error:
        if isinstance(target, _Recorder):
            target.require_written()
        raise OSError(errno.EIO, str(error)) from error
    return extent.count


class _Extent:
    """The arrays of an export: how long texts and lists are, and which names have values, before they are written."""

    def __init__(self, manifest: Manifest) -> None:
        self.count, self._manifest = 0, manifest
        #: The name of the experiment is an attribute; times are not results.
        of_rows = [c for c in row_columns(manifest) if c.name != "experiment" and c.source != "clock"]
        self._columns = {column.name: column for column in (_ESTIMATOR_HASH, *of_rows)}
        parts = [*manifest["data_cells"], *manifest["estimators"]]
        for name in swept_names(manifest):
            numbers = all(type(part["swept"].get(name)) in (int, float, type(None)) for part in parts)
            self._columns[f"swept/{name}"] = Column(f"swept/{name}", "float64" if numbers else "str", "")
        self._longest = dict.fromkeys(self._columns, 1)
        self._names: dict[str, dict[str, None]] = {n: {} for n, c in self._columns.items() if c.type == "by name"}
        self._texts = [name for name, column in self._columns.items() if column.type == "str"]
        self._lists = [name for name, column in self._columns.items() if column.type == "coefficients"]

    def values(self, slot: Slot, result: Mapping[str, Any]) -> dict[str, Any]:
        """Return values of the columns of a row."""
        values = {**result, **plan_values(slot, self._manifest), "estimator_hash": slot.key.estimator_hash}
        for name, value in slot.swept.items():
            of = f"swept/{name}"
            values[of] = canonical_json(value) if self._columns[of].type == "str" else value
        return values

    def include(self, slot: Slot, result: Mapping[str, Any]) -> None:
        """Count a row."""
        self.count += 1
        values = self.values(slot, result)
        for name in self._texts:
            text = values.get(name) or ""
            size = len(text) if text.isascii() else len(text.encode())
            self._longest[name] = max(self._longest[name], size)
        for name in self._lists:
            self._longest[name] = max(self._longest[name], len(values.get(name) or ()))
        for name, known in self._names.items():
            found = values.get(name) or {}
            if not found.keys() <= known.keys():
                known.update(dict.fromkeys(found))

    def datasets(self, group: h5py.Group) -> Iterator[tuple[str, h5py.Dataset]]:
        """Create the arrays, each with what it means."""
        for name, column in self._columns.items():
            attributes: dict[str, Any] = {"meaning": column.meaning.replace("`", ""), "unit": column.unit or ""}
            shape: tuple[int, ...] = (self.count,)
            dtype: Any = np.float64
            if column.type == "str":
                dtype = h5py.string_dtype("utf-8", self._longest[name])
            elif column.type in ("int64", "Int64"):
                dtype = np.int64
                attributes |= {"missing": MISSING} if column.type == "Int64" else {}
            elif column.type == "coefficients":
                shape = (self.count, self._longest[name])
                attributes["padding"] = "NaN, behind the last coefficient; descending powers"
                yield f"{name}_length", _dataset(group, f"{name}_length", (self.count,), np.int64)
            elif column.type == "by name":
                names = self._names[name] = dict.fromkeys(column.names([self._names[name]]))
                shape = (self.count, len(names))
                attributes["columns"] = ", ".join(names)
                yield f"{name}_present", _dataset(group, f"{name}_present", shape, np.uint8)
                _write_texts(group, names_of(name), list(names))
            dataset = _dataset(group, name, shape, dtype)
            dataset.attrs.update({key: value for key, value in attributes.items() if value != ""})
            yield name, dataset

    def array(self, name: str, rows: Sequence[Mapping[str, Any]]) -> AnyArray:
        """Return the values of some rows in one of the arrays."""
        base = name.removesuffix("_present").removesuffix("_length")
        if name in self._columns:
            base = name
        column, values = self._columns[base], [row.get(base) for row in rows]
        if column.type == "str":
            return _encoded([value or "" for value in values], self._longest[name])
        if column.type in ("int64", "Int64"):
            return np.array([MISSING if value is None else value for value in values], dtype=np.int64)
        if column.type == "coefficients":
            lengths = np.array([MISSING if value is None else len(value) for value in values], dtype=np.int64)
            padded = np.full((len(rows), self._longest[base]), np.nan)
            padded[np.arange(padded.shape[1]) < lengths[:, np.newaxis]] = [x for value in values for x in value or ()]
            return padded if name == base else lengths
        if column.type == "by name":
            shape, names = (len(rows), len(self._names[base])), self._names[base]
            found: list[Mapping[str, float | None]] = [value or {} for value in values]
            if name != base:
                return np.array([part in row for row in found for part in names], dtype=np.uint8).reshape(shape)
            return np.array([row.get(part) for row in found for part in names], dtype=np.float64).reshape(shape)
        # "random" is no number: where the search started is in start_delay, and the label in start.
        return np.array([None if isinstance(value, str) else value for value in values], dtype=np.float64)


def _dataset(group: h5py.Group, name: str, shape: tuple[int, ...], dtype: Any) -> h5py.Dataset:
    packing: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}
    chunks = (min(ROWS, shape[0]), *shape[1:])
    return group.create_dataset(
        name, shape, dtype, track_times=False, **({} if 0 in shape else packing | {"chunks": chunks})
    )


def _write_texts(group: h5py.Group, name: str, texts: Sequence[str]) -> None:
    encoded = _encoded(texts, max((len(text.encode()) for text in texts), default=1))
    dataset = _dataset(group, name, encoded.shape, encoded.dtype)
    if texts:
        dataset[...] = encoded


def _encoded(texts: Sequence[str], longest: int) -> AnyArray:
    """Return texts as an array that says that they are UTF-8."""
    array = np.empty(len(texts), h5py.string_dtype("utf-8", longest))
    array[:] = [text.encode() for text in texts]
    return array


def _write_plan(file: h5py.File, manifest: Manifest, origins: Sequence[Origin]) -> None:
    file.attrs.update(
        {
            "format": KIND,
            "format_version": FORMAT,
            "experiment": manifest["experiment"],
            "spec_hash": manifest["spec_hash"],
            "seed": "none" if manifest["seed"] is None else manifest["seed"],
            "runs": manifest["runs"],
            "estimates_planned": planned_count(manifest),
            "origins": json.dumps([origin._asdict() for origin in sorted(origins)], sort_keys=True),
            "code_version": " ".join(dict.fromkeys(origin.code_version for origin in sorted(origins))),
            "platform": " | ".join(dict.fromkeys(origin.platform for origin in sorted(origins))),
        }
    )
    # Swept fields are in the order of the specification. Attributes have a length limit; single texts no checksum.
    for name, text in {"spec": canonical_json(manifest["spec"]), "manifest": json.dumps(manifest)}.items():
        encoded = _encoded([text], len(text.encode())).reshape(())
        dataset = file.create_dataset(name, data=encoded, track_times=False)
        dataset.attrs["sha256"] = hashlib.sha256(text.encode()).hexdigest()


# --- reading --------------------------------------------------------------------------------------------------------


class Export:
    """An open ``runs.h5``; anybody may have made it, so that nothing in it is trusted before it is checked."""

    def __init__(self, file: h5py.File, path: Path) -> None:
        self.path = path
        with saying_where(path):
            if file.attrs.get("format") != KIND:
                raise StorageError(f"{path} is an HDF5 file, but not one that 'ctid run' has written")
            require_format(path, int(file.attrs["format_version"]), FORMAT)
            require_plain_tree(file)
            plan = bytes(file["manifest"][()])
            if hashlib.sha256(plan).hexdigest() != file["manifest"].attrs["sha256"]:
                raise ValueError("its plan is not what was written")
            self.manifest = require_manifest(read_json(plan.decode("utf-8")))
            self.origins = tuple(Origin.of(**entry) for entry in read_json(str(file.attrs["origins"])))
            self._group = file["estimates"]
            self.count = int(self._group["replicate"].shape[0])
            _require_columns(self._group, self.count)

    def has(self, name: str) -> bool:
        """Return whether there is such an array."""
        return name in self._group

    def parts(self, name: str) -> list[str]:
        """Return names of the columns of an array that has several."""
        with saying_where(self.path):
            return _texts(self._group[names_of(name)][()])

    def read(self, name: str, start: int = 0, stop: int | None = None) -> AnyArray:
        """Return some rows of an array."""
        with saying_where(self.path):
            return np.asarray(self._group[name][start:stop])

    def values(self, column: Column, start: int = 0, stop: int | None = None) -> list[Any]:
        """Return values of a column, None where there is none."""
        name, stop = column.name, self.count if stop is None else min(stop, self.count)
        if not self.has(name):
            return [None] * (stop - start)
        values = self.read(name, start, stop)
        if column.type == "str":
            return _texts(values)
        if column.type in ("int64", "Int64"):
            return [None if value == MISSING else value for value in values.tolist()]
        plain = np.where(np.isnan(values), None, values).tolist()  # type: ignore[call-overload]
        if column.type == "coefficients":
            lengths = self.read(f"{name}_length", start, stop).tolist()
            return [None if n == MISSING else row[:n] for row, n in zip(plain, lengths, strict=True)]
        if column.type == "by name":
            names, present = self.parts(name), self.read(f"{name}_present", start, stop).tolist()
            found = [
                {part: value for part, value, there in zip(names, row, mask, strict=True) if there} or None
                for row, mask in zip(plain, present, strict=True)
            ]
            if name == "standard_errors":
                # An estimate with a model has a table of errors, if an empty one.
                models = (self.read("denominator_length", start, stop) != MISSING).tolist()
                found = [one or ({} if there else None) for one, there in zip(found, models, strict=True)]
            return found
        return list(plain)

    def keys(self, start: int = 0, stop: int | None = None) -> list[Key]:
        """Return identities of some estimates."""
        names = ("cell", "estimator_hash", "start")
        cells, estimators, starts = (_texts(self.read(name, start, stop)) for name in names)
        return list(map(Key, cells, self.read("replicate", start, stop).tolist(), estimators, starts))

    def results(self, start: int, stop: int) -> list[dict[str, Any]]:
        """Return results of some estimates, as they were computed."""
        wanted = [column for column in columns.COLUMNS if column.source == "result"]
        values = [self.values(column, start, stop) for column in wanted]
        return [dict(zip((c.name for c in wanted), row, strict=True)) for row in zip(*values, strict=True)]

    def verify(self) -> None:
        """Read all of it, so that HDF5 compares every part with its checksum."""
        for item in self._group.values():
            for dataset in item.values() if isinstance(item, h5py.Group) else [item]:
                with saying_where(self.path):
                    for start in range(0, self.count if dataset.shape[:1] == (self.count,) else 1, ROWS):
                        _ = dataset[start : start + ROWS]


def open_export(path: Path) -> Export:
    """Open ``runs.h5``."""
    with saying_where(path):
        if path.exists():
            require_file(path)
        try:
            file = h5py.File(path, "r")
        except BlockingIOError:
            # It never changes; file systems without locks need not stop anyone from reading it.
            file = h5py.File(path, "r", locking=False)
    return Export(file, path)


def sha256_of(path: Path) -> str | None:
    """Return SHA-256 of a file; None where it cannot be read."""
    with suppress(OSError), path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
    return None


def names_of(name: str) -> str:
    """Return name of the array with the names of the parts of a column."""
    return f"{name.removesuffix('s')}_names"


def _texts(values: AnyArray) -> list[str]:
    if values.dtype.kind != "S" or values.ndim != 1:
        raise ValueError("there are no texts where some belong")
    return [value.decode("utf-8") for value in values.tolist()]


@contextmanager
def saying_where(path: Path) -> Iterator[None]:
    """Say of which file an error is, and that it cannot be read."""
    try:
        yield
    except DataError as error:
        raise StorageError(f"{path} cannot be read: {error}") from error
    except CtidError:
        raise
    # HDF5 reports damage as whatever exception the damaged part happens to cause.
    except Exception as error:
        raise StorageError(f"{path} is damaged or cannot be read ({str(error)[:200]})") from error


def _require_columns(group: h5py.Group, count: int) -> None:
    """Refuse arrays that are not what a column is: of other length, kind or shape."""
    kinds = {"str": "S", "int64": "iu", "Int64": "iu"}
    for column in (_ESTIMATOR_HASH, *columns.COLUMNS):
        name = column.name
        if name not in group:
            if name in ("estimator_hash", "cell", "start", "id", "status"):
                raise ValueError(f"there is no column {name}")
            continue
        dataset, several = group[name], column.type in ("coefficients", "by name")
        if dataset.dtype.kind not in kinds.get(column.type, "f") or dataset.shape[:1] != (count,):
            raise ValueError(f"{name} is no column of {count} estimates")
        if dataset.ndim != 1 + several:
            raise ValueError(f"{name} has another number of dimensions")
        if column.type == "coefficients":
            lengths = np.asarray(group[f"{name}_length"][()])
            if (
                lengths.dtype.kind not in "iu"
                or lengths.shape != (count,)
                or (count and not MISSING <= lengths.min() <= lengths.max() <= dataset.shape[1])
            ):
                raise ValueError(f"{name} has lengths that it cannot have")
        if column.type == "by name":
            names, present = _texts(group[names_of(name)][()]), group[f"{name}_present"]
            if dataset.shape != (count, len(set(names))) or len(set(names)) < len(names):
                raise ValueError(f"{name} has other columns than names")
            if present.shape != dataset.shape or present.dtype.kind not in "bu":
                raise ValueError(f"{name} does not say which of its values there are")
