"""What ``ctid status`` answers: how much of an experiment is done, and what went wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ctid_cli.reporting.estimate import as_object
from ctid_cli.reporting.layout import number, text_table
from ctid_cli.reporting.results import out_option
from ctid_cli.storage.manifest import FAILURES
from ctid_cli.storage.store import ExperimentStatus

#: Failed estimates that the text lists.
LISTED = 10


def status_object(status: ExperimentStatus, estimates: Sequence[Mapping[str, Any]] | None) -> dict[str, Any]:
    """Progress of an experiment for ``ctid status --json``."""
    counts = {
        "experiment": status.experiment,
        "folder": str(status.folder),
        "planned": status.planned,
        "done": status.done,
        "todo": status.todo,
        "failed": status.failed,
        "left_aside": status.left_aside,
        "mixed": status.mixed,
        "running": status.running,
        "groups": [
            {
                "estimator": group.estimator,
                "cell": group.cell,
                **group.swept,
                "planned": group.planned,
                "done": group.done,
                "todo": group.todo,
                "failed": group.failed,
            }
            for group in status.groups
        ],
    }
    return counts if estimates is None else counts | {"estimates": [as_object(row) for row in estimates]}


def overview_text(found: Sequence[ExperimentStatus]) -> str:
    """One line per experiment."""
    header = ["experiment", "done", "planned", "failed", "left aside", ""]
    rows = [
        [item.experiment, str(item.done), str(item.planned), str(item.failed), number(item.left_aside), _remark(item)]
        for item in found
    ]
    return text_table(header, rows, "lrrrrl")


def status_text(status: ExperimentStatus, estimates: Sequence[Mapping[str, Any]], out: Path) -> str:
    """Progress of one experiment: by estimator and data, by outcome, and the first failures."""
    lines = [f"{status.experiment} in {status.folder}: {status.done} of {status.planned} estimates done"]
    remark = _remark(status)
    if remark:
        lines[0] += f" ({remark})"
    swept = list(dict.fromkeys(name for group in status.groups for name in group.swept))
    rows = [
        [
            group.estimator,
            *(number(group.swept.get(name)) for name in swept),
            *(str(count) for count in (group.done, group.planned, group.failed)),
        ]
        for group in status.groups
    ]
    if rows:
        header = ["estimator", *swept, "done", "planned", "failed"]
        lines += ["", text_table(header, rows, "l" * (1 + len(swept)) + "rrr")]
    outcomes = Counter((str(row["status"]), _sentence(row)) for row in estimates)
    if outcomes:
        lines.append("")
        for (name, sentence), count in outcomes.most_common():
            lines.append(f"{count} {name}" + ("" if name in FAILURES else f": {sentence}"))
    failures = [row for row in estimates if row["status"] in FAILURES]
    for row in failures[:LISTED]:
        lines.append(
            f"  {row['id']}  {row['estimator']}, replicate {row['replicate']}, start {row['start']}: {_sentence(row)}"
        )
    if len(failures) > LISTED:
        lines.append(f"  and {len(failures) - LISTED} more")
    if status.left_aside:
        reason = "the latest run asked for other settings or fewer data sets"
        lines += ["", f"{status.left_aside} stored estimates are left aside: {reason}."]
    option = out_option(out)
    if status.todo and not status.running:
        lines += [
            "",
            f"To go on, run the same `ctid run` command again; so far: ctid table {status.experiment}{option}",
        ]
    elif status.done:
        lines += ["", f"Next: ctid table {status.experiment}{option}"]
    return "\n".join(lines)


def _sentence(row: Mapping[str, Any]) -> str:
    # A failure's message goes on with the places in the code that it came from.
    return str(row.get("message") or "").split("\n", 1)[0]


def _remark(status: ExperimentStatus) -> str:
    remarks = []
    if status.running is not None:
        progress = status.running
        counts = f", {progress['done']} of {progress['total']} data sets" if "total" in progress else ""
        remarks.append(f"running now: process {progress.get('pid')} on {progress.get('host')}{counts}")
    elif status.todo:
        remarks.append("unfinished")
    if status.mixed:
        remarks.append("mixes code versions or processors")
    return "; ".join(remarks)
