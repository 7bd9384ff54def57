"""Journals as files: their format, how they are opened, what keeps one from being used, and who is writing to it."""

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

#: The journal, what is exported of it, and the specification of the latest run.
FILE_NAME, EXPORT, SPEC = "journal.sqlite", "runs.h5", "spec.yaml"
#: Another one for every change after which another ctid could misread the file.
FORMAT = 5
#: Marks an SQLite file as a journal of ctid ("ctid" in ASCII).
APPLICATION = 0x63746964
#: What can go wrong while a file is read that may hold anything.
ERRORS = (sqlite3.Error, ValueError, TypeError, KeyError, IndexError, OverflowError)
#: What keeps SQLite from reading or writing a file that is in order; all else that it reports is damage.
_HINDRANCES = ("READONLY", "CANTOPEN", "FULL", "IOERR", "PERM", "AUTH", "BUSY", "LOCKED", "NOMEM", "PROTOCOL")
#: Bytes at the beginning of a write-ahead log.
_LOG_HEADER = 32


def set_up(connection: sqlite3.Connection) -> None:
    """Make commits durable, and let others read meanwhile where the file system has shared memory for it."""
    for locking in ("NORMAL", "EXCLUSIVE"):
        connection.execute(f"PRAGMA locking_mode={locking}")
        if connection.execute("PRAGMA journal_mode=WAL").fetchone() == ("wal",):
            break
    connection.execute("PRAGMA synchronous=FULL")


def require_whole(path: Path, *, planned: bool = True, live: bool = False) -> None:
    """Refuse a file that was emptied: SQLite would remove its log, and a run would begin anew."""
    log, folder = path.with_name(f"{path.name}-wal"), path.parent
    emptied = path.exists() and path.stat().st_size == 0 and log.exists() and log.stat().st_size > _LOG_HEADER
    if emptied or (not planned and ((folder / EXPORT).exists() or (not live and reported(folder)))):
        raise DamageError(f"{path} is damaged: it is empty, and was not")


@contextmanager
def readable(path: Path, *, live: bool) -> Iterator[str]:
    """Return an address at which SQLite reads a journal and changes nothing.

    After a kill, acknowledged estimates stand in the write-ahead log beside the file. SQLite reads it in place if its
    index is there, however stale; else a copy is read. A file without a writer and without a log needs no locks.
    """
    log, index = (path.with_name(f"{path.name}-{end}") for end in ("wal", "shm"))
    # A log that was only begun holds nothing, and SQLite does not get on with its index.
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
    """Say what keeps a journal from being read or written."""
    name = getattr(error, "sqlite_errorname", "") or ""
    reason = (error.strerror if isinstance(error, OSError) else None) or error
    if writing and name not in ("SQLITE_CORRUPT", "SQLITE_NOTADB"):
        safe = "all that was reported as done is safe in it"
        raise StorageError(f"{path} could not be written ({reason}); {safe}") from error
    if isinstance(error, OSError) or name.removeprefix("SQLITE_").startswith(_HINDRANCES):
        raise StorageError(f"{path} cannot be read ({reason})") from error
    raise DamageError(f"{path} is damaged or not a journal ({error})") from error


def require_journal(connection: sqlite3.Connection, path: Path) -> None:
    """Refuse an SQLite file that is no journal, or one of another format."""
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (written,) = connection.execute("PRAGMA user_version").fetchone()
    if application != APPLICATION:
        raise DamageError(f"{path} is an SQLite file, but not a journal of ctid")
    require_format(path, written, FORMAT)


def require_format(path: Path, written: int, known: int) -> None:
    """Refuse a file of another format than the one that this program reads."""
    if written != known:
        raise RefusedError(
            f"{path} has format {written}; this ctid reads format {known}. Use the ctid that wrote it, another results "
            "folder (--out), or --fresh to move the old results aside"
        )


def places_of(path: Path) -> dict[Path, tuple[int, int] | None]:
    """Return the folder and files of a journal, each with what tells it from another one of its name."""
    # While it is open no other file can get the numbers of its files.
    places = (path.parent, path, path.with_name(f"{path.name}-wal"))
    return {place: _identity_of(place) for place in places if place.exists()}


def require_places(known: Mapping[Path, tuple[int, int] | None]) -> None:
    """Refuse to go on in a file that its path does not lead to any more."""
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

#: Says who runs in a folder, for those who find it locked, and how many estimates were reported there. What a killed
#: run leaves of it tells how many estimates the journal holds at least: SQLite drops the end of a damaged write-ahead
#: log without a word.
RUNNING = "running.json"


def announce(folder: Path, experiment: str, started: str, done: int, total: int, stored: int = 0) -> None:
    """Say who runs, how many data sets of how many are done, and how many estimates the journal holds."""
    running = {"experiment": experiment, "pid": os.getpid(), "host": platform.node()}
    running |= {"started": started, "done": done, "total": total, "stored": stored}
    # A courtesy to readers, written over and over: neither worth a synchronisation nor worth failing for.
    with suppress(OSError):
        temporary = folder / f"{RUNNING}.tmp"
        temporary.write_text(json.dumps(running), encoding="utf-8")
        temporary.replace(folder / RUNNING)


def retract(folder: Path) -> None:
    """Take back what was announced, unless another process announced it."""
    running = who_runs(folder)
    if running is not None and (running["pid"], running["host"]) == (os.getpid(), platform.node()):
        with suppress(OSError):
            (folder / RUNNING).unlink(missing_ok=True)


def who_runs(folder: Path) -> dict[str, Any] | None:
    """Return what the run that writes to a folder says about itself."""
    try:
        running = json.loads((folder / RUNNING).read_text(encoding="utf-8"))
        return running if isinstance(running, dict) and {"pid", "host"} <= running.keys() else None
    except (OSError, ValueError):
        return None


def reported(folder: Path) -> int:
    """Return how many estimates were reported as stored by a run that has not ended; 0 where nothing says so."""
    stored = (who_runs(folder) or {}).get("stored")
    return stored if isinstance(stored, int) else 0
