"""The sealed file ``runs.h5``: every estimate of one plan, in columns, with all that is needed to redo them.

The bytes of the file depend on the results alone: rows are in the order of the specification, and times, hosts and runs
are not in it. It is written beside the old one, column by column, synchronised, renamed, read back and compared.
"""

import errno
import hashlib
import json
import os
import re
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ctid_cli.canonical import canonical_json
from ctid_cli.errors import CtidError, DataError, StorageError
from ctid_cli.signals.files import require_file
from ctid_cli.signals.hdf5 import require_plain_tree
from ctid_cli.storage import columns
from ctid_cli.storage.foreign import read_json, require_manifest
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.manifest import Manifest, planned_count, refuse_newer, row_columns, swept_names
from ctid_cli.storage.packing import MISSING, PackedTable, decoded, texts
from ctid_cli.storage.pieces import ROWS, AnyArray, ranges

#: Raised by one whenever an older ctid could misread the file.
FORMAT = 1
KIND = "ctid runs"
#: Bytes before the HDF5 data, which HDF5 leaves to the user.
USER_BLOCK = 512
#: How a file without a user block begins, as older versions wrote them.
_SIGNATURE = b"\x89HDF"
_PACKING: dict[str, Any] = {"compression": "gzip", "shuffle": True}


def write_sealed(manifest: Manifest, origins: Sequence[Origin], table: PackedTable, path: Path) -> str:
    """Write the sealed file of some estimates; returns the checksum of its content."""
    with _minding_the_disk(), h5py.File(path, "w", userblock_size=USER_BLOCK) as file:
        checksum = _write_all(file, manifest, origins, table)
    with path.open("r+b") as written:
        written.seek(USER_BLOCK)
        head = _head(hashlib.file_digest(written, "sha256").hexdigest())
        written.seek(0)
        written.write(head)
        written.flush()
        os.fsync(written.fileno())
    return checksum


@contextmanager
def _minding_the_disk() -> Iterator[None]:
    """Raise what the system said of a disk that is full or read-only; HDF5 says it in other ways as well.

    Closing the file fails a second time, without an OSError. What fails while an object goes out of use, a part of a
    column say, is only printed, and all goes on without that part: here it is an error like any other.
    """
    hooks, failures = (sys.excepthook, sys.unraisablehook), list[BaseException | None]()
    try:
        # Both are called for the same failure; h5py prints it twice.
        sys.excepthook, sys.unraisablehook = lambda *error: None, lambda error: failures.append(error.exc_value)
        yield
    except (OSError, RuntimeError) as error:
        failures.append(error)
        _let_go(error)
    finally:
        sys.excepthook, sys.unraisablehook = hooks
    if failures:
        raise _of_the_disk(failures)


def _let_go(error: BaseException | None) -> None:
    """Have the objects of a file go out of use now that are kept by the frames of an error."""
    while error is not None:
        traceback.clear_frames(error.__traceback__)
        error = error.__context__


def _of_the_disk(failures: Sequence[BaseException | None]) -> OSError:
    for failure in failures:
        error = failure
        while error is not None:
            if found := re.search(r"errno = (\d+), error message = '(.*?)'", str(error)):
                return OSError(int(found[1]), found[2])
            error = error.__context__
    return OSError(errno.EIO, str(failures[0]))


def _write_all(file: h5py.File, manifest: Manifest, origins: Sequence[Origin], table: PackedTable) -> str:
    _write_plan(file, manifest, sorted(origins))
    group = file.create_group("estimates")
    _write(group, "estimator_hash", table)
    for column in row_columns(manifest):
        # The name of the experiment is an attribute; times are not results.
        if column.name != "experiment" and column.source != "clock":
            _write_column(group, column, table)
    swept = group.create_group("swept")
    for name in swept_names(manifest):
        _write(swept, name, table, f"swept/{name}")
    for name, track in table.tracks.items():
        _write_track(file.require_group("tracks").create_group(name), track)
    checksum = _content_checksum(file)
    file.attrs["checksum"] = checksum
    file.flush()
    return checksum


def _head(sha256: str) -> bytes:
    text = f"Written by ctid. HDF5 data begin at byte {USER_BLOCK}; their SHA-256 is {sha256}\n"
    return text.encode().ljust(USER_BLOCK, b"\0")


class SealedTable:
    """The estimates in an open sealed file; what is read from it may be whatever a stranger has put there."""

    def __init__(self, file: h5py.File, path: Path) -> None:
        self._file, self._group, self._path = file, file["estimates"], path
        self.count = int(self._group["replicate"].shape[0])
        _require_columns(self._group, self.count)

    def has(self, name: str) -> bool:
        """Whether the file has such an array: one of a column that is younger than the file is missing."""
        return name in self._group

    def parts(self, name: str) -> list[str]:
        """Names of the columns of an array that has several."""
        with _saying_where(self._path):
            return decoded(self._group[_names_of(name)][()])

    def read(self, name: str, start: int = 0, stop: int | None = None) -> AnyArray:
        """Some rows of an array."""
        with _saying_where(self._path):
            values = np.asarray(self._group[name][start:stop])
            if name.endswith("_length") and values.size:
                most = self._group[name.removesuffix("_length")].shape[1]
                if not MISSING <= values.min() <= values.max() <= most:
                    raise ValueError(f"{name} has values that it cannot have")
            return values


