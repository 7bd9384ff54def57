"""``ctid export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from ctid_cli.cli._common import Out, guarded, write_files


@guarded
def export(
    experiment: Annotated[str, typer.Argument(metavar="EXPERIMENT", help="Name of the experiment.")],
    style: Annotated[Literal["csv", "json"], typer.Option("--format", help="Form of the output.")] = "csv",
    out: Out = Path("results"),
    file: Annotated[
        Path | None, typer.Option("--file", metavar="FILE", help="Write here instead of to stdout.")
    ] = None,
) -> None:
    """Write every estimate of an experiment, one row each."""
    import json

    from ctid_cli.reporting.estimate import as_object
    from ctid_cli.reporting.results import read_results
    from ctid_cli.storage.store import load_estimates
    from ctid_cli.storage.summary import export_rows

    results = read_results(out, experiment)
    if style == "csv":
        text = str(export_rows(load_estimates(results.folder)).to_csv(index=False, lineterminator="\n"))
    else:
        text = json.dumps([as_object(row) for row in results.rows], indent=1, allow_nan=False) + "\n"
    if file is None:
        typer.echo(text, nl=False)
        return
    write_files({file: text.encode()})
    typer.echo(f"{len(results.rows)} estimates written to {file}", err=True)
