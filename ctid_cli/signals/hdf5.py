"""HDF5 files that somebody else may have made: only plain arrays in the file itself, of bounded size."""

import os
from collections.abc import Iterator
from typing import Any

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.signals.files import MAX_FILE_BYTES, MAX_VALUES

#: Groups in groups, members of a file, and bytes of an attribute.
MAX_DEPTH, MAX_MEMBERS, MAX_ATTRIBUTE = 16, 1_000_000, 1_000_000
#: Kinds of NumPy's types that hold plain numbers, or text of a fixed length.
PLAIN = "biufcS"
#: Data sets of a file of columns, and letters of a unit.
MAX_DATA_SETS, MAX_UNIT = 10_000, 60
#: What MATLAB calls arrays of real numbers.
NUMERIC = ("double", "single", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))


def members(group: Any) -> Iterator[tuple[str, Any]]:
    """What a group holds itself; links to other places and other files are refused, not followed."""
    import h5py

    for name in group:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise DataError(f"{name[:60]!r} in it is a link to another place; only what is in the file itself is read")
        yield name, group[name]


def require_plain(name: str, item: Any) -> None:
    """Refuse an array that lies in other files, claims more than can be read, or holds objects."""
    name = name[:60]
    if item.external or item.is_virtual:
        raise DataError(f"{name!r} in it lies in another file; only what is in the file itself is read")
    if item.size is not None and (item.size > MAX_VALUES or item.nbytes > MAX_FILE_BYTES):
        raise DataError(f"{name!r} in it claims to hold {item.size} values; at most {MAX_VALUES} are read")


def require_plain_tree(group: Any, *, kinds: str = PLAIN) -> None:
    """Refuse a file of which any part is not plain, before any of it is read."""
    waiting, seen, total = [(group, "", 0)], 0, 0
    while waiting:
        here, name, depth = waiting.pop()
        _require_small_attributes(here, name)
        for key, item in members(here):
            path, seen = f"{name}/{key}", seen + 1
            if seen > MAX_MEMBERS or depth >= MAX_DEPTH:
                raise DataError("it holds too many groups")
            if hasattr(item, "dtype"):
                require_plain(path, item)
                _require_small_attributes(item, path)
                if item.dtype.kind not in kinds or item.shape is None:
                    raise DataError(f"{path[:60]!r} in it holds neither numbers nor plain text")
                total += item.nbytes
            else:
                waiting.append((item, path, depth + 1))
        if total > MAX_FILE_BYTES:
            raise DataError(f"it claims to hold {total} bytes; at most {MAX_FILE_BYTES} are read")


def _require_small_attributes(item: Any, name: str) -> None:
    for key in item.attrs:
        # A scalar text has the size of a pointer here; HDF5 itself bounds its length.
        if item.attrs.get_id(key).get_storage_size() > MAX_ATTRIBUTE:
            raise DataError(f"the attribute {key[:60]!r} of {name[:60] or '/'!r} is too large")


def hdf5_arrays(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the arrays of a file by name and unit, and the classes of MATLAB objects in it by name.

    MATLAB writes version 7.3 as HDF5, where strings, structs and objects are told apart by attributes.
    """
    import h5py

    arrays: dict[str, Any] = {}
    objects: dict[str, str] = {}

    def visit(name: str, item: Any) -> None:
        _require_small_attributes(item, name)
        kind = text_of(item.attrs.get("MATLAB_class", b"double"))
        if "MATLAB_object_decode" in item.attrs:
            objects[name] = kind
        elif isinstance(item, h5py.Group):
            visit_members(item, f"{name}.")
        elif "MATLAB_empty" in item.attrs:
            arrays[name] = np.empty((0, 0))
        else:
            require_plain(name, item)
            unit = text_of(item.attrs.get("unit", ""))[:MAX_UNIT].strip("[]() ")
            numeric = kind in NUMERIC and item.dtype.kind in PLAIN
            arrays[f"{name} [{unit}]" if unit else name] = item[()] if numeric else np.array("text", dtype=object)

    def visit_members(group: Any, prefix: str) -> None:
        for name, item in members(group):
            if prefix.count(".") > MAX_DEPTH or len(arrays) > MAX_DATA_SETS:
                raise DataError("it holds too many groups or data sets")
            if not name.startswith("#"):  # MATLAB's own store of what objects and cells refer to
                visit(prefix + name, item)

    with h5py.File(path, "r") as store:
        visit_members(store, "")
    return arrays, objects


def text_of(value: Any) -> str:
    """Return an attribute, or a field of MATLAB's, as text; nothing where it is several."""
    if isinstance(value, np.ndarray):
        value = value.item() if value.size == 1 else ""
    return value.decode("latin1") if isinstance(value, bytes) else str(value)
