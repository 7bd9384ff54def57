"""Commands on experiment files: ``ctid init``, ``validate``, ``accuracy``, ``run`` and ``schema``."""

from __future__ import annotations

import gc
import json
import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ctid_cli.cli._common import (
    AllowCode,
    AllowMixed,
    AllowOutside,
    Config,
    Configs,
    Fresh,
    Jobs,
    Out,
    Overrides,
    Runs,
    duration,
    emit,
    guarded,
    printable,
    require_within,
    write_files,
)
from ctid_cli.cli._options import FormatOptions, flag
from ctid_cli.cli._progress import RunReport
from ctid_cli.errors import ExitCode, Problem, RefusedError, SpecError, TooManyFailuresError, UsageError
from ctid_cli.progress import doing
from ctid_cli.reporting.layout import seconds
from ctid_cli.text import count, did_you_mean, listed

if TYPE_CHECKING:
    from ctid_cli.running.engine import RunSummary
    from ctid_cli.running.plan import Plan
    from ctid_cli.storage.manifest import Shard


#: Reasons why a run ended early; signals have their names.
_STOPPED = {
    "time budget": "stopped at the end of the time budget",
    "failures": "stopped at the number of failures that --max-failures allows",
    "machine": "stopped because this machine could not finish all estimates",
}
#: Most changed settings that are listed.
CHANGES = 3

Dask = Annotated[
    str | None,
    flag("--dask", "Compute with the workers of the dask scheduler at tcp://host:port.", "ADDRESS"),
]


#: How a stored estimate failed.
Failure = StrEnum("Failure", ["failed", "timeout", "crashed", "memory"])


@dataclass(frozen=True)
class SpecOptions:
    """Options for reading specifications."""

    overrides: Overrides = None
    allow_code: AllowCode = False
    allow_outside: AllowOutside = False

    def plans(self, configs: Sequence[Path], runs: int | None = None) -> list[tuple[Path, Plan]]:
        """Read and check specifications; warnings go to stderr."""
        from ctid_cli.running.plan import build_plan
        from ctid_cli.running.trial import load_tried

        problems: list[Problem] = []
        plans: list[tuple[Path, Plan]] = []
        allowed = {"allow_code": self.allow_code, "allow_outside": self.allow_outside}
        for config in configs:
            try:
                plans.append((config, build_plan(load_tried(config, self.overrides or [], **allowed), runs)))
            except SpecError as error:
                problems += error.problems
        if problems:
            raise SpecError(problems)
        seen: dict[str, Path] = {}
        for config, plan in plans:
            if plan.experiment in seen:
                both = f"{seen[plan.experiment]} and {config} both describe the experiment {plan.experiment!r}"
                raise UsageError(f"{both}; run them one at a time, or give one of them another name")
            seen[plan.experiment] = config
            self.warn(plan)
        return plans

    def warn(self, plan: Plan) -> None:
        """Print warnings of a specification."""
        for warning in plan.spec.warnings:
            typer.echo(printable(f"warning: {warning}"), err=True)


@dataclass(frozen=True)
class PlaceOptions:
    """Folder of results, and treatment of existing ones."""

    out: Out = Path("results")
    fresh: Fresh = False
    keep_readable: Annotated[
        bool, flag("--keep-readable", "With --fresh: keep what can be read of damaged results.")
    ] = False
    allow_mixed: AllowMixed = False
    retry: Annotated[
        list[Failure] | None,
        flag("--retry", "Compute failed, timeout, crashed or memory estimates again; repeatable.", "KIND"),
    ] = None

    @property
    def treatment(self) -> dict[str, Any]:
        """Treatment of existing results, as options of a run."""
        retry = [kind.upper() for kind in self.retry or ()]
        return {"fresh": self.fresh, "allow_mixed": self.allow_mixed, "retry": retry}


@dataclass(frozen=True)
class EndOptions:
    """Conditions that end a run early."""

    max_failures: Annotated[int | None, flag("--max-failures", "Stop when N estimates have failed.", "N", min=1)] = None
    time_budget: Annotated[
        float | None,
        flag("--time-budget", "Stop after e.g. 90s, 30m or 1h30m.", "TIME", parser=duration),
    ] = None


