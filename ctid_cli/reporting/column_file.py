"""Columns over time as a file: CSV, or HDF5 with the units as attributes."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas as pd


def columns_bytes(table: Mapping[str, NDArray[Any]], style: str, units: Mapping[str, str | None]) -> bytes:
    """The file of a table (``csv`` or ``h5``), with the units of those of its columns that have one."""
    if style == "csv":
        text = io.StringIO()
        lines = csv.writer(text, lineterminator="\n")
        lines.writerow(table)
        lines.writerows(zip(*(_cells(values) for values in table.values()), strict=True))
        return text.getvalue().encode()
    import h5py

    file = io.BytesIO()
    with h5py.File(file, "w", track_order=True) as store:
        for name, values in table.items():
            if values.dtype == object:
                store.create_dataset(name, data=[str(value) for value in values], dtype=h5py.string_dtype())
                continue
            column = store.create_dataset(name, data=values)
            if units.get(name) is not None:
                column.attrs["unit"] = units[name]
    return file.getvalue()


def frame_bytes(frame: pd.DataFrame) -> bytes:
    """Return the CSV file of a table, with all digits, and an empty field where there is no number."""
    return frame.to_csv(index=False, lineterminator="\n").encode()


def _cells(values: NDArray[Any]) -> list[Any]:
    """A column of a text file: an empty field where there is no finite number."""
    if values.dtype.kind == "f":
        return [f"{value:.12g}" if math.isfinite(value) else "" for value in values.tolist()]
    return list((values.astype(int) if values.dtype == bool else values).tolist())
