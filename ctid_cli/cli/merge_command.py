"""The command that joins what several machines have computed: ``ctid merge``."""

from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import AllowMixed, Out, guarded


@guarded
def merge(
    folders: Annotated[
        list[Path], typer.Argument(metavar="FOLDER", help="Folders of shards, or folders that hold some.")
    ],
    out: Out = Path("results"),
    allow_mixed: AllowMixed = False,
    partial: Annotated[bool, typer.Option("--partial", help="Merge although some estimates are missing.")] = False,
) -> None:
    """Merge the shards of experiments into one folder of results.

    `ctid run --shard K/N` computes one of N shards. Merged in whatever order, they give the runs.h5 of a single run,
    byte for byte. The folders of the shards stay as they are.
    """
    from ctid_cli.reporting.results import out_option
    from ctid_cli.storage.merge import find_sources, merge_all

    for merged in merge_all(find_sources(folders), out, allow_mixed=allow_mixed, partial=partial):
        text = f"{merged.experiment}: {merged.stored} of {merged.planned} estimates in {merged.folder}"
        lines = [f"{text} ({merged.new} new, from {merged.sources} folders)"]
        if merged.mixed:
            lines.append("  they mix code versions or processors, which tables will say")
        lines += [f"  {sentence}" for sentence in merged.missing]
        lines.append(f"  next: ctid table {merged.experiment}{out_option(out)}")
        typer.echo("\n".join(lines))
