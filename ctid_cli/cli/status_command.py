"""``ctid status``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import Json, Out, echo_json, guarded


@guarded
def status(
    experiment: Annotated[
        str | None, typer.Argument(metavar="[EXPERIMENT]", help="Only this experiment, with its estimates.")
    ] = None,
    out: Out = Path("results"),
    as_json: Json = False,
) -> None:
    """Say what is stored and what is missing.

    Counts estimates: done, planned, failed, and those that the latest settings set aside.
    """
    from ctid_cli.reporting.overview import overview_text, status_object, status_text
    from ctid_cli.reporting.results import experiments_in, read_results
    from ctid_cli.storage.store import experiment_status

    if experiment is None:
        found = [experiment_status(out / name) for name in experiments_in(out)]
        if as_json:
            for item in found:
                echo_json(status_object(item, None))
        elif found:
            typer.echo(overview_text(found))
        else:
            typer.echo(f"There are no results in {out}. To make some: ctid run configs/quickstart.yaml")
        return
    if not (out / experiment).is_dir():
        read_results(out, experiment)
    one = experiment_status(out / experiment)
    # A first run that is still going on has nothing to read yet.
    rows = read_results(out, experiment).rows if one.done else []
    if as_json:
        echo_json(status_object(one, rows))
    else:
        typer.echo(status_text(one, rows, out))
