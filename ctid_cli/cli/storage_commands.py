"""The commands that look after stored results: ``ctid verify`` and ``ctid repair``."""

import json
from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import Json, Out, answer, guarded
from ctid_cli.errors import MismatchError, UsageError


@guarded
def verify(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="Experiments (quickstart); all by default.")
    ] = None,
    out: Out = Path("results"),
    as_json: Json = False,
) -> None:
    """Check every stored byte of experiments.

    The journal with every estimate in it, the sealed file, the specification, times and provenance. Exit code 7 if
    anything is damaged or missing. Nothing is changed; `ctid repair` saves what can be read.
    """
    from ctid_cli.reporting.integrity import verification_object, verification_text
    from ctid_cli.reporting.results import experiments_in, stored_folder
    from ctid_cli.storage.verify import verify as check

    found = [check(stored_folder(out, name)) for name in dict.fromkeys(names or experiments_in(out))]
    if not found:
        raise UsageError(f"there are no results in {out}")
    for item in found:
        typer.echo(json.dumps(verification_object(item, out)) if as_json else verification_text(item, out))
    wrong = [item.folder for item in found if not item.is_intact]
    if wrong:
        raise MismatchError(f"not as it was written: {', '.join(map(str, wrong))}")


@guarded
def repair(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Experiment (quickstart).")],
    to: Annotated[
        Path | None, typer.Option("--to", metavar="DIR", help="Results folder to save into; OUT-repaired by default.")
    ] = None,
    out: Out = Path("results"),
    as_json: Json = False,
) -> None:
    """Save what can be read of damaged results into a new folder.

    The old folder is not touched. `ctid run` with the same specification and the new folder as --out computes what is
    missing.
    """
    from ctid_cli.reporting.integrity import repair_object, repair_text
    from ctid_cli.reporting.results import stored_folder
    from ctid_cli.storage.repair import repair as save

    target = out.with_name(f"{out.resolve().name}-repaired") if to is None else to
    found = save(stored_folder(out, name), target)
    answer(as_json, lambda: repair_object(found), lambda: repair_text(found, target))
