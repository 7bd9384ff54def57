"""Results of ``ctid status``, ``verify``, ``merge`` and ``validate``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.inference.monte_carlo import CellPrecision, Widest
from ctid_cli.reporting.document import Result, Section, Table
from ctid_cli.reporting.layout import number, picked, rate
from ctid_cli.reporting.measures import SUCCESSES
from ctid_cli.reporting.results import out_option
from ctid_cli.storage.status import ExperimentStatus
from ctid_cli.text import count

if TYPE_CHECKING:
    from ctid_cli.storage.estimates import Estimates
    from ctid_cli.storage.merge import Merged
    from ctid_cli.storage.status import Verification

#: Most outcomes that texts list.
LISTED = 20
MIXED = "mixes code versions or processors"
_STATES = {"enough": "precise enough", "open": "goes on", "at_most": "at_most reached"}


# --- ctid status ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class StatusResult(Result):
    """Progress of one experiment, precision of its measures, and outcomes."""

    schema = "ctid-status-1"

    status: ExperimentStatus
    out: Path
    #: None if the estimates were not read.
    stored: Estimates | None = None
    precision: Sequence[CellPrecision] = ()

    @property
    def name(self) -> str:
        """Name of the experiment; a shard counts only its own data sets."""
        shard = self.status.shard
        return f"shard {shard[0]}/{shard[1]} of {self.status.experiment}" if shard else self.status.experiment

    @property
    def remark(self) -> str:
        """Whether it is running, unfinished or mixed."""
        status = self.status
        running = [_running(status.running)] if status.running is not None else ["unfinished"] * bool(status.todo)
        return "; ".join([*running, *([MIXED] if status.mixed else [])])

    def sections(self) -> list[Section]:
        """Return counts by estimator and data, precisions, and outcomes."""
        status = self.status
        head = f"{self.name} in {status.folder}: {status.done} of {status.planned} estimates done"
        sections = [Section(sentences=[head + (f" ({self.remark})" if self.remark else "")])]
        if status.groups:
            counts = ("done", "planned", "failed")
            groups = [{"estimator": each.estimator, **each.swept, **picked(each, counts)} for each in status.groups]
            sections.append(Section(table=Table.of_rows(groups)))
        sections += [Section(table=precision_table(self.precision))] if self.precision else []
        if self.stored is not None:
            found = self.outcomes()
            shown = found[:LISTED]
            notes = [f"{each['first']}: {each['reason']}" for each in shown if each["reason"]]
            notes += [f"and {len(found) - LISTED} more"] if len(found) > LISTED else []
            table = Table.of_rows([picked(each, ("estimator", "status", "estimates", "first")) for each in shown])
            sections += [Section(table=table), Section(notes=notes)]
        if status.left_aside:
            aside = f"{status.left_aside} stored estimates are set aside: the latest run has other settings."
            aside += " To see them, run their specification again; nothing is computed anew."
            sections.append(Section(sentences=[aside]))
        return [*sections, Section(sentences=self._next())]

    def outcomes(self) -> list[dict[str, Any]]:
        """Return the number of estimates of each estimator, status and reason."""
        assert self.stored is not None
        return outcomes_of(self.stored)

    def _next(self) -> list[str]:
        """Return the suggested next steps."""
        status = self.status
        name = status.folder.name if status.shard else status.experiment
        command = f"ctid table {name}{out_option(self.out)}"
        if status.todo and not status.running:
            return [f"To continue, run the same `ctid run` command again; so far: {command}"]
        return [f"Next: {command}"] if status.done else []

    def content(self) -> dict[str, Any]:
        """Return progress, precision and outcomes for JSON."""
        status = self.status
        content = asdict(status) | {"folder": str(status.folder), "todo": status.todo}
        before, after = ("estimator", "cell"), ("planned", "done", "todo", "failed")
        content["groups"] = [{**picked(one, before), **one.swept, **picked(one, after)} for one in status.groups]
        if self.precision:
            content["precision"] = [asdict(cell) for cell in self.precision]
        if self.stored is not None:
            content["outcomes"] = self.outcomes()
        return content


@dataclass(frozen=True, eq=False)
class Overview(Result):
    """Progress of every experiment in a folder."""

    experiments: Sequence[StatusResult]
    out: Path

    def sections(self) -> list[Section]:
        """Return one line for each experiment."""
        if not self.experiments:
            return [
                Section(
                    sentences=[f"There are no results in {self.out}. To make some: ctid run configs/quickstart.yaml"]
                )
            ]
        return [Section(table=self.main_table())]

    def main_table(self) -> Table:
        """Return one row for each experiment."""
        rows = []
        for one in self.experiments:
            counts = picked(one.status, ("done", "planned", "failed"))
            rows.append({"experiment": one.name, **counts, "set aside": one.status.left_aside, "": one.remark})
        return Table.of_rows(rows)

    def content(self) -> list[dict[str, Any]]:
        """Return the status of every experiment."""
        return [one.content() for one in self.experiments]


def _running(progress: Mapping[str, Any]) -> str:
    """Return who runs the experiment, since when, its progress, and its expected end."""
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


def outcomes_of(stored: Estimates) -> list[dict[str, Any]]:
    """Return the number of estimates of each estimator, status and reason, and the id of the first of them.

    The reason is the first line of the message, which continues with places in the code; successes have none.
    """
    names, of_name = np.unique(stored.column("estimator"), return_inverse=True)
    states, of_state = np.unique(stored.column("status"), return_inverse=True)
    failed = ~np.isin(states, [status.encode() for status in SUCCESSES])[of_state]
    reasons, of_reason = {"": 0}, np.zeros(of_state.size, dtype=int)
    texts = (text.partition("\n")[0] for text in stored.chosen(failed).values("message"))
    of_reason[failed] = [reasons.setdefault(text, len(reasons)) for text in texts]
    shape = names.size, states.size, len(reasons)
    groups = np.ravel_multi_index((of_name, of_state, of_reason), shape)
    found, first, sizes = np.unique(groups, return_index=True, return_counts=True)
    # The most frequent first; equally frequent ones in the order of their first estimates.
    order = np.lexsort((first, -sizes))
    places = zip(*np.unravel_index(found[order], shape), strict=True)
    ids, shown = np.char.decode(stored.column("id")[first[order]]), list(reasons)
    return [
        {
            "estimator": names[name].decode(),
            "status": states[state].decode(),
            "reason": shown[reason],
            "estimates": size,
            "first": one,
        }
        for (name, state, reason), size, one in zip(places, sizes[order].tolist(), ids.tolist(), strict=True)
    ]


# --- precision ------------------------------------------------------------------------------------------------------


def precision_table(cells: Sequence[CellPrecision]) -> Table:
    """Return every data cell with its widest interval."""
    rows = []
    for cell in cells:
        one = cell.widest
        widest = (_measure(one), _width(one), _required(one)) if one else ("-", "-", "-")
        counts = {"data sets": cell.finished, "needed": cell.needed}
        shown = dict(zip(("widest interval", "half-width", "required"), widest, strict=True))
        rows.append({**cell.swept, **counts, **shown, "": _STATES[cell.state]})
    return Table.of_rows(rows)


def block_sentence(cells: Sequence[CellPrecision]) -> str:
    """Return the result of a finished block; ``ctid status`` has the widest interval of each data cell."""
    more = [cell for cell in cells if cell.state == "open"]
    return f"{len(more)} of {len(cells)} data cells need more data sets, up to {max(c.needed for c in more)}"


def precision_sentence(cells: Sequence[CellPrecision]) -> str:
    """Return the result of a run: its data sets, and whether intervals are as narrow as requested."""
    if not cells or any(cell.state == "open" for cell in cells):
        return ""
    sizes, missed = [cell.needed for cell in cells], sum(cell.state == "at_most" for cell in cells)
    if missed:
        ended = f"{missed} of {len(cells)} data cells ended at {max(sizes)} data sets with wider intervals"
        return f"{ended}, which ctid status lists"
    several = " to ".join(dict.fromkeys((str(min(sizes)), str(max(sizes)))))
    return f"{several} data sets in each data cell: all intervals are as narrow as requested"


def _measure(widest: Widest) -> str:
    start = "" if widest.start == "none" else f", start {widest.start}"
    options = "".join(f", {name} = {number(value)}" for name, value in widest.options.items())
    of = f"rmse of {widest.parameter}" if widest.measure == "rmse" else "percentage"
    return f"{of} ({widest.estimator}{options}{start})"


def _width(widest: Widest) -> str:
    return "not known" if widest.half_width is None else _with_unit(widest.half_width, widest)


def _required(widest: Widest) -> str:
    return _with_unit(widest.asked, widest)


def _with_unit(half_width: float, widest: Widest) -> str:
    shown, unit = (100 * half_width, "%") if widest.measure == "rmse" else (half_width, "points")
    return f"± {shown:.3g} {unit}"


# --- ctid verify, merge and validate ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class VerificationResult(Result):
    """Whether the stored files of an experiment are intact."""

    schema = "ctid-verify-1"

    found: Verification
    out: Path

    def sections(self) -> list[Section]:
        """Return a line for each file."""
        verdict = "intact" if self.found.is_intact else "DAMAGED"
        files = Table.of_rows([asdict(finding) for finding in self.found.findings])
        return [Section(f"{self.content()['experiment']}: {verdict}", table=files)]

    def content(self) -> dict[str, Any]:
        """Return the findings for JSON."""
        about = {"experiment": self.found.folder.relative_to(self.out).as_posix(), "folder": str(self.found.folder)}
        return about | {"intact": self.found.is_intact, "findings": [asdict(each) for each in self.found.findings]}


@dataclass(frozen=True, eq=False)
class MergeResult(Result):
    """Outcome of a merge of shards."""

    schema = "ctid-merge-1"

    merged: Merged
    out: Path

    def sections(self) -> list[Section]:
        """Return counts, missing parts, and the next command."""
        merged = self.merged
        head = f"{merged.experiment}: {merged.stored} of {merged.planned} estimates in {merged.folder}"
        lines = [f"{head} ({merged.new} new, from {merged.sources} folders)"]
        lines += [f"  they {MIXED.replace('mixes', 'mix')}, which tables note"] if merged.mixed else []
        lines += [f"  {merged.missing}"] if merged.missing else []
        lines.append(f"  next: ctid table {merged.experiment}{out_option(self.out)}")
        return [Section(lines=lines)]

    def content(self) -> dict[str, Any]:
        """Return the outcome for JSON."""
        return asdict(self.merged) | {"folder": str(self.merged.folder)}


@dataclass(frozen=True, eq=False)
class ValidationResult(Result):
    """Amount of work of a specification without mistakes."""

    schema = "ctid-validate-1"

    file: Path
    experiment: str
    data_sets: int
    data_cells: int
    estimates: int
    #: Most data sets of a cell, if their number follows from a precision.
    at_most: int | None
    warnings: Sequence[str] = ()
    #: Whether data are simulated, and none of them with noise.
    without_noise: bool = False

    def sections(self) -> list[Section]:
        """Return the counts in one sentence, and whether there is no noise."""
        counts = f"{count(self.data_sets, 'data set')} ({count(self.data_cells, 'data cell')})"
        text = f"{self.file}: ok, {self.experiment}: {counts}, {count(self.estimates, 'estimate')}"
        text += "" if self.at_most is None else f"; at most {self.at_most} data sets of a cell"
        noise_free = ["  The data are without noise: the file has no section noise."] * self.without_noise
        return [Section(lines=[text, *noise_free])]

    def content(self) -> dict[str, Any]:
        """Return the counts for JSON."""
        return asdict(self) | {"file": str(self.file)}
