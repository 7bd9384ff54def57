"""The commands that look after stored results: ``ctid merge`` and ``ctid verify``."""

from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import AllowMixed, Out, emit, guarded
from ctid_cli.cli._options import FormatOptions, flag
from ctid_cli.errors import MismatchError, UsageError


@guarded
def merge(
    form: FormatOptions,
    folders: Annotated[
        list[Path], typer.Argument(metavar="FOLDER", help="Folders of shards, or folders that hold some.")
    ],
    out: Out = Path("results"),
    allow_mixed: AllowMixed = False,
    partial: Annotated[bool, flag("--partial", "Merge although some estimates are missing.")] = False,
) -> None:
    """Merge the shards of experiments into one folder of results.

    `ctid run --shard K/N` computes one of N shards. Merged in whatever order, they give the runs.h5 of a single run,
    byte for byte. The folders of the shards stay as they are.
    """
    from ctid_cli.reporting.status_result import MergeResult
    from ctid_cli.storage.merge import find_sources, merge_all

    for merged in merge_all(find_sources(folders), out, allow_mixed=allow_mixed, partial=partial):
        emit(MergeResult(merged, out), form.form)


@guarded
def verify(
    form: FormatOptions,
    names: Annotated[
        list[str] | None, typer.Argument(metavar="NAME", help="Experiments (quickstart); all by default.")
    ] = None,
    out: Out = Path("results"),
) -> None:
    """Check what is stored of experiments.

    The journal with every estimate in it, and runs.h5. Exit code 7 if anything is damaged or missing. Nothing is
    changed: `ctid run --fresh --keep-readable` moves damaged results aside, keeps what can be read and computes the
    rest.
    """
    from ctid_cli.reporting.results import experiments_in, stored_folder
    from ctid_cli.reporting.status_result import VerificationResult
    from ctid_cli.storage.status import verify as check

    found = [check(stored_folder(out, name)) for name in dict.fromkeys(names or experiments_in(out))]
    if not found:
        raise UsageError(f"there are no results in {out}")
    for number, item in enumerate(found):
        typer.echo("", nl=number > 0 and form.form != "json")
        emit(VerificationResult(item, out), form.form)
    wrong = [item.folder for item in found if not item.is_intact]
    if wrong:
        raise MismatchError(f"not as it was written: {', '.join(map(str, wrong))}")
