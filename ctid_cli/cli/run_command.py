"""``ctid run``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ctid_cli.cli._common import Out, Overrides, guarded

if TYPE_CHECKING:
    from ctid_cli.running.engine import RunSummary
    from ctid_cli.running.events import Event, PlanReady


@guarded
def run(
    configs: Annotated[list[Path], typer.Argument(metavar="CONFIG", help="Experiment files (YAML).")],
    jobs: Annotated[
        int | None, typer.Option("--jobs", "-j", min=1, help="Worker processes; all processors by default.")
    ] = None,
    runs: Annotated[
        int | None, typer.Option("--runs", min=1, help="Data sets per setting, instead of the file's own number.")
    ] = None,
    overrides: Overrides = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be computed, and stop.")] = False,
    out: Out = Path("results"),
    fresh: Annotated[bool, typer.Option("--fresh", help="Move older results aside and start anew.")] = False,
    allow_mixed: Annotated[
        bool, typer.Option("--allow-mixed", help="Add to results of another code version or processor.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no summary.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Write one JSON object per line to stdout.")] = False,
) -> None:
    """Run experiments; the same command again resumes.

    Finished estimates are stored as they come, so nothing is lost when a run is stopped or killed.
    """
    from ctid_cli.cli._planning import load_plans
    from ctid_cli.cli._progress import Reporter, json_lines
    from ctid_cli.errors import TooManyFailuresError
    from ctid_cli.running.engine import preview, run_experiment

    plans = load_plans(configs, overrides or [], runs)
    if dry_run:
        previews = [preview(plan, out / plan.experiment, fresh=fresh, allow_mixed=allow_mixed) for _, plan in plans]
        for ready in previews:
            typer.echo(json_lines(ready)[0] if as_json else _intention(ready))
        return
    hopeless = []
    for _, plan in plans:
        with Reporter(plan.experiment) as reporter:

            def tell(event: Event, show: Reporter = reporter) -> None:
                if as_json:
                    for line in json_lines(event):
                        typer.echo(line)
                if not quiet:
                    show(event)

            summary = run_experiment(
                plan, out / plan.experiment, jobs=jobs, on_event=tell, fresh=fresh, allow_mixed=allow_mixed
            )
        if as_json:
            typer.echo(_summary_line(summary))
        if not quiet:
            typer.echo(_conclusion(summary, out), err=as_json)
        if summary.exit_code:
            raise typer.Exit(summary.exit_code)
        if summary.failed == summary.planned:
            hopeless.append(f"{plan.experiment}: all {summary.planned} estimates failed")
    if hopeless:
        raise TooManyFailuresError("\n".join(hopeless))


def _intention(ready: PlanReady) -> str:
    from ctid_cli.reporting.layout import count

    left = f", {ready.left_aside} stored ones set aside" if ready.left_aside else ""
    return (
        f"{ready.experiment}: would compute {count(ready.estimates, 'estimate')}"
        f" of {count(ready.data_sets, 'data set')} into {ready.folder}; {ready.reused} are already stored{left}"
    )


def _summary_line(summary: RunSummary) -> str:
    import json
    from dataclasses import asdict

    content = {key: str(value) if isinstance(value, Path) else value for key, value in asdict(summary).items()}
    return json.dumps({"event": "summary", **content, "missing": summary.missing, "exit_code": summary.exit_code})


def _conclusion(summary: RunSummary, out: Path) -> str:
    from ctid_cli.reporting.layout import seconds
    from ctid_cli.reporting.results import out_option
    from ctid_cli.reporting.study import tables_of

    option = out_option(out)
    stored = summary.reused + summary.computed
    lines = [
        f"{summary.experiment}: {stored} of {summary.planned} estimates stored in {summary.folder}"
        f" ({summary.computed} new, in {seconds(summary.seconds)})"
    ]
    if summary.moved_aside is not None:
        lines.append(f"  older results are now in {summary.moved_aside}")
    if summary.mixed:
        lines.append("  they mix code versions or processors, which tables will say")
    if summary.failed:
        lines.append(f"  {summary.failed} failed; to see why: ctid status {summary.experiment}{option}")
    if summary.stopped_by is not None:
        lines.append(f"  stopped by {summary.stopped_by}; run the same command again to compute the rest")
    name = " ".join(str(number) for number in tables_of(summary.experiment)) or summary.experiment
    lines.append(f"  next: ctid table {name}{option}")
    return "\n".join(lines)
