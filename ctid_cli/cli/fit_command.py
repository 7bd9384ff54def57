"""``ctid fit``."""

from __future__ import annotations

import json
from dataclasses import replace
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
    from ctid_cli.estimators.measured_submodels import Options
    from ctid_cli.reporting.fit_result import FitResult
    from ctid_cli.signals.treatment import Hold


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
    validate: Annotated[
        Path | None, typer.Option("--validate", metavar="FILE", help="Validate on this record.")
    ] = None,
    bootstrap: Annotated[int | None, typer.Option("--bootstrap", metavar="DRAWS", help="Bootstrap intervals.")] = None,
    report: Annotated[bool, typer.Option("--report", help="Write the page fit.html too.")] = False,
    csv: Annotated[
        Path | None, typer.Option("--csv", metavar="DIR", help="Write step, Bode, simulation and residuals as CSV.")
    ] = None,
    export: Annotated[Tool | None, typer.Option("--export", help="Write the model as code for this tool.")] = None,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for fit.json and fit.svg.")] = Path("."),
) -> None:
    """Fit a transfer function with a delay to measured records.

    Prints the parameters with their standard errors and what tells whether to believe them, and writes fit.json and
    fit.svg. The delay is searched over its whole range: no start is needed.
    """
    from ctid_cli.estimation.common import LEAST_DRAWS
    from ctid_cli.estimators.identification import identify
    from ctid_cli.reporting.fit_result import FitResult
    from ctid_cli.reporting.records import Records

    if bootstrap is not None and bootstrap < LEAST_DRAWS:
        raise UsageError(f"--bootstrap must be at least {LEAST_DRAWS} draws, for example 500; got {bootstrap}")
    loop.check()
    options, hold, choices = _chosen(files, model, loop, treatment, columns)
    measured = [loop.applied(columns.read(file, hold, reference=loop.reference)) for file in files]
    other = None
    if validate is not None:
        other = loop.applied(columns.read_whole(validate, hold, reference=loop.reference))
    records = Records(measured, other)
    # Units that differ are refused before anything is computed.
    records.units  # noqa: B018
    with FitProgress(sum(record.n_samples for record in records.data)) as progress:
        noise: Any = ("auto",) if bootstrap is None else ("bootstrap", bootstrap, progress)
        fitted = identify(options, records.data, None if other is None else other.record, *noise)
    result = FitResult(fitted, records, choices)
    written = _files(result, given_command(context), out, report=report, csv=csv, export=export)
    refuse_overwriting([*files, *([validate] if validate else [])], written)
    write_files(written)
    emit(result, form.form, list(written), stored=written[out / "fit.json"].decode())


def _chosen(
    files: list[Path], model: ModelOptions, loop: LoopOptions, treatment: TreatmentOptions, columns: RecordOptions
) -> tuple[Options, Hold, list[str]]:
    """Return the estimator and the hold, with a sentence for each choice that was not the user's."""
    from ctid_cli.reporting.hold_choice import chosen_hold
    from ctid_cli.reporting.order_proposal import propose_structure
    from ctid_cli.reporting.records import Records

    bounds, choices = model.bounds, []

    def held() -> Hold:
        """Return the hold that is given, or the best for one fraction in open loop."""
        if treatment.hold != "auto":
            return treatment.hold
        if loop.loop is not None or model.model != "fraction" or model.integrators:
            return "zoh"
        shown = [columns.read(file, "zoh", reference=loop.reference).record for file in files]
        state = treatment.initial_state, treatment.offset
        found, why = chosen_hold(shown, model.poles, model.zeros, bounds, *state)
        choices.extend([why] if why else [])
        return found

    if model.open:
        if loop.loop is not None or model.fix or model.integrators or treatment.loss != "squares":
            raise UsageError("--poles is missing: with --loop, --fix, --integrators or --loss it must be given")
        hold = held()
        first = Records([columns.read(file, hold, reference=loop.reference) for file in files])
        state = treatment.initial_state, treatment.offset
        poles, zeros, bounds, why = propose_structure(first.data, model.zeros, bounds, *state, first.units.time)
        choices.append(why)
        return estimator_of(Asked(replace(model, poles=poles, zeros=zeros), bounds, treatment)), hold, choices
    asked = Asked(model, bounds or (0.0, 0.0), treatment, loop.counts)
    options = estimator_of(asked)
    if asked.iterated and len(files) > 1:
        raise UsageError(f"{len(files)} files are given, and submodels or a loop are fitted to one; give one file")
    return options, held(), choices


def _files(
    result: FitResult, command: str, out: Path, *, report: bool, csv: Path | None, export: Tool | None
) -> dict[Path, bytes]:
    """Return what is written, by path."""
    from ctid_cli.reporting.column_file import frame_bytes
    from ctid_cli.reporting.fit_tables import fit_tables, model_code

    text = result.file_text(out, command)
    contents = {out / "fit.json": text.encode() + b"\n", out / "fit.svg": result.drawing().saved()}
    if report:
        from ctid_cli.reporting.pages.fit_page import fit_page

        contents[out / "fit.html"] = fit_page(result, json.loads(text)).encode()
    if csv is not None:
        contents |= {csv / name: frame_bytes(frame) for name, frame in fit_tables(result).items()}
    if export is not None:
        name, code = model_code(result.fitted, export, result.units.time)
        contents[out / name] = code.encode()
    return contents
