"""Columns from MATLAB and HDF5 files of plain arrays, read in a separate process.

Some damaged files crash the reading libraries.
"""

import faulthandler
import json
import math
import multiprocessing
import os
import signal
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.progress import doing
from ctid_cli.signals.data_checks import Rows
from ctid_cli.signals.files import require_file, require_values
from ctid_cli.signals.hdf5 import hdf5_arrays, text_of
from ctid_cli.signals.table import Found, Table

MATLAB, HDF5 = (".mat",), (".h5", ".hdf5")
#: Minimum time limit of reading [s], and speed of the slowest disk [bytes/s].
LEAST_PATIENCE, SLOWEST = 50.0, 5e6


def read_array_table(path: str | os.PathLike[str]) -> Table:
    """Read the variables of a MATLAB file, or the data sets of an HDF5 file; an attribute ``unit`` gives the unit."""
    file = require_file(path, f" the file is empty; {_how_to_save(path)}")
    status = os.stat(path)
    return _read_table(file, (status.st_ino, status.st_size, status.st_mtime_ns))


@lru_cache(maxsize=2)  # a command first looks at the names of a file
def _read_table(file: str, version: tuple[int, ...]) -> Table:
    """Read one version of a file."""
    with doing(f"reading {Path(file).name}"):
        content, vectors = _read_in_own_process(file)
    if "refused" in content:
        raise DataError(f"{file}: {content['refused']}")
    names, wrong = content["names"], content["wrong"]
    noun = "variable" if Path(file).suffix.lower() in MATLAB else "data set"
    hints = [_how_to_export(file, name, kind) for name, kind in content["objects"].items()]
    hints = hints or [f"{noun.capitalize()} {name!r} {why}" for name, why in list(wrong.items())[:1]]
    if not names:
        raise DataError(f"{file}: {' '.join(hints) or f'the file holds no arrays; {_how_to_save(file)}'}")

    def read(wanted: Sequence[str]) -> Found:
        for name in wanted:
            if name in wrong:
                raise DataError(f"{file}: {noun} {name!r} {wrong[name]}")
        return Found({name: vectors[name] for name in wanted}, Rows(file))

    return Table(file, tuple(names), read, head=file, noun=noun, hint=" ".join(hints))


def _read_in_own_process(file: str) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return the result of ``_write_content``; refuse a file that crashes it, or takes too long."""
    with TemporaryDirectory(prefix="ctid-", ignore_cleanup_errors=True) as made:
        folder = Path(made)
        with warnings.catch_warnings():
            # The process runs only this function, so threads of other processes do not matter.
            warnings.simplefilter("ignore", DeprecationWarning)
            process = multiprocessing.get_context("fork").Process(target=_write_content, args=(file, folder))
            process.start()
        try:
            process.join(LEAST_PATIENCE + os.stat(file).st_size / SLOWEST)
        finally:
            if process.is_alive():
                process.kill()
                process.join()
        if process.exitcode != 0:
            kind = "a MATLAB file" if Path(file).suffix.lower() in MATLAB else "an HDF5 file"
            raise DataError(f"{file}: this is not {kind}, or a damaged one; {_how_to_save(file)}")
        content: dict[str, Any] = json.loads((folder / "content.json").read_text(encoding="utf-8"))
        saved = {name: folder / f"{k}.npy" for k, name in enumerate(content.get("names", ()))}
        return content, {name: np.load(path, allow_pickle=False) for name, path in saved.items() if path.exists()}


def _write_content(file: str, folder: Path) -> None:
    """Write the vectors of a file to a folder, and the reasons why other variables are not vectors."""
    faulthandler.disable()  # a crash is expected here
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other process ends this one
    try:
        arrays, objects = _arrays(file)
        wrong = {}
        for k, (name, value) in enumerate(arrays.items()):
            try:
                np.save(folder / f"{k}.npy", _vector(value), allow_pickle=False)
            except ValueError as error:
                wrong[name] = str(error)
        content: dict[str, Any] = {"names": list(arrays), "objects": objects, "wrong": wrong}
    except DataError as error:
        content = {"refused": str(error)}
    except PermissionError as error:
        content = {"refused": f"cannot be read: {error.strerror}"}
    except Exception:  # C readers fail on damage in many ways, including memory errors; the caller reports it
        raise SystemExit(1) from None
    (folder / "content.json").write_text(json.dumps(content), encoding="utf-8")


def _arrays(path: str) -> tuple[dict[str, Any], dict[str, str]]:
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
        raise ValueError("is a sparse matrix; save it as a full one")
    array = np.asarray(value)
    if array.dtype.kind == "c":
        raise ValueError("holds complex numbers; save its real or imaginary part")
    if array.dtype.kind not in "biuf":
        raise ValueError("does not hold numbers")
    if array.size == 0:
        raise ValueError("is empty")
    if array.size != max(array.shape, default=1):
        shape = "x".join(str(n) for n in array.shape)
        raise ValueError(f"is a {shape} array; save the columns you mean as vectors of their own")
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
