"""The live log of an experiment: an SQLite file that only the process of the run writes.

What a commit has acknowledged survives the death of the process and of the machine (write-ahead log, full
synchronisation), and is where the path says: a folder that was renamed, replaced or deleted is noticed before. The file
holds every estimate ever computed in the folder, also those that the latest plan does not ask for, and a line for each
run with everything that is no result: times, host, command, limits, versions.

Every row carries a checksum, which is compared whenever the row is read. A damaged file is never repaired in place.
Others may read while the run writes: each sees the file as it was when it began to read.
"""

import hashlib
import json
import math
import os
import shutil
import sqlite3
import uuid
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from ctid_cli.canonical import canonical_json
from ctid_cli.errors import DamageError, RefusedError, StorageError
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.manifest import Key, Manifest, Outcome, Slot, planned_parts, read_json, require_manifest
from ctid_cli.temporary import TemporaryFolder
from ctid_cli.written_files import write_file

#: The journal, and what is exported of it.
FILE_NAME, EXPORT = "journal.sqlite", "runs.h5"
#: Another one for every change after which another ctid could misread the file.
FORMAT = 5
#: Marks an SQLite file as a journal of ctid ("ctid" in ASCII).
APPLICATION = 0x63746964
#: What can go wrong while a file is read that may hold anything.
ERRORS = (sqlite3.Error, ValueError, TypeError, KeyError, IndexError, OverflowError)
#: What keeps SQLite from reading or writing a file that is in order; all else that it reports is damage.
_HINDRANCES = ("READONLY", "CANTOPEN", "FULL", "IOERR", "PERM", "AUTH", "BUSY", "LOCKED", "NOMEM", "PROTOCOL")
#: How long a reader waits for a moment at which the file can be read [s].
_PATIENCE = 2.0
#: Bytes at the beginning of a write-ahead log.
_LOG_HEADER = 32

_KEY = "data_hash, estimator_hash, replicate, start"
_IS_KEY = " AND ".join(f"{name} = ?" for name in _KEY.split(", "))
_COLUMNS = f"{_KEY}, status, seconds, cpu_seconds, session, checksum, result"
_SCHEMA = (
    "CREATE TABLE meta (name TEXT PRIMARY KEY, value TEXT, checksum TEXT) WITHOUT ROWID",
    """CREATE TABLE sessions (
        id TEXT PRIMARY KEY, origin TEXT, started TEXT, stopped TEXT, reason TEXT, info TEXT, checksum TEXT)""",
    # In the order of a plan, in which they are read; what is long stands last.
    f"""CREATE TABLE estimates (
        data_hash TEXT, estimator_hash TEXT, replicate INTEGER, start TEXT,
        status TEXT, seconds REAL, cpu_seconds REAL, session TEXT, checksum TEXT, result TEXT,
        PRIMARY KEY ({_KEY})) WITHOUT ROWID""",
    f"PRAGMA application_id={APPLICATION}",
    f"PRAGMA user_version={FORMAT}",
)
#: What is noted: the plan of the latest run, and the SHA-256 of runs.h5 as long as it holds what that asks for.
#: And how many estimates there are, so that none goes unnoticed.
_MANIFEST, _EXPORTED, _COUNT = "manifest", "exported", "count"


class Row(NamedTuple):
    """An estimate as it is stored."""

    data_hash: str
    estimator_hash: str
    replicate: int
    start: str
    status: str
    seconds: float | None
    cpu_seconds: float | None
    session: str
    checksum: str
    result: str

    @classmethod
    def of(cls, outcome: Outcome, session: str) -> "Row":
        """Return an estimate that was computed just now."""
        key, result, *times = outcome
        of_key = (key.data_hash, key.estimator_hash, key.replicate, key.start)
        seconds, cpu_seconds = (None if t is None or not math.isfinite(t) else float(t) for t in times)
        row = cls(*of_key, str(result["status"]), seconds, cpu_seconds, session, "", canonical_json(result))
        return row._replace(checksum=_digest(*row[:-2], row.result))

    @property
    def key(self) -> Key:
        """Return its identity."""
        return Key(self.data_hash, self.replicate, self.estimator_hash, self.start)

    @property
    def is_intact(self) -> bool:
        """Return whether it is what was written."""
        return self.checksum == _digest(*self[:-2], self.result)

    @property
    def content(self) -> dict[str, Any]:
        """Return its result."""
        found: dict[str, Any] = json.loads(self.result)
        return found


