"""The sealed file ``runs.h5``: every estimate of one plan, in columns, with all that is needed to redo them.

The bytes of the file depend on the results alone: rows are in the order of the specification, and times, hosts and runs
are not in it. It is made in memory, written beside the old one, synchronised, renamed, read back and compared.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ctid_cli.canonical import canonical_json
from ctid_cli.errors import DataError, StorageError
from ctid_cli.frequency.flags import Flag
from ctid_cli.signals.files import require_file
from ctid_cli.signals.hdf5 import require_plain_tree
from ctid_cli.simulation.frequency_measures import MEASURE_UNITS, unpack_track
from ctid_cli.storage import columns
from ctid_cli.storage.foreign import read_json, require_manifest
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.manifest import Key, Manifest, assemble, refuse_newer, row_columns, slots, swept_names

#: Raised by one whenever an older ctid could misread the file.
FORMAT = 1
KIND = "ctid runs"
#: Bytes before the HDF5 data, which HDF5 leaves to the user.
USER_BLOCK = 512
#: How a file without a user block begins, as older versions wrote them.
_SIGNATURE = b"\x89HDF"
#: Stands for a missing whole number.
_MISSING = -1


@dataclass(frozen=True)
class SealedRuns:
    """Content of a sealed file."""

    manifest: Manifest
    origins: tuple[Origin, ...]
    results: Mapping[Key, dict[str, Any]]
    checksum: str


def seal_image(
    manifest: Manifest, origins: Sequence[Origin], results: Mapping[Key, dict[str, Any]]
) -> tuple[bytes, str, int]:
    """The sealed file as bytes, its checksum, and the number of estimates in it."""
    stored = [slot for slot in slots(manifest) if slot.key in results]
    rows = [assemble(slot, manifest, results[slot.key], None, None) for slot in stored]
    with h5py.File("runs.h5", "w", driver="core", backing_store=False, userblock_size=USER_BLOCK) as file:
        _write_plan(file, manifest, sorted(origins))
        group = file.create_group("estimates")
        _write(group, "estimator_hash", _encode([slot.key.estimator_hash for slot in stored]))
        for column in row_columns(manifest):
            # The name of the experiment is an attribute; times are not results.
            if column.name != "experiment" and column.source != "clock":
                _write_column(group, column, [row[column.name] for row in rows])
        swept = group.create_group("swept")
        for name in swept_names(manifest):
            _write(swept, name, _swept_values([row.get(name) for row in rows]))
        for key in dict.fromkeys(slot.key for slot in stored):
            if results[key].get("track") is not None:
                _write_track(file.require_group("tracks").create_group(key.id), results[key]["track"])
        checksum = _content_checksum(file)
        file.attrs["checksum"] = checksum
        file.flush()
        return headed(file.id.get_file_image()), checksum, len(rows)


def headed(image: bytes) -> bytes:
    """HDF5 data behind their user block."""
    return _head(hashlib.sha256(image).hexdigest()) + image


def _head(sha256: str) -> bytes:
    text = f"Written by ctid. HDF5 data begin at byte {USER_BLOCK}; their SHA-256 is {sha256}\n"
    return text.encode().ljust(USER_BLOCK, b"\0")


def read_sealed(path: Path) -> SealedRuns:
    """Read a sealed file and compare it with its checksum."""
    with _checked(path) as (file, checksum):
        # A text; once it was an array of bytes.
        manifest = require_manifest(read_json(bytes(file["manifest"][()]).decode("utf-8")))
        origins = tuple(Origin.of(**entry) for entry in read_json(str(file.attrs["origins"])))
        return SealedRuns(manifest, origins, _results(file["estimates"]), checksum)


def read_sealed_tracks(path: Path) -> dict[str, dict[str, np.ndarray[Any, Any]]]:
    """The tracks in a sealed file."""
    with _checked(path) as (file, _):
        tracks = file.get("tracks", {})
        return {name: {column: tracks[name][column][()] for column in tracks[name]} for name in tracks}


def verify_sealed(path: Path) -> str:
    """Compare a sealed file with its checksum, without taking its content apart."""
    with _checked(path) as (_, checksum):
        return checksum


@contextmanager
def _checked(path: Path) -> Iterator[tuple[h5py.File, str]]:
    try:
        _require_intact(path)
        with _open(path) as file:
            if file.attrs.get("format") != KIND:
                raise StorageError(f"{path} is an HDF5 file, but not one that 'ctid run' has written")
            require_plain_tree(file)
            refuse_newer(path, int(file.attrs["format_version"]), FORMAT)
            checksum = str(file.attrs["checksum"])
            if _content_checksum(file) != checksum:
                raise StorageError(f"{path} is damaged: its content does not agree with its checksum")
            yield file, checksum
    except DataError as error:
        raise StorageError(f"{path} cannot be read: {error}") from error
    # HDF5 reports damage as whatever exception the damaged part happens to cause.
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, UnicodeError, MemoryError) as error:
        raise StorageError(f"{path} cannot be read ({str(error)[:200]})") from error


def _require_intact(path: Path) -> None:
    """Refuse a damaged file before HDF5 sees it, which may go round in circles in there."""
    if path.exists():
        require_file(path)
    with path.open("rb") as file:
        head = file.read(USER_BLOCK)
        if not head.startswith(_SIGNATURE) and head != _head(hashlib.file_digest(file, "sha256").hexdigest()):
            raise StorageError(f"{path} is damaged: its bytes do not agree with the checksum that it begins with")


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
            "estimates_planned": sum(1 for _ in slots(manifest)),
            "origins": json.dumps([asdict(origin) for origin in origins], sort_keys=True),
            "code_version": " ".join(dict.fromkeys(origin.code_version for origin in origins)),
            "platform": " | ".join(dict.fromkeys(origin.platform for origin in origins)),
        }
    )
    # The order of swept fields in the manifest is that of the specification, and columns follow it.
    texts = {"spec": canonical_json(manifest["spec"]), "manifest": json.dumps(manifest, allow_nan=False)}
    for name, text in texts.items():
        # A dataset, because attributes have a length limit; an HDF5 string ends at a zero byte, and JSON holds none.
        file.create_dataset(name, data=_encode([text]).reshape(()), track_times=False)


def _write_track(group: h5py.Group, packed: Mapping[str, Any]) -> None:
    units = {"t": "s", "omega": MEASURE_UNITS["omega"], "flags": "-", "uncertainty": "rad/s"}
    for name, values in unpack_track(packed).items():
        _write(group, name, values).attrs["unit"] = units[name]
    bits = ", ".join(f"{int(flag)} {str(flag.name).lower()}" for flag in Flag)
    group["flags"].attrs["bits"] = f"{bits}; an estimate without any is valid"


def _write(group: h5py.Group, name: str, values: np.ndarray[Any, Any]) -> h5py.Dataset:
    packing: dict[str, Any] = {"compression": "gzip", "shuffle": True} if values.size else {}
    return group.create_dataset(name, data=values, track_times=False, **packing)


def _swept_values(values: Sequence[Any]) -> np.ndarray[Any, Any]:
    if all(value is None or type(value) in (int, float) for value in values):
        return _floats(values)
    return _encode([canonical_json(value) for value in values])


def _write_column(group: h5py.Group, column: columns.Column, rows: Sequence[Any]) -> None:
    name = column.name
    match column.type:
        case "str":
            _write(group, name, _encode([str(row or "") for row in rows]))
        case "int64" | "Int64":
            written = _write(group, name, np.array([_MISSING if row is None else row for row in rows], dtype=np.int64))
            if column.type == "Int64":
                written.attrs["missing"] = _MISSING
        case "coefficients":
            _write_lists(group, name, rows)
        case "by name":
            _write_named(group, name, column.names(rows), [row or {} for row in rows])
        case _:
            # "random" is no number: where the search started is in start_delay, and the label in start.
            _write(group, name, _floats([None if isinstance(row, str) else row for row in rows]))
    attributes = {"meaning": column.meaning.replace("`", ""), "unit": column.unit}
    group[name].attrs.update({key: text for key, text in attributes.items() if text})


def _write_lists(group: h5py.Group, name: str, rows: Sequence[Any]) -> None:
    lengths = np.array([_MISSING if row is None else len(row) for row in rows], dtype=np.int64)
    padded = np.full((len(rows), lengths.max(initial=1)), np.nan)
    for k, row in enumerate(rows):
        padded[k, : len(row or ())] = _floats(row or ())
    _write(group, name, padded).attrs["padding"] = "NaN, behind the last coefficient; descending powers"
    _write(group, f"{name}_length", lengths)


def _write_named(group: h5py.Group, name: str, parts: list[str], rows: Sequence[Mapping[str, Any]]) -> None:
    shape = (len(rows), len(parts))
    values = _floats([row.get(part) for row in rows for part in parts]).reshape(shape)
    _write(group, name, values).attrs["columns"] = ", ".join(parts)
    present = np.array([part in row for row in rows for part in parts], dtype=np.uint8)
    _write(group, f"{name}_present", present.reshape(shape))
    _write(group, f"{name.removesuffix('s')}_names", _encode(parts))


def _results(group: h5py.Group) -> dict[Key, dict[str, Any]]:
    keys = (_decode(group["cell"]), _whole(group["replicate"]), _decode(group["estimator_hash"]))
    found: list[dict[str, Any]] = [columns.no_result() for _ in keys[0]]
    for column in columns.COLUMNS:
        # A column that is younger than the file is missing.
        if column.source == "result" and column.name in group:
            for result, value in zip(found, _read_column(group, column), strict=True):
                result[column.name] = value
    for result in found:
        # An estimate with a model has a table of errors, if an empty one.
        if result["denominator"] is not None:
            result["standard_errors"] = result["standard_errors"] or {}
    starts = _decode(group["start"])
    rows = dict(zip(map(Key, *keys, starts), found, strict=True))
    if {len(found), len(rows)} != {len(part) for part in (*keys, starts)} | {len(rows)}:
        raise ValueError("its columns differ in length, or an estimate is in it twice")
    return rows


def _read_column(group: h5py.Group, column: columns.Column) -> list[Any]:
    name = column.name
    if column.type == "str":
        return _decode(group[name])
    values = _plain(group[name])
    if column.type in ("float64", "boolean") and group[name].ndim != 1:
        raise ValueError(f"{name} is no column")
    match column.type:
        case "int64" | "Int64":
            return [None if value == _MISSING else value for value in _whole(group[name])]
        case "coefficients":
            lengths, width = _whole(group[f"{name}_length"]), group[name].shape[1]
            if not all(n == _MISSING or 0 <= n <= width for n in lengths):
                raise ValueError(f"{name} has lengths that it cannot have")
            return [None if n == _MISSING else row[:n] for row, n in zip(values, lengths, strict=True)]
        case "by name":
            names = _decode(group[f"{name.removesuffix('s')}_names"])
            masks = _plain(group[f"{name}_present"])
            if len(set(names)) != len(names):
                raise ValueError(f"{name} has a name twice")
            return [
                {part: value for part, value, there in zip(names, row, mask, strict=True) if there} or None
                for row, mask in zip(values, masks, strict=True)
            ]
    return values


def _content_checksum(file: h5py.File) -> str:
    digest = hashlib.sha256()

    def include(text: str, data: bytes = b"") -> None:
        digest.update(f"{len(text)} {text} {len(data)}\n".encode() + data)

    def visit(name: str, item: Any) -> None:
        for key in sorted(item.attrs):
            if not (name == "" and key == "checksum"):
                include(f"{name}@{key}={item.attrs[key]}")
        if isinstance(item, h5py.Dataset):
            values = np.ascontiguousarray(item[()])
            include(f"{name} {values.dtype.str} {values.shape}", values.tobytes())
            return
        for key in sorted(item):
            visit(f"{name}/{key}", item[key])

    visit("", file)
    return digest.hexdigest()


def _encode(texts: Sequence[str]) -> np.ndarray[Any, Any]:
    encoded = [text.encode("utf-8") for text in texts]
    return np.array(encoded, dtype=h5py.string_dtype("utf-8", max([1, *map(len, encoded)])))


def _decode(dataset: h5py.Dataset) -> list[str]:
    if dataset.dtype.kind != "S" or dataset.ndim != 1:
        raise ValueError(f"{dataset.name} holds no texts")
    return [value.decode("utf-8") for value in dataset[()].tolist()]


def _floats(values: Sequence[Any]) -> np.ndarray[Any, Any]:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _whole(dataset: h5py.Dataset) -> list[int]:
    """Whole numbers."""
    if dataset.dtype.kind not in "iu" or dataset.ndim != 1:
        raise ValueError(f"{dataset.name} holds no whole numbers")
    numbers: list[int] = dataset[()].tolist()
    return numbers


def _plain(dataset: h5py.Dataset) -> list[Any]:
    """Numbers, None where there is none."""
    if dataset.dtype.kind not in "biuf" or dataset.ndim not in (1, 2):
        raise ValueError(f"{dataset.name} holds no numbers")
    values = dataset[()]
    found = values.astype(object)
    found[values != values] = None
    numbers: list[Any] = found.tolist()
    return numbers
