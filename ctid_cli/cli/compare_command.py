"""``ctid compare``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ctid_cli.cli._common import emit, guarded, refuse_overwriting, write_files
from ctid_cli.cli._options import FormatOptions, RecordOptions
from ctid_cli.signals.treatment import Hold, InitialState, Offset

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ctid_cli.reporting.compare_result import NamedFit
    from ctid_cli.signals.measurement import Measurement


@guarded
def compare(
    files: Annotated[list[Path], typer.Argument(metavar="FIT", help="Files that ctid fit wrote (fit.json).")],
    on: Annotated[
        Path, typer.Option("--on", metavar="FILE", help="Record, preferably one that no model was fitted to.")
    ],
    columns: RecordOptions,
    form: FormatOptions,
    hold: Annotated[
        Hold | None, typer.Option("--hold", help="The input between its samples; as in the fit if not given.")
    ] = None,
    initial_state: Annotated[
        InitialState | None, typer.Option("--initial-state", help="State before the record; as in the fit.")
    ] = None,
    offset: Annotated[
        Offset | None, typer.Option("--offset", help="Constant offset of the output; as in the fit.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for comparison.csv and .svg.")] = Path("."),
) -> None:
    """Compare fitted models on the same samples of one record.

    Prints their fits and tests of their residuals, and writes comparison.csv and comparison.svg.
    """
    from ctid_cli.estimators import model_comparison
    from ctid_cli.reporting.column_file import frame_bytes
    from ctid_cli.reporting.compare_result import ModelComparison, named_fits

    written = [out / "comparison.csv", out / "comparison.svg"]
    refuse_overwriting([*files, on], written)
    models = named_fits(files)
    measurement = _record(models, on, columns, hold)
    fits = [each.fit for each in models]
    found = model_comparison.compare(fits, measurement.record, initial_state=initial_state, offset=offset)
    result = ModelComparison(models, measurement, found)
    write_files({written[0]: frame_bytes(result.to_frame()), written[1]: result.drawing().saved()})
    emit(result, form.form, written)


def _record(models: Sequence[NamedFit], file: Path, columns: RecordOptions, hold: Hold | None) -> Measurement:
    """Read a record: by the column names of the fits where the file has them and none are named."""
    from dataclasses import replace

    from ctid_cli.reporting.compare_result import require_units
    from ctid_cli.signals.measurement import open_table

    own = models[0].columns
    inputs = own["input"] if isinstance(own["input"], list) else [own["input"]]
    names = {str(own["time"]), *inputs, str(own["output"])}
    if not (columns.time or columns.input or columns.output) and names <= set(open_table(file).names):
        columns = replace(columns, time=own["time"], input=inputs, output=[own["output"]])
    found = columns.read(file, hold or models[0].hold)
    require_units(found.record.name, models[0], found.time_unit, found.input_unit, found.output_unit)
    return found
