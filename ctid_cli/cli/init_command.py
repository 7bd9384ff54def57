"""``ctid init``."""

from importlib import resources
from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import guarded, write_files
from ctid_cli.cli._options import flag
from ctid_cli.errors import RefusedError, UsageError
from ctid_cli.text import did_you_mean, listed

#: Kinds of experiment files to begin with, each with what it is about and its files in the folder ``templates``; the
#: first file is the specification, and its experiment has the name of the kind.
TEMPLATES = {
    "open-loop": ("a system and its delay, found from noisy data", ["open-loop.yaml"]),
    "closed-loop": ("a system under a controller, with coloured noise", ["closed-loop.yaml"]),
    "modes": ("a sum of submodels, or one transfer function?", ["modes.yaml"]),
    "frequencies": ("frequencies of a signal that step", ["frequencies.yaml"]),
    "measured": ("models of a measured record", ["measured.yaml", "measured-example.csv"]),
}


@guarded
def init(
    kinds: Annotated[
        list[str] | None, typer.Argument(metavar="KIND", help=f"{', '.join(TEMPLATES)}; all by default.")
    ] = None,
    force: Annotated[bool, flag("--force", "Overwrite files that exist.")] = False,
) -> None:
    """Write commented experiment files to begin with.

    They go into the current folder. Each runs as it is, in seconds, and says what every line of it means.
    """
    wanted = kinds or list(TEMPLATES)
    for kind in wanted:
        if kind not in TEMPLATES:
            near = did_you_mean(kind, TEMPLATES) or "."
            raise UsageError(f"there is no kind {kind!r}{near} Kinds: {', '.join(TEMPLATES)}")
    folder = resources.files("ctid_cli") / "templates"
    files = {Path(name): (folder / name).read_bytes() for kind in wanted for name in TEMPLATES[kind][1]}
    taken = [path for path in files if path.exists()]
    if taken and not force:
        there = f"{listed(taken)} {'are' if len(taken) > 1 else 'is'} here already"
        raise RefusedError(f"{there}, so that nothing was written; work in another folder, or add --force to overwrite")
    write_files(files)
    for kind in wanted:
        about, names = TEMPLATES[kind]
        typer.echo(f"{names[0]:20}  {about}{''.join(f' (with {name})' for name in names[1:])}")
    typer.echo(f"next: ctid run {TEMPLATES[wanted[0]][1][0]}, then ctid table {wanted[0]}")