@guarded
def run(
    configs: Configs,
    spec: SpecOptions,
    place: PlaceOptions,
    end: EndOptions,
    jobs: Jobs = None,
    runs: Runs = None,
    shard: Annotated[
        str | None,
        flag("--shard", "Only the K-th of N equal parts; ctid merge joins them.", "K/N"),
    ] = None,
    dask: Dask = None,
    dry_run: Annotated[bool, flag("--dry-run", "Print what would be computed, without computing it.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no summary.")] = False,
) -> None:
    """Run experiments; the same command again resumes.

    Finished estimates are stored as they come, so nothing is lost when a run is stopped or killed. A section limits of
    the file, or for example --set limits.wall_seconds=600, ends single estimates that take too much.
    """
    from ctid_cli.running.engine import preview
    from ctid_cli.storage.manifest import Shard

    if place.keep_readable and not place.fresh:
        raise UsageError("--keep-readable goes with --fresh")
    plans, part = [plan for _, plan in spec.plans(configs, runs)], None if shard is None else Shard.read(shard)
    if part is not None:
        plans = [plan.part(part) for plan in plans]
    folders = [place.out / (plan.experiment if part is None else part.folder(plan.experiment)) for plan in plans]
    require_within(place.out, *folders)
    if dry_run:
        for plan, folder in zip(plans, folders, strict=True):
            typer.echo(f"{plan.experiment}, into {folder}: {preview(plan, folder, **place.treatment)}")
        return
    # Imported objects stay: scanning them for garbage again and again takes a tenth of exporting many estimates.
    gc.freeze()
    summaries = _run_all(plans, folders, place, end, jobs=jobs, dask=dask, quiet=quiet, part=part)
    failed = [
        f"{one.experiment}: all {one.planned} estimates failed" for one in summaries if one.failed == one.planned > 0
    ]
    if failed:
        raise TooManyFailuresError("\n".join(failed))


def _run_all(
    plans: Sequence[Plan],
    folders: Sequence[Path],
    place: PlaceOptions,
    end: EndOptions,
    *,
    quiet: bool,
    part: Any,
    **how: Any,
) -> list[RunSummary]:
    """Run one experiment after the other, until one ends early."""
    from ctid_cli.running.engine import run_experiment
    from ctid_cli.running.limits import StopRequest

    summaries, ends = [], None if end.time_budget is None else time.monotonic() + end.time_budget
    how |= place.treatment | {"keep_readable": place.keep_readable}
    for plan, folder in zip(plans, folders, strict=True):
        left = None if ends is None else max(ends - time.monotonic(), 0.0)
        stop = StopRequest(failures=end.max_failures, seconds=left)
        with doing(plan.experiment):
            told = RunReport(plan.experiment, quiet=quiet)
            summary = run_experiment(plan, folder, stop=stop, progress=told, **how)
        if not quiet:
            typer.echo(_conclusion(summary, place.out, part))
        if changed := _changed(plan, summary):
            typer.echo(printable(f"warning: {changed}"), err=True)
        if summary.exit_code == ExitCode.MACHINE:
            raise summary.machine_error()
        if summary.exit_code:
            raise typer.Exit(summary.exit_code)
        summaries.append(summary)
    return summaries


def _conclusion(summary: RunSummary, out: Path, part: Shard | None) -> str:
    from ctid_cli.reporting.results import out_option
    from ctid_cli.reporting.status_result import precision_sentence
    from ctid_cli.reporting.study import tables_of

    stored, option = summary.reused + summary.computed, out_option(out)
    text = f"{summary.experiment}: {stored} of {summary.planned} estimates stored in {summary.folder}"
    lines = [f"{text} ({summary.computed} new, in {seconds(summary.seconds)})"]
    if summary.moved_aside is not None:
        lines.append(f"  older results are now in {summary.moved_aside}")
    if summary.mixed:
        lines.append("  they mix code versions or processors, which tables note")
    if precision := precision_sentence(summary.precision):
        lines.append(f"  {precision}")
    if summary.failed:
        lines.append(f"  {summary.failed} failed; to see why: ctid status {summary.experiment}{option}")
    if summary.stopped_by is not None:
        why = _STOPPED.get(summary.stopped_by, f"stopped by {summary.stopped_by}")
        lines.append(f"  {why}; run the same command again to compute the rest")
    if part is not None:
        return "\n".join([*lines, f"  {part}; when all are done: ctid merge {shlex.quote(str(out))}{option}"])
    name = " ".join(str(number) for number in tables_of(summary.experiment)) or summary.experiment
    return "\n".join([*lines, f"  next: ctid table {name}{option}"])


