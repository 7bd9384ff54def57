"""Live log of an experiment: an SQLite file that only the process of the run writes.

Committed estimates survive a crash of the process or machine (write-ahead log, full synchronisation). Before each
commit the path is checked: a folder that was renamed, replaced or deleted is detected. The file holds every estimate
ever computed in the folder, including those outside the latest plan, and one row per run for everything that is not a
result: times, host, command, limits, versions.

Every row carries a checksum, which is verified on every read. A damaged file is never repaired in place. Other
processes may read during a run: each sees the file as it was when reading began.
"""

import hashlib
import json
import math
import sqlite3
import uuid
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from ctid_cli.canonical import canonical_json, read_json
from ctid_cli.errors import DamageError
from ctid_cli.storage import sqlite_file
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.manifest import Key, Manifest, Outcome, Slot, planned_parts, require_manifest
from ctid_cli.written_files import write_file

#: Time that a reader waits for a readable state of the file [s].
_PATIENCE = 2.0

_KEY = "data_hash, estimator_hash, replicate, start"
_IS_KEY = " AND ".join(f"{name} = ?" for name in _KEY.split(", "))
_COLUMNS = f"{_KEY}, status, seconds, cpu_seconds, session, checksum, result"
_SCHEMA = (
    "CREATE TABLE meta (name TEXT PRIMARY KEY, value TEXT, checksum TEXT) WITHOUT ROWID",
    """CREATE TABLE sessions (
        id TEXT PRIMARY KEY, origin TEXT, started TEXT, stopped TEXT, reason TEXT, info TEXT, checksum TEXT)""",
    # In the order of a plan, in which they are read; long columns last.
    f"""CREATE TABLE estimates (
        data_hash TEXT, estimator_hash TEXT, replicate INTEGER, start TEXT,
        status TEXT, seconds REAL, cpu_seconds REAL, session TEXT, checksum TEXT, result TEXT,
        PRIMARY KEY ({_KEY})) WITHOUT ROWID""",
    f"PRAGMA application_id={sqlite_file.APPLICATION}",
    f"PRAGMA user_version={sqlite_file.FORMAT}",
)
#: Keys of notes: the plan of the latest run; the SHA-256 of runs.h5 while it is up to date with that plan; and the
#: number of estimates, so that missing ones are detected.
_MANIFEST, _EXPORTED, _COUNT = "manifest", "exported", "count"


class Row(NamedTuple):
    """A stored estimate."""

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
        """Return the row of an estimate that was just computed."""
        key, result, *times = outcome
        of_key = (key.data_hash, key.estimator_hash, key.replicate, key.start)
        seconds, cpu_seconds = (None if t is None or not math.isfinite(t) else float(t) for t in times)
        row = cls(*of_key, str(result["status"]), seconds, cpu_seconds, session, "", canonical_json(result))
        return row._replace(checksum=_digest(*row[:-2], row.result))

    @property
    def key(self) -> Key:
        """Identity of the estimate."""
        return Key(self.data_hash, self.replicate, self.estimator_hash, self.start)

    @property
    def is_intact(self) -> bool:
        """Whether the row is as it was written."""
        return self.checksum == _digest(*self[:-2], self.result)

    @property
    def content(self) -> dict[str, Any]:
        """Its result."""
        found: dict[str, Any] = json.loads(self.result)
        return found


class Session(NamedTuple):
    """A run that has written to a journal."""

    #: Unique among all runs, so that ids stay the same when journals are merged.
    id: str
    origin: Origin
    started: str
    #: None for running and killed sessions.
    stopped: str | None
    reason: str | None
    info: dict[str, Any]


