"""``ctid fit``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ctid_cli.cli._common import emit, given_command, guarded, refuse_overwriting, write_files
from ctid_cli.cli._options import FormatOptions, RecordOptions
from ctid_cli.cli._progress import FitProgress
from ctid_cli.cli.fit_structure import Asked, LoopOptions, ModelOptions, TreatmentOptions, estimator_of
from ctid_cli.errors import UsageError
from ctid_cli.reporting.document import Tool

if TYPE_CHECKING:
    from ctid_cli.estimators.identification import Identification
    from ctid_cli.estimators.measured_submodels import Options
    from ctid_cli.reporting.fit_result import FitResult
    from ctid_cli.reporting.records import Records
    from ctid_cli.signals.treatment import Hold


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
    treatment: TreatmentOptions,
    columns: RecordOptions,
    form: FormatOptions,
    writing: WritingOptions,
    validate: Annotated[
        Path | None, typer.Option("--validate", metavar="FILE", help="Validate on this record.")
    ] = None,
    bootstrap: Annotated[int | None, typer.Option("--bootstrap", metavar="DRAWS", help="Bootstrap intervals.")] = None,
) -> None:
    """Fit a transfer function with a delay to measured records.

    Prints the parameters with their standard errors and what tells whether to believe them, and writes fit.json and
    fit.svg. The delay is searched over its whole range: no start is needed.
    """
    from ctid_cli.reporting.fit_result import FitResult

    _check_draws(bootstrap)
    loop.check()
    options, hold, choices = _chosen(files, model, loop, treatment, columns)
    records = _records(files, validate, hold, loop, columns)
    result = FitResult(_identified(options, records, bootstrap), records, choices)
    contents = writing.contents(result, given_command(context))
    refuse_overwriting([*files, *([validate] if validate else [])], contents)
    write_files(contents)
    emit(result, form.form, list(contents), stored=next(iter(contents.values())).decode())


def _check_draws(bootstrap: int | None) -> None:
    from ctid_cli.estimation.common import LEAST_DRAWS

    if bootstrap is not None and bootstrap < LEAST_DRAWS:
        raise UsageError(f"--bootstrap must be at least {LEAST_DRAWS} draws, for example 500; got {bootstrap}")


def _chosen(
    files: Sequence[Path], model: ModelOptions, loop: LoopOptions, treatment: TreatmentOptions, columns: RecordOptions
) -> tuple[Options, Hold, list[str]]:
    """Return the estimator and the hold, with a sentence for each choice that was not the user's."""
    from ctid_cli.reporting.order_proposal import propose_structure
    from ctid_cli.reporting.records import Records

    if not model.open:
        asked = Asked(model, model.bounds or (0.0, 0.0), treatment, loop.counts)
        options = estimator_of(asked)
        if asked.iterated and len(files) > 1:
            raise UsageError(f"{len(files)} files are given, and submodels or a loop are fitted to one; give one file")
        hold, why = _hold(files, model, loop, treatment, columns)
        return options, hold, [why] if why else []
    if loop.loop is not None or model.fix or model.integrators or treatment.loss != "squares":
        raise UsageError("--poles is missing: with --loop, --fix, --integrators or --loss it must be given")
    bounds = model.bounds
    hold, why = _hold(files, model, loop, treatment, columns)
    first = Records([columns.read(file, hold) for file in files])
    state = treatment.initial_state, treatment.offset
    found = propose_structure(first.data, model.zeros, bounds, *state, first.units.time)
    options = estimator_of(Asked(replace(model, poles=found.poles, zeros=found.zeros), found.delay_bounds, treatment))
    return options, hold, [*([why] if why else []), found.sentence]


def _hold(
    files: Sequence[Path], model: ModelOptions, loop: LoopOptions, treatment: TreatmentOptions, columns: RecordOptions
) -> tuple[Hold, str]:
    """Return the hold that is given, or the best for one fraction in open loop, and a sentence."""
    from ctid_cli.reporting.hold_choice import chosen_hold

    if treatment.hold != "auto":
        return treatment.hold, ""
    if loop.loop is not None or model.model != "fraction" or model.integrators:
        return "zoh", ""
    records = [columns.read(file, "zoh").record for file in files]
    return chosen_hold(records, model.poles, model.zeros, model.bounds, treatment.initial_state, treatment.offset)


def _records(
    files: Sequence[Path], validate: Path | None, hold: Hold, loop: LoopOptions, columns: RecordOptions
) -> Records:
    """Read the records, in their loop; a DataError where their units differ."""
    from ctid_cli.reporting.records import Records

    measured = [loop.applied(columns.read(file, hold, reference=loop.reference)) for file in files]
    other = None
    if validate is not None:
        other = loop.applied(columns.read_whole(validate, hold, reference=loop.reference))
    records = Records(measured, other)
    # Units that differ are refused before anything is computed.
    records.units  # noqa: B018
    return records


def _identified(options: Options, records: Records, bootstrap: int | None) -> Identification:
    """Fit, with a bar of progress where it takes long."""
    from ctid_cli.identification.identify import identify

    validation = None if records.validation is None else records.validation.record
    with FitProgress(sum(record.n_samples for record in records.data)) as progress:
        noise: Any = ("auto",) if bootstrap is None else ("bootstrap", bootstrap, progress)
        return identify(options, records.data, validation, *noise)
