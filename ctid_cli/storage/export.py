"""``runs.h5``: all estimates of a plan in columns, with everything needed to compute them again.

The bytes of the file depend on the results only: rows are in the order of the specification; times, hosts and runs are
not stored. It is built from the journal in memory, in batches of rows, and replaced atomically; the journal keeps its
SHA-256. Without a journal, the checksums of HDF5 show whether the file is intact.
"""

import hashlib
import io
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from pydantic_core import from_json

from ctid_cli.canonical import canonical_json, read_json
from ctid_cli.errors import CtidError, DataError, StorageError
from ctid_cli.progress import reported
from ctid_cli.signals.files import require_file
from ctid_cli.signals.hdf5 import require_plain_tree
from ctid_cli.storage import column_arrays, columns
from ctid_cli.storage import manifest as plans
from ctid_cli.storage.column_arrays import AnyArray
from ctid_cli.storage.columns import Column
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.journal import Journal, JournalReader
from ctid_cli.storage.manifest import Manifest, Slot
from ctid_cli.storage.sqlite_file import EXPORT, require_format
from ctid_cli.written_files import write_file

KIND, FORMAT = "ctid runs", 2
#: HDF5 file format with checksums of metadata too.
_VERSION = ("v110", "v110")

#: Columns that every file of estimates must have.
REQUIRED = ("estimator_hash", "cell", "start", "id", "status")
_ESTIMATOR_HASH = Column("estimator_hash", "str", "hash of the settings of the estimator", source="plan")

#: Function that returns places in a plan with their results.
Results = Callable[[], Iterable[tuple[Slot, Mapping[str, Any]]]]


# --- writing --------------------------------------------------------------------------------------------------------


@reported("writing runs.h5")
def write_runs(folder: Path, log: Journal) -> tuple[int, str]:
    """Write the estimates of the journal's plan to ``runs.h5``; return their number and the SHA-256 of the file."""
    path, noted = folder / EXPORT, log.exported()
    if noted is not None and sha256_of(path) == noted:
        return open_export(path).count, noted
    count, image = _exported(log)
    try:
        write_file(path, image.getbuffer())
    except OSError as error:
        log.require_in_place()
        reason = f"{path} could not be written ({error.strerror or error})"
        safe = f"all {log.count()} estimates are safe in {log.path}"
        raise StorageError(f"{reason}; {safe}. Free some space and run the same command again") from error
    sha256 = hashlib.sha256(image.getbuffer()).hexdigest()
    log.note_export(sha256)
    return count, sha256


def export_in_memory(log: JournalReader) -> "Export":
    """Return the export that a journal's plan would give now."""
    return Export(h5py.File(_exported(log)[1], "r"), log.path)


def _exported(log: JournalReader) -> tuple[int, io.BytesIO]:
    """Return the number of estimates of a journal's plan, and the bytes of ``runs.h5``.

    HDF5 reports a full disk in many ways, or not at all; so it writes to memory, about 100 bytes per estimate.
    """
    manifest, image, sessions = log.manifest(), io.BytesIO(), set[str]()

    def results() -> Iterator[tuple[Slot, Mapping[str, Any]]]:
        for slot, row in log.planned_rows(manifest):
            sessions.add(row.session)
            yield slot, from_json(row.result)

    return write_export(image, manifest, lambda: log.origins_of(sessions), results), image


def write_export(
    image: io.BytesIO, manifest: Manifest, origins: Callable[[], Sequence[Origin]], results: Results
) -> int:
    """Write estimates to a file; return their number."""
    stored = _stored_columns(manifest)
    writers, count = [column_arrays.ColumnWriter(column) for column in stored], 0
    measured = [writer for writer in writers if not writer.is_fixed]
    for rows in _rows(results(), manifest, stored, 100):
        count += len(rows)
        for writer in measured:
            writer.include(rows)
    with h5py.File(image, "w", libver=_VERSION) as file:
        _write_plan(file, manifest, origins())
        group = file.create_group("estimates")
        for writer in writers:
            writer.create(group, count)
        for number, rows in enumerate(_rows(results(), manifest, stored, column_arrays.ROWS)):
            for writer in writers:
                writer.write(number * column_arrays.ROWS, rows)
    return count


def _stored_columns(manifest: Manifest) -> list[Column]:
    """Return the columns of the file: those of the rows of a plan, and its swept fields."""
    # The experiment name is an attribute; times are not results.
    of_rows = [c for c in plans.row_columns(manifest) if c.name != "experiment" and c.source != "clock"]
    parts = [*manifest["data_cells"], *manifest["estimators"]]
    swept = []
    for name in plans.swept_names(manifest):
        numbers = all(type(part["swept"].get(name)) in (int, float, type(None)) for part in parts)
        swept.append(Column(f"swept/{name}", "float64" if numbers else "str", ""))
    return [_ESTIMATOR_HASH, *of_rows, *swept]


def _rows(
    results: Iterable[tuple[Slot, Mapping[str, Any]]], manifest: Manifest, stored: Sequence[Column], size: int
) -> Iterator[list[dict[str, Any]]]:
    """Yield the values of the columns in batches of rows."""
    texts = {column.name for column in stored if column.type == "str"}
    known: dict[tuple[str, str, str], dict[str, Any]] = {}
    waiting = iter(results)
    while some := list(islice(waiting, size)):
        rows = []
        for (key, cell, estimator), result in some:
            part = key.data_hash, key.estimator_hash, estimator["name"]
            if part not in known:
                swept = {f"swept/{name}": value for name, value in {**cell["swept"], **estimator["swept"]}.items()}
                known[part] = {
                    "estimator_hash": key.estimator_hash,
                    "estimator": estimator["name"],
                    "kind": estimator["kind"],
                    "cell": key.data_hash,
                    **{name: canonical_json(value) if name in texts else value for name, value in swept.items()},
                }
            delay = manifest["starts"].get(key.start)
            own = {"id": key.id, "replicate": key.replicate, "start": key.start, "initial_delay": delay}
            rows.append({**result, **known[part], **own})
        yield rows


