"""Tables as files: CSV, or HDF5 with the units as attributes."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pandas as pd


def frame_bytes(frame: pd.DataFrame) -> bytes:
    """Return the CSV file of a table: an empty field for a missing or infinite number, 0 or 1 for a boolean."""
    numbers = frame.astype({name: int for name, kind in frame.dtypes.items() if kind == np.bool_})
    text = numbers.replace([np.inf, -np.inf], np.nan).to_csv(index=False, float_format="%.12g", lineterminator="\n")
    return str(text).encode()


def hdf5_bytes(frame: pd.DataFrame) -> bytes:
    """Return the HDF5 file of a table, a data set for each column, with the units of ``frame.attrs["units"]``."""
    import h5py

    file = io.BytesIO()
    with h5py.File(file, "w", track_order=True) as store:
        for name, column in frame.items():
            texts = {"dtype": h5py.string_dtype()} if column.dtype == object else {}
            written = store.create_dataset(str(name), data=column.to_numpy(), **texts)
            if unit := frame.attrs["units"][name]:
                written.attrs["unit"] = unit
    return file.getvalue()
