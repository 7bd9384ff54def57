"""Columns as arrays of ``runs.h5``: writing, reading and validation.

Texts are UTF-8, padded to the length of the longest one. A missing whole number is -1, a missing number NaN.
Coefficients fill the front of a row; ``_length`` holds their number. Numbers by name have a column for every name that
occurs in any estimate; ``_present`` marks the names of each estimate, and ``_names`` lists them.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ctid_cli.storage.columns import Column

AnyArray = NDArray[Any]

#: Rows written at once, which form one chunk of the file.
ROWS = 8192
#: Value of a missing whole number.
MISSING = -1
#: Arrays of a column by the suffix of their names, each with the allowed kinds of number.
_ARRAYS: Mapping[str, Mapping[str, str]] = {
    "str": {"": "S"},
    "int64": {"": "iu"},
    "Int64": {"": "iu"},
    "coefficients": {"_length": "iu", "": "f"},
    "by name": {"_present": "bu", "": "f"},
}
_NUMBERS = {"": "f"}


def names_of(name: str) -> str:
    """Return the name of the array that holds the names of the parts of a column."""
    return f"{name.removesuffix('s')}_names"


# --- writing --------------------------------------------------------------------------------------------------------


class ColumnWriter:
    """Writer of the arrays of one column: all values are measured before the arrays are created and filled."""

    def __init__(self, column: Column) -> None:
        self._column = column
        #: Bytes of the longest text, or number of coefficients of the longest list.
        self._longest = 1
        self._names: dict[str, None] = {}
        self._datasets: dict[str, h5py.Dataset] = {}

    @property
    def is_fixed(self) -> bool:
        """Whether the arrays need the same space for any values."""
        return self._column.type not in ("str", "coefficients", "by name")

    def include(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Update the array sizes from the values of some rows."""
        name = self._column.name
        values = [value for row in rows if (value := row.get(name))]
        match self._column.type:
            case "str":
                self._longest = max(self._longest, *(len(text.encode()) for text in set(values)), 0)
            case "coefficients":
                self._longest = max(self._longest, *map(len, values), 0)
            case "by name":
                for value in values:
                    if not value.keys() <= self._names.keys():
                        self._names.update(dict.fromkeys(value))

    @property
    def names(self) -> list[str]:
        """Names of the parts of a column with numbers by name."""
        return list(self._names)

    def create(self, group: h5py.Group, count: int) -> None:
        """Create the arrays; the array of the values carries their description and unit."""
        column = self._column
        about: dict[str, Any] = {"meaning": column.meaning.replace("`", ""), "unit": column.unit}
        if column.type == "Int64":
            about["missing"] = MISSING
        elif column.type == "coefficients":
            about["padding"] = "NaN, behind the last coefficient; descending powers"
        elif column.type == "by name":
            self._names = dict.fromkeys(column.names([self._names]))
            about["columns"] = ", ".join(self._names)
        for name, empty in self.arrays([]).items():
            if column.type == "by name" and name == column.name:
                _write_texts(group, names_of(name), list(self._names))
            self._datasets[name] = _dataset(group, name, (count, *empty.shape[1:]), empty.dtype)
        given = {key: value for key, value in about.items() if value not in (None, "")}
        self._datasets[column.name].attrs.update(given)

    def write(self, start: int, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write the values of some rows, starting at a position."""
        for name, array in self.arrays(rows).items():
            self._datasets[name][start : start + len(rows)] = array

    def arrays(self, rows: Sequence[Mapping[str, Any]]) -> dict[str, AnyArray]:
        """Return the values of measured rows as arrays by name, the array of the values last."""
        name = self._column.name
        values = [row.get(name) for row in rows]
        match self._column.type:
            case "str":
                return {name: encoded_texts([text or "" for text in values], self._longest)}
            case "int64" | "Int64":
                return {name: np.array([MISSING if value is None else value for value in values], dtype=np.int64)}
            case "coefficients":
                lengths = np.array([MISSING if value is None else len(value) for value in values], dtype=np.int64)
                padded = np.full((len(values), self._longest), np.nan)
                filled = np.arange(self._longest) < lengths[:, np.newaxis]
                padded[filled] = [number for value in values for number in value or ()]
                return {f"{name}_length": lengths, name: padded}
            case "by name":
                found: list[Mapping[str, float | None]] = [value or {} for value in values]
                shape = len(found), len(self._names)
                present = np.array([part in row for row in found for part in self._names], dtype=np.uint8)
                numbers = np.array([row.get(part) for row in found for part in self._names], dtype=np.float64)
                return {f"{name}_present": present.reshape(shape), name: numbers.reshape(shape)}
        # "random" is not a number: the start value of the search is in start_delay, and the label in start.
        plain = [None if isinstance(value, str) else value for value in values]
        return {name: np.array(plain, dtype=np.float64)}


def _dataset(group: h5py.Group, name: str, shape: tuple[int, ...], dtype: Any) -> h5py.Dataset:
    packing: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}
    packing["chunks"] = (min(ROWS, shape[0]), *shape[1:])
    return group.create_dataset(name, shape, dtype, track_times=False, **({} if 0 in shape else packing))


def _write_texts(group: h5py.Group, name: str, texts: Sequence[str]) -> None:
    encoded = encoded_texts(texts, max((len(text.encode()) for text in texts), default=1))
    dataset = _dataset(group, name, encoded.shape, encoded.dtype)
    if texts:
        dataset[...] = encoded


def encoded_texts(texts: Sequence[str], longest: int) -> AnyArray:
    """Return texts as an array with the UTF-8 type of HDF5."""
    array = np.empty(len(texts), h5py.string_dtype("utf-8", longest))
    array[:] = [text.encode() for text in texts]
    return array


# --- reading --------------------------------------------------------------------------------------------------------


def decoded(column: Column, read: Callable[[str], AnyArray], names: Sequence[str] = ()) -> list[Any]:
    """Return values (None if missing) from a function that reads an array by its suffix, and the names of the parts."""
    values = read("")
    if column.type == "str":
        return decoded_texts(values)
    if column.type in ("int64", "Int64"):
        return [None if value == MISSING else value for value in values.tolist()]
    plain: list[Any] = np.where(np.isnan(values), None, values).tolist()  # type: ignore[call-overload]
    if column.type == "coefficients":
        lengths = read("_length").tolist()
        return [None if n == MISSING else row[:n] for row, n in zip(plain, lengths, strict=True)]
    if column.type == "by name":
        return [
            {part: value for part, value, there in zip(names, row, present, strict=True) if there} or None
            for row, present in zip(plain, read("_present").tolist(), strict=True)
        ]
    return plain


def decoded_texts(values: AnyArray) -> list[str]:
    """Return the texts in an array."""
    if values.dtype.kind != "S" or values.ndim != 1:
        raise ValueError("there are no texts where some belong")
    return [value.decode("utf-8") for value in values.tolist()]


def require_column(column: Column, group: h5py.Group, count: int) -> None:
    """Refuse arrays whose length, kind or shape does not match a column."""
    name, several = column.name, column.type in ("coefficients", "by name")
    for ending, kinds in _ARRAYS.get(column.type, _NUMBERS).items():
        array = group[name + ending]
        dimensions = 2 if several and ending != "_length" else 1
        if array.dtype.kind not in kinds or array.ndim != dimensions or array.shape[0] != count:
            raise ValueError(f"{name}{ending} is no column of {count} estimates")
    if column.type == "coefficients" and count:
        lengths = np.asarray(group[f"{name}_length"][()])
        if not MISSING <= lengths.min() <= lengths.max() <= group[name].shape[1]:
            raise ValueError(f"{name} has lengths that it cannot have")
    if column.type == "by name":
        names = decoded_texts(group[names_of(name)][()])
        if len(set(names)) < len(names) or {group[name].shape, group[f"{name}_present"].shape} != {(count, len(names))}:
            raise ValueError(f"{name} has other columns than names")
