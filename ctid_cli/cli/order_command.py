"""``ctid order``."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from ctid_cli.canonical import plain
from ctid_cli.cli._common import emit, guarded, span, write_files
from ctid_cli.cli._options import FormatOptions, RecordOptions, Records, Validate, flag, given_options, refuse_options
from ctid_cli.cli.fit_structure import MODES, OPTIONS, FormOption, HoldOption, StructureOptions, as_usage_errors
from ctid_cli.cli.response_fit import frequency_files, frequency_order
from ctid_cli.errors import UsageError
from ctid_cli.signals.treatment import Weight

if TYPE_CHECKING:
    from ctid_cli.identification.choice import Given
    from ctid_cli.reporting.response_order import ResponseOrder

#: Options of the other form of the model, and what to do.
FRACTION = {"--modes": "add --model additive, or drop it"}
RECORD = {"--weight": "samples have equal weights; drop it"}
SUM = dict.fromkeys(("--poles", "--zeros"), "give the numbers of submodels by --modes, or drop it")


@dataclass(frozen=True)
class GridOptions(StructureOptions):
    """Structures that are compared, and the hold of the input."""

    poles: Annotated[str | None, flag("--poles", "Numbers of poles, 1 to 12; else chosen.", "LOW:HIGH")] = None
    zeros: Annotated[str | None, flag("--zeros", "Numbers of zeros.", "LOW:HIGH")] = None
    model: FormOption = "fraction"
    modes: Annotated[str | None, flag("--modes", "Numbers of second-order submodels of a sum.", "LOW:HIGH")] = None
    hold: HoldOption = "auto"
    weight: Annotated[Weight | None, flag("--weight", "Weights of a response without standard errors.")] = None

    def requested(self) -> Given:
        """Return the given options of the choice; a UsageError names contradicting options."""
        is_sum = self.model == "additive"
        refuse_options(given_options(self), SUM if is_sum else FRACTION, f"--model {self.model}")
        for name in ("delay_bounds", "integrators"):
            if self.each(name).keys() - {""}:
                only = "INPUT=VALUE is for ctid fit; structures are ranked with one for all inputs"
                raise UsageError(f"{OPTIONS[name]} {only}")
        return self.given(
            poles=_range("--poles", self.poles, int(not self.common("integrators"))),
            zeros=_range("--zeros", self.zeros, 0),
            modes=_range("--modes", self.modes, *MODES) or MODES if is_sum else None,
            hold=self.hold,
        )


@guarded
def order(
    files: Records,
    grid: GridOptions,
    columns: RecordOptions,
    form: FormatOptions,
    validate: Validate = None,
    out: Annotated[Path, flag("--out", "Folder for order.json and order.svg.", "DIR")] = Path("."),
) -> None:
    """Show the structures that ctid fit chooses from.

    Fits structures with increasing numbers of poles until the best lies inside the grid, ranks them by the criterion of
    ctid fit, and marks the chosen one; or states that there is no model. With --model additive structures are sums of
    second-order submodels. The file may be a table of a frequency response. Writes order.json and order.svg.
    """
    from ctid_cli.identification.choose import choose
    from ctid_cli.reporting.order_result import OrderSearchResult

    result: OrderSearchResult | ResponseOrder
    if frequency_files(files):
        given_to_it = [*given_options(grid), *["--validate"] * (validate is not None)]
        result = frequency_order(files, grid.requested, grid.weight, columns, given_to_it)
    else:
        refuse_options(given_options(grid), RECORD, "a record in time")
        given = grid.requested()
        records = columns.read_all(files, validate, "zoh")
        with as_usage_errors():
            choice = choose(records.data, given, records.units.time)
            result = OrderSearchResult.of(choice, given, records)
    written = [out / "order.json", out / "order.svg"]
    content = json.dumps(plain({**result.json_content(), "written": list(map(str, written))}), allow_nan=False)
    write_files({written[0]: content.encode() + b"\n"})
    emit(result, form.form, written, draw=lambda: write_files({written[1]: result.drawing().saved()}))


def _range(name: str, text: str | None, least: int, most: int = 12) -> tuple[int, int] | None:
    if text is None:
        return None
    found = span(text, int)
    if found is None or not least <= found[0] <= found[1] <= most:
        raise UsageError(
            f"{name} must be LOW:HIGH or one number, from {least} to {most}, for example {least}:3; got {text!r}"
        )
    return found
