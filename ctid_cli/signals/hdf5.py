"""Reading of untrusted HDF5 files: only plain arrays in the file itself, of bounded size."""

import itertools
import os
from collections.abc import Iterator
from typing import Any

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.signals.files import MAX_FILE_BYTES, require_values

#: Maximum depth of groups, number of members of a file, and bytes of an attribute.
MAX_DEPTH, MAX_MEMBERS, MAX_ATTRIBUTE = 16, 1_000_000, 1_000_000
#: NumPy type kinds of plain numbers and text of fixed length.
PLAIN = "biufcS"
#: Maximum number of data sets of a file of columns, and of characters of a unit.
MAX_DATA_SETS, MAX_UNIT = 10_000, 60
#: MATLAB class names of arrays of real numbers.
NUMERIC = ("double", "single", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))


def _items(group: Any, name: str = "", depth: int = 0, count: Iterator[int] | None = None) -> Iterator[tuple[str, Any]]:
    """Yield all groups and data sets with their paths; refuse links, external data and unbounded sizes."""
    import h5py

    count = count or itertools.count()
    _require_small_attributes(group, name)
    for key in group:
        path = f"{name}/{key}" if name else key
        quoted = repr(path[:60])
        if not isinstance(group.get(key, getlink=True), h5py.HardLink):
            raise DataError(f"{quoted} in it is a link to another place; only what is in the file itself is read")
        if next(count) >= MAX_MEMBERS or depth >= MAX_DEPTH:
            raise DataError("it holds too many groups or data sets")
        item = group[key]
        if isinstance(item, h5py.Dataset):
            if item.external or item.is_virtual:
                raise DataError(f"{quoted} in it lies in another file; only what is in the file itself is read")
            if item.size is not None:
                require_values(f"{quoted} in it", max(item.size, item.nbytes // 8))
            _require_small_attributes(item, path)
        yield path, item
        if isinstance(item, h5py.Group):
            yield from _items(item, path, depth + 1, count)


def _require_small_attributes(item: Any, name: str) -> None:
    for key in item.attrs:
        # The reported size of a scalar text is that of a pointer; HDF5 itself limits its length.
        if item.attrs.get_id(key).get_storage_size() > MAX_ATTRIBUTE:
            raise DataError(f"the attribute {key[:60]!r} of {name[:60] or '/'!r} is too large")


def require_plain_tree(group: Any) -> None:
    """Refuse a file with any part that is not plain, before reading any of it."""
    total = 0
    for path, item in _items(group):
        if hasattr(item, "dtype"):
            if item.dtype.kind not in PLAIN or item.shape is None:
                raise DataError(f"{path[:60]!r} in it holds neither numbers nor plain text")
            total += item.nbytes
            if total > MAX_FILE_BYTES:
                raise DataError(f"it claims to hold {total} bytes; at most {MAX_FILE_BYTES} are read")


def hdf5_arrays(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the arrays of a file and their units by name, and the classes of MATLAB objects by name.

    MATLAB writes version 7.3 as HDF5, where attributes distinguish strings, structs and objects.
    """
    import h5py

    arrays: dict[str, Any] = {}
    objects: dict[str, str] = {}
    with h5py.File(path, "r") as store:
        for place, item in _items(store):
            name, kind = place.replace("/", "."), text_of(item.attrs.get("MATLAB_class", b"double"))
            # Names with # are MATLAB's storage for the content of objects and cells.
            if name.startswith(("#", *(f"{known}." for known in objects))):
                continue
            if "MATLAB_object_decode" in item.attrs:
                objects[name] = kind
            elif isinstance(item, h5py.Dataset):
                if len(arrays) >= MAX_DATA_SETS:
                    raise DataError("it holds too many groups or data sets")
                unit = text_of(item.attrs.get("unit", ""))[:MAX_UNIT].strip("[]() ")
                if "MATLAB_empty" in item.attrs:
                    value = np.empty((0, 0))
                else:
                    value = item[()] if kind in NUMERIC and item.dtype.kind in PLAIN else np.array("text", dtype=object)
                arrays[f"{name} [{unit}]" if unit else name] = value
    return arrays, objects


def text_of(value: Any) -> str:
    """Return an attribute, or a MATLAB field, as text; empty if it has several values."""
    if isinstance(value, np.ndarray):
        value = value.item() if value.size == 1 else ""
    return value.decode("latin1") if isinstance(value, bytes) else str(value)
