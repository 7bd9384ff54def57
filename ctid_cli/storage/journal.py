"""The live log of an experiment: an SQLite file that only the process of the run writes.

What a commit has acknowledged survives the death of the process and of the machine (write-ahead log, full
synchronisation), and is where the path says: a folder that was renamed, replaced or deleted is noticed before. The file
holds every estimate ever computed in the folder, also those that later plans leave aside, and one line for each run
with everything that does not belong among the results: times, host, command.

Nothing that is read is trusted: every row carries a checksum, and a tally over those of all estimates tells that none
is missing. Others may read while the run writes: each sees the file as it was when it began to read.
"""

import hashlib
import itertools
import json
import math
import shutil
import sqlite3
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from ctid_cli.canonical import canonical_json
from ctid_cli.errors import DamageError, StorageError
from ctid_cli.storage.columns import FAILURES
from ctid_cli.storage.foreign import read_json, require_manifest
from ctid_cli.storage.identity import Origin, gathered
from ctid_cli.storage.manifest import Key, Manifest, Outcome, refuse_newer
from ctid_cli.storage.whereabouts import Whereabouts
from ctid_cli.written_files import write_file

FILE_NAME = "journal.sqlite"
#: Raised by one whenever an older ctid could misread the file.
FORMAT = 4
#: Marks an SQLite file as a journal of ctid ("ctid" in ASCII).
APPLICATION = 0x63746964

#: First format in which every row has a checksum over all of it.
_CHECKED = 4
_FILES = "CREATE TABLE files (name TEXT, sha256 TEXT, checksum TEXT, PRIMARY KEY (name, sha256)) WITHOUT ROWID"
_SCHEMA = (
    "CREATE TABLE meta (name TEXT PRIMARY KEY, value TEXT NOT NULL, checksum TEXT) WITHOUT ROWID",
    "CREATE TABLE origins (number INTEGER PRIMARY KEY, code_version TEXT, platform TEXT, packages TEXT, checksum TEXT)",
    """CREATE TABLE sessions (
        number INTEGER PRIMARY KEY, started TEXT, stopped TEXT, reason TEXT, info TEXT, checksum TEXT)""",
    """CREATE TABLE estimates (
        data_hash TEXT, replicate INTEGER, estimator_hash TEXT, start TEXT,
        result TEXT NOT NULL, checksum TEXT NOT NULL, seconds REAL, session INTEGER NOT NULL, origin INTEGER,
        cpu_seconds REAL,
        PRIMARY KEY (data_hash, replicate, estimator_hash, start)) WITHOUT ROWID""",
    _FILES,
)
#: From each format to the next: in the first a run had one origin, whatever its estimators, the second has no CPU time,
#: in the third only estimates have a checksum, of what they are and not of how long they took.
_UPGRADES = (
    (
        "ALTER TABLE estimates ADD COLUMN origin INTEGER",
        "UPDATE estimates SET origin = (SELECT origin FROM sessions WHERE number = session)",
        "ALTER TABLE sessions DROP COLUMN origin",
    ),
    ("ALTER TABLE estimates ADD COLUMN cpu_seconds REAL",),
    (*(f"ALTER TABLE {table} ADD COLUMN checksum TEXT" for table in ("meta", "origins", "sessions")), _FILES),
)
_SEALED, _TALLY = "sealed", "tally"
#: Columns of the identity of an estimate.
_KEY = "data_hash, replicate, estimator_hash, start"
#: In format 1 it is the run that has the origin.
_WITH_RUNS = "estimates JOIN sessions ON session = number"
#: What keeps SQLite from reading or writing a file that is in order; all else that it reports is damage.
_HINDRANCES = ("READONLY", "CANTOPEN", "FULL", "IOERR", "PERM", "AUTH", "BUSY", "LOCKED", "NOMEM", "PROTOCOL")
#: What damage can cause while it is read.
_ERRORS = (sqlite3.Error, ValueError, TypeError, KeyError, IndexError, OverflowError)
#: How long a reader waits for a moment at which the file can be read [s].
_READER_PATIENCE = 2.0


class Row(NamedTuple):
    """An estimate as it is stored."""

    key: Key
    result: str
    checksum: str
    seconds: float | None
    cpu_seconds: float | None
    session: int
    origin: int

    def is_intact(self) -> bool:
        """Whether it is what was written; before format 4 times, runs and origins had no checksum."""
        return self.checksum in (self.digest(), _text_digest("\n".join([*map(str, self.key), self.result])))

    def digest(self) -> str:
        """Checksum of all of it."""
        return row_digest("estimates", *self.key, self.result, *self[3:])