class Session(NamedTuple):
    """A run that has written to a journal."""

    #: As no other run has it, so that runs keep theirs where journals are merged.
    id: str
    origin: Origin
    started: str
    #: None while it goes on, and of one that was killed.
    stopped: str | None
    reason: str | None
    info: dict[str, Any]


class JournalReader:
    """An open journal, as far as it is read."""

    def __init__(self, connection: sqlite3.Connection, path: Path, *, live: bool = False) -> None:
        self._connection = connection
        self.path = path
        #: Whether a run is writing to it while it is read.
        self.live = live

    def experiment(self) -> str:
        """Return name of the experiment."""
        return str(self.manifest()["experiment"])

    def manifest(self) -> Manifest:
        """Return the plan of the latest run."""
        with self._guard():
            return require_manifest(read_json(self._meta(_MANIFEST) or ""))

    def exported(self) -> str | None:
        """Return SHA-256 of ``runs.h5``; None if estimates or another plan came after it."""
        return self._meta(_EXPORTED)

    def state(self) -> str | None:
        """Return what changes with every run that writes; None before the first one."""
        rows = self._rows("SELECT id, stopped FROM sessions ORDER BY rowid DESC LIMIT 1")
        return str(rows[0]) if rows else None

    def sessions(self) -> list[Session]:
        """Return every run that has written here, the oldest first."""
        return self._sessions("ORDER BY rowid")

    def session(self, id: str) -> Session:
        """Return one of these runs."""
        (found,) = self._sessions("WHERE id = ?", id)
        return found

    def _sessions(self, where: str, *values: Any) -> list[Session]:
        rows = self._checked("sessions", "id, origin, started, stopped, reason, info", where, *values)
        with self._guard():
            return [
                Session(id, Origin.of(**json.loads(origin)), started, stopped, reason, json.loads(info))
                for id, origin, started, stopped, reason, info in rows
            ]

    def origins(self) -> tuple[Origin, ...]:
        """Return where the stored estimates come from."""
        return self.origins_of(id for (id,) in self._rows("SELECT DISTINCT session FROM estimates"))

    def origins_of(self, sessions: Iterable[str]) -> tuple[Origin, ...]:
        """Return where the estimates of some runs come from."""
        known = {session.id: session.origin for session in self.sessions()}
        with self._guard():
            return tuple(sorted({known[id] for id in sessions}))

    def made(self) -> set[tuple[str, Origin]]:
        """Return the data cells of the stored estimates, and where these come from."""
        known = {session.id: session.origin for session in self.sessions()}
        with self._guard():
            return {(data, known[id]) for data, id in self._rows("SELECT DISTINCT data_hash, session FROM estimates")}

    def count(self) -> int:
        """Return how many estimates are stored."""
        return int(self._rows("SELECT count(*) FROM estimates")[0][0])

    def mean_seconds(self) -> float | None:
        """Return mean time of an estimate [s]; None where none is known."""
        mean: float | None = self._rows("SELECT avg(seconds) FROM estimates")[0][0]
        return mean

    def counts(self) -> Counter[tuple[str, str]]:
        """Return number of estimates of each run with each status."""
        rows = self._rows("SELECT session, status, count(*) FROM estimates GROUP BY 1, 2")
        return Counter({(session, status): count for session, status, count in rows})

    def rows(self) -> Iterator[Row]:
        """Yield every stored estimate."""
        self.require_count()
        yield from self._selected("")

    def require_count(self) -> None:
        """Refuse a file that lacks estimates which were written."""
        written, there = self._meta(_COUNT) or "0", self.count()
        if written != str(there):
            raise DamageError(f"{self.path} is damaged: {written} estimates were written, {there} are there")

    def planned_rows(self, manifest: Manifest) -> Iterator[tuple[Slot, Row]]:
        """Yield the stored estimates that a plan asks for, in its order."""
        for estimator, cell, replicates in planned_parts(manifest):
            order = {start: number for number, start in enumerate(estimator["starts"])}
            wanted = replicates if isinstance(replicates, range) else frozenset(replicates)
            found = self._selected("WHERE data_hash = ? AND estimator_hash = ?", cell["hash"], estimator["hash"])
            for replicate, rows in groupby(found, key=lambda row: row.replicate):
                if replicate in wanted:
                    for row in sorted((row for row in rows if row.start in order), key=lambda row: order[row.start]):
                        yield Slot(row.key, cell, estimator), row

    def row(self, key: Key) -> Row | None:
        """Return a stored estimate."""
        of_key = (key.data_hash, key.estimator_hash, key.replicate, key.start)
        return next(self._selected(f"WHERE {_IS_KEY}", *of_key), None)

    def times(self, data_hash: str, estimator_hash: str) -> dict[tuple[int, str], tuple[float | None, float | None]]:
        """Return times of the estimates of an estimator on a data cell [s], by replicate and start."""
        rows = self._selected("WHERE data_hash = ? AND estimator_hash = ?", data_hash, estimator_hash)
        return {(row.replicate, row.start): (row.seconds, row.cpu_seconds) for row in rows}

    def check(self, *, fully: bool = False) -> None:
        """Refuse a file that SQLite finds damaged; fully, compare indices with tables too."""
        found = self._rows(f"PRAGMA {'integrity' if fully else 'quick'}_check(1)")
        if found != [("ok",)]:
            raise DamageError(f"{self.path} is damaged: {found[0][0] if found else 'SQLite says nothing of it'}")
        self.require_count()

    def _selected(self, where: str, *values: Any) -> Iterator[Row]:
        """Yield some estimates, compared with their checksums."""
        with self._guard():
            for values_of_row in self._connection.execute(f"SELECT {_COLUMNS} FROM estimates {where}", values):
                row = Row(*values_of_row)
                if not row.is_intact:
                    raise DamageError(f"{self.path} is damaged: estimate {row.key.id} has changed since it was written")
                yield row

    def _rows(self, query: str, *values: Any) -> list[Any]:
        with self._guard():
            return self._connection.execute(query, values).fetchall()

    def _checked(self, table: str, names: str, where: str = "", *values: Any) -> list[Any]:
        """Return rows of a table, compared with their checksums; ``names`` are all its columns but that."""
        rows = self._rows(f"SELECT {names}, checksum FROM {table} {where}", *values)
        for *row, checksum in rows:
            if _digest(table, *row) != checksum:
                raise DamageError(f"{self.path} is damaged: {table} {row[0]!r} has changed since it was written")
        return [row for *row, _ in rows]

    def _meta(self, name: str) -> str | None:
        rows = self._checked("meta", "name, value", "WHERE name = ?", name)
        return str(rows[0][1]) if rows else None

    @contextmanager
    def _guard(self, *, writing: bool = False) -> Iterator[None]:
        try:
            yield
        except ERRORS as error:
            refuse(self.path, error, writing=writing)


