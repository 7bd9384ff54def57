"""``ctid order``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from ctid_cli.canonical import plain
from ctid_cli.cli._common import emit, guarded, span, write_files
from ctid_cli.cli._options import FormatOptions, RecordOptions, Records, Validate, flag
from ctid_cli.cli._progress import FitProgress
from ctid_cli.cli.fit_structure import (
    MODES,
    FormOption,
    HoldOption,
    ModelForm,
    StructureOptions,
    TreatmentOptions,
    as_usage_errors,
    given_of,
    per_input,
)
from ctid_cli.cli.response_fit import frequency_files
from ctid_cli.errors import UsageError


@guarded
def order(
    files: Records,
    structure: StructureOptions,
    treatment: TreatmentOptions,
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
    _refuse_other_form(model, poles=poles, zeros=zeros, modes=modes)
    for option, texts in (("--delay", structure.delays), ("--integrators", structure.each_integrators)):
        if per_input(option, texts).keys() - {""}:
            raise UsageError(f"{option} INPUT=VALUE is for ctid fit; structures are ranked with one for all inputs")
    ranges = _range("--poles", poles, int(not structure.integrators)), _range("--zeros", zeros, 0)
    given = replace(given_of(structure, treatment, hold), poles=ranges[0], zeros=ranges[1])
    if model == "additive":
        given = replace(given, modes=_range("--modes", modes, *MODES) or MODES)
    records = columns.read_all(files, validate, "zoh")
    with as_usage_errors(), FitProgress(sum(record.n_samples for record in records.data)):
        choice = choose(records.data, given, records.units.time)
        result = OrderSearchResult.of(choice, given, records)
    written = [out / "order.json", out / "order.svg"]
    content = json.dumps(plain({**result.json_content(), "written": list(map(str, written))}), allow_nan=False)
    write_files({written[0]: content.encode() + b"\n", written[1]: result.drawing().saved()})
    emit(result, form.form, written)


def _refuse_other_form(model: ModelForm, **options: str | None) -> None:
    own = {"fraction": ("poles", "zeros"), "additive": ("modes",)}
    why = {
        "fraction": "is for a sum of submodels; add --model additive, or drop it",
        "additive": "is for one transfer function; give the numbers of submodels by --modes, or drop it",
    }
    for name, text in options.items():
        if text is not None and name not in own[model]:
            raise UsageError(f"--{name} {why[model]}")


def _range(name: str, text: str | None, least: int, most: int = 12) -> tuple[int, int] | None:
    if text is None:
        return None
    found = span(text, int)
    if found is None or not least <= found[0] <= found[1] <= most:
        raise UsageError(
            f"{name} must be LOW:HIGH or one number, from {least} to {most}, for example {least}:3; got {text!r}"
        )
    return found
