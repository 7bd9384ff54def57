"""Columns from MATLAB and HDF5 files of plain arrays, read in a separate process.

Some damaged files crash the reading libraries.
"""

import faulthandler
import json
import math
import multiprocessing
import os
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.signals.files import require_file, require_values
from ctid_cli.signals.hdf5 import hdf5_arrays, text_of
from ctid_cli.signals.table import Columns, Table

MATLAB, HDF5 = (".mat",), (".h5", ".hdf5")
#: Minimum time limit of reading [s], and speed of the slowest disk [bytes/s].
LEAST_PATIENCE, SLOWEST = 50.0, 5e6


def read_array_table(path: str | os.PathLike[str]) -> Table:
    """Read the variables of a MATLAB file, or the data sets of an HDF5 file; an attribute ``unit`` gives the unit."""
    file = require_file(path, f" the file is empty; {_how_to_save(path)}")
    told, vectors = _read_in_own_process(path, file)
    if "refused" in told:
        raise DataError(f"{file}: {told['refused']}")
    names, wrong = told["names"], told["wrong"]
    hint = " ".join(_how_to_export(path, name, kind) for name, kind in told["objects"].items())
    if not names:
        raise DataError(f"{file}: {hint}" if hint else f"{file}: the file holds no arrays; {_how_to_save(path)}")
    noun = "variable" if Path(path).suffix.lower() in MATLAB else "data set"

    def read(asked: Sequence[str]) -> Columns:
        for name in asked:
            if name in wrong:
                raise DataError(f"{file}: {noun} {name!r} {wrong[name]}")
        return Columns(file, {name: vectors[name] for name in asked})

    return Table(file, tuple(names), read, head=file, noun=noun, hint=hint)


def _read_in_own_process(path: str | os.PathLike[str], file: str) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return the result of ``_write_content``; refuse a file that crashes it, or takes too long."""
    with TemporaryDirectory(prefix="ctid-", ignore_cleanup_errors=True) as made:
        folder = Path(made)
        with warnings.catch_warnings():
            # The process runs only this function, so threads of other processes do not matter.
            warnings.simplefilter("ignore", DeprecationWarning)
            process = multiprocessing.get_context("fork").Process(target=_write_content, args=(path, folder))
            process.start()
        process.join(LEAST_PATIENCE + Path(path).stat().st_size / SLOWEST)
        if process.is_alive():
            process.kill()
            process.join()
        if process.exitcode != 0:
            kind = "a MATLAB file" if Path(path).suffix.lower() in MATLAB else "an HDF5 file"
            raise DataError(f"{file}: this is not {kind}, or a damaged one; {_how_to_save(path)}")
        told: dict[str, Any] = json.loads((folder / "told.json").read_text(encoding="utf-8"))
        right = {name: k for k, name in enumerate(told.get("names", ())) if name not in told["wrong"]}
        return told, {name: np.load(folder / f"{k}.npy", allow_pickle=False) for name, k in right.items()}


def _write_content(path: str | os.PathLike[str], folder: Path) -> None:
    """Write the vectors of a file to a folder, and the reasons why other variables are not vectors."""
    faulthandler.disable()  # a crash is expected here
    told: dict[str, Any]
    try:
        arrays, objects = _arrays(path)
        told = {"names": list(arrays), "objects": objects, "wrong": {}}
        for k, (name, value) in enumerate(arrays.items()):
            try:
                np.save(folder / f"{k}.npy", _vector(value), allow_pickle=False)
            except ValueError as error:
                told["wrong"][name] = str(error)
    except DataError as error:
        told = {"refused": str(error)}
    except PermissionError as error:
        told = {"refused": f"cannot be read: {error.strerror}"}
    except Exception:  # C readers fail on damage in many ways, including memory errors; the caller reports it
        raise SystemExit(1) from None
    (folder / "told.json").write_text(json.dumps(told), encoding="utf-8")


def _arrays(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return arrays by name, and the classes of objects by name."""
    import scipy.io

    if Path(path).suffix.lower() in HDF5:
        return hdf5_arrays(path)
    claimed: list[Any] = []
    with warnings.catch_warnings():
        # Objects in one file share a placeholder name, which does not affect the arrays.
        warnings.simplefilter("ignore")
        with suppress(Exception):  # objects have no such headers; the reader itself reports other errors
            claimed = scipy.io.whosmat(path)
        for name, shape, _ in claimed:
            require_values(repr(name), math.prod(shape))
        try:
            return _flat(scipy.io.loadmat(path))
        except NotImplementedError:  # version 7.3 is HDF5
            return hdf5_arrays(path)


def _flat(content: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the arrays of structs by their full names, and the classes of objects by name."""
    from scipy.io.matlab import MatlabObject, MatlabOpaque

    arrays: dict[str, Any] = {}
    objects: dict[str, str] = {}

    def visit(name: str, value: Any) -> None:
        if isinstance(value, MatlabOpaque):
            objects[text_of(value.flat[0]["s0"]) or name] = text_of(value.flat[0]["s2"])
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


def _vector(value: Any) -> Array:
    """Return an array as a vector of real numbers; a ValueError gives the reason if it is not one."""
    if hasattr(value, "toarray"):
        try:
            # Indices are checked before they are used for writing.
            value.tocsc().check_format(full_check=True)
            value = value.toarray()
        except (ValueError, MemoryError):
            raise ValueError("is a damaged sparse matrix") from None
    array = np.asarray(value)
    if array.dtype.kind not in "biufc":
        raise ValueError("does not hold numbers")
    if array.size == 0:
        raise ValueError("is empty")
    if array.size != max(array.shape, default=1):
        shape = "x".join(str(n) for n in array.shape)
        raise ValueError(f"is a {shape} array; save the columns you mean as vectors of their own")
    if array.dtype.kind == "c":
        if np.any(array.imag != 0):
            raise ValueError("holds complex numbers; save its real or imaginary part")
        array = array.real
    return np.array(array, dtype=float).reshape(-1)


def _how_to_save(path: str | os.PathLike[str]) -> str:
    if Path(path).suffix.lower() in HDF5:
        return "save each column as a data set of its own, with its unit as the attribute 'unit'"
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