def _write_plan(file: h5py.File, manifest: Manifest, origins: Sequence[Origin]) -> None:
    file.attrs.update(
        {
            "format": KIND,
            "format_version": FORMAT,
            "experiment": manifest["experiment"],
            "spec_hash": manifest["spec_hash"],
            "seed": "none" if manifest["seed"] is None else manifest["seed"],
            "runs": manifest["runs"],
            "estimates_planned": plans.planned_count(manifest),
            "origins": json.dumps([origin._asdict() for origin in sorted(origins)], sort_keys=True),
            "code_version": " ".join(dict.fromkeys(origin.code_version for origin in sorted(origins))),
            "platform": " | ".join(dict.fromkeys(origin.platform for origin in sorted(origins))),
        }
    )
    # Not sorted: swept fields keep the order of the specification. HDF5 attributes have a length limit.
    text = json.dumps(manifest)
    encoded = column_arrays.encoded_texts([text], len(text.encode())).reshape(())
    dataset = file.create_dataset("manifest", data=encoded, track_times=False)
    # HDF5 has no checksum for scalar texts.
    dataset.attrs["sha256"] = hashlib.sha256(text.encode()).hexdigest()


# --- reading --------------------------------------------------------------------------------------------------------


class Export:
    """An open ``runs.h5``. The file is untrusted: everything in it is checked before use."""

    def __init__(self, file: h5py.File, path: Path) -> None:
        self.path = path
        with naming_file(path):
            if file.attrs.get("format") != KIND:
                raise StorageError(f"{path} is an HDF5 file, but not one that 'ctid run' has written")
            require_format(path, int(file.attrs["format_version"]), FORMAT)
            require_plain_tree(file)
            plan = bytes(file["manifest"][()])
            if hashlib.sha256(plan).hexdigest() != file["manifest"].attrs["sha256"]:
                raise ValueError("its plan is not what was written")
            self.manifest = plans.require_manifest(read_json(plan.decode("utf-8")))
            self.origins = tuple(Origin.of(**entry) for entry in read_json(str(file.attrs["origins"])))
            self._group = file["estimates"]
            self.count = int(self._group["replicate"].shape[0])
            for column in (_ESTIMATOR_HASH, *columns.COLUMNS):
                if column.name in self._group:
                    column_arrays.require_column(column, self._group, self.count)
                elif column.name in REQUIRED:
                    raise ValueError(f"there is no column {column.name}")

    def has(self, name: str) -> bool:
        """Return whether an array exists."""
        return name in self._group

    def parts(self, name: str) -> list[str]:
        """Return the column names of an array with several columns."""
        with naming_file(self.path):
            return column_arrays.decoded_texts(self._group[column_arrays.names_of(name)][()])

    def read(self, name: str, start: int = 0, stop: int | None = None) -> AnyArray:
        """Return some rows of an array."""
        with naming_file(self.path):
            return np.asarray(self._group[name][start:stop])

    def values(self, column: Column, start: int = 0, stop: int | None = None) -> list[Any]:
        """Return values of a column, None if missing."""
        name, stop = column.name, self.count if stop is None else min(stop, self.count)
        if not self.has(name):
            return [None] * (stop - start)
        names = self.parts(name) if column.type == "by name" else ()
        with naming_file(self.path):
            values = column_arrays.decoded(column, lambda ending: self._group[name + ending][start:stop], names)
        if name == "standard_errors":
            # An estimate with a model has a table of errors, which may be empty.
            models = (self.read("denominator_length", start, stop) != column_arrays.MISSING).tolist()
            return [one or ({} if there else None) for one, there in zip(values, models, strict=True)]
        return values

    def verify(self) -> None:
        """Read the whole file, so that HDF5 verifies all checksums."""
        for item in self._group.values():
            for dataset in item.values() if isinstance(item, h5py.Group) else [item]:
                with naming_file(self.path):
                    for start in range(0, self.count if dataset.shape[:1] == (self.count,) else 1, column_arrays.ROWS):
                        _ = dataset[start : start + column_arrays.ROWS]


def open_export(path: Path) -> Export:
    """Open ``runs.h5``."""
    with naming_file(path):
        if path.exists():
            require_file(path)
        try:
            file = h5py.File(path, "r")
        except BlockingIOError:
            # The file never changes, so file systems without locks can be used.
            file = h5py.File(path, "r", locking=False)
    return Export(file, path)


def sha256_of(path: Path) -> str | None:
    """Return the SHA-256 of a file; None if it cannot be read."""
    with suppress(OSError), path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
    return None


@contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Add to an error which file cannot be read."""
    try:
        yield
    except DataError as error:
        raise StorageError(f"{path} cannot be read: {error}") from error
    except CtidError:
        raise
    # HDF5 reports damage by many kinds of exceptions.
    except Exception as error:
        raise StorageError(f"{path} is damaged or cannot be read ({str(error)[:200]})") from error