class JournalReader:
    """Reading interface of an open journal."""

    def __init__(self, connection: sqlite3.Connection, path: Path, *, live: bool = False) -> None:
        self._connection = connection
        self.path = path
        #: Whether a run writes to it during reading.
        self.live = live

    def experiment(self) -> str:
        """Return the name of the experiment."""
        return str(self.manifest()["experiment"])

    def manifest(self) -> Manifest:
        """Return the plan of the latest run."""
        with self._guard():
            return require_manifest(read_json(self._meta(_MANIFEST) or ""))

    def exported(self) -> str | None:
        """Return the SHA-256 of ``runs.h5``; None if estimates or the plan have changed since."""
        return self._meta(_EXPORTED)

    def sessions(self) -> list[Session]:
        """Return all runs that wrote to this journal, the oldest first."""
        return self._sessions("ORDER BY rowid")

    def session(self, id: str) -> Session:
        """Return the run with an id."""
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
        """Return the origins of the stored estimates."""
        return self.origins_of(id for (id,) in self._rows("SELECT DISTINCT session FROM estimates"))

    def origins_of(self, sessions: Iterable[str]) -> tuple[Origin, ...]:
        """Return the origins of the estimates of some runs."""
        known = {session.id: session.origin for session in self.sessions()}
        with self._guard():
            return tuple(sorted({known[id] for id in sessions}))

    def made(self) -> set[tuple[str, Origin]]:
        """Return the data cells of the stored estimates, with their origins."""
        known = {session.id: session.origin for session in self.sessions()}
        with self._guard():
            return {(data, known[id]) for data, id in self._rows("SELECT DISTINCT data_hash, session FROM estimates")}

    def count(self) -> int:
        """Return the number of stored estimates."""
        return int(self._rows("SELECT count(*) FROM estimates")[0][0])

    def counts(self) -> Counter[tuple[str, str]]:
        """Return the number of estimates for each run and status."""
        rows = self._rows("SELECT session, status, count(*) FROM estimates GROUP BY 1, 2")
        return Counter({(session, status): count for session, status, count in rows})

    def rows(self) -> Iterator[Row]:
        """Yield every stored estimate."""
        self.require_count()
        yield from self._selected("")

    def require_count(self) -> int:
        """Return the number of stored estimates; refuse fewer than were written or than a killed run reported."""
        written, there = int(self._meta(_COUNT) or 0), self.count()
        # A live run may report more estimates than existed when reading began.
        written = written if self.live else max(written, sqlite_file.reported(self.path.parent))
        if written != there:
            raise DamageError(f"{self.path} is damaged: {written} estimates were written, {there} are there")
        return there

    def planned_rows(self, manifest: Manifest) -> Iterator[tuple[Slot, Row]]:
        """Yield the stored estimates of a plan, in its order."""
        for estimator, cell, replicates in planned_parts(manifest):
            for row in self.rows_of(estimator, cell, replicates):
                yield Slot(row.key, cell, estimator), row

    def rows_of(
        self, estimator: Mapping[str, Any], cell: Mapping[str, Any], replicates: Sequence[int]
    ) -> Iterator[Row]:
        """Yield the stored estimates of a planned estimator on some data sets of a data cell, in order."""
        order = {start: number for number, start in enumerate(estimator["starts"])}
        wanted = replicates if isinstance(replicates, range) else frozenset(replicates)
        found = self._selected("WHERE data_hash = ? AND estimator_hash = ?", cell["hash"], estimator["hash"])
        for replicate, rows in groupby(found, key=lambda row: row.replicate):
            if replicate in wanted:
                yield from sorted((row for row in rows if row.start in order), key=lambda row: order[row.start])

    def row(self, key: Key) -> Row | None:
        """Return a stored estimate."""
        of_key = (key.data_hash, key.estimator_hash, key.replicate, key.start)
        return next(self._selected(f"WHERE {_IS_KEY}", *of_key), None)

    def times(
        self, data_hash: str, estimator_hash: str, first: int, last: int
    ) -> dict[tuple[int, str], tuple[float | None, float | None]]:
        """Return times of the estimates of an estimator on data sets of a cell, the last included [s], by key."""
        where = "WHERE data_hash = ? AND estimator_hash = ? AND replicate BETWEEN ? AND ?"
        rows = self._selected(where, data_hash, estimator_hash, first, last)
        return {(row.replicate, row.start): (row.seconds, row.cpu_seconds) for row in rows}

    def check(self, *, fully: bool = False) -> None:
        """Refuse a file that SQLite reports as damaged; a full check compares indices with tables too."""
        found = self._rows(f"PRAGMA {'integrity' if fully else 'quick'}_check(1)")
        if found != [("ok",)]:
            raise DamageError(f"{self.path} is damaged: {found[0][0] if found else 'SQLite says nothing of it'}")
        self.require_count()

    def _selected(self, where: str, *values: Any) -> Iterator[Row]:
        """Yield selected estimates after verifying their checksums."""
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
        """Return rows of a table after verifying their checksums; ``names`` are all other columns."""
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
        except sqlite_file.ERRORS as error:
            sqlite_file.refuse(self.path, error, writing=writing)


