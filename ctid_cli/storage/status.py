"""Progress of experiments, search for an estimate, and verification of stored files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ctid_cli.errors import CtidError, DamageError, UsageError
from ctid_cli.progress import reported
from ctid_cli.storage import columns
from ctid_cli.storage import folder as folders
from ctid_cli.storage.estimates import Estimates, read_stored, stored_in
from ctid_cli.storage.export import open_export, sha256_of
from ctid_cli.storage.folder import InUseError
from ctid_cli.storage.identity import as_text
from ctid_cli.storage.journal import JournalReader
from ctid_cli.storage.manifest import planned_parts, shard_of, slots
from ctid_cli.storage.sqlite_file import EXPORT, FILE_NAME, RUNNING, who_runs
from ctid_cli.written_files import is_leftover

#: Data of a run that may be published: nothing that names a machine, a user or a folder.
PUBLIC = ("jobs", "processors", "packages")


def find_estimate(results: Path, prefix: str) -> Estimates:
    """Find one estimate among all experiments by a prefix of its id."""
    matches: dict[str, Estimates] = {}
    in_use = ""
    for folder in folders.experiment_folders(results):
        try:
            stored = read_stored(folder)
        except InUseError as error:
            in_use = f"; it may come later: {error}"
            continue
        ids = stored.column("id")
        for number in np.flatnonzero(np.char.startswith(ids, prefix.encode())).tolist():
            matches.setdefault(ids[number].decode(), stored.part(number, number + 1))
    if not matches:
        raise UsageError(f"no id in {results} begins with {prefix!r}{in_use}; 'ctid export' lists all ids")
    if len(matches) > 1:
        some = ", ".join(sorted(matches)[:5])
        raise UsageError(f"{len(matches)} estimates have an id that begins with {prefix!r}: {some}…; give more of it")
    return next(iter(matches.values()))


def public_sessions(folder: Path) -> list[dict[str, Any]]:
    """Return the publishable data of the runs that computed an experiment."""
    with folders.reading_journal(folder) as log:
        if log is None:
            return []
        counts, sessions = log.counts(), log.sessions()
    return [
        {
            "started": session.started,
            "stopped": session.stopped,
            "computed": sum(count for (id, _), count in counts.items() if id == session.id),
            "failed": sum(counts[session.id, status] for status in columns.FAILURES),
            "code_version": session.origin.code_version,
            "numeric_platform": session.origin.platform,
            **{key: session.info.get(key) for key in PUBLIC},
        }
        for session in sessions
    ]


@dataclass(frozen=True)
class Progress:
    """Numbers of planned, stored and failed estimates."""

    planned: int
    done: int
    failed: int

    @property
    def todo(self) -> int:
        """Number of estimates still to compute."""
        return self.planned - self.done


@dataclass(frozen=True)
class GroupStatus(Progress):
    """Progress of one estimator on one data cell."""

    estimator: str
    cell: str
    swept: dict[str, Any]


@dataclass(frozen=True)
class ExperimentStatus(Progress):
    """Progress of an experiment."""

    experiment: str
    folder: Path
    left_aside: int | None
    mixed: bool
    running: dict[str, Any] | None
    groups: tuple[GroupStatus, ...]
    #: Shard number and number of shards; None for a whole experiment.
    shard: tuple[int, int] | None = None


def experiment_status(folder: Path) -> ExperimentStatus:
    """Count stored and missing estimates."""
    try:
        with folders.reading_journal(folder) as log:
            running = _running(folder) if log is not None and log.live else None
            return _status(folder, log, running)
    except InUseError:
        # A run that has just started has nothing to read yet.
        running = _running(folder)
        name = str(running.get("experiment") or folder.name)
        return ExperimentStatus(0, 0, 0, name, folder, None, False, running, ())


def _running(folder: Path) -> dict[str, Any]:
    """Return the data of the running process, its speed and the predicted end."""
    running = who_runs(folder)
    if running is None:
        return {"pid": None, "host": None}
    about: dict[str, Any] = {"data_sets_per_second": None, "expected_end": None}
    with suppress(KeyError, TypeError, ValueError, OverflowError):
        present = datetime.now(UTC)
        elapsed = (present - datetime.fromisoformat(running["started"])).total_seconds()
        if running["done"] > 0 and elapsed > 0:
            speed = running["done"] / elapsed
            left = timedelta(seconds=(running["total"] - running["done"]) / speed)
            about = {"data_sets_per_second": speed, "expected_end": as_text(present + left)}
    return running | about


def _status(folder: Path, log: JournalReader | None, running: dict[str, Any] | None) -> ExperimentStatus:
    #: For each estimate that is stored, by data cell and estimator, whether it failed.
    failures: dict[tuple[str, str], Sequence[bool]] = {}
    if log is None:
        stored = stored_in(folder, None)
        manifest, mixed, left_aside = stored.manifest, stored.mixed, None
        for block in stored.blocks:
            failures[block.cell["hash"], block.hash] = stored.failures[block.first : block.last].tolist()
    else:
        manifest, sessions = log.manifest(), set[str]()
        for estimator, cell, replicates in planned_parts(manifest):
            failures[cell["hash"], estimator["hash"]] = failed = list[bool]()
            for row in log.rows_of(estimator, cell, replicates):
                sessions.add(row.session)
                failed.append(row.status in columns.FAILURES)
        mixed = len(log.origins_of(sessions)) > 1
        # Estimates shared by two names are stored once in a journal.
        left_aside = log.require_count() - sum(map(len, failures.values()))
    groups = []
    for estimator, cell, replicates in planned_parts(manifest):
        own = failures.get((cell["hash"], estimator["hash"]), ())
        swept = {**cell["swept"], **estimator["swept"]}
        planned = len(replicates) * len(estimator["starts"])
        groups.append(GroupStatus(planned, len(own), sum(own), estimator["name"], cell["hash"], swept))
    counts = {name: sum(getattr(group, name) for group in groups) for name in ("planned", "done", "failed")}
    part = shard_of(manifest)
    return ExperimentStatus(
        **counts,
        experiment=manifest["experiment"],
        folder=folder,
        left_aside=left_aside,
        mixed=mixed,
        running=running,
        groups=tuple(groups),
        shard=None if part is None else (part.number, part.of),
    )


State = Literal["intact", "damaged", "missing", "stale", "left over"]
# --- verification of stored files ------------------------------------------------------------------------------------

#: Findings that are errors; all others are in order.
WRONG = ("damaged", "missing")


@dataclass(frozen=True)
class Finding:
    """Result of checking one file."""

    #: Relative to the folder.
    file: str
    state: State
    #: Description of its content or of the error.
    message: str


@dataclass(frozen=True)
class Verification:
    """Result of checking the folder of an experiment."""

    folder: Path
    findings: tuple[Finding, ...]

    @property
    def is_intact(self) -> bool:
        """Whether no file is damaged or missing."""
        return not any(finding.state in WRONG for finding in self.findings)


@reported("checking stored estimates")
def verify(folder: Path) -> Verification:
    """Read and check everything stored by a run."""
    live, noted, findings = False, None, []
    try:
        with folders.reading_journal(folder) as log:
            if log is not None:
                live, noted = log.live, log.exported()
                findings.append(_journal(log))
            elif (folder / FILE_NAME).exists():
                findings.append(Finding(FILE_NAME, "intact", "a run was stopped before it had planned anything"))
    except DamageError as error:
        findings.append(Finding(FILE_NAME, "damaged", str(error)))
    findings += _export(folder, noted, known=bool(findings) and findings[0].state == "intact")
    if not live:
        left = sorted(path.name for path in folder.glob("*") if is_leftover(path.name) or path.name == RUNNING)
        findings += [Finding(name, "left over", "of a run that was killed; it does no harm") for name in left]
    return Verification(folder, tuple(findings))


def _journal(log: JournalReader) -> Finding:
    log.check(fully=True)
    manifest, sessions = log.manifest(), log.sessions()
    planned = {slot.key for slot in slots(manifest)}
    # Reading verifies the checksum of each row.
    there = Counter(row.key in planned for row in log.rows())
    message = f"{there[True]} of {len(planned)} estimates"
    message += f", {there[False]} set aside" if there[False] else ""
    message += f", {len(sessions)} run{'s' if len(sessions) != 1 else ''}"
    return Finding(FILE_NAME, "intact", message + (", one is going on" if log.live else ""))


def _export(folder: Path, noted: str | None, *, known: bool) -> Iterator[Finding]:
    path, again = folder / EXPORT, "'ctid run' with the same specification writes it again"
    if not path.exists():
        if noted is not None:
            yield Finding(EXPORT, "missing", again)
        return
    if noted is not None and sha256_of(path) != noted:
        yield Finding(EXPORT, "damaged", f"it is not what was written; {again}")
        return
    try:
        export = open_export(path)
        export.verify()
    except CtidError as error:
        yield Finding(EXPORT, "damaged", f"{error}; {again}" if known else str(error))
        return
    holds = f"{export.count} estimates"
    if noted is None and known:
        yield Finding(EXPORT, "stale", f"{holds}, but not those of the journal, which is read in its place; {again}")
    else:
        yield Finding(EXPORT, "intact", holds if known else f"{holds}; there is no intact journal to compare with")
