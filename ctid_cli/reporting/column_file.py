"""Columns over time as a file: CSV, or HDF5 with the units as attributes."""

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray


def columns_bytes(table: Mapping[str, NDArray[Any]], style: str, units: Mapping[str, str | None]) -> bytes:
    """The file of a table (``csv`` or ``h5``), with the units of those of its columns that have one."""
    if style == "csv":
        import pandas as pd

        marks = {name: int for name, values in table.items() if values.dtype == bool}
        frame = pd.DataFrame(dict(table)).replace([np.inf, -np.inf], np.nan).astype(marks)
        return frame.to_csv(index=False, float_format="%.12g", lineterminator="\n").encode()
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