@dataclass(frozen=True)
class OpenSealed:
    """A sealed file whose columns are read when they are asked for."""

    manifest: Manifest
    origins: tuple[Origin, ...]
    table: SealedTable
    checksum: str
    #: Whether its bytes have a checksum of their own; those of older files have none.
    has_head: bool


def open_sealed(path: Path, *, fully: bool = False) -> OpenSealed:
    """Open a sealed file that is as it was written: its bytes, and fully its content, agree with their checksums.

    The content of an older file, whose bytes have none, is always compared.
    """
    with _saying_where(path):
        has_head = _require_intact(path)
        # It stays open as long as anybody has the table.
        file = _open(path)
        checksum = _require_content(file, path, fully=fully or not has_head)
        # A text; once it was an array of bytes.
        manifest = require_manifest(read_json(bytes(file["manifest"][()]).decode("utf-8")))
        origins = tuple(Origin.of(**entry) for entry in read_json(str(file.attrs["origins"])))
        return OpenSealed(manifest, origins, SealedTable(file, path), checksum, has_head)


def read_sealed_tracks(path: Path) -> dict[str, dict[str, np.ndarray[Any, Any]]]:
    """The tracks in a sealed file."""
    with _saying_where(path):
        _require_intact(path)
        with _open(path) as file:
            _require_content(file, path, fully=True)
            tracks = file.get("tracks", {})
            return {name: {column: tracks[name][column][()] for column in tracks[name]} for name in tracks}


def verify_sealed(path: Path) -> str:
    """Compare a sealed file with its checksums, without taking its content apart; returns that of the content."""
    with _saying_where(path):
        _require_intact(path)
        with _open(path) as file:
            return _require_content(file, path, fully=True)


def _require_content(file: h5py.File, path: Path, *, fully: bool) -> str:
    if file.attrs.get("format") != KIND:
        raise StorageError(f"{path} is an HDF5 file, but not one that 'ctid run' has written")
    require_plain_tree(file)
    refuse_newer(path, int(file.attrs["format_version"]), FORMAT)
    checksum = str(file.attrs["checksum"])
    if fully and _content_checksum(file) != checksum:
        raise StorageError(f"{path} is damaged: its content does not agree with its checksum")
    return checksum


@contextmanager
def _saying_where(path: Path) -> Iterator[None]:
    try:
        yield
    except DataError as error:
        raise StorageError(f"{path} cannot be read: {error}") from error
    except CtidError:
        raise
    # HDF5 reports damage as whatever exception the damaged part happens to cause.
    except Exception as error:
        raise StorageError(f"{path} cannot be read ({str(error)[:200]})") from error


def _require_intact(path: Path) -> bool:
    """Refuse a damaged file before HDF5 sees it, which may go round in circles in there; whether bytes told so."""
    if path.exists():
        require_file(path)
    with path.open("rb") as file:
        head = file.read(USER_BLOCK)
        if head.startswith(_SIGNATURE):
            return False
        if head != _head(hashlib.file_digest(file, "sha256").hexdigest()):
            raise StorageError(f"{path} is damaged: its bytes do not agree with the checksum that it begins with")
        return True


def _open(path: Path) -> h5py.File:
    try:
        return h5py.File(path, "r")
    except BlockingIOError:
        # The file is complete and never changes; file systems without locks need not stop anyone from reading it.
        return h5py.File(path, "r", locking=False)


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
            "origins": json.dumps([asdict(origin) for origin in origins], sort_keys=True),
            "code_version": " ".join(dict.fromkeys(origin.code_version for origin in origins)),
            "platform": " | ".join(dict.fromkeys(origin.platform for origin in origins)),
        }
    )
    # The order of swept fields in the manifest is that of the specification, and columns follow it.
    plans = {"spec": canonical_json(manifest["spec"]), "manifest": json.dumps(manifest, allow_nan=False)}
    for name, text in plans.items():
        # A dataset, because attributes have a length limit; an HDF5 string ends at a zero byte, and JSON holds none.
        encoded = texts([text])
        file.create_dataset(name, data=_typed(encoded).reshape(()), track_times=False)


def _write_track(group: h5py.Group, packed: Mapping[str, Any]) -> None:
    from ctid_cli.frequency.flags import Flag
    from ctid_cli.simulation.frequency_measures import MEASURE_UNITS, unpack_track

    units = {"t": "s", "omega": MEASURE_UNITS["omega"], "flags": "-", "uncertainty": "rad/s"}
    for name, values in unpack_track(packed).items():
        _write_array(group, name, values).attrs["unit"] = units[name]
    bits = ", ".join(f"{int(flag)} {str(flag.name).lower()}" for flag in Flag)
    group["flags"].attrs["bits"] = f"{bits}; an estimate without any is valid"


