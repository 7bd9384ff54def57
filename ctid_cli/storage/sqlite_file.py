"""Journals as files: format, opening, causes of refusal, and the process that is writing."""

import json
import os
import platform
import shutil
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NoReturn

from ctid_cli.errors import DamageError, RefusedError, StorageError

#: The journal, its export, and the specification of the latest run.
FILE_NAME, EXPORT, SPEC = "journal.sqlite", "runs.h5", "spec.yaml"
#: Increased by every change that another version of ctid could misread.
FORMAT = 5
#: Marks an SQLite file as a journal of ctid ("ctid" in ASCII).
APPLICATION = 0x63746964
#: Errors that can occur when an untrusted file is read.
ERRORS = (sqlite3.Error, ValueError, TypeError, KeyError, IndexError, OverflowError)
#: SQLite errors of an intact file that cannot be read or written; all others mean damage.
_HINDRANCES = ("READONLY", "CANTOPEN", "FULL", "IOERR", "PERM", "AUTH", "BUSY", "LOCKED", "NOMEM", "PROTOCOL")
#: Bytes of the header of a write-ahead log.
_LOG_HEADER = 32


def set_up(connection: sqlite3.Connection) -> None:
    """Make commits durable, and allow concurrent readers if the file system supports shared memory for it."""
    for locking in ("NORMAL", "EXCLUSIVE"):
        connection.execute(f"PRAGMA locking_mode={locking}")
        if connection.execute("PRAGMA journal_mode=WAL").fetchone() == ("wal",):
            break
    connection.execute("PRAGMA synchronous=FULL")


def require_whole(path: Path, *, planned: bool = True, live: bool = False) -> None:
    """Refuse a file that was emptied: SQLite would remove its log, and a run would start from the beginning."""
    log, folder = path.with_name(f"{path.name}-wal"), path.parent
    emptied = path.exists() and path.stat().st_size == 0 and log.exists() and log.stat().st_size > _LOG_HEADER
    if emptied or (not planned and ((folder / EXPORT).exists() or (not live and reported(folder)))):
        raise DamageError(f"{path} is damaged: it is empty, and was not")


@contextmanager
def readable(path: Path, *, live: bool) -> Iterator[str]:
    """Yield an address at which SQLite can read a journal without changing it.

    After a kill, committed estimates are in the write-ahead log next to the file. SQLite reads it in place if its index
    exists, even an outdated one; otherwise a copy is read. A file without a writer and a log needs no locks.
    """
    log, index = (path.with_name(f"{path.name}-{end}") for end in ("wal", "shm"))
    # A log with a header only holds no data, and SQLite cannot handle its index.
    empty = not log.exists() or log.stat().st_size <= _LOG_HEADER
    if live or (index.exists() and not empty):
        yield f"{path.resolve().as_uri()}?mode=ro&readonly_shm=1"
    elif empty:
        yield f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    else:
        with TemporaryDirectory(prefix="ctid-", ignore_cleanup_errors=True) as folder:
            copy = Path(folder) / path.name
            shutil.copyfile(path, copy)
            shutil.copyfile(log, copy.with_name(log.name))
            yield copy.as_uri()


def refuse(path: Path, error: Exception, *, writing: bool = False) -> NoReturn:
    """Raise an error with the reason why a journal cannot be read or written."""
    name = getattr(error, "sqlite_errorname", "") or ""
    reason = (error.strerror if isinstance(error, OSError) else None) or error
    if writing and name not in ("SQLITE_CORRUPT", "SQLITE_NOTADB"):
        safe = "all that was reported as done is safe in it"
        raise StorageError(f"{path} could not be written ({reason}); {safe}") from error
    if isinstance(error, OSError) or name.removeprefix("SQLITE_").startswith(_HINDRANCES):
        raise StorageError(f"{path} cannot be read ({reason})") from error
    raise DamageError(f"{path} is damaged or not a journal ({error})") from error


def require_journal(connection: sqlite3.Connection, path: Path) -> None:
    """Refuse an SQLite file that is not a journal, or has another format."""
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (written,) = connection.execute("PRAGMA user_version").fetchone()
    if application != APPLICATION:
        raise DamageError(f"{path} is an SQLite file, but not a journal of ctid")
    require_format(path, written, FORMAT)


def require_format(path: Path, written: int, known: int) -> None:
    """Refuse a file of a format that this version cannot read."""
    if written != known:
        raise RefusedError(
            f"{path} has format {written}; this ctid reads format {known}. Use the ctid that wrote it, another results "
            "folder (--out), or --fresh to move the old results aside"
        )


def places_of(path: Path) -> dict[Path, tuple[int, int] | None]:
    """Return the folder and files of a journal with their file numbers, which identify them."""
    # No other file can get these numbers while the journal is open.
    places = (path.parent, path, path.with_name(f"{path.name}-wal"))
    return {place: _identity_of(place) for place in places if place.exists()}


def require_places(known: Mapping[Path, tuple[int, int] | None]) -> None:
    """Refuse to continue if a path no longer leads to the open file."""
    for place, identity in known.items():
        if _identity_of(place) != identity:
            advice = "Nothing that was computed since is counted as stored. Bring it back to go on, or run anew"
            raise StorageError(f"{place} was renamed, deleted or replaced while a run wrote to it. {advice}")


def _identity_of(path: Path) -> tuple[int, int] | None:
    with suppress(OSError):
        found = os.stat(path)
        return found.st_dev, found.st_ino
    return None


# --- who is writing ---------------------------------------------------------------------------------------------------

#: File that names the process running in a folder, for messages about a locked folder, and the reported number of
#: estimates. After a kill it gives a lower bound of the number in the journal: SQLite silently drops the end of a
#: damaged write-ahead log.
RUNNING = "running.json"


def announce(folder: Path, experiment: str, started: str, done: int, total: int, stored: int = 0) -> None:
    """Record the running process, its finished and total data sets, and the number of stored estimates."""
    running = {"experiment": experiment, "pid": os.getpid(), "host": platform.node()}
    running |= {"started": started, "done": done, "total": total, "stored": stored}
    # Informative and often rewritten: not synchronised, and write errors are ignored.
    with suppress(OSError):
        temporary = folder / f"{RUNNING}.tmp"
        temporary.write_text(json.dumps(running), encoding="utf-8")
        temporary.replace(folder / RUNNING)


def retract(folder: Path) -> None:
    """Remove the record of the running process, unless another process wrote it."""
    running = who_runs(folder)
    if running is not None and (running["pid"], running["host"]) == (os.getpid(), platform.node()):
        with suppress(OSError):
            (folder / RUNNING).unlink(missing_ok=True)


def who_runs(folder: Path) -> dict[str, Any] | None:
    """Return the record of the run that writes to a folder."""
    try:
        running = json.loads((folder / RUNNING).read_text(encoding="utf-8"))
        return running if isinstance(running, dict) and {"pid", "host"} <= running.keys() else None
    except (OSError, ValueError):
        return None


def reported(folder: Path) -> int:
    """Return the number of stored estimates reported by a run that has not ended; 0 if there is no report."""
    stored = (who_runs(folder) or {}).get("stored")
    return stored if isinstance(stored, int) else 0