@dataclass
class _Tally:
    """How many estimates there are, and all their checksums in one number, whatever their order."""

    count: int = 0
    mark: int = 0

    def add(self, checksum: str) -> None:
        self.count += 1
        self.mark ^= int(checksum, 16)

    def remove(self, checksum: str) -> None:
        self.count -= 1
        self.mark ^= int(checksum, 16)

    def __str__(self) -> str:
        return f"{self.count} {self.mark:032x}"


@dataclass(frozen=True)
class Entry:
    """A stored estimate."""

    result: dict[str, Any]
    #: Time it took, and processor time [s].
    seconds: float | None
    cpu_seconds: float | None
    session: int
    origin: Origin


class Journal:
    """An open journal."""

    def __init__(self, connection: sqlite3.Connection, path: Path, *, live: bool = False) -> None:
        self._connection = connection
        self.path = path
        #: Whether a run is writing to it while it is read.
        self.live = live
        (self._format,) = connection.execute("PRAGMA user_version").fetchone()
        #: Where its files lay when it was opened for writing, and the estimates in it.
        self._whereabouts: Whereabouts | None = None
        self._tally = _Tally()
        #: Numbers of the present run's origins by estimator.
        self._origins: dict[str, int] = {}

    def experiment(self) -> str:
        """Name of the experiment."""
        return str(self.manifest()["experiment"])

    def manifest(self) -> Manifest:
        """The plan of the latest run."""
        with self._guard():
            return require_manifest(read_json(self._meta("manifest") or ""))

    def sealed(self) -> str | None:
        """Checksum of the sealed file, or None if estimates came after it."""
        return self._meta(_SEALED)

    def origins(self) -> tuple[Origin, ...]:
        """Where the stored estimates come from."""
        return gathered((estimator, origin) for _, estimator, origin in self.made())

    def made(self) -> set[tuple[str, str, Origin]]:
        """Data cells and estimators of the stored estimates, and where these come from."""
        known = self._known_origins()
        rows = self._rows(f"SELECT DISTINCT data_hash, estimator_hash, origin FROM {self._estimates}")
        return {(data, estimator, known[origin]) for data, estimator, origin in rows}

    @property
    def _estimates(self) -> str:
        return "estimates" if self._format > 1 else _WITH_RUNS

    def _known_origins(self) -> dict[int, Origin]:
        rows = self._checked("origins", "number, code_version, platform, packages")
        with self._guard():
            return {number: Origin.of(code, machine, json.loads(packages)) for number, code, machine, packages in rows}

    def sessions(self) -> list[dict[str, Any]]:
        """Every run that has written here, the oldest first."""
        names = ("session", "started", "stopped", "reason")
        rows = self._checked("sessions", "number, started, stopped, reason, info")
        with self._guard():
            return [dict(zip(names, values, strict=True)) | json.loads(info) for *values, info in rows]

    def keys(self) -> set[Key]:
        """Which estimates are stored."""
        found = {Key(*row) for row in self._rows(f"SELECT {_KEY} FROM estimates")}
        self._require_count(len(found))
        return found

    def statuses(self) -> dict[Key, str]:
        """Status of every stored estimate."""
        with self._guard():
            return {row.key: json.loads(row.result)["status"] for row in self.rows()}

    def failures(self) -> list[tuple[Key, str, int]]:
        """Every stored failure: its status, and the run that it comes from."""
        with self._guard():
            found = [(row.key, str(json.loads(row.result)["status"]), row.session) for row in self.rows()]
        return [failure for failure in found if failure[1] in FAILURES]

    def entries(self) -> dict[Key, Entry]:
        """Every stored estimate."""
        origins = self._known_origins()
        with self._guard():
            return {
                row.key: Entry(json.loads(row.result), row.seconds, row.cpu_seconds, row.session, origins[row.origin])
                for row in self.rows()
            }

    def rows(self) -> Iterator[Row]:
        """Every stored estimate, compared with its checksum; at the end, all of them with their tally."""
        tally = _Tally()
        for row in self.unchecked_rows():
            if not row.is_intact():
                raise DamageError(f"{self.path} is damaged: estimate {row.key.id} has changed since it was written")
            tally.add(row.checksum)
            yield row
        self._require_count(tally.count)
        if self._meta(_TALLY) not in (None, str(tally)):
            raise DamageError(f"{self.path} is damaged: its estimates are not those that were written")

    def unchecked_rows(self) -> Iterator[Row]:
        """Every row of the table of estimates."""
        with self._guard():
            # A file that is only read keeps its format.
            cpu = "cpu_seconds" if self._format > 2 else "NULL"
            chosen = f"{_KEY}, result, estimates.checksum, seconds, {cpu}, session, origin"
            for row in self._connection.execute(f"SELECT {chosen} FROM {self._estimates}"):
                yield Row(Key(*row[:4]), *row[4:])

    def _require_count(self, count: int) -> None:
        stored = self._meta(_TALLY)
        # Before format 4 nobody counted.
        if stored is None and self._format < _CHECKED:
            return
        written = "an unknown number of" if stored is None else stored.split()[0]
        if written != str(count):
            raise DamageError(f"{self.path} is damaged: {written} estimates were written, {count} are there")

    def check(self, *, fully: bool = False) -> None:
        """Refuse a file that SQLite finds damaged; fully, compare indices with tables too."""
        found = self._rows(f"PRAGMA {'integrity' if fully else 'quick'}_check(1)")
        if found != [("ok",)]:
            raise DamageError(f"{self.path} is damaged: {found[0][0] if found else 'no answer'}")

    def files(self) -> dict[str, set[str]]:
        """SHA-256 of everything that was ever written to the files beside the journal, by name."""
        noted: dict[str, set[str]] = {}
        for name, sha256 in self._checked("files", "name, sha256") if self._format >= _CHECKED else ():
            noted.setdefault(name, set()).add(sha256)
        return noted

    def write_beside(self, name: str, data: bytes) -> None:
        """Write a file beside the journal, if it is not there already."""
        # Noted first: whenever the run is killed, the file holds something that is known.
        with self._transaction():
            self._insert("files", name, hashlib.sha256(data).hexdigest())
        path = self.path.parent / name
        if not path.exists() or path.read_bytes() != data:
            write_file(path, data)

    def begin(self, manifest: Manifest, origins: Mapping[str, Origin], started: str, info: dict[str, Any]) -> int:
        """Note that a run begins, and where the estimates of each estimator will come from."""
        with self._transaction():
            self._replan(manifest)
            known = {origin: number for number, origin in self._known_origins().items()}
            for estimator, origin in origins.items():
                if origin not in known:
                    number = known[origin] = self._next("origins")
                    self._insert("origins", number, *_origin_row(origin))
                self._origins[estimator] = known[origin]
            session = self._next("sessions")
            self._insert("sessions", session, started, None, None, canonical_json(info))
        return session

    def replan(self, manifest: Manifest) -> None:
        """Note that the plan of the present run has changed."""
        with self._transaction():
            self._replan(manifest)

    def _replan(self, manifest: Manifest) -> None:
        # Not sorted: the order of swept fields and starts is that of the specification.
        text = json.dumps(manifest, allow_nan=False)
        if self._meta("manifest") != text:
            self._set_meta("manifest", text)
            self._connection.execute("DELETE FROM meta WHERE name = ?", (_SEALED,))

    def add(self, outcomes: Iterable[Outcome], session: int) -> None:
        """Store estimates, in place of earlier ones if there are any; when this returns, they are safe."""
        rows = []
        for key, result, seconds, cpu_seconds in outcomes:
            times = _finite(seconds), _finite(cpu_seconds)
            rows.append(Row(key, canonical_json(result), "", *times, session, self._origins[key.estimator_hash]))
        with self._transaction():
            tally = self._add(rows)
        self._tally = tally

    def restore(
        self,
        manifest: Manifest,
        origins: Mapping[int, Origin],
        sessions: Mapping[int, Sequence[Any]],
        rows: Iterable[Row],
    ) -> None:
        """Fill an empty journal with what was saved of another."""
        with self._transaction():
            self._replan(manifest)
            for number, origin in origins.items():
                self._insert("origins", number, *_origin_row(origin))
            for number, session in sessions.items():
                self._insert("sessions", number, *session)
            tally = self._add(rows)
        self._tally = tally

    def _add(self, rows: Iterable[Row]) -> _Tally:
        tally = _Tally(self._tally.count, self._tally.mark)
        for row in rows:
            checksum = row.digest()
            # What it replaces is not counted any more.
            where = " AND ".join(f"{name} = ?" for name in _KEY.split(", "))
            query = f"SELECT checksum FROM estimates WHERE {where}"
            for (earlier,) in self._connection.execute(query, row.key).fetchall():
                tally.remove(earlier)
            tally.add(checksum)
            values = (*row.key, row.result, checksum, row.seconds, row.session, row.origin, row.cpu_seconds)
            self._connection.execute("INSERT OR REPLACE INTO estimates VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", values)
        self._connection.execute("DELETE FROM meta WHERE name = ?", (_SEALED,))
        self._set_meta(_TALLY, str(tally))
        return tally

    def mark_sealed(self, checksum: str) -> None:
        """Note that the sealed file holds the present estimates of the present plan."""
        with self._transaction():
            self._set_meta(_SEALED, checksum)

    def end(self, session: int, stopped: str, reason: str) -> None:
        """Note that a run ends."""
        with self._transaction() as connection:
            query = "SELECT number, started, info FROM sessions WHERE number = ?"
            number, started, info = connection.execute(query, (session,)).fetchone()
            self._insert("sessions", number, started, stopped, reason, info)

    def require_in_place(self) -> None:
        """Refuse to go on in a file that its path does not lead to any more."""
        if self._whereabouts is not None:
            self._whereabouts.check()

    def prepare(self) -> None:
        """Check everything before anything is added, and remember where the files are."""
        self._tally = self._count() if self._format else _Tally()
        if self._format < FORMAT:
            with self._transaction():
                self._upgrade()
        self._whereabouts = Whereabouts(self.path, self.path.with_name(f"{self.path.name}-wal"))

    def _upgrade(self) -> None:
        """Bring a journal of an older format, or an empty one, to the present one."""
        execute, old = self._connection.execute, self._format
        for statement in itertools.chain(*_UPGRADES[old - 1 :]) if old else _SCHEMA:
            execute(statement)
        execute(f"PRAGMA application_id={APPLICATION}")
        execute(f"PRAGMA user_version={FORMAT}")
        self._format = FORMAT
        if old < _CHECKED:
            for table in ("meta", "origins", "sessions"):
                for *row, _ in execute(f"SELECT * FROM {table}").fetchall():
                    self._insert(table, *row)
            self._set_meta(_TALLY, str(self._tally))

    def _count(self) -> _Tally:
        tally = _Tally()
        for row in self.rows():
            tally.add(row.checksum)
        return tally

    def close(self) -> None:
        """Close the file; closing cannot lose what was acknowledged, so it does not complain."""
        with suppress(sqlite3.Error):
            self._connection.close()
        if self._whereabouts is not None:
            self._whereabouts.close()

    def _rows(self, query: str, *values: str) -> list[Any]:
        with self._guard():
            return self._connection.execute(query, values).fetchall()

    def _checked(self, table: str, columns: str, where: str = "", *values: str) -> list[Any]:
        """Rows of a table, compared with their checksums; it is read whole, so that ``columns`` are all but that."""
        if self._format < _CHECKED:
            return self._rows(f"SELECT {columns} FROM {table} {where}", *values)
        rows = self._rows(f"SELECT {columns}, checksum FROM {table} {where}", *values)
        for *row, checksum in rows:
            if row_digest(table, *row) != checksum:
                raise DamageError(f"{self.path} is damaged: {table} {row[0]!r} has changed since it was written")
        return [row for *row, _ in rows]

    def _insert(self, table: str, *row: Any) -> None:
        """Store a row and its checksum, in place of one with the same key."""
        marks = ", ".join("?" * (len(row) + 1))
        self._connection.execute(f"INSERT OR REPLACE INTO {table} VALUES ({marks})", (*row, row_digest(table, *row)))

    def _next(self, table: str) -> int:
        (number,) = self._connection.execute(f"SELECT coalesce(max(number), 0) + 1 FROM {table}").fetchone()
        return int(number)

    def _meta(self, name: str) -> str | None:
        rows = self._checked("meta", "name, value", "WHERE name = ?", name)
        return str(rows[0][1]) if rows else None

    def _set_meta(self, name: str, value: str) -> None:
        self._insert("meta", name, value)

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        # The connection commits, or rolls back what an exception has left undone.
        with self._guard(writing=True), self._connection as connection:
            connection.execute("BEGIN IMMEDIATE")
            yield connection
        self.require_in_place()

    @contextmanager
    def _guard(self, *, writing: bool = False) -> Iterator[None]:
        try:
            yield
        except _ERRORS as error:
            _refuse(self.path, error, writing=writing)


