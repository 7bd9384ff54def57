"""Whether every stored byte of an experiment is what was written."""

import hashlib
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ctid_cli.errors import CtidError, DamageError
from ctid_cli.storage import folder as place
from ctid_cli.storage.folder import CANONICAL, PROVENANCE, RUNNING, SEALED, SPEC, TIMINGS
from ctid_cli.storage.journal_reader import FILE_NAME, JournalReader
from ctid_cli.storage.planned import KeySet
from ctid_cli.storage.repair import salvage
from ctid_cli.storage.sealed import open_sealed
from ctid_cli.written_files import is_leftover

State = Literal["intact", "damaged", "missing", "stale", "unchecked", "left over"]
#: What is wrong; all else is in order, or cannot be known.
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
        """Whether nothing is wrong."""
        return not any(finding.state in WRONG for finding in self.findings)


@dataclass(frozen=True)
class _Noted:
    """What the journal says about the files beside it; nothing where there is none, or a damaged one."""

    files: dict[str, set[str]]
    sealed: str | None = None
    known: bool = False
    #: Runs that were killed, and whether the latest one was: a file may be noted and never have been written.
    killed: frozenset[int] = frozenset()
    lately: bool = False

    def may_be_missing(self, name: str) -> bool:
        """Whether a file need not be there although it is noted."""
        number = re.match(rf"{PROVENANCE}/(\d+)-", name)
        return int(number[1]) in self.killed if number else self.lately


def verify(folder: Path) -> Verification:
    """Read and check everything that a run has stored."""
    noted, live, findings = _Noted({}), False, []
    try:
        with place.reading_journal(folder) as log:
            if log is not None:
                live = log.live
                findings.append(_journal(log))
                killed = [session["stopped"] is None for session in log.sessions()]
                numbers = frozenset(number for number, was in enumerate(killed, 1) if was)
                noted = _Noted(log.files(), log.sealed(), True, numbers, not killed or killed[-1])
            elif (folder / FILE_NAME).exists():
                findings.append(Finding(FILE_NAME, "intact", "a run was stopped before it had planned anything"))
    except DamageError as error:
        # The cause is the damage without what is said about the other files.
        findings = [Finding(FILE_NAME, "damaged", f"{error.__cause__}. {_what_can_be_read(folder)}")]
    findings += _sealed(folder, noted, has_journal=bool(findings))
    findings += _beside(folder, noted)
    return Verification(folder, (*findings, *([] if live else _left_over(folder))))


def _journal(log: JournalReader) -> Finding:
    log.check(fully=True)
    sessions, planned = log.sessions(), KeySet.planned(log.manifest())
    # Reading compares each with its checksum.
    there = Counter(row.key in planned for row in log.rows())
    message = f"{there[True]} of {len(planned)} estimates"
    aside = there[False]
    message += f", {aside} set aside" if aside else ""
    message += f", {len(sessions)} runs" if len(sessions) != 1 else ", 1 run"
    return Finding(FILE_NAME, "intact", message + (", one is going on" if log.live else ""))


def _what_can_be_read(folder: Path) -> str:
    found = salvage(folder)
    if found.manifest is None or not found.rows:
        return "Nothing of it can be read"
    planned = len(KeySet.planned(found.manifest))
    missing = len({slot.key for slot in found.missing()})
    return f"{planned - missing} of {planned} estimates can be read; 'ctid repair' saves them into a new folder"


def _sealed(folder: Path, noted: _Noted, *, has_journal: bool) -> Iterator[Finding]:
    path = folder / SEALED
    if not path.exists():
        if noted.sealed is not None:
            yield Finding(SEALED, "missing", "'ctid run' with the same specification writes it again")
        return
    try:
        runs = open_sealed(path, fully=True)
    except CtidError as error:
        advice = "; 'ctid run' with the same specification writes it again" if noted.known else ""
        yield Finding(SEALED, "damaged", f"{error}{advice}")
        return
    holds = f"{runs.table.count} estimates"
    if runs.checksum == noted.sealed:
        yield Finding(SEALED, "intact", holds)
    elif noted.known:
        older = "not what the journal holds by now, which is read in its place; the next 'ctid run' writes it again"
        yield Finding(SEALED, "stale", f"intact, {holds}, but {older}")
    else:
        yield Finding(SEALED, "intact", holds if has_journal else f"{holds}; there is no journal to compare with")


def _beside(folder: Path, noted: _Noted) -> Iterator[Finding]:
    """The files beside the journal that it has notes of, and those that it should have."""
    own = [SPEC, CANONICAL, TIMINGS, *(f"{PROVENANCE}/{path.name}" for path in _files(folder / PROVENANCE, "*.json"))]
    for name in sorted({*noted.files, *own}):
        try:
            data = (folder / name).read_bytes()
        except FileNotFoundError:
            if name in noted.files and not noted.may_be_missing(name):
                yield Finding(name, "missing", "a run has written it")
            continue
        except OSError as error:
            yield Finding(name, "damaged", f"cannot be read ({error.strerror})")
            continue
        if name not in noted.files:
            why = "an older ctid wrote it" if noted.known else "there is no intact journal"
            yield Finding(name, "unchecked", f"nothing says what it should be: {why}")
        elif hashlib.sha256(data).hexdigest() in noted.files[name]:
            yield Finding(name, "intact", f"{len(data)} bytes")
        else:
            yield Finding(name, "damaged", "not what a run has written")


def _left_over(folder: Path) -> Iterator[Finding]:
    for path in _files(folder, "*"):
        if is_leftover(path.name) or path.name == RUNNING:
            yield Finding(path.name, "left over", "of a run that was killed; it does no harm")


def _files(folder: Path, pattern: str) -> Iterable[Path]:
    return sorted(path for path in folder.glob(pattern) if path.is_file())
