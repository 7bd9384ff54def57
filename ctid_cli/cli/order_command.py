"""``ctid order``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

from ctid_cli.canonical import plain
from ctid_cli.cli._common import emit, guarded, span, write_files
from ctid_cli.cli._options import FormatOptions, RecordOptions, Records, Validate, flag, refuse_options
from ctid_cli.cli._progress import FitProgress
from ctid_cli.cli.fit_structure import MODES, OPTIONS, FormOption, HoldOption, StructureOptions, as_usage_errors
from ctid_cli.cli.response_fit import frequency_files
from ctid_cli.errors import UsageError

#: Options of the other form of the model, and what to do.
FRACTION = {"--modes": "add --model additive, or drop it"}
SUM = dict.fromkeys(("--poles", "--zeros"), "give the numbers of submodels by --modes, or drop it")


@guarded
def order(
    files: Records,
    structure: StructureOptions,
    columns: RecordOptions,
    form: FormatOptions,
    poles: Annotated[str | None, flag("--poles", "Numbers of poles, 1 to 12; else as many as needed.", "LOW:HIGH")] = (
        None
    ),
    zeros: Annotated[str | None, flag("--zeros", "Numbers of zeros.", "LOW:HIGH")] = None,
    model: FormOption = "fraction",
    modes: Annotated[str | None, flag("--modes", "Numbers of second-order submodels of a sum.", "LOW:HIGH")] = None,
    hold: HoldOption = "auto",
    validate: Validate = None,
    out: Annotated[Path, flag("--out", "Folder for order.json and order.svg.", "DIR")] = Path("."),
) -> None:
    """Show the structures that ctid fit chooses from.

    Fits structures with increasing numbers of poles until the best lies inside the grid, ranks them by the criterion of
    ctid fit, and marks the chosen one; or states that there is no model. With --model additive structures are sums of
    second-order submodels. Writes order.json and order.svg.
    """
    from ctid_cli.identification.choose import choose
    from ctid_cli.reporting.order_result import OrderSearchResult

    if frequency_files(files):
        raise UsageError(
            f"{files[0]} is a frequency response: its structure is given, not chosen; use ctid fit --poles"
        )
    ranges = {"--poles": poles, "--zeros": zeros, "--modes": modes}
    is_sum = model == "additive"
    typed = [option for option, text in ranges.items() if text is not None]
    refuse_options(typed, SUM if is_sum else FRACTION, "a sum of submodels" if is_sum else "one fraction")
    for name in ("delay_bounds", "integrators"):
        if structure.each(name).keys() - {""}:
            raise UsageError(
                f"{OPTIONS[name]} INPUT=VALUE is for ctid fit; structures are ranked with one for all inputs"
            )
    given = structure.given(
        poles=_range("--poles", poles, int(not structure.common("integrators"))),
        zeros=_range("--zeros", zeros, 0),
        modes=_range("--modes", modes, *MODES) or MODES if is_sum else None,
        hold=hold,
    )
    records = columns.read_all(files, validate, "zoh")
    with as_usage_errors(), FitProgress(sum(record.n_samples for record in records.data)):
        choice = choose(records.data, given, records.units.time)
        result = OrderSearchResult.of(choice, given, records)
    written = [out / "order.json", out / "order.svg"]
    content = json.dumps(plain({**result.json_content(), "written": list(map(str, written))}), allow_nan=False)
    write_files({written[0]: content.encode() + b"\n", written[1]: result.drawing().saved()})
    emit(result, form.form, written)


def _range(name: str, text: str | None, least: int, most: int = 12) -> tuple[int, int] | None:
    if text is None:
        return None
    found = span(text, int)
    if found is None or not least <= found[0] <= found[1] <= most:
        raise UsageError(
            f"{name} must be LOW:HIGH or one number, from {least} to {most}, for example {least}:3; got {text!r}"
        )
    return found
