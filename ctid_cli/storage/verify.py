"""Whether what is stored of an experiment is what was written."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ctid_cli.errors import CtidError, DamageError
from ctid_cli.storage import folder as place
from ctid_cli.storage.announcement import RUNNING
from ctid_cli.storage.export import open_export, sha256_of
from ctid_cli.storage.journal import JournalReader
from ctid_cli.storage.manifest import slots
from ctid_cli.storage.sqlite_file import EXPORT, FILE_NAME
from ctid_cli.written_files import is_leftover

State = Literal["intact", "damaged", "missing", "stale", "left over"]
#: What is wrong; all else is in order.
WRONG = ("damaged", "missing")


@dataclass(frozen=True)
class Finding:
    """What was found of one file."""

    #: Relative to the folder.
    file: str
    state: State
    #: What is in it, or what is wrong with it.
    message: str


@dataclass(frozen=True)
class Verification:
    """What was found in the folder of an experiment."""

    folder: Path
    findings: tuple[Finding, ...]

    @property
    def is_intact(self) -> bool:
        """Return whether nothing is wrong."""
        return not any(finding.state in WRONG for finding in self.findings)


def verify(folder: Path) -> Verification:
    """Read and check everything that a run has stored."""
    live, noted, findings = False, None, []
    try:
        with place.reading_journal(folder) as log:
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
    # Reading compares each row with its checksum.
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