def open_journal(path: Path) -> Journal:
    """Open a journal for writing, and make it if there is none."""
    with ExitStack() as stack:
        try:
            connection = sqlite3.connect(path, isolation_level=None, timeout=0.0)
            stack.callback(connection.close)
            _set_up(connection)
            if connection.execute("SELECT 1 FROM sqlite_master LIMIT 1").fetchone():
                _format(connection, path)
            log = Journal(connection, path)
            log.prepare()
        except (OSError, *_ERRORS) as error:
            _refuse(path, error, writing=True)
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
def read_journal(path: Path, *, live: bool = False) -> Iterator[Journal | None]:
    """Open a journal for reading without touching its files, ``live`` while a run writes to it."""
    if not path.exists():
        yield None
        return
    with ExitStack() as stack:
        try:
            address = stack.enter_context(_readable(path, live=live))
            connection = sqlite3.connect(address, uri=True, isolation_level=None, timeout=_READER_PATIENCE)
            stack.callback(connection.close)
            # All that is read from here on is of one moment.
            connection.execute("BEGIN")
            planned = connection.execute("SELECT 1 FROM sqlite_master LIMIT 1").fetchone()
            if planned:
                _format(connection, path)
                planned = connection.execute("SELECT 1 FROM meta WHERE name = 'manifest'").fetchone()
                if not planned and connection.execute("SELECT 1 FROM sessions").fetchone():
                    raise DamageError(f"{path} is damaged: it holds no plan")
            log = Journal(connection, path, live=live)
        except (OSError, *_ERRORS) as error:
            _refuse(path, error)
        yield log if planned else None


