"""``ctid order``."""

import json
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import (
    From,
    InputColumn,
    InputHold,
    Json,
    OutputColumn,
    TimeColumn,
    To,
    guarded,
    span,
    write_files,
)
from ctid_cli.cli.fit_structure import check_integrators, delay_bounds
from ctid_cli.errors import UsageError
from ctid_cli.signals.treatment import InitialState, Offset


@guarded
def order(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Records (.csv, .mat, .h5), an experiment each.")
    ],
    poles: Annotated[str, typer.Option("--poles", metavar="LOW:HIGH", help="Numbers of poles, 1 to 12.")] = "1:6",
    zeros: Annotated[str, typer.Option("--zeros", metavar="LOW:HIGH", help="Numbers of zeros.")] = "0:3",
    delay: Annotated[
        str | None,
        typer.Option("--delay", metavar="LOW:HIGH|VALUE", help="Range or value [time unit]; else as ctid check says."),
    ] = None,
    initial_state: Annotated[InitialState, typer.Option("--initial-state", help="State before the record.")] = "rest",
    integrators: Annotated[int, typer.Option("--integrators", help="Poles at the origin besides.")] = 0,
    offset: Annotated[Offset, typer.Option("--offset", help="Constant offset of the output (not input).")] = "none",
    hold: InputHold = "zoh",
    time: TimeColumn = None,
    input: InputColumn = None,
    output: OutputColumn = None,
    start: From = None,
    stop: To = None,
    validate: Annotated[
        Path | None, typer.Option("--validate", metavar="FILE", help="Judge on this record too.")
    ] = None,
    as_json: Json = False,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for order.json and order.svg.")] = Path("."),
) -> None:
    """Say how many poles and zeros measured records ask for.

    Fits all structures of a range, ranks them by BIC, and says which one to take and why, or that there is no model
    here. Residuals that are not white are made so first, by one noise model for all. Writes order.json and order.svg.
    """
    from ctid_cli.estimators.order_search import search_orders
    from ctid_cli.reporting.order_plot import order_drawing
    from ctid_cli.reporting.order_proposal import proposed_delay
    from ctid_cli.reporting.order_report import order_object, order_text
    from ctid_cli.reporting.records import Records
    from ctid_cli.signals.measurement import read_measurement

    check_integrators(integrators, offset)
    ranges = _range("--poles", poles, int(not integrators)), _range("--zeros", zeros, 0)
    bounds = None if delay is None else delay_bounds(delay)
    read = partial(read_measurement, time=time, input=input, output=output, hold=hold)
    measurements = [read(file, start=start, stop=stop) for file in files]
    other = None if validate is None else read(validate)
    units = Records(measurements, other).units
    said = ""
    if bounds is None:
        bounds, said = proposed_delay([item.record for item in measurements], units.time)
    try:
        found = search_orders(
            [item.record for item in measurements],
            *ranges,
            bounds,
            initial_state=initial_state,
            offset=offset,
            validation=None if other is None else other.record,
            integrators=integrators,
        )
    except ValueError as error:
        raise UsageError(str(error)) from None
    data, figure = out / "order.json", out / "order.svg"
    text = json.dumps(order_object(found, measurements, units, [data, figure]), allow_nan=False)
    title = ", ".join(file.name for file in files)
    write_files({data: text.encode() + b"\n", figure: order_drawing(found, title).saved()})
    if as_json:
        typer.echo(text)
    else:
        parts = [
            order_text(found, measurements, units),
            *([f"- {said}"] if said else []),
            "",
            f"Written: {data}, {figure}",
        ]
        typer.echo("\n".join(parts))


def _range(name: str, text: str, least: int) -> tuple[int, int]:
    found = span(text, int)
    if found is None or not least <= found[0] <= found[1] <= 12:
        raise UsageError(
            f"{name} must be LOW:HIGH or one number, from {least} to 12, for example {least}:3; got {text!r}"
        )
    return found