def _changed(plan: Plan, summary: RunSummary) -> str:
    """Return the settings that have changed since the estimates set aside were stored; empty if there are none."""
    from ctid_cli.reporting.results import differences

    if not summary.left_aside or summary.former is None:
        return ""
    changed = differences(plan.spec.canonical(), summary.former, ())
    if not changed:
        return ""
    more = f"; and {len(changed) - CHANGES} more" if len(changed) > CHANGES else ""
    text = (
        f"{count(summary.left_aside, 'stored estimate')} of {summary.experiment} set aside, not deleted: this run has "
    )
    return (
        f"{text}{'; '.join(changed[:CHANGES])}{more}. To see them, run their specification again, which computes "
        "nothing anew; to keep both in view, give one of them another name (experiment: NAME)"
    )


@guarded
def validate(configs: Configs, spec: SpecOptions, form: FormatOptions) -> None:
    """Check experiment files without running them.

    Prints every mistake with its place in the file, or the amount of work of the experiment.
    """
    from ctid_cli.reporting.status_result import ValidationResult

    for config, plan in spec.plans(configs):
        section, sets = plan.spec.monte_carlo, plan.data_sets
        at_most = section.most if section is not None and section.until is not None else None
        cells, estimates = len(plan.data_cells), sets * plan.estimates_each
        # Measured records and signals have no such field.
        noise_free = all(getattr(cell.source, "noise", True) is None for cell in plan.data_cells)
        warnings = list(plan.spec.warnings)
        emit(
            ValidationResult(config, plan.experiment, sets, cells, estimates, at_most, warnings, noise_free), form.form
        )


@guarded
def schema(
    section: Annotated[str | None, typer.Argument(metavar="SECTION", help="A section or kind, with --text.")] = None,
    as_text: Annotated[bool, flag("--text", "Write a readable reference instead of JSON.")] = False,
) -> None:
    """Print the JSON Schema of experiment files, or a reference.

    With --text the reference: type, unit, default, allowed values and meaning of every key, or of those of one
    section or kind, for example `ctid schema --text sampling` or `ctid schema --text td_srivc`.
    """
    from ctid_cli.specification.load import json_schema
    from ctid_cli.specification.reference import reference_text

    if section is not None and not as_text:
        raise UsageError(f"a part of the schema is there as text only; write: ctid schema --text {section}")
    typer.echo(reference_text(section) if as_text else json.dumps(json_schema(), indent=2))


@guarded
def accuracy(
    config: Config,
    spec: SpecOptions,
    form: FormatOptions,
    out: Out = Path("results"),
) -> None:
    """Compute the expected standard errors of an experiment.

    No data are needed.

    For every estimator and the swept numbers of samples: the standard error of each parameter by theory, with its
    formula. White Gaussian excitation on a regular clock has a limit for long records; otherwise the sensitivities of
    the experiment's first data sets are used. If the experiment has results in OUT, their deviations from theory come
    last.
    """
    from ctid_cli.reporting.accuracy_result import AccuracyResult
    from ctid_cli.reporting.results import find_results

    ((_, plan),) = spec.plans([config])
    emit(AccuracyResult.of(plan, find_results(out, plan.experiment)), form.form)


#: Kinds of example experiment files, each with its subject and its files in the folder ``templates``; the first file is
#: the specification, and its experiment has the name of the kind.
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
    """Write experiment files with comments, as a start.

    They go into the current folder. Each runs unchanged, in seconds, and explains every line.
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
