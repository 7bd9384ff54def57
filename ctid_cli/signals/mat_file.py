"""Columns from MATLAB files that hold plain arrays."""

import json
import math
import os
import warnings
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.signals.apart import done_apart
from ctid_cli.signals.files import require_file, require_values
from ctid_cli.signals.hdf5 import MAX_DEPTH, PLAIN, members, require_plain
from ctid_cli.signals.table import Table

#: Seconds that reading may take, and bytes a second of the slowest disk.
LEAST_PATIENCE, SLOWEST = 50.0, 5e6
#: Variables of one file.
MAX_NAMES_READ = 10_000
#: What MATLAB calls arrays of real numbers.
NUMERIC = ("double", "single", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))


def read_mat_table(path: str | os.PathLike[str]) -> Table:
    """Variables of a MATLAB file, read in a process of its own: some damaged files crash their readers."""
    file = require_file(path, f" the file is empty; {_how_to_save(path)}")
    patience = LEAST_PATIENCE + Path(path).stat().st_size / SLOWEST
    vectors: dict[str, Array] = {}
    with done_apart(partial(_write_answer, path, file), patience) as folder:
        if folder is None:
            raise DataError(f"{file}: this is not a MATLAB file, or a damaged one; {_how_to_save(path)}")
        answer = json.loads((folder / "answer.json").read_text(encoding="utf-8"))
        for k, name in enumerate(answer.get("names", ())):
            if name not in answer["wrong"]:
                vectors[name] = np.load(folder / f"{k}.npy", allow_pickle=False)
    if "refused" in answer:
        raise DataError(answer["refused"])
    names, objects = tuple(answer["names"]), answer["objects"]
    hint = " ".join(_how_to_export(path, name, kind) for name, kind in objects.items())
    if not names:
        raise DataError(f"{file}: {hint}" if hint else f"{file}: the file holds no arrays; {_how_to_save(path)}")

    def convert(name: str) -> Array:
        if name not in vectors:
            raise DataError(answer["wrong"][name])
        return vectors[name]

    return Table(file, names, convert, lines=None, noun="variable", hint=hint)


def _write_answer(path: str | os.PathLike[str], file: str, folder: Path) -> None:
    """Write the vectors of a file to a folder, and why other variables are none."""
    answer: dict[str, Any]
    try:
        arrays, objects = _content(path, file)
        answer = {"names": list(arrays), "objects": objects, "wrong": {}}
        for k, (name, value) in enumerate(arrays.items()):
            try:
                np.save(folder / f"{k}.npy", _vector(file, name, value), allow_pickle=False)
            except DataError as error:
                answer["wrong"][name] = str(error)
    except DataError as error:
        answer = {"refused": str(error)}
    except Exception:  # a reader in C meets damage in its own way, memory included; the caller says so
        raise SystemExit(1) from None
    (folder / "answer.json").write_text(json.dumps(answer), encoding="utf-8")


def _content(path: str | os.PathLike[str], file: str) -> tuple[dict[str, Any], dict[str, str]]:
    """Arrays by name, and the classes of objects by name.

    MATLAB writes version 7.3 as HDF5, where strings, structs and objects are told apart by attributes.
    """
    import scipy.io

    try:
        with warnings.catch_warnings():
            # Two objects in one file share a placeholder name, which is no concern of the arrays beside them.
            warnings.simplefilter("ignore")
            for name, shape in _shapes(path).items():
                require_values(file, name, math.prod(shape))
            return _flat(scipy.io.loadmat(path))
    except DataError:
        raise
    except NotImplementedError:
        return _read_hdf5(path, file)
    except OSError as error:
        raise DataError(f"{file}: cannot be read: {error.strerror or error}") from None
    except Exception:  # the reader meets damaged files with whatever its parser stumbles over
        raise DataError(f"{file}: this is not a MATLAB file, or a damaged one; {_how_to_save(path)}") from None


def _shapes(path: str | os.PathLike[str]) -> dict[str, tuple[int, ...]]:
    """What the headers of a file claim; nothing where objects are in it, which have no such headers."""
    import scipy.io

    try:
        return {name: tuple(shape) for name, shape, _ in scipy.io.whosmat(path)}
    except NotImplementedError:
        raise
    except Exception:  # the reader itself says what is wrong
        return {}


