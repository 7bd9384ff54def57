"""``ctid show``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import Json, Out, echo_json, guarded


@guarded
def show(
    id: Annotated[str, typer.Argument(metavar="ID", help="Identifier of the estimate, or its first letters.")],
    out: Out = Path("results"),
    as_json: Json = False,
    history: Annotated[
        bool, typer.Option("--history", help="Make the data set and the estimate again, and print every iteration.")
    ] = False,
) -> None:
    """Print one estimate in full.

    Its parameters with their uncertainty, its status, the data it comes from, and how to redo it.
    `ctid export EXPERIMENT` lists the identifiers, `ctid status EXPERIMENT` those of failed estimates.
    """
    from ctid_cli.reporting.detail import detail_object, detail_text, repeat
    from ctid_cli.storage.store import find_estimate

    found = find_estimate(out, id)
    again = repeat(found) if history else None
    if as_json:
        echo_json(detail_object(found, again, out))
    else:
        typer.echo(detail_text(found, again, out))