class Journal(JournalReader):
    """A journal open for writing."""

    def __init__(self, connection: sqlite3.Connection, path: Path) -> None:
        super().__init__(connection, path)
        #: Identity of its folder and files when it was opened; empty until its tables exist.
        self.places: dict[Path, tuple[int, int] | None] = {}

    def write_spec(self, data: bytes) -> None:
        """Write the specification next to the journal, unless it is already there."""
        path = self.path.with_name(sqlite_file.SPEC)
        if not path.exists() or path.read_bytes() != data:
            write_file(path, data)

    def begin(self, manifest: Manifest, origin: Origin, started: str, info: dict[str, Any]) -> str:
        """Record the start of a run, and the origin of its estimates."""
        with self.transaction():
            self.note_plan(manifest)
            return self.note_session(Session(new_id(), origin, started, None, None, info))

    def note_session(self, session: Session) -> str:
        """Record a run and return its id; must be called inside a transaction."""
        id, origin, *times, info = session
        self._insert("sessions", id, canonical_json(origin._asdict()), *times, canonical_json(info))
        return id

    def replan(self, manifest: Manifest) -> None:
        """Record a changed plan of the current run."""
        with self.transaction():
            self.note_plan(manifest)

    def note_plan(self, manifest: Manifest) -> None:
        """Record the latest plan; must be called inside a transaction."""
        # Not sorted: swept fields and starts keep the order of the specification.
        text = json.dumps(manifest, allow_nan=False)
        if self._meta(_MANIFEST) != text:
            self._insert("meta", _MANIFEST, text)
            self._connection.execute("DELETE FROM meta WHERE name = ?", (_EXPORTED,))

    def add(self, outcomes: Iterable[Outcome], session: str) -> None:
        """Store estimates, replacing earlier ones; they are durable when this returns."""
        with self.transaction():
            self.add_rows(Row.of(outcome, session) for outcome in outcomes)

    def add_rows(self, rows: Iterable[Row]) -> None:
        """Store rows, replacing earlier ones; must be called inside a transaction."""
        execute, marks, new = self._connection.execute, ", ".join("?" * len(Row._fields)), 0
        for row in rows:
            new += execute(f"SELECT 1 FROM estimates WHERE {_IS_KEY}", row[:4]).fetchone() is None
            execute(f"INSERT OR REPLACE INTO estimates ({_COLUMNS}) VALUES ({marks})", row)
        execute("DELETE FROM meta WHERE name = ?", (_EXPORTED,))
        self._insert("meta", _COUNT, str(int(self._meta(_COUNT) or 0) + new))

    def note_export(self, sha256: str) -> None:
        """Record that ``runs.h5`` holds the current estimates of the current plan."""
        with self.transaction():
            self._insert("meta", _EXPORTED, sha256)

    def end(self, session: str, stopped: str, reason: str) -> None:
        """Record the end of a run."""
        with self.transaction():
            self.note_session(self.session(session)._replace(stopped=stopped, reason=reason))

    def require_in_place(self) -> None:
        """Refuse to continue if the path no longer leads to the open file."""
        sqlite_file.require_places(self.places)

    def close(self) -> None:
        """Close the file; errors are ignored because committed data cannot be lost."""
        with suppress(sqlite3.Error):
            self._connection.close()

    def _insert(self, table: str, *row: Any) -> None:
        """Store a row and its checksum, replacing a row with the same key."""
        marks = ", ".join("?" * (len(row) + 1))
        self._connection.execute(f"INSERT OR REPLACE INTO {table} VALUES ({marks})", (*row, _digest(table, *row)))

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Commit the enclosed changes, or roll them back if an exception occurs."""
        # The connection commits, or rolls back after an exception.
        with self._guard(writing=True), self._connection as connection:
            connection.execute("BEGIN IMMEDIATE")
            yield
        self.require_in_place()


def open_journal(path: Path) -> Journal:
    """Open a journal for writing; create it if it does not exist."""
    sqlite_file.require_whole(path)
    with ExitStack() as stack:
        try:
            connection = sqlite3.connect(path, isolation_level=None, timeout=0.0)
            stack.callback(connection.close)
            sqlite_file.set_up(connection)
            log = Journal(connection, path)
            if connection.execute("SELECT 1 FROM sqlite_master LIMIT 1").fetchone():
                sqlite_file.require_journal(connection, path)
                log.check()
            else:
                sqlite_file.require_whole(path, planned=False)
                with log.transaction():
                    for statement in _SCHEMA:
                        connection.execute(statement)
            log.places = sqlite_file.places_of(path)
        except (OSError, *sqlite_file.ERRORS) as error:
            sqlite_file.refuse(path, error, writing=True)
        stack.pop_all()
        return log


@contextmanager
def read_journal(path: Path, *, live: bool = False) -> Iterator[JournalReader | None]:
    """Open a journal for reading without changing its files; ``live`` during a run."""
    if not path.exists():
        yield None
        return
    sqlite_file.require_whole(path)
    with ExitStack() as stack:
        try:
            address = stack.enter_context(sqlite_file.readable(path, live=live))
            connection = sqlite3.connect(address, uri=True, isolation_level=None, timeout=_PATIENCE)
            stack.callback(connection.close)
            # All following reads see one consistent state.
            connection.execute("BEGIN")
            planned = connection.execute("SELECT 1 FROM sqlite_master LIMIT 1").fetchone()
            if planned:
                sqlite_file.require_journal(connection, path)
                planned = connection.execute("SELECT 1 FROM meta WHERE name = ?", (_MANIFEST,)).fetchone()
                if not planned and connection.execute("SELECT 1 FROM sessions").fetchone():
                    raise DamageError(f"{path} is damaged: it holds no plan")
            log = JournalReader(connection, path, live=live)
        except (OSError, *sqlite_file.ERRORS) as error:
            sqlite_file.refuse(path, error)
        sqlite_file.require_whole(path, planned=bool(planned), live=live)
        yield log if planned else None


def new_id() -> str:
    """Return a unique id of a run."""
    return uuid.uuid4().hex[:16]


def _digest(*values: Any) -> str:
    """Return the checksum of a row."""
    return hashlib.sha256(repr(values).encode("utf-8", "surrogatepass")).hexdigest()[:32]
