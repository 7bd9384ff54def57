"""``ctid model``: what fitted models answer, and fitted models on other records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ctid_cli.cli._common import (
    ComputingCommand,
    From,
    InputColumn,
    Json,
    OutputColumn,
    TimeColumn,
    To,
    answer,
    guarded,
    refuse_overwriting,
    span,
    write_files,
)
from ctid_cli.errors import UsageError
from ctid_cli.signals.treatment import Hold, InitialState, Offset

if TYPE_CHECKING:
    from ctid_cli.reporting.figures.style import Drawing
    from ctid_cli.reporting.model_report import NamedFit

FitFile = Annotated[Path, typer.Argument(metavar="FIT", help="A fit.json.")]
FitFiles = Annotated[list[Path], typer.Argument(metavar="FIT...", help="Files that ctid fit wrote (fit.json).")]
Level = Annotated[float, typer.Option("--level", help="Confidence level of the bands.")]
Bands = Annotated[
    Literal["linearised", "sampled"], typer.Option("--bands", help="From a linearisation, or from drawn parameters.")
]
OwnHold = Annotated[
    Hold | None, typer.Option("--hold", help="The input between its samples; as in the fit if not given.")
]
State = Annotated[InitialState | None, typer.Option("--initial-state", help="State before the record; as in the fit.")]
OutputOffset = Annotated[Offset | None, typer.Option("--offset", help="Constant offset of the output; as in the fit.")]
Folder = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the files that are written.")]

model = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


@model.callback()
def _root() -> None:
    """Use fitted models: responses with confidence bands, other records, other tools."""


@model.command("simulate", cls=ComputingCommand)
@guarded
def simulate_fit(
    file: FitFile,
    on: Annotated[
        Path, typer.Option("--on", metavar="FILE", help="The input (.csv, .mat, .h5); an output is not needed.")
    ],
    time: TimeColumn = None,
    input: InputColumn = None,
    hold: OwnHold = None,
    level: Level = 0.95,
    bands: Bands = "linearised",
    as_json: Json = False,
    out: Folder = Path("."),
) -> None:
    """Simulate the output for another input, from rest.

    Writes simulation.csv and simulation.svg: the noise-free output with its confidence band at every instant.
    """
    from ctid_cli.reporting.model_plot import response_drawing
    from ctid_cli.reporting.model_report import named_fits, require_input, response_columns
    from ctid_cli.signals.measurement import read_input

    models = named_fits([file])
    found = read_input(on, time=time, input=input, hold=hold or models[0].hold)
    require_input(models, found, str(on))
    band = models[0].fit.simulate(found.signal, level=level, bands=bands)
    columns = response_columns(models, [band], found.signal.values)
    drawing = response_drawing(models, [band], "output", found.signal)
    _write_response("simulation", models, columns, drawing, level, as_json, out, [on])


@model.command("step", cls=ComputingCommand)
@guarded
def step(
    files: FitFiles,
    until: Annotated[float | None, typer.Option("--until", metavar="TIME", help="Last instant [time unit].")] = None,
    level: Level = 0.95,
    bands: Bands = "linearised",
    as_json: Json = False,
    out: Folder = Path("."),
) -> None:
    """Step responses with confidence bands; writes step.csv and step.svg."""
    import numpy as np

    from ctid_cli.reporting.model_plot import response_drawing
    from ctid_cli.reporting.model_report import named_fits, response_columns

    if until is not None and not 0 < until < float("inf"):
        raise UsageError(f"--until must be a positive time, not {until:g}")
    models = named_fits(files)
    last = until or max(float(each.fit.step_response(level=level).t[-1]) for each in models)
    times = np.linspace(0.0, last, 500)
    found = [each.fit.step_response(times, level=level, bands=bands) for each in models]
    drawing = response_drawing(models, found, "step response")
    _write_response("step", models, response_columns(models, found), drawing, level, as_json, out)


@model.command("bode", cls=ComputingCommand)
@guarded
def bode(
    files: FitFiles,
    on: Annotated[
        Path | None, typer.Option("--on", metavar="FILE", help="Record whose own frequency response stands behind.")
    ] = None,
    band: Annotated[
        str | None, typer.Option("--band", metavar="LOW:HIGH", help="Frequencies to show [rad/time unit].")
    ] = None,
    time: TimeColumn = None,
    input: InputColumn = None,
    output: OutputColumn = None,
    hold: OwnHold = None,
    level: Level = 0.95,
    bands: Bands = "linearised",
    as_json: Json = False,
    out: Folder = Path("."),
) -> None:
    """Gain and phase with confidence bands; writes bode.csv and bode.svg.

    With --on the response that a record shows without any model stands behind, with its own intervals.
    """
    import numpy as np

    from ctid_cli.inference.frequency_response import estimate_frequency_response
    from ctid_cli.reporting.model_plot import models_bode_drawing
    from ctid_cli.reporting.model_report import frequency_columns, named_fits, record_for

    limits = None if band is None else _limits(band)
    models, behind = named_fits(files), None
    if on is not None:
        behind = estimate_frequency_response([record_for(models, on, hold, time, input, output).record])
    elif any((time, input, output, hold)):
        raise UsageError("--time, --input, --output and --hold are of a record; name it with --on FILE")
    if limits is None:
        own = [each.fit.frequency_response(level=level).frequencies for each in models]
        own += [] if behind is None else [behind.frequencies[behind.frequencies > 0]]
        limits = min(float(w[0]) for w in own), max(float(w[-1]) for w in own)
    w = np.geomspace(*limits, 500)
    found = [each.fit.frequency_response(w, level=level, bands=bands) for each in models]
    drawing = models_bode_drawing(models, found, behind)
    records = [] if on is None else [on]
    _write_response("bode", models, frequency_columns(models, found), drawing, level, as_json, out, records)


@model.command("compare", cls=ComputingCommand)
@guarded
def compare_fits(
    files: FitFiles,
    on: Annotated[Path, typer.Option("--on", metavar="FILE", help="Record, best one that no model was fitted to.")],
    time: TimeColumn = None,
    input: InputColumn = None,
    output: OutputColumn = None,
    hold: OwnHold = None,
    start: From = None,
    stop: To = None,
    initial_state: State = None,
    offset: OutputOffset = None,
    as_json: Json = False,
    out: Folder = Path("."),
) -> None:
    """Compare fitted models on one record: fit, tests of the residuals, overlay.

    Writes comparison.csv and comparison.svg.
    """
    from ctid_cli.estimators.model_comparison import compare
    from ctid_cli.reporting.model_plot import comparison_drawing
    from ctid_cli.reporting.model_report import (
        comparison_columns,
        comparison_object,
        comparison_table,
        named_fits,
        record_for,
    )

    models = named_fits(files)
    measurement = record_for(models, on, hold, time, input, output, start, stop)
    found = compare([each.fit for each in models], measurement.record, initial_state=initial_state, offset=offset)
    columns = comparison_columns(found, models, measurement.record)
    written = _write(out / "comparison", columns, comparison_drawing(models, found, measurement), [*files, on])
    head = f"{measurement.record.name}: {measurement.record.n_samples} samples"
    answer(
        as_json,
        lambda: comparison_object(models, measurement, found),
        lambda: f"{head}\n\n{comparison_table(models, found).draw()}",
        written,
    )


@model.command("residuals", cls=ComputingCommand)
@guarded
def residuals(
    file: FitFile,
    on: Annotated[Path, typer.Option("--on", metavar="FILE", help="Record (.csv, .mat, .h5).")],
    time: TimeColumn = None,
    input: InputColumn = None,
    output: OutputColumn = None,
    hold: OwnHold = None,
    start: From = None,
    stop: To = None,
    initial_state: State = None,
    offset: OutputOffset = None,
    as_json: Json = False,
    out: Folder = Path("."),
) -> None:
    """Auto- and cross-correlation of the residuals on a record, with bands; writes residuals.csv and residuals.svg."""
    from ctid_cli.estimators.model_comparison import compare
    from ctid_cli.reporting.model_plot import residual_drawing
    from ctid_cli.reporting.model_report import (
        named_fits,
        record_for,
        residual_columns,
        residual_object,
        residual_text,
    )

    (each,) = models = named_fits([file])
    measurement = record_for(models, on, hold, time, input, output, start, stop)
    (one,) = compare([each.fit], measurement.record, initial_state=initial_state, offset=offset)
    drawing = residual_drawing(each, one, measurement)
    written = _write(out / "residuals", residual_columns(one, each.units), drawing, [file, on])
    answer(
        as_json,
        lambda: residual_object(each, measurement, one),
        lambda: residual_text(each, measurement, one),
        written,
    )


@model.command("export", cls=ComputingCommand)
@guarded
def export_fit(
    file: FitFile,
    style: Annotated[Literal["control", "matlab", "scipy"], typer.Option("--format", help="Which tool it is for.")],
    pade: Annotated[
        int | None, typer.Option("--pade", metavar="ORDER", help="Approximate the delay, for control only.")
    ] = None,
    name: Annotated[str, typer.Option("--name", help="Variable that gets the model.")] = "G",
    kind: Annotated[
        Literal["idtf", "tf"] | None, typer.Option("--kind", help="Kind of model, for matlab only; idtf by default.")
    ] = None,
    as_json: Json = False,
    out: Folder = Path("."),
) -> None:
    """Write the model as code for python-control, MATLAB or SciPy, with every digit.

    Writes NAME.m, or NAME_control.py, or NAME_scipy.py. The delay stays apart unless --pade asks for an approximation.
    """
    from ctid_cli.reporting.model_report import named_fits

    if pade is not None and style != "control":
        raise UsageError(f"--pade belongs to --format control, not to {style}, where the delay stays exact")
    if kind is not None and style != "matlab":
        raise UsageError(f"--kind belongs to --format matlab, not to {style}")
    (each,) = named_fits([file])
    if style == "matlab":
        path, text = out / f"{name}.m", each.fit.to_matlab(name, kind or "idtf", each.units.time)
    else:
        path, text = out / f"{name}_{style}.py", each.fit.to_python(name, style, pade)
    refuse_overwriting([file], [path])
    write_files({path: text.encode()})
    answer(as_json, lambda: {"format": style, "text": text}, lambda: text.removesuffix("\n"), [path])


def _write_response(
    name: str,
    models: Sequence[NamedFit],
    columns: Mapping[str, Any],
    drawing: Drawing,
    level: float,
    as_json: bool,
    out: Path,
    records: Sequence[Path] = (),
) -> None:
    """Write a response and its figure, and answer with a part of it."""
    from ctid_cli.reporting.model_report import names_of, response_object, response_tables

    written = _write(out / name, columns, drawing, [*(model.path for model in models), *records])
    head = f"{names_of(models)}: {100 * level:g} % bands, pointwise"
    answer(
        as_json,
        lambda: response_object(models, columns, level),
        lambda: f"{head}\n\n{response_tables(columns, models, logarithmic=name == 'bode')}",
        written,
    )


def _write(stem: Path, columns: Mapping[str, Any], drawing: Drawing, inputs: Sequence[Path]) -> list[Path]:
    """Write columns and their figure, unless one of the files would be one that was read."""
    from ctid_cli.reporting.model_report import csv_bytes

    files = data, figure = [stem.with_name(f"{stem.name}.{style}") for style in ("csv", "svg")]
    refuse_overwriting(inputs, files)
    write_files({data: csv_bytes(columns), figure: drawing.saved()})
    return files


def _limits(text: str) -> tuple[float, float]:
    limits = span(text, float)
    if limits is None or not 0 < limits[0] < limits[1] < float("inf"):
        raise UsageError(f"--band must be LOW:HIGH, two rising positive frequencies such as 0.1:50; got {text!r}")
    return limits
