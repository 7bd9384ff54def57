"""What ``ctid status`` answers: how much of an experiment is done, and what went wrong."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ctid_cli.inference.monte_carlo import CellPrecision
from ctid_cli.reporting.layout import Table, number, picked, rate
from ctid_cli.reporting.precision_words import precision_table
from ctid_cli.reporting.results import out_option
from ctid_cli.storage.columns import FAILURES
from ctid_cli.storage.status import ExperimentStatus

#: Failed estimates that the text lists.
LISTED = 10
#: Columns that the text says something of.
OF_STATUS = ("id", "estimator", "replicate", "start", "status", "message")


def status_object(
    status: ExperimentStatus,
    precision: Sequence[CellPrecision] = (),
) -> dict[str, Any]:
    """Progress of an experiment for ``ctid status --json``, without its estimates."""
    content = asdict(status) | {"folder": str(status.folder), "todo": status.todo}
    before, after = ("estimator", "cell"), ("planned", "done", "todo", "failed")
    content["groups"] = [{**picked(group, before), **group.swept, **picked(group, after)} for group in status.groups]
    return content | ({"precision": [asdict(cell) for cell in precision]} if precision else {})


def overview_text(found: Sequence[ExperimentStatus]) -> str:
    """One line per experiment."""
    rows = [
        [_name(item), *map(number, (item.done, item.planned, item.failed, item.left_aside)), _remark(item)]
        for item in found
    ]
    return Table(["experiment", "done", "planned", "failed", "set aside", ""], rows, "lrrrrl").draw()


def status_text(
    status: ExperimentStatus,
    estimates: Iterable[Mapping[str, Any]],
    out: Path,
    precision: Sequence[CellPrecision] = (),
) -> str:
    """Progress of one experiment: by estimator and data, by precision, by outcome, and the first failures."""
    remark = _remark(status)
    blocks = [f"{_name(status)} in {status.folder}: {status.done} of {status.planned} estimates done"]
    blocks[0] += f" ({remark})" if remark else ""
    if status.groups:
        swept = list(dict.fromkeys(name for group in status.groups for name in group.swept))
        rows = [
            [group.estimator, *map(number, (*map(group.swept.get, swept), group.done, group.planned, group.failed))]
            for group in status.groups
        ]
        header = ["estimator", *swept, "done", "planned", "failed"]
        blocks.append(Table(header, rows, "l" * (1 + len(swept)) + "rrr").draw())
    if precision:
        blocks.append(precision_table(precision).draw())
    if outcomes := _outcomes(estimates):
        blocks.append("\n".join(outcomes))
    if status.left_aside:
        blocks.append(f"{status.left_aside} stored estimates are set aside: the latest run asked for others.")
    command = f"ctid table {status.folder.name if status.shard else status.experiment}{out_option(out)}"
    if status.todo and not status.running:
        blocks.append(f"To continue, run the same `ctid run` command again; so far: {command}")
    elif status.done:
        blocks.append(f"Next: {command}")
    return "\n\n".join(blocks)


def _outcomes(estimates: Iterable[Mapping[str, Any]]) -> list[str]:
    """How often each status came, and the first failures."""
    outcomes: Counter[tuple[str, str]] = Counter()
    failures: list[Mapping[str, Any]] = []
    failed = 0
    for row in estimates:
        outcomes[str(row["status"]), sentence_of(row)] += 1
        if row["status"] in FAILURES:
            failed += 1
            if len(failures) < LISTED:
                failures.append(row)
    lines = [f"{n} {name}" + ("" if name in FAILURES else f": {text}") for (name, text), n in outcomes.most_common()]
    for row in failures:
        place = f"{row['estimator']}, replicate {row['replicate']}, start {row['start']}"
        lines.append(f"  {row['id']}  {place}: {sentence_of(row)}")
    return [*lines, f"  and {failed - LISTED} more"] if failed > LISTED else lines


def sentence_of(row: Mapping[str, Any]) -> str:
    """How an estimate ended, in a sentence."""
    # A failure's message goes on with the places in the code that it came from.
    return str(row.get("message") or "").split("\n", 1)[0]


def _running(progress: Mapping[str, Any]) -> str:
    """Who runs, since when, how far it is, and when it will have ended."""
    if progress["pid"] is None:
        return "running now"
    words = [f"running now: process {progress['pid']} on {progress['host']}"]
    if "started" in progress:
        words.append(f"since {progress['started']}")
    if "total" in progress:
        words.append(f"{progress['done']} of {progress['total']} data sets")
    if progress.get("data_sets_per_second") is not None:
        words += [rate(progress["data_sets_per_second"]), f"to end about {progress['expected_end']}"]
    return ", ".join(words)


def _name(status: ExperimentStatus) -> str:
    """What the numbers are of: a shard has only those of its own data sets."""
    return f"shard {status.shard[0]}/{status.shard[1]} of {status.experiment}" if status.shard else status.experiment


def _remark(status: ExperimentStatus) -> str:
    remarks = []
    if status.running is not None:
        remarks.append(_running(status.running))
    elif status.todo:
        remarks.append("unfinished")
    if status.mixed:
        remarks.append("mixes code versions or processors")
    return "; ".join(remarks)