def _flat(content: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Arrays by name, and the classes of objects by name."""
    from scipy.io.matlab import MatlabObject, MatlabOpaque

    arrays: dict[str, Any] = {}
    objects: dict[str, str] = {}

    def visit(name: str, value: Any) -> None:
        if isinstance(value, MatlabOpaque):
            objects[_text(value.flat[0]["s0"]) or name] = _text(value.flat[0]["s2"])
        elif isinstance(value, MatlabObject):
            objects[name] = str(value.classname)
        elif isinstance(value, np.ndarray) and value.dtype.names is not None and value.size == 1:
            for field in value.dtype.names:
                visit(f"{name}.{field}", value.flat[0][field])
        else:
            arrays[name] = value

    for name, value in content.items():
        if not name.startswith("__"):
            visit(name, value)
    return arrays, objects


def _read_hdf5(path: str | os.PathLike[str], file: str) -> tuple[dict[str, Any], dict[str, str]]:
    import h5py

    arrays: dict[str, Any] = {}
    objects: dict[str, str] = {}

    def parts(group: Any, prefix: str) -> Iterator[tuple[str, Any]]:
        if prefix.count(".") > MAX_DEPTH or len(arrays) > MAX_NAMES_READ:
            raise DataError("it holds too many structs")
        for name, item in members(group):
            if not name.startswith("#"):  # MATLAB's own store of what objects and cells refer to
                yield prefix + name, item

    def visit(name: str, item: Any) -> None:
        kind = _text(item.attrs.get("MATLAB_class", b"double"))
        if "MATLAB_object_decode" in item.attrs:
            objects[name] = kind
        elif isinstance(item, h5py.Group):
            for field, part in parts(item, f"{name}."):
                visit(field, part)
        elif "MATLAB_empty" in item.attrs:
            arrays[name] = np.empty((0, 0))
        else:
            require_plain(name, item)
            numeric = kind in NUMERIC and item.dtype.kind in PLAIN
            arrays[name] = item[()] if numeric else np.array("text", dtype=object)

    try:
        with h5py.File(path, "r") as store:
            for name, item in parts(store, ""):
                visit(name, item)
    except DataError as error:
        raise DataError(f"{file}: {error}") from None
    # HDF5 reports damage as whatever exception the damaged part happens to cause.
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, UnicodeError, MemoryError):
        raise DataError(f"{file}: this is not a MATLAB file, or a damaged one; {_how_to_save(path)}") from None
    return arrays, objects


def _vector(file: str, name: str, value: Any) -> Array:
    array = _full(file, name, value)
    if array.dtype.kind not in "biufc":
        raise DataError(f"{file}: variable {name!r} does not hold numbers")
    if array.size == 0:
        raise DataError(f"{file}: variable {name!r} is empty")
    if array.size != max(array.shape, default=1):
        shape = "x".join(str(n) for n in array.shape)
        raise DataError(
            f"{file}: variable {name!r} is a {shape} array; save the columns you mean as vectors of their own"
        )
    if array.dtype.kind == "c":
        if np.any(array.imag != 0):
            raise DataError(f"{file}: variable {name!r} holds complex numbers")
        array = array.real
    return np.array(array, dtype=float).reshape(-1)


def _full(file: str, name: str, value: Any) -> Any:
    """A matrix as an array; if it is sparse, its indices are looked at before anything is written to where they say."""
    if not hasattr(value, "toarray"):
        return np.asarray(value)
    try:
        value.tocsc().check_format(full_check=True)
        return value.toarray()
    except (ValueError, MemoryError):
        raise DataError(f"{file}: variable {name!r} is a damaged sparse matrix") from None


def _how_to_save(path: str | os.PathLike[str]) -> str:
    return f"in MATLAB, save plain vectors: save('{Path(path).stem}.mat', 't', 'u', 'y', '-v7')"


def _how_to_export(path: str | os.PathLike[str], name: str, kind: str) -> str:
    if kind != "iddata":
        return f"{name!r} is a MATLAB {kind} object, which only MATLAB can read; {_how_to_save(path)}"
    target = f"{Path(path).stem}_plain.mat"
    return (
        f"{name!r} is a MATLAB iddata object, which only MATLAB can read; there, write its arrays to {target} with\n"
        f"  s = struct('t', {name}.SamplingInstants, 'u', {name}.InputData, 'y', {name}.OutputData); "
        f"save('{target}', '-struct', 's', '-v7')"
    )


def _text(value: Any) -> str:
    if isinstance(value, np.ndarray):
        value = value.item() if value.size == 1 else ""
    return value.decode("latin1") if isinstance(value, bytes) else str(value)
