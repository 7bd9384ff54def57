"""``ctid fit``."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ctid_cli.cli._common import emit, given_command, guarded, refuse_overwriting, write_files
from ctid_cli.cli._options import FormatOptions, RecordOptions, Records, Validate, flag
from ctid_cli.cli.fit_structure import FitOptions, ModelRequest, as_usage_errors
from ctid_cli.cli.loop_options import LoopOptions, without_delay
from ctid_cli.cli.response_fit import frequency_files, frequency_fit
from ctid_cli.errors import UsageError
from ctid_cli.progress import reported
from ctid_cli.reporting.document import Tool

if TYPE_CHECKING:
    from ctid_cli.reporting.fit_result import FitResult


@dataclass(frozen=True)
class WritingOptions:
    """Files that ``ctid fit`` writes."""

    report: Annotated[bool, flag("--report", "Write the page fit.html too.")] = False
    csv: Annotated[Path | None, flag("--csv", "Write step, Bode, simulation and residuals as CSV.", "DIR")] = None
    export: Annotated[Tool | None, flag("--export", "Write the model as code for this tool.")] = None
    out: Annotated[Path, flag("--out", "Folder for fit.json and fit.svg.", "DIR")] = Path(".")

    @reported("preparing the files")
    def contents(self, result: FitResult, command: str) -> dict[Path, Callable[[], bytes]]:
        """Return functions that make the contents of the files by path; the first is the fit itself."""
        text = result.file_text(self.out, command)
        contents: dict[Path, Callable[[], bytes]] = {
            self.out / "fit.json": lambda: text.encode() + b"\n",
            self.out / "fit.svg": lambda: result.drawing().saved(),
        }
        if self.report:
            contents[self.out / "fit.html"] = lambda: result.page(json.loads(text)).encode()
        if self.csv is not None:
            from ctid_cli.reporting.column_file import csv_bytes
            from ctid_cli.reporting.fit_tables import fit_tables

            contents |= {self.csv / name: partial(csv_bytes, table) for name, table in fit_tables(result).items()}
        if self.export is not None:
            from ctid_cli.reporting.fit_tables import model_code

            name, code = model_code(result.fitted, self.export, result.units.time)
            contents[self.out / name] = code.encode
        return contents


@dataclass(frozen=True)
class AssessmentOptions:
    """Options for the assessment of the fit."""

    validate: Validate = None
    bootstrap: Annotated[
        int | None, flag("--bootstrap", "Intervals from this number of simulated noises.", "DRAWS")
    ] = None
    predict: Annotated[
        int | None, flag("--predict", "Fit of predictions K samples ahead, with --noise.", "K", min=1)
    ] = None

    @property
    def draws(self) -> dict[str, Any]:
        """Requested intervals, as options of a fit."""
        return {} if self.bootstrap is None else {"covariance": "bootstrap", "bootstrap_draws": self.bootstrap}

    def check(self, noise: str, lengths: Mapping[str, int]) -> None:
        """Refuse too few draws, predictions of white noise, and horizons longer than a record."""
        from ctid_cli.estimation.common import LEAST_DRAWS

        if self.bootstrap is not None and self.bootstrap < LEAST_DRAWS:
            found = f"got {self.bootstrap}"
            raise UsageError(f"--bootstrap must be at least {LEAST_DRAWS} draws, for example 500; {found}")
        if self.predict is None:
            return
        if noise == "white":
            raise UsageError("--predict needs a noise model: white noise cannot be predicted; add --noise auto")
        for name, n in lengths.items():
            if self.predict >= n:
                wrong = f"--predict {self.predict} is as long as {name} with its {n} samples or longer"
                raise UsageError(f"{wrong}; give a smaller number, for example 10")


#: From this number of coefficients on the search takes long (8 s for 12 and 30 s for 18 of 600 samples), and fewer
#: samples for each than the second number seldom determine them: standard errors of 18 of the example record were
#: 37 to 71 % of their estimates.
MANY, SAMPLES_EACH = 12, 50


def _note_many_coefficients(poles: object, zeros: object, samples: int) -> None:
    """Say at once that many coefficients are asked for of few samples."""
    count = poles + (zeros if isinstance(zeros, int) else 0) + 1 if isinstance(poles, int) else 0
    if count >= MANY and samples < SAMPLES_EACH * count:
        few = f"{count} coefficients are asked for, and {samples} samples seldom determine them"
        typer.echo(f"ctid fit: {few}; the search takes long (ctid order compares smaller structures)", err=True)


@guarded
def fit(
    context: typer.Context,
    files: Records,
    model: FitOptions,
    loop: LoopOptions,
    columns: RecordOptions,
    form: FormatOptions,
    writing: WritingOptions,
    assessment: AssessmentOptions,
) -> None:
    """Fit a transfer function to records or a frequency response.

    Prints the parameters with their standard errors and diagnostics, and writes fit.json and fit.svg. Poles, zeros,
    integrators, the range of the delay, the hold of the input, and the treatment of state and offset are chosen by one
    criterion unless they are given. The file may be a table of a frequency response, such as ctid frf writes: its
    poles, zeros, integrators and delay are chosen unless --poles is given.
    """
    request = ModelRequest(model, loop, columns.names)
    read = [*files, *([assessment.validate] if assessment.validate else [])]
    refuse_overwriting(read, [writing.out / "fit.json", *([writing.csv / "step.csv"] if writing.csv else [])])
    if frequency_files(files):
        result: FitResult = frequency_fit(files, request, columns, assessment)
    else:
        result = _fit_of_records(files, request, columns, assessment)
    contents = writing.contents(result, given_command(context))
    refuse_overwriting(read, [*contents])
    (path, fit_itself), *others = contents.items()
    stored = fit_itself()
    write_files({path: stored})

    def write_others() -> None:
        for path, content in others:
            write_files({path: content()})

    emit(result, form.form, list(contents), stored.decode(), write_others)


def _fit_of_records(
    files: list[Path], request: ModelRequest, columns: RecordOptions, assessment: AssessmentOptions
) -> FitResult:
    """Fit a model to records in time."""
    from ctid_cli.identification.identify import identify
    from ctid_cli.reporting.fit_result import FitResult

    noise, loop = request.options.noise, request.loop
    assessment.check(noise, {})
    loop.check()
    estimator = request.estimator()
    if request.single and not request.simulated and len(files) > 1:
        what = "a record is fitted alone without the controller of its loop, and by submodels"
        raise UsageError(f"{len(files)} files are given, and {what}; give one file")
    if loop.unstable and (assessment.predict or 1) > 1:
        raise UsageError("--predict must be 1 for a plant that may be unstable: later outputs are not predicted")
    hold = None if request.hold == "auto" else request.hold
    records = columns.read_all(files, assessment.validate, hold, reference=loop.reference).treated(loop.applied)
    if request.single and request.options.common("delay_bounds") is None:
        records = records.treated(without_delay)
    assessment.check(noise, {record.name: record.n_samples for record in records.all})
    samples = sum(record.n_samples for record in records.data)
    _note_many_coefficients(getattr(estimator, "poles", None), getattr(estimator, "zeros", None), samples)
    with as_usage_errors():
        draws = assessment.draws | {"time_unit": records.units.time}
        found = identify(records.data, estimator, records.validation_record, **draws)
    return FitResult(found, records.of_fit(found), assessment.predict)
