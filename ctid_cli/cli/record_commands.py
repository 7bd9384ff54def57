"""``ctid check``, ``ctid compare`` and ``ctid frf``: records alone, and compared with models."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ctid_cli.cli._common import emit, guarded, refuse_overwriting, write_files
from ctid_cli.cli._options import FormatOptions, RecordOptions, flag
from ctid_cli.errors import MismatchError, UsageError
from ctid_cli.signals.treatment import AskedHold, Hold, InitialState, Offset, ResponseMethod

if TYPE_CHECKING:
    from ctid_cli.signals.measurement import Measurement
    from ctid_cli.storage.fit_file import StoredFit


@guarded
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Measured record (.csv, .mat, .h5).")],
    columns: RecordOptions,
    form: FormatOptions,
    hold: Annotated[AskedHold, flag("--hold", "The input between its samples.")] = "auto",
    strict: Annotated[bool, flag("--strict", "Exit code 7 if there is a PROBLEM.")] = False,
) -> None:
    """Describe a measured record, and suggest a first fit.

    Clock, gaps, input, saturation, outliers; signal-to-noise ratio, response time, delay; offset, drift, start from
    rest and feedback, tested with the response to the input in noise of any colour. Columns are found by their usual
    names (t, u, y) unless named.
    """
    from ctid_cli.identification.choice import Given
    from ctid_cli.identification.choose import choose
    from ctid_cli.inference.record_facts import record_facts
    from ctid_cli.reporting.record_result import RecordCheckResult

    measured = columns.read(file, "zoh" if hold == "auto" else hold)
    facts = record_facts(measured.record)
    result = RecordCheckResult(measured, facts)
    if result.worst != "problem":
        choice = choose(measured.record, Given(hold=hold), measured.time_unit or "s")
        result = replace(result, command=command_of(measured, choice.words()) if choice.has_model else None)
    emit(result, form.form)
    if strict and result.worst == "problem":
        raise MismatchError(f"{file}: no model can be identified from this record as it is")


def command_of(measured: Measurement, chosen: Sequence[str]) -> str:
    """Return the fit of a record with the chosen options, and the requested columns and part."""
    from ctid_cli.signals.table import ROLES, USUAL_NAMES, split_header

    words = ["ctid", "fit", measured.record.name]
    for role in ROLES:
        name = split_header(getattr(measured, role))[0]
        if name.lower() not in USUAL_NAMES[role][:2] and Path(measured.record.name).suffix.lower() != ".mat":
            words += [f"--{role}", name]
    words += chosen
    for option, value in (("--from", measured.start), ("--to", measured.stop)):
        words += [] if value is None else [option, f"{value:.12g}"]
    return shlex.join(words)


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
    from ctid_cli.reporting.column_file import csv_bytes
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
    write_files({written[0]: csv_bytes(result.main_table())})
    emit(result, form.form, written, draw=lambda: write_files({written[1]: result.drawing().saved()}))


def _record(fit: StoredFit, file: Path, columns: RecordOptions, hold: Hold | None) -> Measurement:
    """Read a record, with the column names of the fit if the file has them and none are given."""
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


@dataclass(frozen=True)
class MethodOptions:
    """Method of estimating a frequency response, and its settings."""

    method: Annotated[ResponseMethod, flag("--method", "How the response is estimated.")] = "auto"
    period: Annotated[int | None, flag("--period", "Period of the input, if not found.", "SAMPLES", min=2)] = None
    width: Annotated[int | None, flag("--width", "Half-width of the local polynomials.", "LINES", min=4)] = None
    segment: Annotated[int | None, flag("--segment", "Length of Welch's segments.", "SAMPLES", min=1)] = None

    def arguments(self) -> dict[str, Any]:
        """Return the method, which one of its settings implies, and the settings; refuse those of two methods."""
        settings = {"periodic": self.period, "local-polynomial": self.width, "welch": self.segment}
        given = [method for method, value in settings.items() if value is not None]
        if given and (len(given) > 1 or self.method not in ("auto", given[0])):
            raise UsageError(
                "--period is for --method periodic, --width for local-polynomial, and --segment for welch; give one"
            )
        method = given[0] if given else self.method
        return {"method": method, "period": self.period, "half_width": self.width, "segment": self.segment}


@guarded
def frf(
    files: Annotated[
        list[Path],
        typer.Argument(metavar="FILE", help="Record (.csv, .mat, .h5); several: realisations of one input."),
    ],
    columns: RecordOptions,
    form: FormatOptions,
    estimation: MethodOptions,
    hold: Annotated[Hold, flag("--hold", "The input between its samples.")] = "zoh",
    out: Annotated[Path, flag("--out", "Folder for frf.csv and frf.svg.", "DIR")] = Path("."),
) -> None:
    """Estimate the frequency response of measured records.

    No model is fitted. A periodic input is averaged over its periods, which gives the variance of the noise and,
    from lines without input or from several records, the level of nonlinear distortions. Other records are analysed by
    local polynomials. Writes frf.csv and frf.svg.
    """
    from ctid_cli.inference.frequency_response import estimate_frequency_response
    from ctid_cli.reporting.column_file import csv_bytes
    from ctid_cli.reporting.frf_result import FrequencyResponseResult

    written = [out / "frf.csv", out / "frf.svg"]
    refuse_overwriting(files, written)
    arguments = estimation.arguments()
    records = columns.read_all(files, None, hold)
    found = estimate_frequency_response(records.data, time_unit=records.units.time, **arguments)
    result = FrequencyResponseResult(found, records)
    write_files({written[0]: csv_bytes(result.main_table())})
    emit(result, form.form, written, draw=lambda: write_files({written[1]: result.drawing().saved()}))
