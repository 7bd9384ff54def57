"""``ctid table``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import Out, guarded


class TableFormat(StrEnum):
    """Forms of a table."""

    text = "text"
    md = "md"
    csv = "csv"
    json = "json"


@guarded
def table(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", help="Table (1, useful-redundancy/3) or experiment (quickstart)."),
    ] = None,
    style: Annotated[TableFormat, typer.Option("--format", help="Form of the output.")] = TableFormat.text,
    out: Out = Path("results"),
) -> None:
    """Print tables of convergence percentages.

    With their 95 % intervals and numbers of data sets, and the published values where there are any.

    Without a name: all tables of the useful-redundancy study. Cells that were not run say so.
    """
    from ctid_cli.reporting.report import build_tables, write_tables

    if not out.is_dir():
        typer.echo(f"ctid: there is no folder {out}, so nothing was run yet (--out names the results folder)", err=True)
    typer.echo(write_tables(build_tables(names or [], out), style.value))
