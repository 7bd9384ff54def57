"""Fits made in Python as files."""

import os
from pathlib import Path

from ctid_cli.errors import StorageError
from ctid_cli.estimators.identification import Identification
from ctid_cli.reporting.estimate import Units
from ctid_cli.reporting.identification_report import identification_object
from ctid_cli.signals.measurement import Measurement
from ctid_cli.storage.fit_file import fit_text
from ctid_cli.written_files import write_file


def save_fit(result: Identification, path: str | os.PathLike[str]) -> None:
    """Write a fit to a file that :func:`~ctid_cli.storage.fit_file.load_fit` and ``ctid report`` read.

    Parameters
    ----------
    result : Identification
        The fit.
    path : path
        The file, such as ``fit.json``. Since records in memory have no file, their samples are in it.

    Raises
    ------
    StorageError
        If the file cannot be written.
    """
    measured = [Measurement.of(record) for record in result.records]
    other = None if result.validation is None else Measurement.of(result.validation.record)
    content = identification_object(result, measured, Units(), other)
    text = fit_text(result, content, measured, other, Path(path).parent)
    try:
        write_file(Path(path), text.encode() + b"\n")
    except OSError as error:
        raise StorageError(f"{path} cannot be written: {error.strerror or error}") from error
