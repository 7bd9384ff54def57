"""``ctid compare``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ctid_cli.cli._common import emit, guarded, refuse_overwriting, write_files
from ctid_cli.cli._options import FormatOptions, RecordOptions, flag
from ctid_cli.signals.treatment import Hold, InitialState, Offset

if TYPE_CHECKING:
    from ctid_cli.signals.measurement import Measurement
    from ctid_cli.storage.fit_file import StoredFit


@guarded
def compare(
    files: Annotated[list[Path], typer.Argument(metavar="FIT", help="Files that ctid fit wrote (fit.json).")],
    on: Annotated[Path, flag("--on", "Record, preferably one that no model was fitted to.", "FILE")],
    columns: RecordOptions,
    form: FormatOptions,
    hold: Annotated[Hold | None, flag("--hold", "The input between its samples; as in the fit.")] = None,
    initial_state: Annotated[InitialState | None, flag("--initial-state", "Before the record; as in the fit.")] = None,
    offset: Annotated[Offset | None, flag("--offset", "Constant offset of the output; as in the fit.")] = None,
    out: Annotated[Path, flag("--out", "Folder for comparison.csv and .svg.", "DIR")] = Path("."),
) -> None:
    """Compare fitted models on the same samples of one record.

    Prints their fits and tests of their residuals, and writes comparison.csv and comparison.svg.
    """
    from ctid_cli.estimators import model_comparison
    from ctid_cli.reporting.column_file import frame_bytes
    from ctid_cli.reporting.compare_result import ModelComparison, short_names
    from ctid_cli.storage.fit_file import read_fits

    written = [out / "comparison.csv", out / "comparison.svg"]
    refuse_overwriting([*files, on], written)
    short_names(files)  # refuses a file that is given twice
    fits = read_fits(files)
    measurement = _record(fits[0], on, columns, hold)
    models = [each.result for each in fits]
    found = model_comparison.compare(models, measurement.record, initial_state=initial_state, offset=offset)
    result = ModelComparison(fits, measurement, found)
    write_files({written[0]: frame_bytes(result.to_frame()), written[1]: result.drawing().saved()})
    emit(result, form.form, written)


def _record(fit: StoredFit, file: Path, columns: RecordOptions, hold: Hold | None) -> Measurement:
    """Read a record: by the column names of the fit where the file has them and none are named."""
    from dataclasses import replace

    from ctid_cli.signals.measurement import open_table

    own = fit.content["records"][0]["columns"]
    inputs = own["input"] if isinstance(own["input"], list) else [own["input"]]
    names = {own["time"], *inputs, own["output"]}
    if not (columns.time or columns.input or columns.output) and names <= set(open_table(file).names):
        columns = replace(columns, time=own["time"], input=inputs, output=[own["output"]])
    found = columns.read(file, hold or fit.content["settings"]["hold"])
    units = {"time": found.time_unit, "input": found.input_unit, "output": found.output_unit}
    fit.units.require_same(found.record.name, units)
    return found
