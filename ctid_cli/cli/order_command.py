"""``ctid order``."""

import json
from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.canonical import plain
from ctid_cli.cli._common import InputHold, emit, guarded, span, write_files
from ctid_cli.cli._options import FormatOptions, RecordOptions
from ctid_cli.cli.fit_structure import check_integrators, delay_bounds
from ctid_cli.errors import UsageError
from ctid_cli.signals.treatment import InitialState, Offset


@guarded
def order(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Records (.csv, .mat, .h5), an experiment each.")
    ],
    columns: RecordOptions,
    form: FormatOptions,
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
    validate: Annotated[
        Path | None, typer.Option("--validate", metavar="FILE", help="Judge on this record too.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for order.json and order.svg.")] = Path("."),
) -> None:
    """Say how many poles and zeros measured records ask for.

    Fits all structures of a range, ranks them by BIC, and says which one to take and why, or that there is no model
    here. Residuals that are not white are made so first, by one noise model for all. Writes order.json and order.svg.
    """
    from ctid_cli.estimators.order_search import search_orders
    from ctid_cli.reporting.order_proposal import proposed_delay
    from ctid_cli.reporting.order_result import OrderSearchResult
    from ctid_cli.reporting.records import Records

    check_integrators(integrators, offset)
    ranges = _range("--poles", poles, int(not integrators)), _range("--zeros", zeros, 0)
    bounds, choice = (None if delay is None else delay_bounds(delay)), ""
    measurements = [columns.read(file, hold) for file in files]
    records = Records(measurements, None if validate is None else columns.read_whole(validate, hold))
    if bounds is None:
        bounds, choice = proposed_delay(records.data, records.units.time)
    try:
        found = search_orders(
            *(records.data, *ranges, bounds),
            initial_state=initial_state,
            offset=offset,
            validation=records.validation and records.validation.record,
            integrators=integrators,
        )
    except ValueError as error:
        raise UsageError(str(error)) from None
    result = OrderSearchResult(found, records, choice)
    written = [out / "order.json", out / "order.svg"]
    content = json.dumps(plain({**result.content(), "written": list(map(str, written))}), allow_nan=False)
    write_files({written[0]: content.encode() + b"\n", written[1]: result.drawing().saved()})
    emit(result, form.form, written)


def _range(name: str, text: str, least: int) -> tuple[int, int]:
    found = span(text, int)
    if found is None or not least <= found[0] <= found[1] <= 12:
        raise UsageError(
            f"{name} must be LOW:HIGH or one number, from {least} to 12, for example {least}:3; got {text!r}"
        )
    return found
