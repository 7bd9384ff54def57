"""The sealed file ``runs.h5``: every estimate of one plan, in columns, with all that is needed to redo them.

The bytes of the file depend on the results alone: rows are in the order of the specification, and times, hosts and runs
are not in it. It is made in memory, written beside the old one, synchronised, renamed, read back and compared.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.errors import RefusedError, StorageError
from ctid_cli.simulation.frequency_measures import MEASURE_UNITS, measure_names, unpack_track
from ctid_cli.storage.manifest import (
    FAILURES,
    Key,
    Manifest,
    assemble,
    is_additive,
    is_of_signal,
    slots,
    swept_names,
)
from ctid_cli.storage.summary import parameter_names
from ctid_cli.storage.version import Origin

if TYPE_CHECKING:
    import h5py

#: Raised by one whenever an older ctid could misread the file.
FORMAT = 1
KIND = "ctid runs"

_TEXTS = ("id", "estimator", "kind", "estimator_hash", "cell", "start", "status", "message")
_NUMBERS = ("start_delay", "delay", "cost", "fit_percent", "validation_fit_percent", "condition_number")
_UNITS = {
    "start_delay": "s",
    "delay": "s",
    "cost": "output unit^2",
    "fit_percent": "%",
    "validation_fit_percent": "%",
    "condition_number": "-",
}
#: Stands for a missing number of iterations.
_NO_ITERATIONS = -1


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
    """The sealed file as bytes."""
    import h5py

    rows = [
        assemble(slot, manifest, results[slot.key], None) | {"estimator_hash": slot.key.estimator_hash}
        for slot in slots(manifest)
        if slot.key in results
    ]
    tracks = {
        slot.key.id: results[slot.key]["track"]
        for slot in slots(manifest)
        if results.get(slot.key, {}).get("track") is not None
    }
    with h5py.File("runs.h5", "w", driver="core", backing_store=False) as file:
        _write(file, manifest, sorted(origins, key=_origin_text), rows)
        _write_tracks(file, tracks)
        checksum = _content_checksum(file)
        file.attrs["checksum"] = checksum
        file.flush()
        return file.id.get_file_image(), checksum, len(rows)


def read_sealed(path: Path) -> SealedRuns:
    """Read a sealed file and compare it with its checksum."""
    with _checked(path) as (file, checksum):
        manifest = json.loads(_text(file["manifest"]))
        origins = tuple(_origin(entry) for entry in json.loads(str(file.attrs["origins"])))
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
    import h5py

    try:
        with _open(path, h5py) as file:
            if file.attrs.get("format") != KIND:
                raise StorageError(f"{path} is an HDF5 file, but not one that 'ctid run' has written")
            version = int(file.attrs["format_version"])
            if version > FORMAT:
                raise RefusedError(
                    f"{path} has format {version}; this ctid reads formats up to {FORMAT}."
                    " Use the newer ctid that wrote it"
                )
            checksum = str(file.attrs["checksum"])
            if _content_checksum(file) != checksum:
                raise StorageError(f"{path} is damaged: its content does not agree with its checksum")
            yield file, checksum
    # HDF5 reports damage as whatever exception the damaged part happens to cause.
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, UnicodeError) as error:
        raise StorageError(f"{path} cannot be read ({error})") from error


def _open(path: Path, h5py: Any) -> h5py.File:
    try:
        return h5py.File(path, "r")
    except BlockingIOError:
        # The file is complete and never changes; file systems without locks need not stop anyone from reading it.
        return h5py.File(path, "r", locking=False)


def _write(file: h5py.File, manifest: Manifest, origins: Sequence[Origin], rows: Sequence[Mapping[str, Any]]) -> None:
    spec = json.dumps(manifest["spec"], sort_keys=True, allow_nan=False, separators=(",", ":"))
    attributes = {
        "format": KIND,
        "format_version": FORMAT,
        "experiment": manifest["experiment"],
        "spec_hash": manifest["spec_hash"],
        "seed": "none" if manifest["seed"] is None else manifest["seed"],
        "runs": manifest["runs"],
        "estimates_planned": sum(1 for _ in slots(manifest)),
        "origins": json.dumps([_origin_dict(origin) for origin in origins], sort_keys=True),
        "code_version": " ".join(dict.fromkeys(origin.code_version for origin in origins)),
        "platform": " | ".join(dict.fromkeys(origin.platform for origin in origins)),
    }
    file.attrs.update(attributes)
    file.create_dataset("spec", data=_bytes(spec), track_times=False)
    # The order of swept fields in the manifest is that of the specification, and columns follow it.
    file.create_dataset("manifest", data=_bytes(json.dumps(manifest, allow_nan=False)), track_times=False)
    group = file.create_group("estimates")
    for name in _TEXTS:
        _column(group, name, _encode([str(row[name] or "") for row in rows]))
    _column(group, "replicate", np.array([row["replicate"] for row in rows], dtype=np.int64))
    iterations = [_NO_ITERATIONS if row["iterations"] is None else row["iterations"] for row in rows]
    _column(group, "iterations", np.array(iterations, dtype=np.int64)).attrs["missing"] = _NO_ITERATIONS
    for name in _NUMBERS:
        _column(group, name, _floats([row[name] for row in rows])).attrs["unit"] = _UNITS[name]
    initial = [row["initial_delay"] for row in rows]
    # "random" is no number: where the search started is in start_delay, and the label in start.
    fixed = _column(group, "initial_delay", _floats([v if isinstance(v, int | float) else None for v in initial]))
    fixed.attrs["unit"] = "s"
    for name in ("numerator", "denominator"):
        _ragged(group, name, [row[name] for row in rows])
    _named(group, "standard_errors", "standard_error_names", [row["standard_errors"] for row in rows])
    if is_additive(manifest):
        found = [row["parameters"] for row in rows]
        _named(group, "parameters", "parameter_names", found, parameter_names(found))
    if is_of_signal(manifest):
        measures = [row["measures"] for row in rows]
        _named(group, "measures", "measure_names", measures, measure_names(measures))
    swept = group.create_group("swept")
    for name in swept_names(manifest):
        values = [row.get(name) for row in rows]
        if all(v is None or (isinstance(v, int | float) and not isinstance(v, bool)) for v in values):
            _column(swept, name, _floats(values))
        else:
            _column(swept, name, _encode([json.dumps(value, sort_keys=True) for value in values]))


def _write_tracks(file: h5py.File, tracks: Mapping[str, Mapping[str, Any]]) -> None:
    from ctid_cli.frequency.flags import Flag

    bits = ", ".join(f"{int(flag)} {str(flag.name).lower()}" for flag in Flag)
    units = {"t": "s", "omega": MEASURE_UNITS["omega"], "flags": "-", "uncertainty": "rad/s"}
    for identifier, packed in tracks.items():
        group = file.require_group("tracks").create_group(identifier)
        for name, values in unpack_track(packed).items():
            _column(group, name, values).attrs["unit"] = units[name]
        group["flags"].attrs["bits"] = f"{bits}; an estimate without any is valid"


def _column(group: h5py.Group, name: str, values: np.ndarray[Any, Any]) -> h5py.Dataset:
    if not values.size:
        return group.create_dataset(name, data=values, track_times=False)
    return group.create_dataset(name, data=values, track_times=False, compression="gzip", shuffle=True)


def _ragged(group: h5py.Group, name: str, rows: Sequence[Sequence[float | None] | None]) -> None:
    lengths = np.array([_NO_ITERATIONS if row is None else len(row) for row in rows], dtype=np.int64)
    padded = np.full((len(rows), max([1, *lengths.tolist()])), np.nan)
    for k, row in enumerate(rows):
        if row:
            padded[k, : len(row)] = _floats(row)
    _column(group, name, padded).attrs["padding"] = "NaN, behind the last coefficient; descending powers"
    _column(group, f"{name}_length", lengths)


def _named(
    group: h5py.Group,
    column: str,
    names_of: str,
    rows: Sequence[Mapping[str, float | None] | None],
    order: Sequence[str] = (),
) -> None:
    names = list(dict.fromkeys([*order, *(name for row in rows if row for name in row)]))
    values = np.full((len(rows), len(names)), np.nan)
    present = np.zeros((len(rows), len(names)), dtype=np.uint8)
    for k, row in enumerate(rows):
        for name, value in (row or {}).items():
            place = names.index(name)
            present[k, place] = 1
            values[k, place] = np.nan if value is None else value
    _column(group, column, values)
    _column(group, f"{column}_present", present)
    _column(group, names_of, _encode(names))


def _results(group: h5py.Group) -> dict[Key, dict[str, Any]]:
    texts = {name: _decode(group[name][()]) for name in ("cell", "estimator_hash", "start", "status", "message")}
    numbers = {name: group[name][()].tolist() for name in (*_NUMBERS, "replicate", "iterations")}
    coefficients = {name: group[name][()].tolist() for name in ("numerator", "denominator")}
    lengths = {name: group[f"{name}_length"][()].tolist() for name in ("numerator", "denominator")}
    errors = _read_named(group, "standard_errors", "standard_error_names")
    parameters = _read_named(group, "parameters", "parameter_names") if "parameters" in group else []
    measures = _read_named(group, "measures", "measure_names") if "measures" in group else []
    results = {}
    for k in range(len(texts["cell"])):
        key = Key(texts["cell"][k], numbers["replicate"][k], texts["estimator_hash"][k], texts["start"][k])
        failed = texts["status"][k] in FAILURES
        result: dict[str, Any] = {name: _none(numbers[name][k]) for name in _NUMBERS}
        result |= {"status": texts["status"][k], "message": texts["message"][k]}
        result["iterations"] = None if numbers["iterations"][k] == _NO_ITERATIONS else numbers["iterations"][k]
        for name, rows in coefficients.items():
            length = lengths[name][k]
            result[name] = None if length == _NO_ITERATIONS else [_none(value) for value in rows[k][:length]]
        result["standard_errors"] = None if failed else errors[k]
        result["parameters"] = (parameters[k] or None) if parameters else None
        if measures:
            result["measures"] = measures[k] or None
        results[key] = result
    return results


def _read_named(group: h5py.Group, column: str, names_of: str) -> list[dict[str, float | None]]:
    names = _decode(group[names_of][()])
    values, present = group[column][()].tolist(), group[f"{column}_present"][()].tolist()
    return [
        {name: _none(value) for name, value, there in zip(names, row, mask, strict=True) if there}
        for row, mask in zip(values, present, strict=True)
    ]


def _content_checksum(file: h5py.File) -> str:
    import h5py

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


def _bytes(text: str) -> np.ndarray[Any, Any]:
    # A byte array, because HDF5 strings end at their first zero byte, and attributes have a length limit.
    return np.frombuffer(text.encode("utf-8"), dtype=np.uint8)


def _text(dataset: Any) -> str:
    return bytes(dataset[()].tobytes()).decode("utf-8")


def _encode(texts: Sequence[str]) -> np.ndarray[Any, Any]:
    import h5py

    encoded = [text.encode("utf-8") for text in texts]
    kind = h5py.string_dtype("utf-8", max([1, *map(len, encoded)]))
    return np.array(encoded, dtype=kind)


def _decode(values: np.ndarray[Any, Any]) -> list[str]:
    return [value.decode("utf-8") for value in values.tolist()]


def _floats(values: Sequence[Any]) -> np.ndarray[Any, Any]:
    return np.array([np.nan if value is None else float(value) for value in values], dtype=np.float64)


def _none(value: float) -> float | None:
    return None if value != value else value


def _origin_dict(origin: Origin) -> dict[str, Any]:
    packages = [list(pair) for pair in origin.packages]
    return {"code_version": origin.code_version, "platform": origin.platform, "packages": packages}


def _origin(entry: Mapping[str, Any]) -> Origin:
    packages = tuple((name, version) for name, version in entry["packages"])
    return Origin(entry["code_version"], entry["platform"], packages)


def _origin_text(origin: Origin) -> str:
    return json.dumps(_origin_dict(origin), sort_keys=True)