def _write(group: h5py.Group, name: str, table: PackedTable, source: str = "") -> h5py.Dataset:
    """Write an array, as much of it at a time as makes whole chunks."""
    source = source or name
    some = table.read(source, 0, 0)
    shape = (table.count, *some.shape[1:])
    empty = 0 in shape
    written = group.create_dataset(name, shape, _type(some.dtype), track_times=False, **({} if empty else _PACKING))
    if not empty:
        rows = written.chunks[0] * -(-ROWS // written.chunks[0])
        for start, stop in ranges(table.count, rows):
            written[start:stop] = _typed(table.read(source, start, stop))
    return written


def _write_array(group: h5py.Group, name: str, values: np.ndarray[Any, Any]) -> h5py.Dataset:
    packing = _PACKING if values.size else {}
    return group.create_dataset(name, data=_typed(values), track_times=False, **packing)


def _typed(values: AnyArray) -> AnyArray:
    """An array whose texts say that they are UTF-8."""
    typed = np.empty(values.shape, _type(values.dtype))
    typed[...] = values
    return typed


def _type(dtype: np.dtype[Any]) -> Any:
    return h5py.string_dtype("utf-8", dtype.itemsize) if dtype.kind == "S" else dtype


def _write_column(group: h5py.Group, column: columns.Column, table: PackedTable) -> None:
    name = column.name
    match column.type:
        case "int64" | "Int64":
            written = _write(group, name, table)
            if column.type == "Int64":
                written.attrs["missing"] = MISSING
        case "coefficients":
            _write(group, name, table).attrs["padding"] = "NaN, behind the last coefficient; descending powers"
            _write(group, f"{name}_length", table)
        case "by name":
            _write(group, name, table).attrs["columns"] = ", ".join(table.parts(name))
            _write(group, f"{name}_present", table)
            _write_array(group, _names_of(name), texts(table.parts(name)))
        case _:
            _write(group, name, table)
    attributes = {"meaning": column.meaning.replace("`", ""), "unit": column.unit}
    group[name].attrs.update({key: text for key, text in attributes.items() if text})


def _names_of(name: str) -> str:
    return f"{name.removesuffix('s')}_names"


def _require_columns(group: h5py.Group, count: int) -> None:
    """Refuse arrays that are not what a column is: of other length, kind or shape."""
    kinds = {"str": ("S", 1), "int64": ("iu", 1), "Int64": ("iu", 1), "coefficients": ("biuf", 2)}
    kinds |= {"by name": ("biuf", 2), "estimator_hash": ("S", 1)}
    wanted = {"estimator_hash": "estimator_hash"}
    wanted |= {column.name: column.type for column in columns.COLUMNS if column.name in group}
    for name in ("cell", "start", "id"):
        if name not in group:
            raise ValueError(f"there is no column {name}")
    for name, kind in wanted.items():
        letters, dimensions = kinds.get(kind, ("biuf", 1))
        dataset = group[name]
        if dataset.dtype.kind not in letters or dataset.ndim != dimensions or len(dataset) != count:
            raise ValueError(f"{name} is no column of {count} estimates")
        if kind == "coefficients":
            lengths = group[f"{name}_length"]
            if lengths.dtype.kind not in "iu" or lengths.shape != (count,):
                raise ValueError(f"{name} has no lengths")
        if kind == "by name":
            names = decoded(group[_names_of(name)][()])
            if len(set(names)) != len(names):
                raise ValueError(f"{name} has a name twice")
            present = group[f"{name}_present"]
            if dataset.shape != (count, len(names)) or present.shape != dataset.shape or present.dtype.kind not in "bu":
                raise ValueError(f"{name} has other columns than names")


def _content_checksum(file: h5py.File) -> str:
    digest = hashlib.sha256()

    def include(text: str, data: bytes = b"") -> None:
        digest.update(f"{len(text)} {text} {len(data)}\n".encode() + data)

    def visit(name: str, item: Any) -> None:
        for key in sorted(item.attrs):
            if not (name == "" and key == "checksum"):
                include(f"{name}@{key}={item.attrs[key]}")
        if isinstance(item, h5py.Dataset):
            if not item.shape:
                values = np.ascontiguousarray(item[()])
                include(f"{name} {values.dtype.str} {values.shape}", values.tobytes())
                return
            # All of it at once would be the same text.
            text = f"{name} {item.dtype.str} {item.shape}"
            digest.update(f"{len(text)} {text} {item.nbytes}\n".encode())
            for start, stop in ranges(item.shape[0]):
                digest.update(np.ascontiguousarray(item[start:stop]).tobytes())
            return
        for key in sorted(item):
            visit(f"{name}/{key}", item[key])

    visit("", file)
    return digest.hexdigest()