class Journal(JournalReader):
    """A journal that is open for writing."""

    def __init__(self, connection: sqlite3.Connection, path: Path) -> None:
        super().__init__(connection, path)
        #: The folder and its files as they were when it was opened, and the folder itself.
        self._places: dict[Path, tuple[int, int] | None] = {}
        self._folder: int | None = None

    def write_beside(self, name: str, data: bytes) -> None:
        """Write a file beside the journal, if it is not there already."""
        path = self.path.parent / name
        if not path.exists() or path.read_bytes() != data:
            write_file(path, data)

    def begin(self, manifest: Manifest, origin: Origin, started: str, info: dict[str, Any]) -> str:
        """Note that a run begins, and where its estimates will come from."""
        with self.transaction():
            self.note_plan(manifest)
            return self.note_session(Session(new_id(), origin, started, None, None, info))

    def note_session(self, session: Session) -> str:
        """Note a run, whose id is returned; inside a transaction."""
        id, origin, *times, info = session
        self._insert("sessions", id, canonical_json(origin._asdict()), *times, canonical_json(info))
        return id

    def replan(self, manifest: Manifest) -> None:
        """Note that the plan of the present run has changed."""
        with self.transaction():
            self.note_plan(manifest)

    def note_plan(self, manifest: Manifest) -> None:
        """Note the latest plan; inside a transaction."""
        # Not sorted: the order of swept fields and starts is that of the specification.
        text = json.dumps(manifest, allow_nan=False)
        if self._meta(_MANIFEST) != text:
            self._insert("meta", _MANIFEST, text)
            self._connection.execute("DELETE FROM meta WHERE name = ?", (_EXPORTED,))

    def add(self, outcomes: Iterable[Outcome], session: str) -> None:
        """Store estimates, in place of earlier ones if there are any; when this returns, they are safe."""
        with self.transaction():
            self.add_rows(Row.of(outcome, session) for outcome in outcomes)

    def add_rows(self, rows: Iterable[Row]) -> None:
        """Store rows, in place of earlier ones if there are any; inside a transaction."""
        execute, marks, new = self._connection.execute, ", ".join("?" * len(Row._fields)), 0
        for row in rows:
            new += execute(f"SELECT 1 FROM estimates WHERE {_IS_KEY}", row[:4]).fetchone() is None
            execute(f"INSERT OR REPLACE INTO estimates ({_COLUMNS}) VALUES ({marks})", row)
        execute("DELETE FROM meta WHERE name = ?", (_EXPORTED,))
        self._insert("meta", _COUNT, str(int(self._meta(_COUNT) or 0) + new))

    def note_export(self, sha256: str) -> None:
        """Note that ``runs.h5`` holds the present estimates of the present plan."""
        with self.transaction():
            self._insert("meta", _EXPORTED, sha256)

    def end(self, session: str, stopped: str, reason: str) -> None:
        """Note that a run ends."""
        with self.transaction():
            self.note_session(self.session(session)._replace(stopped=stopped, reason=reason))

    def require_in_place(self) -> None:
        """Refuse to go on in a file that its path does not lead to any more."""
        for place, found in self._places.items():
            if _identity(place) != found:
                advice = "Nothing that was computed since is counted as stored. Bring it back to go on, or run anew"
                raise StorageError(f"{self._what_became_of(place)}. {advice}")

    def _what_became_of(self, place: Path) -> str:
        now = None
        with suppress(OSError):
            # Linux knows the present name of an open folder.
            now = os.readlink(f"/proc/self/fd/{self._folder}")
        moved = now is not None and now != str(place.resolve()) and not now.endswith(" (deleted)")
        if moved and place == self.path.parent:
            return f"{place} was renamed while a run wrote to it; it is {now} now"
        return f"{place} was deleted or replaced while a run wrote to it"

    def remember_place(self) -> None:
        """Remember where the files are."""
        folder = self.path.parent
        self._folder = os.open(folder, os.O_RDONLY)
        places = (folder, self.path, self.path.with_name(f"{self.path.name}-wal"))
        self._places = {place: _identity(place) for place in places if place.exists()}

    def close(self) -> None:
        """Close the file; closing cannot lose what was acknowledged, so it does not complain."""
        with suppress(sqlite3.Error):
            self._connection.close()
        if self._folder is not None:
            with suppress(OSError):
                os.close(self._folder)
            self._folder = None

    def _insert(self, table: str, *row: Any) -> None:
        """Store a row and its checksum, in place of one with the same key."""
        marks = ", ".join("?" * (len(row) + 1))
        self._connection.execute(f"INSERT OR REPLACE INTO {table} VALUES ({marks})", (*row, _digest(table, *row)))

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Return commit what is done inside, or undo all of it if an exception ends it."""
        # The connection commits, or rolls back what an exception has left undone.
        with self._guard(writing=True), self._connection as connection:
            connection.execute("BEGIN IMMEDIATE")
            yield
        self.require_in_place()


def open_journal(path: Path) -> Journal:
    """Open a journal for writing, and make it if there is none."""
    _require_whole(path)
    with ExitStack() as stack:
        try:
            connection = sqlite3.connect(path, isolation_level=None, timeout=0.0)
            stack.callback(connection.close)
            _set_up(connection)
            log = Journal(connection, path)
            if connection.execute("SELECT 1 FROM sqlite_master LIMIT 1").fetchone():
                _require_journal(connection, path)
                log.check()
            else:
                with log.transaction():
                    for statement in _SCHEMA:
                        connection.execute(statement)
            log.remember_place()
        except (OSError, *ERRORS) as error:
            refuse(path, error, writing=True)
        stack.pop_all()
        return log


def _set_up(connection: sqlite3.Connection) -> None:
    """Make commits durable, and let others read meanwhile where the file system has shared memory for it."""
    for locking in ("NORMAL", "EXCLUSIVE"):
        connection.execute(f"PRAGMA locking_mode={locking}")
        if connection.execute("PRAGMA journal_mode=WAL").fetchone() == ("wal",):
            break
    connection.execute("PRAGMA synchronous=FULL")


@contextmanager
def read_journal(path: Path, *, live: bool = False) -> Iterator[JournalReader | None]:
    """Open a journal for reading without touching its files, ``live`` while a run writes to it."""
    if not path.exists():
        yield None
        return
    _require_whole(path)
    with ExitStack() as stack:
        try:
            address = stack.enter_context(_readable(path, live=live))
            connection = sqlite3.connect(address, uri=True, isolation_level=None, timeout=_PATIENCE)
            stack.callback(connection.close)
            # All that is read from here on is of one moment.
            connection.execute("BEGIN")
            planned = connection.execute("SELECT 1 FROM sqlite_master LIMIT 1").fetchone()
            if planned:
                _require_journal(connection, path)
                planned = connection.execute("SELECT 1 FROM meta WHERE name = ?", (_MANIFEST,)).fetchone()
                if not planned and connection.execute("SELECT 1 FROM sessions").fetchone():
                    raise DamageError(f"{path} is damaged: it holds no plan")
            log = JournalReader(connection, path, live=live)
        except (OSError, *ERRORS) as error:
            refuse(path, error)
        _require_whole(path, planned=bool(planned))
        yield log if planned else None


def _require_whole(path: Path, *, planned: bool = True) -> None:
    """Refuse a file that was emptied: beside what was made from it, or its log, which SQLite would remove."""
    log, export = path.with_name(f"{path.name}-wal"), path.with_name(EXPORT)
    emptied = path.exists() and path.stat().st_size == 0 and log.exists() and log.stat().st_size > _LOG_HEADER
    if emptied or (not planned and export.exists()):
        raise DamageError(f"{path} is damaged: it is empty, and was not")


@contextmanager
def _readable(path: Path, *, live: bool) -> Iterator[str]:
    """Return an address at which SQLite reads a journal and changes nothing.

    After a kill, acknowledged estimates stand in the write-ahead log beside the file. SQLite reads it in place if its
    index is there, however stale; else a copy is read. A file that nobody writes to and that has no log needs no locks.
    """
    log, index = (path.with_name(f"{path.name}-{end}") for end in ("wal", "shm"))
    # A log that was only begun holds nothing, and SQLite does not get on with its index.
    empty = not log.exists() or log.stat().st_size <= _LOG_HEADER
    if live or (index.exists() and not empty):
        yield f"{path.resolve().as_uri()}?mode=ro&readonly_shm=1"
    elif empty:
        yield f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    else:
        with TemporaryFolder() as folder:
            copy = folder / path.name
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


def _require_journal(connection: sqlite3.Connection, path: Path) -> None:
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


def _identity(path: Path) -> tuple[int, int] | None:
    with suppress(OSError):
        found = os.stat(path)
        return found.st_dev, found.st_ino
    return None


def new_id() -> str:
    """Return an id as no other run has it."""
    return uuid.uuid4().hex[:16]


def _digest(*values: Any) -> str:
    """Return checksum of a row."""
    return hashlib.sha256(repr(values).encode("utf-8", "surrogatepass")).hexdigest()[:32]
