"""``ctid table``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from ctid_cli.cli._common import Out, guarded


@guarded
def table(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", help="Table (1, useful-redundancy/3) or experiment (quickstart)."),
    ] = None,
    style: Annotated[
        Literal["text", "md", "csv", "json"], typer.Option("--format", help="Form of the output.")
    ] = "text",
    check: Annotated[
        bool,
        typer.Option("--check", help="Compare with the committed tables and the paper; exit code 7 if they differ."),
    ] = False,
    reference: Annotated[
        Path | None,
        typer.Option("--reference", metavar="FILE", help="With --check: these tables (CSV) for the committed ones."),
    ] = None,
    out: Out = Path("results"),
) -> None:
    """Print tables of convergence percentages.

    With their 95 % intervals and numbers of data sets, and the published values where there are any.

    Without a name: all tables of the useful-redundancy study. Cells that were not run say so; where the folder results
    holds nothing of a table, as in a fresh clone, the committed results are printed.
    """
    from ctid_cli.errors import MismatchError, UsageError
    from ctid_cli.reporting.comparison import check_tables, mismatch_sentence, write_comparison
    from ctid_cli.reporting.layout import write_reports
    from ctid_cli.reporting.tables import build_tables

    if reference is not None and not check:
        raise UsageError("--reference goes with --check")
    if not out.is_dir():
        typer.echo(f"ctid: there is no folder {out}, so nothing was run yet (--out names the results folder)", err=True)
    if not check:
        tables = build_tables(names or [], out, style, committed=out == Path("results"))
        typer.echo(write_reports(tables, style))
        # Text and Markdown hold their notes themselves.
        for note in (note for report in tables for note in report.notes if style in ("csv", "json")):
            typer.echo(f"ctid: {note}", err=True)
        return
    comparison = check_tables(names or [], out, reference)
    typer.echo(write_comparison(comparison, style))
    if comparison.mismatches:
        raise MismatchError(mismatch_sentence(comparison))