@contextmanager
def _readable(path: Path, *, live: bool) -> Iterator[str]:
    """An address at which SQLite reads a journal and changes nothing.

    After a kill, acknowledged estimates stand in the write-ahead log beside the file. SQLite reads it in place if its
    index is there, however stale; else a copy is read. A file that nobody writes to and that has no log needs no locks.
    """
    log, index = (path.with_name(f"{path.name}-{end}") for end in ("wal", "shm"))
    if live or (index.exists() and log.exists()):
        yield f"{path.resolve().as_uri()}?mode=ro&readonly_shm=1"
    elif not log.exists() or not log.stat().st_size:
        yield f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    else:
        with tempfile.TemporaryDirectory(prefix="ctid-") as folder:
            copy = Path(folder) / path.name
            shutil.copyfile(path, copy)
            shutil.copyfile(log, copy.with_name(log.name))
            yield copy.as_uri()


def _refuse(path: Path, error: Exception, *, writing: bool = False) -> NoReturn:
    """Say what keeps a journal from being read or written."""
    name = getattr(error, "sqlite_errorname", "") or ""
    reason = (error.strerror if isinstance(error, OSError) else None) or error
    if writing and name not in ("SQLITE_CORRUPT", "SQLITE_NOTADB"):
        safe = "all that was reported as done is safe in it"
        raise StorageError(f"{path} could not be written ({reason}); {safe}") from error
    if isinstance(error, OSError) or name.removeprefix("SQLITE_").startswith(_HINDRANCES):
        raise StorageError(f"{path} cannot be read ({reason})") from error
    raise DamageError(f"{path} is damaged or not a journal ({error})") from error


def _format(connection: sqlite3.Connection, path: Path) -> int:
    """Format of a journal; other files, and newer formats, are refused."""
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (written_by,) = connection.execute("PRAGMA user_version").fetchone()
    if application != APPLICATION:
        raise DamageError(f"{path} is an SQLite file, but not a journal of ctid")
    refuse_newer(path, written_by, FORMAT)
    return int(written_by)


def _origin_row(origin: Origin) -> tuple[str, str, str]:
    return origin.code_version, origin.platform, canonical_json(origin.packages)


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def row_digest(table: str, *values: object) -> str:
    """Checksum of a row."""
    return _text_digest(json.dumps([table, *values], default=repr))


def _text_digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:32]
