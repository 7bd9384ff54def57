"""``ctid fit``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ctid_cli.cli._common import emit, given_command, guarded, refuse_overwriting, write_files
from ctid_cli.cli._options import FormatOptions, RecordOptions
from ctid_cli.cli._progress import FitProgress
from ctid_cli.cli.fit_structure import Asked, FitOptions, LoopOptions, ModelOptions, as_usage_errors, options_of
from ctid_cli.errors import UsageError
from ctid_cli.reporting.document import Tool

if TYPE_CHECKING:
    from ctid_cli.estimators.identification import Identification
    from ctid_cli.estimators.loop_output_error import LoopOutputError
    from ctid_cli.estimators.measured_submodels import MeasuredSubmodels
    from ctid_cli.identification.choice import Given
    from ctid_cli.reporting.fit_result import FitResult
    from ctid_cli.reporting.records import Records


@dataclass(frozen=True)
class WritingOptions:
    """Which files ``ctid fit`` writes."""

    report: Annotated[bool, typer.Option("--report", help="Write the page fit.html too.")] = False
    csv: Annotated[
        Path | None, typer.Option("--csv", metavar="DIR", help="Write step, Bode, simulation and residuals as CSV.")
    ] = None
    export: Annotated[Tool | None, typer.Option("--export", help="Write the model as code for this tool.")] = None
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for fit.json and fit.svg.")] = Path(".")

    def contents(self, result: FitResult, command: str) -> dict[Path, bytes]:
        """Return what is written, by path; the first is the fit itself."""
        from ctid_cli.reporting.column_file import frame_bytes
        from ctid_cli.reporting.fit_tables import fit_tables, model_code

        text = result.file_text(self.out, command)
        contents = {self.out / "fit.json": text.encode() + b"\n", self.out / "fit.svg": result.drawing().saved()}
        if self.report:
            from ctid_cli.reporting.pages.fit_page import fit_page

            contents[self.out / "fit.html"] = fit_page(result, json.loads(text)).encode()
        if self.csv is not None:
            contents |= {self.csv / name: frame_bytes(frame) for name, frame in fit_tables(result).items()}
        if self.export is not None:
            name, code = model_code(result.fitted, self.export, result.units.time)
            contents[self.out / name] = code.encode()
        return contents


@guarded
def fit(
    context: typer.Context,
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Records (.csv, .mat, .h5), an experiment each.")
    ],
    model: ModelOptions,
    loop: LoopOptions,
    treatment: FitOptions,
    columns: RecordOptions,
    form: FormatOptions,
    writing: WritingOptions,
    validate: Annotated[
        Path | None, typer.Option("--validate", metavar="FILE", help="Validate on this record.")
    ] = None,
    bootstrap: Annotated[
        int | None,
        typer.Option("--bootstrap", metavar="DRAWS", help="Compute bootstrap intervals from this number of draws."),
    ] = None,
    predict: Annotated[
        int | None, typer.Option("--predict", metavar="K", help="Fit of predictions K samples ahead, with --noise.")
    ] = None,
) -> None:
    """Fit a transfer function with a delay to measured records.

    Prints the parameters with their standard errors and what tells whether to believe them, and writes fit.json and
    fit.svg. Poles, zeros, integrators, the range of the delay, the hold of the input, and the treatment of state and
    offset are chosen by one criterion where they are not given.
    """
    from ctid_cli.reporting.fit_result import FitResult

    _check_draws(bootstrap)
    _check_predicted(predict, treatment.noise)
    loop.check()
    asked = Asked(model, treatment, loop.use, columns.names)
    options = options_of(asked)
    if asked.single and len(files) > 1:
        raise UsageError(f"{len(files)} files are given, and submodels or a loop are fitted to one; give one file")
    records = _records(files, validate, loop, columns, treatment)
    found = _identified(options, records, bootstrap)
    other = None if found.validation is None else found.validation.record
    result = FitResult(found, records.with_data(found.records, other), predict)
    contents = writing.contents(result, given_command(context))
    refuse_overwriting([*files, *([validate] if validate else [])], contents)
    write_files(contents)
    emit(result, form.form, list(contents), stored=next(iter(contents.values())).decode())


def _check_draws(bootstrap: int | None) -> None:
    from ctid_cli.estimation.common import LEAST_DRAWS

    if bootstrap is not None and bootstrap < LEAST_DRAWS:
        raise UsageError(f"--bootstrap must be at least {LEAST_DRAWS} draws, for example 500; got {bootstrap}")


def _check_predicted(ahead: int | None, noise: str) -> None:
    if ahead is not None and ahead < 1:
        raise UsageError(f"--predict must be at least 1 sample, for example 10; got {ahead}")
    if ahead is not None and noise == "white":
        raise UsageError("--predict needs a noise model: white noise cannot be predicted; add --noise auto")


def _records(
    files: Sequence[Path], validate: Path | None, loop: LoopOptions, columns: RecordOptions, treatment: FitOptions
) -> Records:
    """Read the records, in their loop; a DataError where their units differ."""
    from ctid_cli.reporting.records import Records

    hold = "zoh" if treatment.hold == "auto" else treatment.hold
    measured = [loop.applied(columns.read(file, hold, reference=loop.reference)) for file in files]
    other = None
    if validate is not None:
        other = loop.applied(columns.read_whole(validate, hold, reference=loop.reference))
    records = Records(measured, other)
    # Units that differ are refused before anything is computed.
    records.units  # noqa: B018
    return records


def _identified(
    options: MeasuredSubmodels | LoopOutputError | Given, records: Records, bootstrap: int | None
) -> Identification:
    """Fit, with a bar of progress where it takes long."""
    from ctid_cli.identification.identify import identify

    validation = None if records.validation is None else records.validation.record
    with as_usage_errors(), FitProgress(sum(record.n_samples for record in records.data)) as progress:
        noise: Any = ("auto",) if bootstrap is None else ("bootstrap", bootstrap, progress)
        return identify(records.data, options, validation, *noise)
