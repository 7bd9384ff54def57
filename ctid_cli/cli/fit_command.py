"""``ctid fit``."""

import json
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from ctid_cli.cli._common import (
    From,
    InputColumn,
    Json,
    OutputColumn,
    TimeColumn,
    To,
    given_command,
    guarded,
    write_files,
)
from ctid_cli.cli._progress import FitProgress
from ctid_cli.cli.fit_structure import Asked, ModelForm, check_loop, delay_bounds, estimator_of, with_loop
from ctid_cli.errors import UsageError
from ctid_cli.signals.treatment import AskedHold, Hold, InitialState, LossKind, Offset
from ctid_cli.text import wrapped


@guarded
def fit(
    context: typer.Context,
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Records (.csv, .mat, .h5), an experiment each.")
    ],
    poles: Annotated[
        int | None, typer.Option("--poles", help="Poles, 1 to 12 (0 with --integrators); else by an order search.")
    ] = None,
    zeros: Annotated[int | None, typer.Option("--zeros", help="Zeros, fewer than poles.")] = None,
    delay: Annotated[
        str | None, typer.Option("--delay", metavar="LOW:HIGH|VALUE", help="Range or value [time unit]; 0.")
    ] = None,
    model: Annotated[ModelForm, typer.Option("--model", help="One fraction, or a sum of submodels.")] = "fraction",
    terms: Annotated[
        str | None, typer.Option("--terms", metavar="P/Z,P/Z,...", help="Poles/zeros of each submodel.")
    ] = None,
    integrators: Annotated[
        int, typer.Option("--integrators", help="Poles at the origin besides; of a sum, in its first submodel.")
    ] = 0,
    fix: Annotated[
        list[str] | None, typer.Option("--fix", metavar="NAME=VALUE", help="Hold a parameter; repeatable.")
    ] = None,
    loop: Annotated[
        Path | None, typer.Option("--loop", metavar="FILE", help="YAML with the section loop of the record.")
    ] = None,
    reference: Annotated[
        str | None, typer.Option("--reference", metavar="NAME", help="Column of the loop's reference.")
    ] = None,
    ignore_loop: Annotated[bool, typer.Option("--ignore-loop", help="Fit as if there were no loop.")] = False,
    initial_state: Annotated[InitialState, typer.Option("--initial-state", help="State before the record.")] = "rest",
    offset: Annotated[Offset, typer.Option("--offset", help="Constant offset of the output (not input).")] = "none",
    loss: Annotated[LossKind, typer.Option("--loss", help="What large output errors count.")] = "squares",
    hold: Annotated[AskedHold, typer.Option("--hold", help="The input between its samples.")] = "auto",
    time: TimeColumn = None,
    input: InputColumn = None,
    output: OutputColumn = None,
    start: From = None,
    stop: To = None,
    validate: Annotated[Path | None, typer.Option("--validate", metavar="FILE", help="Judge on this record.")] = None,
    bootstrap: Annotated[int | None, typer.Option("--bootstrap", metavar="DRAWS", help="Bootstrap intervals.")] = None,
    report: Annotated[bool, typer.Option("--report", help="Write the page fit.html too.")] = False,
    as_json: Json = False,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for fit.json and fit.svg.")] = Path("."),
) -> None:
    """Fit a transfer function with a delay to measured records.

    Prints the parameters with their standard errors and what tells whether to believe them, and writes fit.json and
    fit.svg. The delay is searched over its whole range: no start is needed.
    """
    from ctid_cli.estimation.common import LEAST_DRAWS
    from ctid_cli.estimators.identification import identify
    from ctid_cli.reporting.identification_plot import identification_drawing
    from ctid_cli.reporting.identification_report import common_units, identification_object, identification_text
    from ctid_cli.signals.measurement import read_measurement
    from ctid_cli.storage.fit_file import fit_text

    if bootstrap is not None and bootstrap < LEAST_DRAWS:
        raise UsageError(f"--bootstrap must be at least {LEAST_DRAWS} draws, for example 500; got {bootstrap}")
    check_loop(loop, reference, ignore_loop)
    read = partial(read_measurement, time=time, input=input, output=output, reference=reference)
    bounds = None if delay is None else delay_bounds(delay)
    said: list[str] = []

    def held() -> Hold:
        """The hold that is given, or the best for one fraction in open loop."""
        if hold != "auto":
            return hold
        if loop is not None or model != "fraction" or integrators:
            return "zoh"
        from ctid_cli.reporting.hold_choice import chosen_hold

        shown = [read(file, start=start, stop=stop, hold="zoh").record for file in files]
        chosen, why = chosen_hold(shown, poles, zeros, bounds, initial_state, offset)
        said.extend([why] if why else [])
        return chosen

    if poles is None and model == "fraction" and terms is None:
        if loop is not None or fix or integrators or loss != "squares":
            raise UsageError("--poles is missing: with --loop, --fix, --integrators or --loss it must be given")
        from ctid_cli.reporting.order_proposal import propose_structure

        hold = held()
        first = [read(file, start=start, stop=stop, hold=hold) for file in files]
        unit = common_units(first).time
        proposal = propose_structure([item.record for item in first], zeros, bounds, initial_state, offset, unit)
        poles, zeros, bounds, searched = proposal
        said.append(searched)
    taken: Hold = "zoh" if hold == "auto" else hold
    asked = Asked(
        *(model, terms, poles, zeros, integrators, bounds or (0.0, 0.0), fix or (), initial_state, offset, loss, taken),
        loop=loop is not None and not ignore_loop,
    )
    options = estimator_of(asked)
    if asked.iterated and len(files) > 1:
        raise UsageError(f"{len(files)} files are given, and submodels or a loop are fitted to one; give one file")
    hold = held()
    measurements = [read(file, start=start, stop=stop, hold=hold) for file in files]
    other = None if validate is None else read(validate, hold=hold)
    if loop is not None:
        measurements = [with_loop(loop, measurement, ignore_loop) for measurement in measurements]
        other = other and with_loop(loop, other, ignore_loop)
    units = common_units(measurements if other is None else [*measurements, other])
    validation = None if other is None else other.record
    with FitProgress(sum(item.record.n_samples for item in measurements)) as progress:
        noise: Any = ("auto",) if bootstrap is None else ("bootstrap", bootstrap, progress)
        result = identify(options, [item.record for item in measurements], validation, *noise)
    content = identification_object(result, measurements, units, other)
    text = fit_text(result, content, measurements, other, out, given_command(context))
    figure = identification_drawing(result, measurements, units).saved()
    contents = {out / "fit.json": text.encode() + b"\n", out / "fit.svg": figure}
    if report:
        from ctid_cli.reporting.pages.fit_page import fit_page

        contents[out / "fit.html"] = fit_page(result, measurements, other, json.loads(text)).encode()
    write_files(contents)
    if as_json:
        typer.echo(text)
    else:
        for sentence in said:
            typer.echo(wrapped(sentence) + "\n")
        typer.echo(identification_text(result, measurements, units))
        typer.echo(f"\nWritten: {', '.join(map(str, contents))}")
