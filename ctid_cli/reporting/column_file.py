"""Tables as files: CSV, or HDF5 with the units as attributes."""

from __future__ import annotations

import io
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.reporting.document import csv_text

if TYPE_CHECKING:
    from ctid_cli.reporting.document import Table


def csv_bytes(table: Table) -> bytes:
    """Return the CSV file of a table: an empty field for a missing or infinite number, 0 or 1 for a boolean."""
    return csv_text([table.titles, *zip(*map(_fields, table.columns), strict=True)]).encode()


def _fields(column: Any) -> list[Any]:
    """Return the values of a column as fields of a file."""
    values = np.asarray(column)
    if values.dtype.kind == "f":
        return [f"{value:.12g}" if math.isfinite(value) else "" for value in values.tolist()]
    return list(values.astype(int).tolist() if values.dtype.kind == "b" else values.tolist())


def hdf5_bytes(table: Table) -> bytes:
    """Return the HDF5 file of a table, a data set for each column, with the units of the table."""
    import h5py

    file, units = io.BytesIO(), table.units or {}
    with h5py.File(file, "w", track_order=True) as store:
        for title, column in zip(table.titles, map(np.asarray, table.columns), strict=True):
            texts = {"dtype": h5py.string_dtype()} if column.dtype.kind == "O" else {}
            written = store.create_dataset(title, data=column, **texts)
            if unit := units.get(title):
                written.attrs["unit"] = unit
    return file.getvalue()
