"""The commands that look after stored results: ``ctid merge``, ``verify`` and ``repair``."""

import json
from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import AllowMixed, Json, Out, answer, guarded
from ctid_cli.errors import MismatchError, UsageError


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
