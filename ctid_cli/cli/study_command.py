"""``ctid study``."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ctid_cli.cli._common import ComputingCommand, Fresh, Jobs, Out, Runs, guarded
from ctid_cli.cli.experiment_commands import run
from ctid_cli.errors import MismatchError

if TYPE_CHECKING:
    from ctid_cli.studies.catalogue import StudyFolder

Names = Annotated[list[str] | None, typer.Argument(metavar="[NAME]...", help="Studies; all of them by default.")]

study = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


@study.callback()
def _root() -> None:
    """Run a reproduced study, check its claims, and publish it."""


def _chosen(names: list[str] | None) -> list[StudyFolder]:
    from ctid_cli.studies.catalogue import all_studies, find_study

    return [find_study(name) for name in names or all_studies()]


@study.command("list")
@guarded
def list_studies() -> None:
    """Name the studies, with their experiments."""
    for item in _chosen(None):
        typer.echo(f"{item.name}: {item.title}")
        for name, config in item.configs.items():
            typer.echo(f"  {name}  configs/{config}")


@study.command("run", cls=ComputingCommand)
@guarded
def run_study(
    names: Names = None,
    runs: Runs = None,
    jobs: Jobs = None,
    out: Out = Path("results"),
    fresh: Fresh = False,
) -> None:
    """Run all experiments of a study; the same command again resumes."""
    from ctid_cli.studies.catalogue import last_part

    for item in _chosen(names):
        run([item.config(last_part(name)) for name in item.configs], jobs=jobs, runs=runs, out=out, fresh=fresh)


@study.command("check", cls=ComputingCommand)
@guarded
def check_study(
    names: Names = None,
    first: Annotated[bool, typer.Option("--first", help="Compare the first data sets with those committed.")] = False,
    update_first: Annotated[bool, typer.Option("--update-first", help="Commit to the first data sets anew.")] = False,
    jobs: Jobs = None,
    out: Out = Path("results"),
) -> None:
    """Say which claims of a study its results bear out, and which they did when it was published.

    Exit code 7 if one does not hold.
    """
    from ctid_cli.studies.catalogue import read_study
    from ctid_cli.studies.claim import claims_table
    from ctid_cli.studies.publishing import against_published, evaluate, published_folder

    if first or update_first:
        _compute_first(_chosen(names), update_first, jobs)
        return
    failed = 0
    for item in _chosen(names):
        claims = evaluate(read_study(item, out))
        typer.echo(f"{item.name}\n\n{claims_table(claims)}")
        changed = against_published(claims, published_folder(item))
        if changed:
            typer.echo(f"When they were published:\n\n{claims_table(changed)}")
        failed += sum(claim.holds is False for claim in claims)
    if failed:
        raise MismatchError(f"{failed} of the claims do not hold")


def _compute_first(studies: list[StudyFolder], update: bool, jobs: int | None) -> None:
    from ctid_cli.studies.first_estimates import Comparison, compare, compute_first, read_first, write_first

    wrong = []
    for item in studies:
        begun = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            found = compute_first(item, Path(folder), jobs)
        if update:
            write_first(item, found)
        compared = Comparison([], []) if update else compare(found, read_first(item))
        wrong += compared.wrong
        if compared.wrong:
            verdict = f"{len(compared.wrong)} of {len(found)} estimates differ from the committed ones"
        else:
            verdict = f"{len(found)} estimates {'written' if update else 'agree with the committed ones'}"
        typer.echo(f"{item.name}: {verdict} ({time.monotonic() - begun:.0f} s)")
        for line in compared.wrong:
            typer.echo(f"  {line}")
        for line in compared.largest:
            typer.echo(f"  largest difference: {line}")
    if wrong:
        raise MismatchError(f"{len(wrong)} of the first estimates are not as they were committed")


@study.command("publish")
@guarded
def publish_study(names: Names = None, out: Out = Path("results")) -> None:
    """Write tables, figures, claims and environment of a study to results/published.

    Refused unless one commit of this repository, without changes, computed all results. Exit code 7 if a claim does
    not hold, which is published nevertheless.
    """
    from ctid_cli.studies.catalogue import read_study
    from ctid_cli.studies.publishing import evaluate, publish, published_folder

    failed = []
    for item in _chosen(names):
        found = read_study(item, out)
        claims = evaluate(found)
        publish(found, claims, published_folder(item))
        typer.echo(published_folder(item))
        failed += [claim for claim in claims if claim.holds is False]
    if failed:
        raise MismatchError("\n".join(f"does not hold: {claim.experiment}, {claim.claim}" for claim in failed))
