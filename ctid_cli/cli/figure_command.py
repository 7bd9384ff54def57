"""``ctid figure``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import Out, guarded, write_files


@guarded
def figure(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME]...",
            help="Figure (2, useful-redundancy/2, additive/3) or study (useful-redundancy, additive).",
        ),
    ] = None,
    out: Out = Path("results"),
    file: Annotated[
        Path | None, typer.Option("--file", metavar="FILE", help="Where a single figure goes instead.")
    ] = None,
) -> None:
    """Draw figures of a study as SVG files.

    Most are computed from the study's specifications and need no results: all of useful-redundancy, additive/2 and
    additive/6. The others of additive are drawn from results in OUT; where these are missing, the answer says what to
    run first. Each goes to OUT/<study>_figures/figure_<number>.svg, and its path is printed.

    Without a name: all figures of the useful-redundancy study.
    """
    from ctid_cli.errors import UsageError
    from ctid_cli.studies.drawing import find_figures, require_results

    figures = find_figures(names or [])
    if file is not None and len(figures) != 1:
        raise UsageError(f"--file takes one figure, not {len(figures)}; --out names the folder of several")
    require_results(figures, out)
    for item in figures:
        path = out / item.place if file is None else file
        write_files({path: item.svg(out)})
        typer.echo(path)
