"""``ctid reproduce``: the published studies, run, checked and published."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ctid_cli.cli._common import Fresh, Jobs, Out, Runs, emit, guarded
from ctid_cli.cli._options import FormatOptions, flag
from ctid_cli.cli.experiment_commands import EndOptions, PlaceOptions, SpecOptions, run
from ctid_cli.errors import MismatchError, UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ctid_cli.reporting.study import Study
    from ctid_cli.running.plan import Plan


@dataclass(frozen=True)
class Actions:
    """Actions in place of running the studies; one at a time."""

    list: Annotated[bool, flag("--list", "List the studies with their experiments.")] = False
    check: Annotated[bool, flag("--check", "Test the claims, and compare the tables with those committed.")] = False
    first: Annotated[bool, flag("--first", "Compute the first data sets, and compare with those committed.")] = False
    update_first: Annotated[
        bool, flag("--update-first", "Compute the first data sets, and store them as the reference.")
    ] = False
    publish: Annotated[
        bool, flag("--publish", "Write tables, figures, claims and environment to results/published.")
    ] = False

    @property
    def chosen(self) -> str:
        """Name of the action, ``run`` if none is given."""
        given = [action.name for action in fields(self) if getattr(self, action.name)]
        if len(given) > 1:
            names = " and ".join(f"--{name.replace('_', '-')}" for name in given)
            raise UsageError(f"{names} exclude each other; give one of them")
        return given[0] if given else "run"


@dataclass(frozen=True)
class PublishedSpecs(SpecOptions):
    """Specifications of studies, whose warnings are not shown."""

    def warn(self, plan: Plan) -> None:
        """Print nothing."""


@guarded
def reproduce(
    actions: Actions,
    form: FormatOptions,
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME", help="Studies, or experiments as --list names them; all by default."),
    ] = None,
    runs: Runs = None,
    jobs: Jobs = None,
    out: Out = Path("results"),
    fresh: Fresh = False,
) -> None:
    """Run the published studies; the same command again resumes.

    With --check their claims are tested and their tables compared with those that are committed and with the paper
    (exit code 7 if one does not hold). --publish is refused unless one commit of this repository, without changes,
    computed all results. A study runs the code that its own specifications name, as part of the repository.
    """
    from ctid_cli.reporting.study import find_studies, last_part

    studies = find_studies(names or [])
    if actions.chosen in ("publish", "first", "update_first"):
        _require_whole(studies)
    match actions.chosen:
        case "list":
            _list(studies, form)
        case "check":
            _check(studies, out, form)
        case "publish":
            _publish(studies, out)
        case "run":
            for study in studies:
                configs = [study.config(last_part(name)) for name in study.configs]
                place = PlaceOptions(out=out, fresh=fresh)
                run(configs, spec=PublishedSpecs(), place=place, end=EndOptions(), jobs=jobs, runs=runs)
        case first:
            _compute_first(studies, jobs, update=first == "update_first")


def _require_whole(studies: Sequence[Study]) -> None:
    """Refuse a part of a study if only the whole study can be published or compared."""
    from ctid_cli.reporting.study import find_study

    for study in studies:
        if study.configs != find_study(study.name).configs:
            raise UsageError(f"--publish, --first and --update-first take whole studies; write {study.name}")


def _list(studies: Sequence[Study], form: FormatOptions) -> None:
    """Print the subject of each study, and the experiments of all."""
    from ctid_cli.reporting.document import Section, Table
    from ctid_cli.reporting.table_result import TableResult

    rows = [
        {"study": study.name, "experiment": experiment, "specification": config}
        for study in studies
        for experiment, config in study.configs.items()
    ]
    titles = [f"- {study.name}: {study.title}" for study in studies]
    table = Table.of_rows([{key: row[key] for key in ("experiment", "specification")} for row in rows])
    emit(TableResult(rows, [Section("", titles, table, notes=["Specifications are in configs."])]), form.form)


def _check(studies: Sequence[Study], out: Path, form: FormatOptions) -> None:
    """Test the claims of studies, and compare the tables of the one that has any."""
    from ctid_cli.reporting.comparison_result import check_tables
    from ctid_cli.reporting.study import tables_of
    from ctid_cli.studies.catalogue import read_study
    from ctid_cli.studies.claims import check_claims

    failed = []
    for study in studies:
        found = check_claims(read_study(study, out))
        emit(found, form.form)
        failed += [f"{study.name}: {len(found.failed)} claims do not hold"] if found.failed else []
        tables = sorted({str(number) for name in study.configs for number in tables_of(name)})
        if tables:
            comparison = check_tables(tables, out)
            emit(comparison, form.form)
            failed += [] if comparison.mismatches.empty else [comparison.verdict]
    if failed:
        raise MismatchError("; ".join(failed))


def _publish(studies: Sequence[Study], out: Path) -> None:
    """Publish studies, also with claims that do not hold."""
    from ctid_cli.studies.catalogue import read_study
    from ctid_cli.studies.claims import check_claims
    from ctid_cli.studies.publishing import publish

    failed = []
    for study in studies:
        found = check_claims(read_study(study, out))
        publish(found, out)
        typer.echo(study.published)
        failed += [f"does not hold: {claim.experiment}, {claim.claim}" for claim in found.failed]
    if failed:
        raise MismatchError("\n".join(failed))


def _compute_first(studies: Sequence[Study], jobs: int | None, *, update: bool) -> None:
    """Compute the first data sets of studies, and compare them with the committed ones or replace those."""
    from ctid_cli.studies.first_estimates import compare, compute_first, read_first, write_first

    wrong = 0
    for study in studies:
        begun = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            found = compute_first(study, Path(folder), jobs)
        if update:
            write_first(study, found)
            typer.echo(f"{study.name}: {len(found)} estimates written ({time.monotonic() - begun:.0f} s)")
            continue
        compared = compare(found, read_first(study))
        verdict = f"{len(compared.wrong)} of {len(found)} estimates differ from the committed ones"
        if not compared.wrong:
            verdict = f"{len(found)} estimates agree with the committed ones"
        typer.echo(f"{study.name}: {verdict} ({time.monotonic() - begun:.0f} s)")
        for line in (*compared.wrong, *(f"largest difference: {line}" for line in compared.largest)):
            typer.echo(f"  {line}")
        wrong += len(compared.wrong)
    if wrong:
        raise MismatchError(f"{wrong} of the first estimates are not as they were committed")
